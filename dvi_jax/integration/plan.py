"""The steps of a run in blocks with a save after each."""

from typing import Any, NamedTuple

from jaxtyping import Array

from lanewise import Layout
from lanewise.jaxprs.jaxapi import batch_size
from lanewise.primitive import generates

from ..base.machine import results_memory
from ..observe.solution import Save


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


def adds_start_outside(plan: Plan) -> bool:
    """Whether the start is added to the saved states after the compiled run, not in it."""
    # Among few states the start is a large fraction, which need not be written for a user who reads
    # the last state only. Among many it is a small fraction, and adding it later copies them all.
    return plan.num_blocks <= 4


def check_memory(
    save: Save, plan: Plan, q0: Array, beside: int, leaves: list[Any], layout: Layout
) -> None:
    """**Raises** `ValueError` for results that no memory can hold; `beside`: bytes of observables
    at a save point."""
    memory = results_memory()
    saved = plan.num_blocks + 1 + plan.save_tail if save.ts is None else save.ts.shape[0]
    each = (2 * q0.size + 2) * q0.dtype.itemsize + beside  # q, p, t and h
    count, is_compiled = batch_size(leaves)
    if memory is None or count * saved * each <= memory:
        return
    # XLA does not compute results that the function around this one does not use.
    if is_compiled and (layout.form == "arrays" or not generates()):
        return
    batch = f" of each of {count} trajectories" if count > 1 else ""
    disk = ", run fewer trajectories at once, or write results to disk with dvi.sweep(store=...)"
    raise ValueError(
        f"the results need {count * saved * each / 2**30:.3g} GiB of memory ({saved} saved "
        f"state{'s' * (saved > 1)}{batch}), but only {memory / 2**30:.3g} GiB are available. Save "
        "fewer states with save=dvi.Save(every=m), dvi.Save(final=True) or dvi.Save(ts=times)"
        f"{disk * (count > 1)}. A reduction such as dvi.MaxDrift(function) observes every step in "
        "constant memory."
    )
