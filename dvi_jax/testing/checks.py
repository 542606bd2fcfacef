"""The checks: order, structure, long runs, derivatives, compiled programs.

The docstring of a check is its entry in the certificate.
"""

import jax
import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi

from . import problems
from .candidate import LONG, LONG_H, STEPS, Candidate, loss
from .check import Measured, at_most, check, not_measured
from .problems import SPAN, STRENGTH, inputs

ROUND_OFF = 1e-12

# --- order

TOLERANCE = 0.2
FLOOR = 3e-13
"""Errors below are not used: round-off begins at about 1e-14."""

NUMBERS = tuple(round(8 * 2 ** (k / 4)) for k in range(25))
"""Numbers of steps, 8 to 512, in increasing order until the error is below the floor."""

POINTS = 6
"""Number of the finest points above the floor that the order is fitted to."""

_ORDER = (
    "Check the coefficients by their order conditions, or set `order` to the order that was "
    "measured. Evaluate the force at the time and state of each part of the step."
)


@check("order", _ORDER, ".2f")
def check_order(candidate: Candidate) -> Measured:
    """The exponent r in log error = c + r log h + d h², fitted by least squares, where the error is
    that of the state at t = 4 on the coupled problem without its force. The six smallest of the
    steps h = 4/8 … 4/512 with an error above 3e-13 are used, because smaller errors contain
    round-off. r must be within 0.2 of the order claimed."""
    return _measured_order(candidate, 0.0)


@check("forced-order", _ORDER, ".2f")
def check_forced_order(candidate: Candidate) -> Measured:
    """The same as order, with the force."""
    return _measured_order(candidate, STRENGTH)


def _measured_order(candidate: Candidate, epsilon: float) -> Measured:
    """Where a few steps already reach round-off, the slope alone belongs to an h that is too large.

    For McLachlan8 it is 8.2, and 8.04 with the next term of the error.
    """
    order_claim = candidate.method.order
    steps, errors, end = errors_at(candidate, epsilon)
    bound = f"{order_claim:g} ± {TOLERANCE:g}"
    if len(errors) < POINTS or not np.all(np.isfinite(errors)):
        points = f"{len(errors)} points above round-off, at least {POINTS} needed"
        return not_measured(bound, f"{points}; {end}")
    h, e = np.array(steps[-POINTS:]), np.array(errors[-POINTS:])
    terms = np.stack([np.ones_like(h), np.log(h), h**2], axis=1)
    order = float(np.linalg.lstsq(terms, np.log(e), rcond=None)[0][1])
    detail = f"errors {e[0]:.1e} to {e[-1]:.1e} for h = {h[0]:.3g} to {h[-1]:.3g}; {end}"
    return Measured(order, bound, abs(order - order_claim) <= TOLERANCE, True, detail)


def errors_at(candidate: Candidate, epsilon: float) -> tuple[list[float], list[float], str]:
    """Steps h, largest error of a component at the end for each, and why the list ends.

    It ends at a trajectory that failed, with NaN.
    """
    exact, doubt = problems.reference(candidate.problem, epsilon)
    x = inputs(candidate.problem, 0.0) | {"epsilon": epsilon}
    steps, errors = [], []
    for n in NUMBERS:
        h = SPAN * candidate.problem.h / n
        error = float(np.max(np.abs(candidate.flow(x | {"h": h}, n) - exact)))
        if error <= max(FLOOR, 100 * doubt):
            return steps, errors, f"round-off from h = {h:.3g} on"
        steps.append(h)
        errors.append(error)
        if not np.isfinite(error):
            return steps, errors, f"the trajectory failed at h = {h:.3g}"
    return steps, errors, "no round-off met"


# --- structure

_SYMPLECTIC = (
    "Compose the step of symplectic maps such as dvi.TypeII, or set is_symplectic = False."
)


@check("symplecticity", _SYMPLECTIC, any_problem=True)
def check_symplectic(candidate: Candidate) -> Measured:
    """max |MᵀJM − J|, where M is the Jacobian of one step h = 0.1 by automatic differentiation and
    J the symplectic matrix; coupled problem without its force. At most 1e-12."""

    @jax.jit
    @jax.jacfwd
    def jacobian(z, x):
        q, p = (part.reshape(x["q0"].shape) for part in jnp.split(z, 2))
        start = {"q0": q, "p0": p}
        return problems.state(problems.run(candidate.problem, candidate.method, x | start))

    x = inputs(candidate.problem, 0.0) | {"epsilon": jnp.zeros(())}
    M = jacobian(jnp.concatenate([x["q0"].ravel(), x["p0"].ravel()]), x)
    return at_most(symplectic_defect(M), ROUND_OFF, candidate.method.is_symplectic)


def symplectic_defect(M) -> float:
    """max |MᵀJM − J| of a matrix of shape (2n, 2n); zero if it is symplectic."""
    M = np.asarray(M)
    n = len(M) // 2
    J = np.block([[np.zeros((n, n)), np.eye(n)], [-np.eye(n), np.zeros((n, n))]])
    return float(np.max(np.abs(M.T @ J @ M - J)))


