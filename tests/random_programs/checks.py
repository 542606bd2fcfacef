"""What every random program must do, and how it is compared with XLA in plain arrays."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import jaxpr_as_fun

import dvi_jax as dvi
import lanewise
from dvi_jax.base.results import status_code

COPIES = 6
"""Perturbed copies of each start, which show how much round-off grows along the trajectory."""

SHAKEN = 2
"""Runs of the reference in which the numbers that all starts share are moved by some ulp."""

ALLOWED = 100
"""Allowed difference, in units of what perturbations of some ulp make, and of round-off."""


class Ill(Exception):
    """A program that is refused when it is called, as a user's mistake would be."""


def load(text: str) -> dict[str, Any]:
    """The names of a program."""
    names: dict[str, Any] = {"__name__": "program"}
    exec(compile(text, "<program>", "exec"), names)
    return names


def _numbers(solution: Any) -> dict[str, Any]:
    stop = () if solution.stop is None else tuple(solution.stop)
    return {
        "states": (solution.ts, solution.qs, solution.ps, solution.observed, stop),
        "status": status_code(solution.result),
        "failed_step": solution.stats["failed_step"],
    }


class Case:
    """A loaded program, ready to be run in several ways."""

    def __init__(self, names: dict[str, Any], seed: int = 0):
        self.run, self.start, self.smooth = names["run"], names["START"], names["SMOOTH"]
        shared = names["SHARED"]
        self.axes = {k: None if k in shared else 0 for k in self.start}
        self.rng = np.random.default_rng(seed)

    def traced(self, start: dict[str, Any], form: str = "auto") -> dict[str, Any]:
        return _numbers(self.run(start["q"], start["p"], start["epsilon"], start["args"], form))

    @functools.cache  # noqa: B019
    def one(self, form: str = "auto") -> Callable:
        """The run of one trajectory, traced once: a trace takes as long as a compilation."""
        of = functools.partial(self.traced, form=form)
        jaxpr, shapes = jax.make_jaxpr(of, return_shape=True)(self.lane(0))
        tree = jax.tree.structure(shapes)
        return lambda start: tree.unflatten(jaxpr_as_fun(jaxpr)(*jax.tree.leaves(start)))

    @functools.cache  # noqa: B019
    def compiled(self, form: str) -> Callable:
        one = self.one(form)
        if form == "auto":
            return jax.jit(jax.vmap(one, in_axes=(self.axes,)))

        def each(start: dict[str, Any]) -> dict[str, Any]:
            own = {k: x for k, x in start.items() if self.axes[k] == 0}
            return lax.map(lambda mine: one({**start, **mine}), own)

        # The reference: one trajectory after the other takes less time to compile than a batch,
        # and so does code that is not optimised.
        return jax.jit(each, compiler_options={"xla_backend_optimization_level": 0})

    def batch(self, start: dict[str, Any], form: str = "auto") -> dict[str, Any]:
        return jax.tree.map(np.asarray, self.compiled(form)(start))

    def lane(self, i: int) -> dict[str, Any]:
        return {
            k: x if self.axes[k] is None else jax.tree.map(lambda y: y[i], x)
            for k, x in self.start.items()
        }

    def copies(self, count: int) -> dict[str, Any]:
        """The starts, and after them `count` copies, all of whose numbers are moved by some ulp,
        and whose zeros are positive in one and negative in the next: XLA and machine code leave out
        sums with a known zero, which would make +0 of −0."""

        def moved(x):
            parts = 4 * np.finfo(x.dtype).eps * self.rng.uniform(-1, 1, (count, *x.shape))
            signs = (-1.0) ** np.arange(count).reshape(count, *[1] * x.ndim)
            near = np.where(x == 0, signs * np.abs(x), x * (1 + parts))
            return np.concatenate([x, *near.astype(x.dtype)])

        return {
            name: x if self.axes[name] is None else jax.tree.map(moved, x)
            for name, x in self.start.items()
        }

    def shaken(self, start: dict[str, Any]) -> dict[str, Any]:
        """The same starts, with the numbers that all of them share moved by some ulp."""

        def moved(x):
            parts = 4 * np.finfo(x.dtype).eps * self.rng.uniform(-1, 1, x.shape)
            return np.asarray(x * (1 + parts)).astype(x.dtype)

        return {
            name: jax.tree.map(moved, x) if self.axes[name] is None else x
            for name, x in start.items()
        }


