"""What functions change by in one step of a map, at sampled points, order by order in ε."""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import lanewise
from lanewise.jaxprs.dependence import depends_on

from ...base.results import RESULTS
from ...base.types import Interval
from ...engine.in_pairs import at_points_in_pairs
from ...engine.pairs import Pair
from ...methods import Method
from ...methods.step import Equations
from ..algebra.motion import Motion
from ..algebra.taylor import taylor_coefficients
from ..functions import sampling
from ..functions.basis import BoundBasis
from ..functions.sampling import Displacements, SamplePoints, require_finite

_EXACT = 1e-12  # A series with less relative change at large ε is exact and not an expansion
_TRIAL_EPSILONS = (0.5, -0.3)  # They are tried where |ε| = 1 makes the perturbation as large as H_D
_EXACT_STEPS = 100  # Steps over which it is tried


class StepMap(NamedTuple):
    """The map of one step of a method, and functions whose change is computed."""

    equations: Equations
    h: Any
    method: Method
    basis: BoundBasis

    @property
    def is_constrained(self) -> bool:
        """Whether samples lie on the manifold of a constraint."""
        return self.equations.system.constraint is not None

    def without_names(self) -> "StepMap":
        """For compiled functions: see `BoundBasis.without_names`."""
        return self._replace(basis=self.basis.without_names())


class Changes(NamedTuple):
    """S samples, and what B functions change by in one step from each.

    - `step_map`, `samples`: the map with its functions, and where it was applied.
    - `values`: φ, (S, B). `terms`: A_0 … A_z, (S, z + 1, B): Taylor coefficients in ε of
      φ(Φ_ε(z), t + h) − φ(z, t). `volume`: those of log |det DΦ_ε| from order 1, (S, z + 1).
    - `motion`: what slopes predict for A_0, and its rounding.
    - `slopes`: ∂φ/∂(q, p, t), (S, B, 2n + 1). `shifts`: z1 − z of z = (q, p, t), (S, 2n + 1).
    - `good`: where the step succeeds and all is finite, (S,).
    """

    step_map: StepMap
    samples: SamplePoints
    values: np.ndarray
    terms: np.ndarray
    volume: np.ndarray
    motion: Motion
    slopes: np.ndarray
    shifts: np.ndarray
    good: np.ndarray

    def subset(self, index: np.ndarray) -> "Changes":
        arrays = {k: x[index] for k, x in self._asdict().items() if isinstance(x, np.ndarray)}
        samples, motion = self.samples.subset(index), self.motion.subset(index)
        return self._replace(samples=samples, motion=motion, **arrays)

    @property
    def displacements(self) -> Displacements:
        """What the step changes (q, p) by."""
        return Displacements(self.samples, self.shifts[:, :-1])

    def recompute(self, samples: SamplePoints | None = None, h: Any = None) -> "Changes":
        """Of order 0 at other samples or with another step, unchecked."""
        step_map = self.step_map if h is None else self.step_map._replace(h=np.asarray(h))
        return changes_at(step_map, 0, self.samples if samples is None else samples)


def changes_at(step_map: StepMap, order: int, samples: SamplePoints) -> Changes:
    """Unchecked."""
    arrays = [np.asarray(x) for x in batched_changes(step_map.without_names(), order, samples)]
    values, terms, volume, good, slopes, shifts, blur = arrays
    finite = [np.isfinite(x.reshape(len(good), -1)).all(axis=1) for x in arrays]
    with np.errstate(all="ignore"):
        rounding = np.abs(values) + np.abs(values + terms[:, 0])
        rounding = rounding + np.einsum("sbi,si->sb", np.abs(slopes), blur)
        predictions = (slopes * shifts[:, None]).swapaxes(1, 2)
    motion = Motion(predictions, np.finfo(float).eps * rounding)
    good = good & np.all(finite, axis=0)
    return Changes(step_map, samples, values, terms, volume, motion, slopes, shifts, good)