@check(
    "reversal",
    "Make the step its own adjoint (dvi.Strang does so for any method with an inverse), or set "
    "is_symmetric = False.",
    any_problem=True,
)
def check_reversible(candidate: Candidate) -> Measured:
    """max |z − z0| after ten steps h = 0.1 and ten steps −h, where z = (q, p) is the state; coupled
    problem with its force. At most 1e-12. Claimed by symmetric methods."""
    n, x = 10, inputs(candidate.problem, 0.0)
    q, p = candidate.flow(x, n)
    final = candidate.flow(x | {"q0": q, "p0": p, "t0": n * x["h"], "h": -x["h"]}, n)
    defect = np.max(np.abs(final - np.stack([x["q0"], x["p0"]])))
    return at_most(float(defect), ROUND_OFF, candidate.method.is_symmetric)


@check(
    "adjoint",
    "Let `inverse` solve for the start of the same step, over the same interval, or set "
    "is_invertible = False.",
    any_problem=True,
)
def check_inverse(candidate: Candidate) -> Measured:
    """max |z − z0| after four steps h = 0.1 of the method and four steps −h of its adjoint; coupled
    problem with its force. At most 1e-12. Claimed by invertible methods."""
    bound, method = f"≤ {ROUND_OFF:g}", candidate.method
    if not method.is_invertible:
        return not_measured(bound, "the method has no inverse", claimed=False)
    adjoint = dvi.Adjoint(method)  # pyright: ignore[reportCallIssue]
    x = inputs(candidate.small)
    z, success = candidate.program(x)
    q, p = (part.reshape(x["q0"].shape) for part in jnp.split(z, 2))
    end = {"q0": q, "p0": p, "t0": x["t0"] + STEPS * x["h"], "h": -x["h"]}
    final, success_of_inverse = jax.jit(lambda x: candidate.run(x, method=adjoint))(x | end)
    if not (success and success_of_inverse):
        return not_measured(bound, "a step or its inverse failed")
    start = np.concatenate([x["q0"].ravel(), x["p0"].ravel()])
    distance, defect = (float(np.max(np.abs(a - start))) for a in (z, final))
    if distance < 1e-3:  # the identity is its own inverse, and shows nothing
        return not_measured(bound, f"the steps moved the state by {distance:.2g} only")
    return at_most(defect, ROUND_OFF, detail=f"the steps moved the state by {distance:.2g}")


# --- long runs

FRACTION, QUIET = 0.05, 1e-10


@check("energy", _SYMPLECTIC)
def check_energy(candidate: Candidate) -> Measured:
    """Drift of the energy (slope times length of the run) divided by the range of the energy, or by
    1e-10 of the energy if this is larger; 100 000 steps h = 0.2 of the central problem without its
    force. At most 0.05. Claimed by symplectic methods."""
    x, run = inputs(problems.CENTRAL), candidate.long_run
    drift = abs(float(run.observed["slope"])) * LONG * LONG_H
    swing = float(run.observed["range"])
    start = float(problems.central_hamiltonian(0, 0, x["q0"], x["p0"], x["args"]))
    detail = f"over {LONG} steps drift {drift:.1e}, range {swing:.1e}, energy {start:.2g}"
    return _of_long_run(candidate, drift / max(swing, QUIET * start), FRACTION, detail)


@check("momentum", _SYMPLECTIC)
def check_momentum(candidate: Candidate) -> Measured:
    """Largest relative change of the angular momentum in the same run. At most 1e-12. Claimed by
    symplectic methods."""
    (q1, q2), (p1, p2) = problems.CENTRAL.q0, problems.CENTRAL.p0
    change = float(candidate.long_run.observed["momentum"])
    return _of_long_run(candidate, change / abs(q1 * p2 - q2 * p1), ROUND_OFF)


def _of_long_run(candidate, value: float, bound: float, detail: str = "") -> Measured:
    run, claim = candidate.long_run, candidate.method.is_symplectic
    if run.status != "successful":
        cause = f"the trajectory failed at step {int(run.stats['failed_step'])}: {run.status}"
        return not_measured(f"≤ {bound:g}", cause, claim)
    return at_most(value, bound, claim, detail)


# --- derivatives


@check(
    "gradient",
    "Compute with JAX operations on all inputs: look for stop_gradient, for Python numbers made "
    "from arrays, and for an `inverse` that does not undo the step.",
)
def check_gradient(candidate: Candidate) -> Measured:
    """Largest relative difference between the reverse-mode gradient and a central difference
    quotient, for q0, p0, t0, h, ε and args; four steps of the coupled problem with its force. At
    most 1e-6."""
    gradient = candidate.gradients[0]["Reversible"]  # the default of `integrate`
    quotient = {name: _quotient(candidate, name) for name in gradient}
    error = {name: abs(gradient[name] - x) / abs(x) for name, x in quotient.items()}
    worst = _worst(error)
    return at_most(error[worst], 1e-6, detail=f"worst in {worst}")


