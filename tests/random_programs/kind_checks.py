"""Checks of the runs of `kinds` and `library`, and the search for numbers with which one fails.

python tests/random_programs/kind_checks.py [--count 1000] [--seed S] [--kinds stop noise …]

A seed is a random structure with `PER_STRUCTURE` sets of random numbers. The exit status is 1 if
anything has failed.
"""

import collections
import functools
import os
import sys
import time
from pathlib import Path
from typing import Any

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))
    import compilation

    compilation.set_flags()

import jax
import jax.numpy as jnp
import numpy as np

from random_programs import kinds
from random_programs.kinds import Kind, Numbers
from random_programs.library import library
from random_programs.search import arguments

KINDS = (*kinds.KINDS, library)
"""The functions that draw a structure; the structures of a search take them by turns."""

LANES = 6
"""Trajectories of a batch; the last one is invalid."""

PER_STRUCTURE = 50
"""Sets of random numbers for each structure."""


def rows(values: Numbers) -> Numbers:
    """The results that are numbers, without the status."""
    return {name: x for name, x in values.items() if name not in ("status", "stopped")}


def loss(values: Numbers, xp: Any) -> Any:
    """A sum with fixed weights of the finite results of a trajectory that has not failed."""
    total = xp.zeros(())
    for name, x in sorted(rows(values).items()):
        x = xp.asarray(x)
        if x.dtype.kind == "f" and name not in ("drift", "last"):
            x = x.reshape(-1)
            weights = np.cos(1.0 + np.arange(x.size))
            total = total + xp.sum(weights * xp.where(xp.isfinite(x), x, 0.0))
    return xp.where(values["status"] | values["stopped"], total, 0.0)


def stacked(numbers: list[Numbers]) -> Numbers:
    return jax.tree.map(lambda *xs: np.stack(xs), *numbers)


class Compiled:
    """The programs of a structure, each compiled once."""

    def __init__(self, kind: Kind):
        self.kind = kind
        self.batch = jax.jit(jax.vmap(kind.run))
        self.one = jax.jit(kind.run)

    @functools.cached_property
    def arrays(self):
        one = functools.partial(self.kind.run, form="arrays")
        options = {"xla_backend_optimization_level": 0}
        return jax.jit(lambda s: jax.lax.map(one, s), compiler_options=options)

    def _total(self, shared: Numbers, own: Numbers, fixed: Numbers) -> Any:
        """The sum of the losses of a batch in which all trajectories share some numbers."""
        values = jax.vmap(lambda own: self.kind.run({**fixed, **own, **shared}))(own)
        return jnp.sum(jax.vmap(lambda values: loss(values, jnp))(values))

    @functools.cached_property
    def reverse(self):
        def slopes(shared, own):
            moving = {name: own[name] for name in self.kind.own}
            of_all = lambda shared, moving: self._total(shared, {**own, **moving}, {})  # noqa: E731
            return jax.value_and_grad(of_all, (0, 1))(shared, moving)

        return jax.jit(slopes)

    @functools.cached_property
    def forward(self):
        def slope(shared, own, directions):
            moving = {name: own[name] for name in self.kind.own}
            of_all = lambda shared, moving: self._total(shared, {**own, **moving}, {})  # noqa: E731
            return jax.jvp(of_all, (shared, moving), directions)[1]

        return jax.jit(slope)

    def check_empty(self) -> None:
        """A batch of no trajectory."""
        numbers = stacked([self.kind.draw(np.random.default_rng(0))] * 2)
        expected = self.batch(numbers)
        empty = jax.vmap(self.kind.run)(jax.tree.map(lambda x: x[:0], numbers))
        for name, x in empty.items():
            assert x.shape == (0, *expected[name].shape[1:]), f"a batch of 0: {name} {x.shape}"

    def check(self, seed: int, slopes: bool = True) -> str:
        """One set of random numbers, and derivatives by them. **Raises** `AssertionError`."""
        random, kind = np.random.default_rng(seed), self.kind
        lanes = [kind.draw(random) for _ in range(LANES)]
        spoil = kind.invalid[random.integers(len(kind.invalid))]
        results = jax.tree.map(np.asarray, self.batch(stacked([*lanes[:-1], spoil(lanes[-1])])))
        self._check_numbers(results, lanes[:-1])
        assert not results["status"][-1], f"successful: {spoil(lanes[-1])}"
        # The invalid one changes no bit of the others, nor does the place, nor the batch.
        valid = jax.tree.map(np.asarray, self.batch(stacked(lanes[::-1])))
        alone = jax.tree.map(np.asarray, self.one(lanes[0]))
        for name, x in results.items():
            np.testing.assert_array_equal(x[:-1], valid[name][:0:-1], f"bits of {name}")
            np.testing.assert_array_equal(x[0], alone[name], f"bits of {name} alone")
        if kind.has_arrays:
            arrays = jax.tree.map(np.asarray, self.arrays(stacked([*lanes[:-1], spoil(lanes[-1])])))
            self._check_numbers(arrays, lanes[:-1])
            np.testing.assert_array_equal(arrays["status"], results["status"], "status")
        return self._check_slopes(lanes, spoil, random) if slopes else "numbers"

    def _check_numbers(self, results: Numbers, lanes: list[Numbers]) -> None:
        for i, numbers in enumerate(lanes):
            expected = self.kind.loop(numbers)
            size = max(np.max(np.abs(x), where=np.isfinite(x), initial=0)
                       for x in map(np.asarray, rows(expected).values()))  # fmt: skip
            for name, x in expected.items():
                # A drift of pairs is far below the size of the states.
                allowed = (
                    1e-9 * np.abs(x) + 1e-28 if name == "drift" else self.kind.tolerance * size
                )
                np.testing.assert_allclose(
                    results[name][i], x, rtol=0, atol=float(allowed), err_msg=f"{name} of {i}"
                )

    def _check_slopes(self, lanes: list[Numbers], spoil: Any, random: Any) -> str:
        kind = self.kind
        shared = {name: lanes[0][name] for name in kind.shared}
        lanes = [{**numbers, **shared} for numbers in lanes]
        spoiled = spoil(lanes[-1])
        is_own = all(np.array_equal(spoiled[x], shared[x]) for x in shared)  # NaN is not equal
        own = [{n: x for n, x in numbers.items() if n not in shared}
               for numbers in [*lanes[:-1], spoiled if is_own else lanes[-1]]]  # fmt: skip
        counted = lanes[:-1] if is_own else lanes
        ways = {n: random.uniform(-1, 1, np.shape(x)) * np.abs(x) for n, x in shared.items()}
        moves = [{n: random.uniform(-1, 1, np.shape(lane[n])) * np.abs(lane[n]) for n in kind.own}
                 for lane in lanes]  # fmt: skip
        if is_own:  # an invalid trajectory does not move
            moves[-1] = jax.tree.map(np.zeros_like, moves[-1])

        def total(d):
            values = [
                kind.loop({
                    **lane,
                    **{n: lane[n] + d * ways[n] for n in ways},
                    **{n: lane[n] + d * way[n] for n in way},
                })
                for lane, way in zip(counted, moves, strict=False)
            ]  # fmt: skip
            pattern = [np.isfinite(np.ravel(x)) for value in values for x in rows(value).values()]
            return sum(loss(x, np) for x in values), np.concatenate(pattern)

        deltas = 3e-5, 1e-5
        pairs = [(total(d), total(-d)) for d in deltas]
        patterns = [pattern for pair in pairs for _, pattern in pair]
        if any((pattern != patterns[0]).any() for pattern in patterns):
            return "no slopes: a trajectory ends in another step"
        coarse, fine = ((a[0] - b[0]) / (2 * d) for (a, b), d in zip(pairs, deltas, strict=True))
        own = stacked(own)
        moving = stacked(moves) if kind.own else {}
        value, (of_shared, of_own) = self.reverse(shared, own)
        expected = total(0.0)[0]
        assert abs(value - expected) <= 1e-7 * (1 + abs(expected)), f"loss {value}, {expected}"
        pieces = [
            *((of_shared[n], ways[n]) for n in ways),
            *((of_own[n], moving[n]) for n in moving),
        ]
        reverse = sum(np.sum(a * b) for a, b in pieces)
        forward = self.forward(shared, own, (ways, moving))
        size = sum(np.sum(np.abs(a * b)) for a, b in pieces)
        np.testing.assert_allclose(reverse, forward, rtol=0, atol=1e-9 * size, err_msg="reverse")
        allowed = 10 * np.abs(coarse - fine) + 1e-7 * size
        assert abs(forward - fine) <= allowed, f"slope {forward}, differences {coarse}, {fine}"
        return "numbers and slopes"