def checked_changes(step_map: StepMap, order: int, samples: SamplePoints) -> Changes:
    """The same, or an error for failing steps, NaN or infinity, and a time that is not sampled."""
    names, changes = step_map.basis.names, changes_at(step_map, order, samples)
    if not changes.good.all():
        good = batched_changes(step_map.without_names(), order, samples)[3]
        sampling.require_steps(good, samples)
    sampling.check_finite(step_map.basis, changes.values)

    def change(m, j):
        term = "the change" if m == 0 else f"the term of order {m} in ε of the change"
        return f"{term} of the basis function {names[j]!r} in a step"

    def derivative(j, _):
        return f"the derivative of the basis function {names[j]!r}"

    hint = "keep the samples away from singularities of H_D and the force"
    require_finite(changes.terms, change, f"{hint}, also at the end of the step")
    require_finite(changes.slopes, derivative)
    require_finite(np.where(changes.good, 0, np.nan), lambda: "the derivative of the map", hint)
    if np.ptp(samples.t) == 0 and _may_depend_on_time(step_map.equations, samples):
        sampling.require_times(_depends_on_time(changes, order), samples, "the map")
    return changes


def _depends_on_time(changes: Changes, order: int) -> bool:
    """Whether the changes differ at later times, by more than rounding."""
    step_map, samples = changes.step_map, changes.samples
    limits = 1e-8 * np.max(np.abs(changes.terms), axis=0, keepdims=True)
    limits = np.broadcast_to(limits, changes.terms.shape).copy()
    predictions = np.sum(np.abs(changes.motion.changes), axis=1)
    for shift in sampling.later(float(step_map.h), changes.displacements.relative_step):
        # t1 − t0 loses digits at a later time, and a step is in proportion to it.
        loss = 4 * np.finfo(float).eps * (np.max(np.abs(samples.t)) + shift) / abs(step_map.h)
        other = changes_at(step_map, order, samples._replace(t=samples.t + shift)).terms
        limits[:, 0] = np.maximum(1e-8, loss) * predictions + 8 * changes.motion.rounding
        if not (np.abs(other - changes.terms) <= limits).all():
            return True
    return False


def _may_depend_on_time(equations, samples) -> bool:
    """Whether t enters H_D, perturbation or force at all."""
    q, p, t = (jnp.asarray(x[0]) for x in samples)
    system, args, epsilon = equations.system, equations.args, jnp.ones(())

    def energies(t):
        H = system.hamiltonian(t, t, q, p, epsilon, args)
        return H, system.disturbing_force(t, t, q, p, epsilon, args)

    return depends_on(energies, 0, t)


def _map(step_map: StepMap, epsilon: Array) -> Any:
    """(q, p, t) → (q1, p1, t1) and the status, with t the slow time for a system that has one."""
    equations, h, method, _ = step_map
    system, slow = equations.system, equations.system.slow_time
    system = dataclasses.replace(system, slow_time=False)
    equations = Equations(system, epsilon, equations.args, equations.newton)

    def step(q, p, t):
        t1 = t + (epsilon * h if slow else h)
        q1, p1, info = method.step(equations, Interval(t, t1, jnp.asarray(h, float)), q, p)
        return q1, p1, t1, info

    return step


@eqx.filter_jit
def batched_changes(step_map: StepMap, order: int, samples):
    """Values of the basis, Taylor coefficients in ε of their changes and of log |det DΦ_ε| (its
    order 0 is 0 here).

    Shapes (S, B), (S, z + 1, B), (S, z + 1); whether the steps succeed, (S,); slopes of the
    functions, (S, B, 2n + 1); z1 − z, and what z1 and z − z1 are rounded by in units of the last
    digit, (S, 2n + 1).
    """
    basis = step_map.basis

    def at_point(q, p, t):
        z = jnp.concatenate([q.ravel(), p.ravel(), jnp.asarray(t)[None]])

        def state(z):
            return z[: q.size].reshape(q.shape), z[q.size : -1].reshape(p.shape), z[-1]

        def image(z, epsilon):
            """(q1, p1, t1) as a vector, and again with the status."""
            q1, p1, t1, info = _map(step_map, epsilon)(*state(z))
            end = jnp.concatenate([q1.ravel(), p1.ravel(), t1[None]])
            return end, (q1, p1, t1, info.result == RESULTS.successful)

        def change(epsilon):
            *end, _ = image(z, epsilon)[1]
            return basis(*end) - basis(q, p, t)

        def change_and_matrix(epsilon):
            """The change, and the matrix DΦ."""
            D, (*end, _) = jax.jacfwd(image, has_aux=True)(z, epsilon)
            return jnp.concatenate([basis(*end) - basis(q, p, t), D[:-1, :-1].ravel()])

        zero, volumes = jnp.zeros(()), jnp.zeros(order + 1)
        if order == 0:
            terms = change(zero)[None]
        else:
            series = taylor_coefficients(change_and_matrix, zero, order)
            terms, D = jnp.split(series, [basis.size], axis=1)
            volumes = _log_determinant(D.reshape(order + 1, z.size - 1, z.size - 1))
        # Rounding of z moves z1 − z by as much as the derivative along some vector of its size.
        signs = jnp.asarray(np.random.default_rng(0).choice([-1.0, 1.0], z.size))
        z1, dz1, end = jax.jvp(lambda z: image(z, zero), (z,), (signs * jnp.abs(z),), has_aux=True)
        blur = jnp.abs(z1) + jnp.abs(dz1 - signs * jnp.abs(z))
        slopes = jax.jacfwd(lambda z: basis(*state(z)))(z)
        return basis(q, p, t), terms, volumes, end[3], slopes, z1 - z, blur

    return jax.vmap(at_point)(*samples)


