"""The status of a trajectory, one for each element of a batch."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array


class RESULTS(eqx.Enumeration):
    """Status of one trajectory.

    The first status of a trajectory that is not `successful` stays. Within one step `not_finite`
    has precedence over `not_converged`, since NaN in a solve is more than a lack of iterations.
    Compare with ``sol.result == dvi.RESULTS.successful`` (an array of booleans for a batch);
    ``dvi.RESULTS[sol.result]`` is the text.
    """

    successful = ""
    not_converged = (
        "The iteration for the implicit step did not converge. Likely causes: (a) h is too "
        "large for this state, so that the discrete equations have no nearby solution; (b) the "
        "mixed derivative of H_D or the derivative of W in p1 is not continuous there; (c) the "
        "tolerance lies below round-off, where large terms cancel to almost nothing. Try a smaller "
        "h, or newton=dvi.Newton(max_steps=..., rtol=..., atol=...), atol for (c). dvi.Picard() "
        "needs h times the derivative of the rate to be less than one; dvi.Newton() does not."
    )
    not_finite = (
        "The state became NaN or infinite. Likely causes: (a) the initial state or args contain a "
        "value that is not finite, or a negative temperature, friction or mass for dvi.Langevin; "
        "(b) a singularity of H_D was met (two bodies at one place, say), or of its derivative: "
        "that of jnp.where(r > 0, f(r), 0) is NaN at r = 0, unless r is replaced inside of f too, "
        "as f(jnp.where(r > 0, r, 1)); (c) h is beyond the stability limit and the orbit escaped."
    )
    bad_step_size = (
        "The step size h is zero or not finite. On a `Given` lattice: two neighbouring times "
        "are equal or the times change direction. A ring has whole turns only, h = 1."
    )
    no_root = (
        "The lattice equation (14) has no root near the last step: no h satisfies the energy "
        "balance there. It happens near turning points and apsides, most often for an H_D of first "
        "order. "
        "Try a smaller first h, dvi.discretise(H, order=2), a policy, "
        "lattice=dvi.Variational(on_no_root='hold') or 'minimise', or "
        "lattice=dvi.TimeTransformed(g), whose steps always exist."
    )
    out_of_range = (
        "The state left the range of dvi.FixedPoint(quantum), 2^53 quanta in float64 and 2^24 in "
        "float32, beyond which sums are no longer exact. Likely causes: (a) quantum is too small "
        "for a state of this size; (b) the orbit escaped. Take a larger quantum, or units in which "
        "the state is smaller."
    )
    stopped = "The condition of dvi.Stop was met: the trajectory ended before its last step."
    not_reached = (
        "A time of dvi.Save(ts=...) lies outside of the run: before its start, or after its last "
        "step; or a clock does not grow along the trajectory; or there is no event that belongs to "
        "a time of dvi.EventTimes. Take more steps, or leave out those times."
    )
    step_control_failed = (
        "The step sizes of dvi.AdaptiveReversible(g) no longer follow g: a step has another sign "
        "than h, or differs from h g by more than a factor of four. Likely causes: (a) h is too "
        "large, so that g changes too much within one step; (b) g is zero, negative or not finite "
        "at a state of the trajectory; (c) the motion is dissipative, or g depends on the sign of "
        "p. Try a smaller h, or lattice=dvi.TimeTransformed(g)."
    )

    inconsistent = (
        "The initial state does not satisfy the constraint g(q, args) = 0, or its velocity is not "
        "along it, (∂g/∂q) ∂H/∂p = 0. dvi.project(system, q0, p0) computes the nearest state that "
        "does."
    )
    redundant = (
        "The components of the constraint are not independent at the initial state: the rank of "
        "∂g/∂q is less than their number, so that the forces of constraint are not determined. "
        "Leave out the components that follow from the others."
    )
    lost = (
        "The particle was lost in the ring: it hit an aperture, or a coordinate exceeded 1. "
        "dvi.rings.track also reports the element."
    )
    event_not_finite = (
        "The function g of dvi.Stop, dvi.Section or dvi.Jump became NaN at a state of the "
        "trajectory. Give it a value at all states, for example with jnp.where."
    )
    not_returned = (
        "The trajectory is at g ≥ 0 of a dvi.Jump that must send it back to g < 0. Likely causes: "
        "(a) its map leaves the state there, or it comes to rest on the surface; (b) the run "
        "starts there, or on the surface towards g > 0; (c) it was there within one step before, "
        "so that h is too large; (d) the surface may be passed, as for a kick: give "
        "returns=False."
    )
    too_many_jumps = (
        "More than 8 jumps of dvi.Jump in one step. Likely causes: (a) they accumulate, as the "
        "bounces of a ball that comes to rest; (b) the map does not change the direction; (c) h is "
        "too large. dvi.Stop can end the run before."
    )


# In the order of the class, which numbers them. A new status goes to the end: stores have numbers.
STATUS_NAMES = (
    *("successful", "not_converged", "not_finite", "bad_step_size", "no_root", "out_of_range"),
    *("stopped", "not_reached", "step_control_failed", "inconsistent", "redundant"),
    *("lost", "event_not_finite", "not_returned", "too_many_jumps"),
)


def status_name(result: RESULTS) -> Any:
    """The short name of a status, or an array of names for a batch."""
    # On the host: JAX has no arrays of strings.
    code = np.asarray(status_code(result))
    return STATUS_NAMES[int(code)] if code.ndim == 0 else np.array(STATUS_NAMES)[code]


def status_counts(names: Any) -> str:
    """Statuses in words: the name of one, or "57 successful, 3 not_finite" for a batch."""
    values, counts = np.unique(np.asarray(names), return_counts=True)
    if np.ndim(names) == 0:
        return str(names)
    return ", ".join(f"{n} {name}" for n, name in zip(counts, values, strict=True))


def status_code(result: RESULTS) -> Array:
    """The index of a status in `STATUS_NAMES`, for each trajectory of a batch."""
    (code,) = jax.tree.leaves(result)  # an Enumeration has one leaf, its index
    return code


def first_failure(earlier: RESULTS, later: RESULTS) -> RESULTS:
    """The combined status when `later` follows `earlier`: the first failure."""
    # A selection, not a branch: in a batch every trajectory has its own status.
    return RESULTS.where(earlier == RESULTS.successful, later, earlier)


def first_of(statuses: RESULTS, exists: Array) -> RESULTS:
    """The first status of a row that is a failure, among the places that exist."""
    is_failure = exists & (statuses != RESULTS.successful)
    first = jax.tree.map(lambda code: code[jnp.argmax(is_failure)], statuses)
    return RESULTS.where(jnp.any(is_failure), first, RESULTS.successful)


def with_auxiliary(status: RESULTS, auxiliary: RESULTS) -> RESULTS:
    """The status of a run whose evaluations between its steps have the status `auxiliary`."""
    is_good = (status == RESULTS.successful) | (status == RESULTS.stopped)
    return RESULTS.where(is_good & (auxiliary != RESULTS.successful), auxiliary, status)


class IntegrationError(RuntimeError):
    """Raised by `integrate` with ``throw=True`` when a trajectory failed.

    `solution` contains everything before the failing step, with its status and statistics.
    """

    def __init__(self, message: str, solution: object = None):
        super().__init__(message)
        self.solution = solution