def check(text: str, alone: bool = True) -> str:
    """Check a program. Returns what was compared.

    `alone`: also one trajectory by itself, which takes a compilation more.

    **Raises** `AssertionError` for a difference, and `Ill` where dvi_jax refuses the program with
    an error of its own.
    """
    case = Case(load(text))
    try:  # of traced numbers: a start of NaN is refused where it is known
        case.one()
    except (ValueError, TypeError, ArithmeticError) as error:
        raise Ill(str(error)) from error
    start = case.copies(COPIES)
    found = case.batch(start)
    expected = case.batch(start, "arrays")
    if None in case.axes.values():
        runs = [expected, *(case.batch(case.shaken(start), "arrays") for _ in range(SHAKEN))]
        expected = jax.tree.map(lambda *x: np.concatenate(x), *runs)
    count = len(case.start["q"])
    # Elementary functions of float32 differ by an ulp of theirs, in a float64 run as well.
    rounding = np.finfo(np.float32 if "float32" in text else np.float64).eps
    compared = _compare(found, expected, count, rounding)
    try:
        _same_bits_elsewhere(case, start, found, alone)
    except AssertionError:  # what is too large to be compiled has no equal bits
        explanation = str(lanewise.explain(case.one(), case.lane(0)))
        if "left to XLA: the number of operations" not in explanation:
            raise
    if case.smooth:
        compared += _compare_gradient(case)
    return compared


def _rows(tree: Any) -> list[np.ndarray]:
    return [np.asarray(x) for x in jax.tree.leaves(tree)]


def _compare(found: dict[str, Any], expected: dict[str, Any], count: int, rounding: float) -> str:
    """Numbers, of relative size `rounding`, and statuses of the first `count` trajectories; the
    others are copies of them.

    Copies differ by some ulp in the start. XLA rounds every operation, machine code joins products
    and sums: a program in which numbers cancel shows what that does in one of the two only.
    """
    skipped = 0
    for i in range(count):
        mine = [x[i::count].astype(float) for x in _rows(found["states"])]
        rows = [x[i::count].astype(float) for x in _rows(expected["states"])]
        verdicts = [np.stack([_verdict(of["status"]), of["failed_step"]])[:, i::count]
                    for of in (found, expected)]  # fmt: skip
        patterns = [np.isnan(x) for x in mine + rows]
        # Where perturbations by some ulp change what happens, there is nothing to compare.
        apart = [np.any(v != v[:, :1]) for v in verdicts] + [np.any(x != x[:1]) for x in patterns]
        if any(apart):
            skipped += 1
            continue
        for name, (a, *_), (b, *_) in zip(("status", "failed_step"), *verdicts, strict=True):
            assert a == b, f"{name} of trajectory {i}: {a}, XLA {b}"
        # A drift is a difference of numbers that are not shown, of about the size of the states.
        size = max(np.max(np.abs(x[np.isfinite(x)]), initial=0.0) for x in rows)
        for ours, theirs, leaf in zip(mine, rows, _rows(found["states"]), strict=True):
            is_float = leaf.dtype.kind == "f"
            eps, tiny = (rounding, np.finfo(leaf.dtype).tiny) if is_float else (0.0, 0.0)
            a, b = ours[0], theirs[0]
            spread = np.maximum(_spread(ours), _spread(theirs))
            assert np.array_equal(np.isnan(a), np.isnan(b)), (
                f"NaN of trajectory {i}: {a.tolist()}, XLA {b.tolist()}"
            )
            finite = np.isfinite(b)
            # The sign of an infinity may be that of a zero, which some copies have with another.
            same = np.all((ours == a) | finite, axis=0) & np.all((theirs == b) | finite, axis=0)
            infinite = same & ~finite & ~np.isnan(b)
            assert np.array_equal(a[infinite], b[infinite]), (
                f"infinities of trajectory {i}: {a.tolist()}, XLA {b.tolist()}"
            )
            allowed = ALLOWED * (spread + eps * (np.abs(b) + size) + tiny)
            wrong = finite & (np.abs(a - b) > allowed)
            assert not wrong.any(), (
                f"numbers of trajectory {i}: {a[wrong].tolist()}, XLA {b[wrong].tolist()}, "
                f"allowed difference {np.broadcast_to(allowed, b.shape)[wrong].tolist()}"
            )
    return f"{count - skipped} of {count} trajectories"