def terms_in_pairs(step_map: StepMap, order: int, samples: SamplePoints) -> Pair:
    """A_0 … A_z, shape (S, z + 1, B), with 31 digits: see `Changes`."""
    basis = step_map.basis

    def terms(q, p, t):
        def change(epsilon):
            *end, info = _map(step_map, epsilon)(q, p, t)
            good = info.result == RESULTS.successful
            return jnp.where(good, basis(*end) - basis(q, p, t), jnp.nan)

        return taylor_coefficients(change, jnp.zeros(()), order)

    (pairs,) = at_points_in_pairs(terms, *map(jnp.asarray, samples))
    # Numbers below 1e-290 have no lower part; above 1e300 it is NaN.
    name = "the change of the basis functions in a step, in pairs of numbers,"
    require_finite(pairs.lo, lambda *_: name, "scale the coordinates, or use dvi.FloatingPoint()")
    return pairs


def _log_determinant(D: Array) -> Array:
    """The series of log |det D|, with order 0 as 0, from that of D: with D' = D X it has the
    derivative tr X."""
    divide = jax.vmap(lanewise.solve, (None, 1), 1)
    growth: list[Array] = []
    for k in range(len(D) - 1):
        lower = sum((D[j] @ growth[k - j] for j in range(1, k + 1)), start=jnp.zeros_like(D[0]))
        growth.append(divide(D[0], (k + 1) * D[k + 1] - lower))
    traces = [jnp.trace(X) / (k + 1) for k, X in enumerate(growth)]
    return jnp.stack([jnp.zeros(()), *traces])


@eqx.filter_jit
def is_exact(step_map: StepMap, series, sizes, samples):
    """Whether Σ ε^m c_m·φ is conserved over many steps at ε that are not small; `sizes`: a typical
    change in a step, and the unit of 1/ε."""
    (typical, scale), basis = sizes, step_map.basis

    def conserved_at(epsilon):
        c = epsilon ** jnp.arange(series.shape[0]) @ series
        step = _map(step_map, epsilon)

        def value(q, p, t):
            def take_step(_, state):
                q, p, t, good = state
                q, p, t, info = step(q, p, t)
                return q, p, t, good & (info.result == RESULTS.successful)

            good = jnp.asarray(True)
            q1, p1, t1, good = jax.lax.fori_loop(0, _EXACT_STEPS, take_step, (q, p, t, good))
            start, end = basis(q, p, t), basis(q1, p1, t1)
            rounding = jnp.abs(c) @ (jnp.abs(start) + jnp.abs(end))
            # An orbit that leaves the range of numbers says nothing.
            good = good & jnp.all(jnp.isfinite(end))
            return c @ start, c @ end - c @ start, rounding, good

        start, change, rounding, good = jax.vmap(value)(*map(jnp.asarray, samples))
        size = jnp.minimum(_EXACT_STEPS * typical, 1) * jnp.std(start)
        limit = _EXACT * size + _EXACT_STEPS * jnp.finfo(start.dtype).eps * rounding
        return (jnp.mean(good) > 0.5) & jnp.all(~good | (jnp.abs(change) <= limit))

    return jnp.all(jax.vmap(conserved_at)(jnp.array(_TRIAL_EPSILONS) / scale))