def structure(seed: int, names: Any = None) -> Compiled:
    """The random structure with this number; the kinds follow by turns."""
    chosen = [kind for kind in KINDS if not names or kind.__name__ in names]
    return Compiled(chosen[seed % len(chosen)](np.random.default_rng(seed)))


def search(count: int, seed: int, names: Any) -> int:
    began, counted, failures = time.monotonic(), collections.Counter(), 0
    for first in range(0, count, PER_STRUCTURE):
        number = seed + first // PER_STRUCTURE
        compiled, before, failed = structure(number, names), time.monotonic(), 0
        kind = compiled.kind.text.split(":")[0]
        for i in range(-1, PER_STRUCTURE):
            try:
                if i < 0:
                    compiled.check_empty()
                else:
                    counted[kind, compiled.check(PER_STRUCTURE * number + i)] += 1
            except Exception as error:
                failed += 1
                counted[kind, "failed"] += 1
                words = f"{type(error).__name__}: {' '.join(str(error).split())[:400]}"
                if failed == 1:  # others of a structure mostly have the same cause
                    print(f"failure: structure {number}, numbers {PER_STRUCTURE * number + i}\n"
                          f"  {compiled.kind.text}\n  {words}", flush=True)  # fmt: skip
        failures += failed
        spent = time.monotonic() - began
        print(f"{first + PER_STRUCTURE} programs, {failures} failures, {spent:.0f} s "
              f"({time.monotonic() - before:.0f} s: {compiled.kind.text})", flush=True)  # fmt: skip
        jax.clear_caches()
    for (kind, what), number in sorted(counted.items()):
        print(f"{number:6} {kind}: {what}")
    return 1 if failures else 0


def main() -> int:
    parser = arguments("Search for random runs that fail.", 1000)
    parser.add_argument("--kinds", nargs="*", choices=[kind.__name__ for kind in KINDS])
    given = parser.parse_args()
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    jax.config.update("jax_enable_x64", True)
    return search(given.count, given.seed, given.kinds)


if __name__ == "__main__":
    sys.exit(main())