@check("modes", "Let `inverse` undo the step to round-off: `Reversible` rebuilds states with it.")
def check_modes(candidate: Candidate) -> Measured:
    """Largest relative difference between a derivative by reverse mode, with the adjoints `Direct`,
    `Checkpointed` and `Reversible`, and by forward mode. At most 1e-10."""
    backward, forward = candidate.gradients
    error = {name: abs(sum(row.values()) / forward - 1) for name, row in backward.items()}
    worst = _worst(error)
    return at_most(error[worst], 1e-10, detail=f"worst with {worst}")


def _worst(errors: dict[str, float]) -> str:
    """The name of the largest error; NaN is larger than any number."""
    return max(errors, key=lambda name: np.inf if np.isnan(errors[name]) else errors[name])


def _quotient(candidate: Candidate, name: str) -> float:
    """Central differences with steps of 1e-3 and 2e-3, extrapolated: errors of about 1e-11."""
    x = inputs(candidate.small)

    def loss_of(shift):
        return float(loss(np.asarray(candidate.program(x | {name: x[name] + shift})[0])))

    def slope(s):
        return (loss_of(s) - loss_of(-s)) / (2 * s)

    return (4 * slope(1e-3) - slope(2e-3)) / 3


# --- compiled programs


@check(
    "jit",
    "Let the step depend on its arguments alone: no counters, random numbers or other state of "
    "Python.",
)
def check_jit(candidate: Candidate) -> Measured:
    """Relative difference between a step that is compiled (`jax.jit`) and the same step without
    compilation; central problem with its force. At most 1e-14."""
    reference = candidate.one_step()
    with jax.disable_jit():
        return at_most(_relative(reference, candidate.one_step()), 1e-14)


@check("vmap", "Look for operations that mix the elements of a batch, such as a custom_vmap.")
def check_batch(candidate: Candidate) -> Measured:
    """Relative difference between four trajectories in a batch (`jax.vmap`), different in every
    input, and the same four computed one by one; coupled problem with its force. At most 1e-12."""
    xs = _batch(candidate)
    batch = candidate.batch(_stack(xs))[0]
    alone = [candidate.program(x)[0] for x in xs]
    return at_most(_relative(batch, alone), ROUND_OFF, detail=f"{len(xs)} trajectories")


@check("failure", "Return the status of every solve in `info`, and never replace NaN by a number.")
def check_failure(candidate: Candidate) -> Measured:
    """A batch as in the check vmap, in which one trajectory overflows. It must have a failure
    status and be NaN, and the others must agree to 1e-12 with those computed alone."""
    xs, bad = _batch(candidate), 1
    xs[bad] |= {"q0": jnp.full_like(xs[bad]["q0"], 1e200)}
    batch, good = candidate.batch(_stack(xs))
    if good[bad] or np.isfinite(batch[bad]).any():
        report = "as a success" if good[bad] else "as a failure, but its state is a number"
        detail = f"the trajectory that overflows is reported {report}"
        return Measured(np.inf, f"≤ {ROUND_OFF:g}", False, detail=detail)
    alone = [candidate.program(x)[0] for i, x in enumerate(xs) if i != bad]
    return at_most(_relative(np.delete(batch, bad, 0), alone), ROUND_OFF)


@check(
    "traces",
    "Make equal instances compare equal: static fields must be hashable, and not functions that "
    "are made for each instance.",
    ".0f",
)
def check_traces(candidate: Candidate) -> Measured:
    """Number of times that JAX traces a run again for other values of q0, p0, t0, h, ε and args and
    an equal new instance of the method. It must be 0."""
    calls, counts = 0, []

    def count_calls(t0, t1, q0, p0, q1, p1, args):
        nonlocal calls
        calls += 1
        return q1

    for scale in (1.0, 1.1, 1.2):
        calls = 0  # a function with other values in its closure is another function
        candidate.one_step(scale, count_calls)
        # One call is the check of shapes that `integrate` makes before it has a program.
        counts.append(calls - 1)
    first, *repeats = counts
    if first < 1:
        return not_measured("≤ 0", "the run was not traced")
    return at_most(float(max(repeats)), 0.0, detail=f"{first} calls while it is compiled")


def _batch(candidate: Candidate) -> list[dict[str, jax.Array]]:
    """Inputs of four trajectories that differ in every input."""
    x = inputs(candidate.small)
    return [jax.tree.map(lambda a, i=i: a * (1 + 0.1 * i), x) for i in range(4)]


def _stack(xs):
    return jax.tree.map(lambda *a: jnp.stack(a), *xs)


def _relative(a, b) -> float:
    return float(np.max(np.abs(np.subtract(a, b))) / np.max(np.abs(b)))
