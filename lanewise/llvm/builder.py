"""A builder of LLVM IR: operations, loops and branches for one block of trajectories."""

from collections.abc import Callable, Sequence

from .arithmetic import Operations
from .ir import Num


class Builder(Operations):
    """The body of one function."""

    def any_lane(self, a: Num) -> str:
        """Whether a truth value is true on a trajectory of the block, as a scalar i1."""
        if not a.vec:
            return self.ref(a, 0, False)
        # The sum over the vectors is NaN if one of them is, so that one comparison is enough.
        if a.op == "not" and a.args[0].op == "finite":  # one comparison for the block
            (zero,) = a.args[0].args
            kind, total = self.type(zero.dtype, True), zero.names[0]
            for other in zero.names[1:]:
                total = self.new(f"fadd {kind} {total}, {other}")
            bits = self.new(f"fcmp uno {kind} {total}, {total}")
            a = self.number([bits], "bool", True)
        kind = self.type("bool", True)
        total = a.names[0]
        for other in a.names[1:]:
            total = self.new(f"or {kind} {total}, {other}")
        if self.W == 1:
            return total
        # A mask as an integer compiles to one test of a register; a reduction by `or` does not.
        bits = self.new(f"bitcast {kind} {total} to i{self.W}")
        return self.new(f"icmp ne i{self.W} {bits}, 0")

    def loop(
        self,
        carry: Sequence[Num],
        vec: Sequence[bool],
        test: Callable[[list[Num], str], str],
        body: Callable[[list[Num], str], list[Num]],
        count: bool = False,
        carried_over: Callable[..., list[tuple[Num, Num]]] | None = None,
    ) -> list[Num]:
        """The carry once ``test(carry, i)``, the name of an i1, is false; `i` counts if `count`.

        `carried_over(carry before a round, carry after it, numbers of the round)` finds pairs
        (x, y) where y is what x will be in the next round; x is then not computed but carried.
        """
        start = [self.refs(number, wide) for number, wide in zip(carry, vec, strict=True)]
        # The preheader is the end of the block from which the loop is entered.
        entered_from, preheader = self.block, self.reserve()
        # head: phis and the test; inner: a round, which goes back to head; end: after the last
        # round.
        head, inner, end = self.label(), self.label(), self.label()
        self.emit(f"br label %{head}")
        first_block = len(self.blocks)
        self.begin(head)
        phis, phi_section = [], self.reserve()
        self.loops += 1
        for number, wide in zip(carry, vec, strict=True):
            names = [self.name() for _ in range(self.U if wide else 1)]
            phis.append(self.number(names, number.dtype, wide))
        counter = self.name() if count else ""
        self.scopes.append({})
        goes_on = test(phis, counter)
        self.emit(f"br i1 {goes_on}, label %{inner}, label %{end}")
        self.begin(inner)
        next_carry = body(phis, counter)
        # `vec` comes from the dependence of the jaxpr. A number that varies in a scalar would lose
        # the values of all trajectories but one.
        assert all(wide or not a.vec for a, wide in zip(next_carry, vec, strict=True))
        next_names = [self.refs(a, wide) for a, wide in zip(next_carry, vec, strict=True)]
        next_counter = self.new(f"add nuw nsw i64 {counter}, 1") if count else ""
        scope = self.scopes.pop()
        self.loops -= 1
        left_from = self.block
        self.emit(f"br label %{head}")

        # The value of a number after a round is known only now.
        def write_phi(name: str, kind: str, old: str, new: str) -> None:
            text = f"phi {kind} [{old}, %{entered_from}], [{new}, %{left_from}]"
            phi_section.append((name, text))

        for phi, olds, news, wide in zip(phis, start, next_names, vec, strict=True):
            for name, old, new in zip(phi.names, olds, news, strict=True):
                write_phi(name, self.type(phi.dtype, wide), old, new)
        if count:
            write_phi(counter, "i64", "0", next_counter)
        if carried_over is not None:
            # The number of the first round is computed before the loop, from the numbers that enter
            # it.
            entering = {
                phi.serial: self.number(old, phi.dtype, wide)
                for phi, old, wide in zip(phis, start, vec, strict=True)
            }
            numbers = [x for x in scope.values() if isinstance(x, Num)]
            pairs = carried_over(phis, next_carry, numbers)
            with self.writing(preheader):
                firsts = [self.refs(self.recompute(x, entering), True) for x, _ in pairs]
            for (x, y), olds in zip(pairs, firsts, strict=True):
                for name, old, new in zip(x.names, olds, y.names, strict=True):
                    self.remove(name, first_block)
                    write_phi(name, self.type(x.dtype, True), old, new)
        self.begin(end)
        return phis

    def repeat(self, end: str | int, body: Callable[[str], object]) -> None:
        """``body(i)`` for i = 0, …, end − 1; `i` is the name of an i64."""

        def run(_, i: str) -> list[Num]:
            body(i)
            return []

        self.loop([], [], lambda _, i: self.new(f"icmp slt i64 {i}, {end}"), run, count=True)

    def loop_below(self, stop: Num, carry: Sequence[Num], vec, body, **options) -> list[Num]:
        """The carry after a loop that goes on while its first number, a scalar, is below `stop`."""

        def test(state: list[Num], _) -> str:
            return self.ref(self.compare("lt", state[0], stop), 0, False)

        return self.loop(carry, vec, test, lambda state, _: body(*state), **options)

    def recompute(self, x: Num, substitutes: dict[int, Num]) -> Num:
        """The number x with other numbers in place of some that it is made of."""
        first = next(iter(substitutes))  # numbers before it do not depend on any of them
        open_, needed = [x], dict[int, Num]()
        while open_:
            y = open_.pop()
            if y.serial > first and not (y.serial in substitutes or y.serial in needed):
                needed[y.serial] = y
                open_ += y.args
        for serial, y in sorted(needed.items()):  # operands first
            args = [substitutes.get(a.serial, a) for a in y.args]
            # A closed-off number is a name for another one and has no instruction of its own.
            assert y.write is not None or y.op == "same"
            substitutes[serial] = self.op(y.op, args, y.dtype, y.write) if y.write else args[0]
        return substitutes.get(x.serial, x)

    def branch(
        self,
        condition: str,
        yes: Callable[[], list[Num]],
        no: Callable[[], list[Num]],
        vec: Sequence[bool],
        dtypes: Sequence[str],
    ) -> list[Num]:
        """The numbers of one branch or of the other; only that one is run."""
        labels, end = (self.label(), self.label()), self.label()
        self.emit(f"br i1 {condition}, label %{labels[0]}, label %{labels[1]}")
        ends, names = [], []
        for label, run in zip(labels, (yes, no), strict=True):
            self.begin(label)
            self.scopes.append({})
            names.append([self.refs(x, wide) for x, wide in zip(run(), vec, strict=True)])
            self.scopes.pop()
            # A branch may contain loops and branches: it ends in another block than it began with.
            ends.append(self.block)
            self.emit(f"br label %{end}")
        self.begin(end)
        results = []
        for wide, dtype, *pairs in zip(vec, dtypes, *names, strict=True):
            kind = self.type(dtype, wide)
            phis = [
                self.new(f"phi {kind} [{a}, %{ends[0]}], [{b}, %{ends[1]}]")
                for a, b in zip(*pairs, strict=True)
            ]
            results.append(self.number(phis, dtype, wide))
        return results