def _verdict(status: np.ndarray) -> np.ndarray:
    """Statuses, "not finite" taken for "no root": near the end of the range the order of the
    operations decides between them."""
    return np.where(status == 2, 1, status)


def _spread(copies: np.ndarray) -> np.ndarray:
    """The largest distance of a copy from the first."""
    with np.errstate(invalid="ignore"):
        return np.max(np.where(np.isfinite(copies), np.abs(copies - copies[0]), 0.0), axis=0)


def _same_bits_elsewhere(
    case: Case, start: dict[str, Any], found: dict[str, Any], alone: bool
) -> None:
    """A trajectory at another place of the batch, and alone, has the same bits."""
    turned = {
        k: x if case.axes[k] is None else jax.tree.map(lambda y: y[::-1].copy(), x)
        for k, x in start.items()
    }
    for a, b in zip(_rows(case.batch(turned)), _rows(found), strict=True):
        assert np.array_equal(a[::-1], b, equal_nan=a.dtype.kind == "f"), "bits at another place"
    one = jax.tree.map(np.asarray, jax.jit(case.one())(case.lane(0))) if alone else None
    for a, b in zip(_rows(one), _rows(found), strict=True) if alone else ():
        assert np.array_equal(a, b[0], equal_nan=a.dtype.kind == "f"), "bits of one alone"


def _loss(numbers: dict[str, Any], xp: Any) -> Any:
    """Of one trajectory; NaN if it fails, though it may be after all that is saved."""
    _, qs, ps, observed, _ = numbers["states"]
    total = sum(xp.sum(xp.tanh(x)) for x in [qs, ps, *jax.tree.leaves(observed)])
    fine = [numbers["status"] == status_code(kind)
            for kind in (dvi.RESULTS.successful, dvi.RESULTS.stopped)]  # fmt: skip
    return xp.where(fine[0] | fine[1], total, xp.nan)


def _compare_gradient(case: Case) -> str:
    """The gradient by the start of one trajectory against central differences."""
    start = case.lane(0)
    q = jnp.asarray(start["q"])
    loss = jax.value_and_grad(lambda q: _loss(case.traced({**start, "q": q}), jnp))
    value, slope = map(np.asarray, jax.jit(loss)(q))
    if not np.isfinite(value):
        return ", no gradient of a trajectory that fails"
    deltas = [3e-4, 1e-4, 3e-5, 1e-5]
    points = np.stack([q + s * d * e for d in deltas for e in np.eye(q.size) for s in (1, -1)])
    # A batch of the size of that of the copies needs no further compilation.
    lanes = len(case.start["q"]) * (1 + COPIES)
    assert len(points) <= lanes
    batch = {
        name: x if case.axes[name] is None
        else jax.tree.map(lambda y: np.broadcast_to(y, (lanes, *y.shape)), start[name])
        for name, x in case.start.items()
    }  # fmt: skip
    found = case.batch({**batch, "q": np.resize(points, (lanes, q.size))})
    values = [_loss(jax.tree.map(lambda x, i=i: x[i], found), np) for i in range(len(points))]
    values = np.reshape(values, (len(deltas), q.size, 2))
    slopes = (values[..., 0] - values[..., 1]) / (2 * np.array(deltas)[:, None])
    # The difference of two neighbours estimates the error of a difference.
    errors = np.abs(np.diff(slopes, axis=0)) + 1e-16 / np.array(deltas[1:])[:, None]
    allowed = 10 * np.min(errors, axis=0) + 1e-7 * (1 + np.abs(slope))
    close = np.min(np.abs(slopes[1:] - slope), axis=0) <= allowed
    if np.all(np.isfinite(slopes)):
        assert np.all(close), f"gradient {slope}, differences {slopes.tolist()}"
    return ", a gradient"
