"""The steps of a run in blocks with a save after each."""

from typing import NamedTuple

from ._solution import Save


class Plan(NamedTuple):
    """Steps as blocks of `block` steps with a save after each, then a tail. Static."""

    num_blocks: int
    block: int
    tail: int
    save_tail: bool

    @property
    def num_steps(self) -> int:
        return self.num_blocks * self.block + self.tail


def make_plan(save: Save, num_steps: int) -> Plan:
    every = save.every
    if every is None:
        # Without `every` a run that saves its end only is one block. A block has at least one step.
        keeps_end_alone = save.final or save.ts is not None
        every = max(num_steps, 1) if keeps_end_alone else 1
    num_blocks, tail = divmod(num_steps, every)
    return Plan(num_blocks, every, tail, save.final and tail > 0)


def piece_length(count: int, every: int) -> int:
    """The length, about `every`, of the pieces of `count` steps."""
    # A divisor of `count`, if there is one near: with pieces of one length one loop is compiled.
    lengths = range(min(3 * every // 2, count), every // 2, -1)
    return next((n for n in lengths if count % n == 0), every)
