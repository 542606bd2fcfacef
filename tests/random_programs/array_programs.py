"""Random programs of arrays: loops over time whose bodies are drawn from `operations.py`."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from random_programs.operations import FAMILIES, LARGEST, fit
from random_programs.reference import evaluate

SMOOTH = ("moves", "numbers", "choices", "reductions", "products", "indices", "calls")
ORDINARY = dict.fromkeys(("moves", "numbers"), 3) | dict.fromkeys(("choices", "reductions"), 1)

KINDS: dict[str, dict[str, int]] = {
    "moves": {"moves": 6, "numbers": 3},
    "in place": {"moves": 3, "numbers": 3, "choices": 1},
    "reductions": {"reductions": 5, "moves": 2, "numbers": 2},
    "products": {"products": 4, **ORDINARY},
    "pairs": {"pairs": 3, **ORDINARY},
    "cumulative": {"cumulative": 4, **ORDINARY},
    "indices": {"indices": 5, **ORDINARY},
    "types": {"types": 5, **ORDINARY},
    "branches": {"branches": 4, **ORDINARY},
    "derivatives": {"derivatives": 2, "choices": 1, "reductions": 1, **ORDINARY},
    "loops": {"branches": 1, **ORDINARY},
    "everything": {**dict.fromkeys([*FAMILIES, "branches", "derivatives"], 1), "moves": 3},
    "large": {"pairs": 1, "products": 1, "branches": 1, "derivatives": 1, **ORDINARY},
}
"""The weights of the families of operations in the bodies of each kind."""

SMALL_KINDS = [kind for kind in KINDS if kind != "large"]
"""Without arrays of thousands of elements, which take minutes to compile number by number."""

FORMS = {
    "in place": ["scan", "fori", "while", "rows"],
    "derivatives": ["scan", "fori", "rows", "nested"],
    "loops": ["while", "until", "nested", "every second", "rows", "reversed", "two"],
}
ALL_FORMS = ["scan", "scan", "fori", "while", "rows", "reversed", "nested", "until", "two"]
UPDATES = {
    "kick": lambda old, last, latest, other: old + 0.1 * jnp.sin(last),
    "replace": lambda old, last, latest, other: jnp.tanh(last),
    "unchanged": lambda old, last, latest, other: old,
    "drift": lambda old, last, latest, other: old + 0.1 * latest,
    "shifted": lambda old, last, latest, other: (
        0.5 * jnp.roll(old, 1) + 0.3 * jnp.roll(latest, -1) * old
    ),
    "other": lambda old, last, latest, other: 0.6 * jnp.roll(other, 1, 0) - 0.3 * jnp.flip(old),
}
"""The new value of a carry, of its old one, the last values of the step, the new value of the carry
before, and the old value of another one."""

LENGTHS = [5, 8, 16, 31, 47, 50, 62, 63, 64, 65, 100, 130, 200]
MATRICES = [(7, 9), (12, 17), (3, 65), (63, 4), (16, 16), (20, 3), (49, 2)]
BLOCKS = [(3, 5, 7), (4, 4, 9), (9, 2, 8), (5, 6, 3)]
LARGE = [(3000,), (4097,), (64, 65), (3, 1000), (700, 3), (16, 17, 9)]


@dataclasses.dataclass(frozen=True)
class Move:
    """One operation of a plan; the numbers choose operands and variants (see operations.py)."""

    place: int
    family: str
    name: str
    numbers: tuple[int, ...]
    plans: tuple[tuple["Move", ...], ...] = ()


class Program:
    """A random program of a seed and a kind; operations at the places `removed` do nothing."""

    def __init__(self, seed: int, kind: str, removed: frozenset[int] = frozenset()):
        self.seed, self.kind, self.removed, self.count = seed, kind, removed, 0
        self.rng = rng = np.random.default_rng([seed, list(KINDS).index(kind)])
        self.length = int(rng.integers(2, 6))
        self.form = self._choice(FORMS.get(kind, ALL_FORMS))
        self.before = self._plan(int(rng.integers(0, 3)))
        self.body = self._plan(int(rng.integers(3, 10)))
        self.after = self._plan(int(rng.integers(0, 3)))
        self.updates = [self._choice(list(UPDATES)) for _ in range(3)]
        self.exchange = self._choice(["no", "no", "swap", "copy"])
        self.saves = [self._choice(["nothing", "state", "sum", "value"]) for _ in range(2)]
        self.picks = [int(x) for x in rng.integers(10**6, size=8)]
        self.whole = self._choice(["value", "grad", "jvp"] if kind == "derivatives" else ["value"])
        shape = self._choice([self._choice(LENGTHS)] * 3 + ["matrix", "block"])
        table = {"matrix": MATRICES, "block": BLOCKS}
        self.shape = (shape,) if isinstance(shape, int) else self._choice(table[shape])
        if kind == "large":
            self.shape = self._choice(LARGE)
        self.other = self._choice([self.shape, (self._choice(LENGTHS),), self._choice(MATRICES)])
        single = kind == "types" and rng.random() < 0.4
        self.dtype = "float32" if single else "float64"
        self.batch = self._choice([None] * 5 + [1, 3, 3, 3, 8])
        self.bits = rng.random() < 0.4
        self.inputs = self._inputs()

    def _choice(self, items: Any) -> Any:
        return items[int(self.rng.integers(len(items)))]

    def _plan(self, count: int, weights: dict[str, int] | None = None) -> tuple[Move, ...]:
        weights = weights or KINDS[self.kind]
        families = [family for family, weight in weights.items() for _ in range(weight)]
        return tuple(self._move(self._choice(families)) for _ in range(count))

    def _move(self, family: str) -> Move:
        place, self.count = self.count, self.count + 1
        numbers = tuple(int(x) for x in self.rng.integers(10**6, size=6))
        inner = dict.fromkeys(SMOOTH, 1) | {"moves": 3, "numbers": 3}
        table = {"branches": BRANCHES, "derivatives": DERIVATIVES}.get(family)
        if table is None:
            return Move(place, family, self._choice(list(FAMILIES[family])), numbers)
        plans = tuple(self._plan(int(self.rng.integers(1, 4)), inner) for _ in range(3))
        return Move(place, family, self._choice(list(table)), numbers, plans)

    def _inputs(self) -> list[np.ndarray]:
        """The operands, with the batch in front; one trajectory of some has a NaN."""
        lanes = self.batch or 1
        shapes = [self.shape, self.shape, self.other, (self.length, *self.shape)]
        arrays = [self.rng.uniform(-1, 1, (lanes, *s)).astype(self.dtype) for s in shapes]
        if self.rng.random() < (0.5 if lanes > 2 else 0.1):
            lane, which = lanes // 2, int(self.rng.integers(3))
            flat = arrays[which][lane].reshape(-1)
            flat[:: 1 if self.rng.random() < 0.3 else flat.size] = np.nan
        start = self.rng.integers(0, 7, lanes).astype(np.int32)
        arrays = [*arrays, start]
        return arrays if self.batch else [x[0] for x in arrays]

    # The program as a function

    def values(self, plan: tuple[Move, ...], pool: list[Any], i: Any) -> list[Any]:
        """The pool with the result of each operation of a plan."""
        pool = list(pool)
        for move in plan:
            recent, a, b, k, m, n = move.numbers
            # The newest value more often, so that programs are deep and little of them is unused.
            u = pool[-1 if recent % 3 else a % len(pool)]
            u = fit(u, (3,)) if u.ndim == 0 else u
            v = fit(pool[b % len(pool)], u.shape)
            table = {"branches": BRANCHES, "derivatives": DERIVATIVES}.get(move.family)
            if move.place in self.removed:
                out = u
            elif table is None:
                out = FAMILIES[move.family][move.name](u, v, k, m, n, i)
            else:
                run = functools.partial(self.inner, i=i)
                out = table[move.name](u, v, k, i, *(functools.partial(run, p) for p in move.plans))
            pool.append(out if 0 < out.size <= LARGEST and out.ndim <= 4 else u)
        return pool

    def inner(self, plan: tuple[Move, ...], u: Any, v: Any, i: Any) -> Any:
        """A function of two arrays that has the shape of the first one."""
        return jnp.tanh(fit(self.values(plan, [u, v], i)[-1], u.shape))

    def step(self, i: Any, carry: list[Any], row: Any) -> tuple[list[Any], list[Any]]:
        """The next carry, and what is saved."""
        pool = self.values(self.body, [*carry, row], i)
        new: list[Any] = []
        for k, (old, update) in enumerate(zip(carry, self.updates, strict=True)):
            last = fit(pool[-1 - self.picks[k] % 3], old.shape)
            latest = fit(new[-1] if new else pool[-1], old.shape)
            other = fit(carry[(k + 1) % 3], old.shape)
            new.append(UPDATES[update](old, last, latest, other))
        if self.exchange == "swap":
            new[:2] = new[1::-1]
        if self.exchange == "copy":
            new[1] = new[0]
        saved = {
            "nothing": lambda _: [],
            "state": lambda pick: [new[pick % 3]],
            "sum": lambda pick: [jnp.sum(new[0] * new[1]) / new[0].size + jnp.max(new[pick % 3])],
            "value": lambda pick: [0.5 * pool[pick % len(pool)]],
        }
        rows = [save(p) for save, p in zip(map(saved.get, self.saves), self.picks, strict=False)]
        return new, [x for row in rows for x in row]

    def loop(self, carry: list[Any], rows: Any, start: Any) -> list[Any]:
        """The loop over time: its last carry and what it saved."""
        first, length = rows[0], self.length

        def count(s, row):
            new, saved = self.step(s[0], s[1], row)
            return (s[0] + 1, new), saved

        def rounds(s, n):
            return lax.fori_loop(0, n, lambda _, s: count(s, first)[0], s)

        s = (start, carry)
        if self.form in ("scan", "rows", "reversed"):
            s, saved = lax.scan(
                lambda s, row: count(s, first if row is None else row),
                s,
                None if self.form == "scan" else rows,
                length,
                reverse=self.form == "reversed",
            )
            return [*s[1], *saved]
        if self.form == "fori":
            return rounds(s, length)[1]
        if self.form == "while":
            limit = start + length
            return lax.while_loop(lambda s: s[0] < limit, lambda s: count(s, first)[0], s)[1]
        if self.form == "until":
            limit = start + length

            def goes_on(s):
                return (s[0] < limit) & (jnp.max(jnp.abs(s[1][0])) > 0.8137)

            s = lax.while_loop(goes_on, lambda s: count(s, first)[0], s)
            return [s[0], *s[1]]
        if self.form == "two":
            s, saved = lax.scan(lambda s, _: count(s, first), s, None, 2)
            return [*rounds(s, length)[1], *saved]
        # "nested", "every second": rows are saved after some rounds of an inner loop.
        inner = 2 if self.form == "every second" else length
        s, saved = lax.scan(lambda s, row: count(rounds(s, inner - 1), row), s, rows)
        return [*s[1], *saved]

    def result(self, x, y, z, rows, start) -> list[Any]:
        pool = self.values(self.before, [x, y, z], start)
        carry = [fit(pool[-1], x.shape), y, z]
        results = self.loop(carry, rows, start)
        floats = [r for r in results[:4] if r.ndim and jnp.issubdtype(r.dtype, jnp.floating)]
        return [*results, *self.values(self.after, floats, start)[len(floats) :]]

    def __call__(self, x, y, z, rows, start) -> list[Any]:
        def outputs(x, y):
            outs = self.result(x, y, z, rows, start)
            return [out for out in outs if jnp.issubdtype(out.dtype, jnp.floating)]

        def loss(x, y):
            return sum(jnp.sum(jnp.sin(out)) for out in outputs(x, y))

        if self.whole == "grad":
            return list(jax.grad(loss, (0, 1))(x, y))
        if self.whole == "jvp":
            primals, tangents = jax.jvp(outputs, (x, y), (jnp.cos(x), jnp.ones_like(y)))
            return [*primals, *tangents]
        return self.result(x, y, z, rows, start)

    def lane(self, i: int) -> list[np.ndarray]:
        """The operands of one trajectory."""
        return [x[i] for x in self.inputs] if self.batch else self.inputs

    @functools.cached_property
    def jaxpr(self) -> Any:
        """The program of one trajectory, traced."""
        return jax.make_jaxpr(self)(*self.lane(0))

    def expected(self, noise: float = 0.0) -> list[np.ndarray]:
        """The outputs of all trajectories one by one, of operands with relative noise."""
        rng, outs = np.random.default_rng(1), []
        for i in range(self.batch or 1):
            lane = [
                x * (1 + noise * rng.uniform(-1, 1, x.shape)).astype(x.dtype)
                if x.dtype.kind == "f"
                else x
                for x in self.lane(i)
            ]
            outs.append(evaluate(self.jaxpr, *lane))
        return [np.stack(x) if self.batch else x[0] for x in zip(*outs, strict=True)]


BRANCHES = {
    "cond": lambda u, v, k, i, f, g, h: lax.cond(
        jnp.sum(u) / u.size > 0.1137, f, g, u, v
    ),
    "passed on": lambda u, v, k, i, f, g, h: lax.cond(
        i % 2 == 0, lambda u, v: (u, f(u, v)), lambda u, v: (v, u), u, v
    )[k % 2],
    "switch": lambda u, v, k, i, f, g, h: lax.switch(
        (i + k) % 4, [f, g, h, lambda u, v: v], u, v
    ),
    "rounds": lambda u, v, k, i, f, g, h: lax.fori_loop(
        0, 2 + k % 3, lambda _, s: (s[1] + 0.1 * f(*s), s[0]), (u, v)
    )[k % 2],
    "counted": lambda u, v, k, i, f, g, h: lax.fori_loop(
        0, i % 4, lambda j, s: f(s, v) + 0.1 * jnp.asarray(j, s.dtype), u
    ),
    "until": lambda u, v, k, i, f, g, h: lax.while_loop(
        lambda s: (s[0] < 4) & (jnp.max(jnp.abs(s[1])) > 0.3137),
        lambda s: (s[0] + 1, 0.7 * f(s[1], v)),
        (0, u),
    )[1],
    "until each": lambda u, v, k, i, f, g, h: jax.vmap(  # a condition for each row
        lambda x: lax.while_loop(
            lambda s: (s[0] < 4) & (jnp.max(jnp.abs(s[1])) > 0.3137),
            lambda s: (s[0] + 1, 0.7 * jnp.sin(s[1]) + 0.1 * s[0]),
            (0, x),
        )[1]
    )(f(u, v)),
}  # fmt: skip
"""Control flow around three functions (u, v) → array like u."""

DERIVATIVES = {
    "grad": lambda u, v, k, i, f, g, h: jax.grad(lambda u: jnp.mean(jnp.sin(f(u, v))))(u),
    "both": lambda u, v, k, i, f, g, h: sum(
        jax.grad(lambda u, v: jnp.mean(f(u, v) * v), (0, 1))(u, v)
    ),
    "jvp": lambda u, v, k, i, f, g, h: jax.jvp(lambda u: f(u, v), (u,), (v,))[1],
    "vjp": lambda u, v, k, i, f, g, h: 0.3 * jax.vjp(lambda u: f(u, v), u)[1](v)[0],
    "second": lambda u, v, k, i, f, g, h: jax.jvp(
        jax.grad(lambda u: jnp.mean(jnp.sin(f(u, v)))), (u,), (v,)
    )[1],
}
