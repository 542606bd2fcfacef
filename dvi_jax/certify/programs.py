"""That compiling, batching and tracing change nothing, and that a bad lane stays alone."""

import jax
import jax.numpy as jnp
import numpy as np

from .candidate import POINT, Candidate, one_step_of_central, point
from .measured import Measured, at_most, not_measured

SAME = 1e-14
LANES = 1e-12


def jit_equals_eager(candidate: Candidate) -> Measured:
    """The largest difference of one step compiled from the same step op by op, relative."""
    compiled, _ = candidate.counted_step
    with jax.disable_jit():
        eager = one_step_of_central(candidate.method, 1.0)
    return at_most(_relative(compiled, eager), SAME)


def vmap_equals_loop(candidate: Candidate) -> Measured:
    """The largest difference of a batch from its lanes run one by one, relative."""
    lanes = _lanes()
    together, _ = candidate.batch(_stacked(lanes))
    alone = np.stack([candidate.final(x)[0] for x in lanes])
    return at_most(_relative(np.asarray(together), alone), LANES, detail=f"{len(lanes)} lanes")


def failed_lane(candidate: Candidate) -> Measured:
    """The same with one lane that overflows, which must be told and be NaN."""
    lanes, bad = _lanes(), 1
    lanes[bad] = lanes[bad] | {"q0": jnp.asarray(1e200)}
    together, good = candidate.batch(_stacked(lanes))
    together, allowed = np.asarray(together), f"≤ {LANES:g}"
    if good[bad] or np.isfinite(together[bad]).any():
        said = "as a success" if good[bad] else "as a failure, its state a number"
        return Measured(np.inf, allowed, False, detail=f"the lane that overflows is given {said}")
    alone = np.stack([candidate.final(x)[0] for i, x in enumerate(lanes) if i != bad])
    return at_most(_relative(np.delete(together, bad, 0), alone), LANES)


def retraces(candidate: Candidate) -> Measured:
    """Traces of the run when q0, p0, h, ε, args and t0 change and the method is made anew."""
    _, (first, *further) = candidate.counted_step
    if first < 1:
        return not_measured("≤ 0", "the run was not traced")
    return at_most(float(max(further)), 0.0, detail=f"{first} calls while it is compiled")


def _lanes() -> list[dict[str, jax.Array]]:
    """Inputs that differ in everything from lane to lane."""
    return [{name: x * (1 + 0.1 * i) for name, x in point().items()} for i in range(4)]


def _stacked(lanes: list[dict[str, jax.Array]]) -> dict[str, jax.Array]:
    return {name: jnp.stack([x[name] for x in lanes]) for name in POINT}


def _relative(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.max(np.abs(a - b)) / np.max(np.abs(b)))
