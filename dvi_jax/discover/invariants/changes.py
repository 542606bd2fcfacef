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
from ..functions.basis import BoundBasis
from ..functions.sampling import (
    Displacements,
    Samples,
    check_finite,
    later,
    require_finite,
    require_steps,
)

# A series whose relative change at large ε is smaller is exact and not an expansion.
_EXACT = 1e-12
# The ε at which that is tried, in units of that at which the perturbation is as large as H_D.
_TRIED = (0.5, -0.3)
_EXACT_STEPS = 100  # Steps over which it is tried


class Stepped(NamedTuple):
    """The map of one step of a method, and functions whose change is computed."""

    equations: Equations
    h: Any
    method: Method
    basis: BoundBasis

    @property
    def is_constrained(self) -> bool:
        """Whether samples lie on the manifold of a constraint."""
        return self.equations.system.constraint is not None

    def unnamed(self) -> "Stepped":
        """For compiled functions: see `BoundBasis.unnamed`."""
        return self._replace(basis=self.basis.unnamed())


class Changes(NamedTuple):
    """S samples, and what B functions change by in one step from each.

    - `stepped`, `samples`: the map with its functions, and where it was applied.
    - `values`: φ, (S, B). `terms`: A_0 … A_z, (S, z + 1, B): Taylor coefficients in ε of
      φ(Φ_ε(z), t + h) − φ(z, t). `volume`: those of log |det DΦ_ε| from order 1, (S, z + 1).
    - `motion`: what slopes predict for A_0, and its rounding.
    - `slopes`: ∂φ/∂(q, p, t), (S, B, 2n + 1). `moved`: z1 − z of z = (q, p, t), (S, 2n + 1).
    - `good`: where the step succeeds and all is finite, (S,).
    """

    stepped: Stepped
    samples: Samples
    values: np.ndarray
    terms: np.ndarray
    volume: np.ndarray
    motion: Motion
    slopes: np.ndarray
    moved: np.ndarray
    good: np.ndarray

    def at(self, some: np.ndarray) -> "Changes":
        """Of some of the samples."""
        parts = self.samples.at(some), self.motion.at(some)
        names = "values", "terms", "volume", "slopes", "moved", "good"
        arrays = {name: getattr(self, name)[some] for name in names}
        return self._replace(samples=parts[0], motion=parts[1], **arrays)

    @property
    def displacements(self) -> Displacements:
        """What the step changes (q, p) by."""
        return Displacements(self.samples, self.moved[:, :-1])

    def elsewhere(self, samples: Samples | None = None, h: Any = None) -> "Changes":
        """Of order 0 at other samples or with another step, unchecked."""
        stepped = self.stepped if h is None else self.stepped._replace(h=np.asarray(h))
        return changes_at(stepped, 0, self.samples if samples is None else samples)


def changes_at(stepped: Stepped, order: int, samples: Samples) -> Changes:
    """Unchecked."""
    found = [np.asarray(x) for x in batched_changes(stepped.unnamed(), order, samples)]
    values, terms, volume, good, slopes, move, blur = found
    finite = [np.isfinite(x.reshape(len(good), -1)).all(axis=1) for x in found]
    with np.errstate(all="ignore"):
        rounding = np.abs(values) + np.abs(values + terms[:, 0])
        rounding = rounding + np.einsum("sbi,si->sb", np.abs(slopes), blur)
        predicted = (slopes * move[:, None]).swapaxes(1, 2)
    motion = Motion(predicted, np.finfo(float).eps * rounding)
    good = good & np.all(finite, axis=0)
    return Changes(stepped, samples, values, terms, volume, motion, slopes, move, good)


def checked_changes(stepped: Stepped, order: int, samples: Samples) -> Changes:
    """The same, or an error for steps that fail, numbers that are not finite, and a time that is
    not sampled."""
    names, found = stepped.basis.names, changes_at(stepped, order, samples)
    if not found.good.all():
        require_steps(np.asarray(batched_changes(stepped.unnamed(), order, samples)[3]), samples)
    check_finite(stepped.basis, found.values)

    def change(m, j):
        what = "the change" if m == 0 else f"the term of order {m} in ε of the change"
        return f"{what} of the basis function {names[j]!r} in a step"

    singular = "H_D, the force or the function is singular there or at the end of the step"
    require_finite(found.terms, change, f"{singular}; keep the samples away from singularities")
    require_finite(found.slopes, lambda j, i: f"the derivative of the basis function {names[j]!r}")
    hint = "keep the samples away from singularities of H_D and the force"
    require_finite(np.where(found.good, 0, np.nan), lambda: "the derivative of the map", hint)
    if np.ptp(samples.t) == 0 and _may_depend_on_time(stepped.equations, samples):
        _require_no_time(found, order)
    return found


def _require_no_time(found: Changes, order: int) -> None:
    stepped, samples = found.stepped, found.samples
    allowed = 1e-8 * np.max(np.abs(found.terms), axis=0, keepdims=True)
    allowed = np.broadcast_to(allowed, found.terms.shape).copy()
    predicted = np.sum(np.abs(found.motion.changes), axis=1)
    for shift in later(float(stepped.h), found.displacements.relative_step):
        # t1 − t0 loses digits at a later time, and a step is in proportion to it.
        lost = 4 * np.finfo(float).eps * (np.max(np.abs(samples.t)) + shift) / abs(stepped.h)
        other = changes_at(stepped, order, samples._replace(t=samples.t + shift)).terms
        allowed[:, 0] = np.maximum(1e-8, lost) * predicted + 8 * found.motion.rounding
        if not (np.abs(other - found.terms) <= allowed).all():
            raise ValueError(
                "the map depends on the time, but all samples have the same time, "
                f"t = {samples.t[0]:g}. Give samples=(qs, ps, ts) with different times in ts."
            )


def _may_depend_on_time(equations, samples) -> bool:
    """Whether t enters H_D, perturbation or force at all."""
    q, p, t = (jnp.asarray(x[0]) for x in samples)
    system, args, one = equations.system, equations.args, jnp.ones(())

    def energies(t):
        H = system.hamiltonian(t, t, q, p, one, args)
        return H, system.disturbing_force(t, t, q, p, one, args)

    return depends_on(energies, 0, t)


def _map(stepped: Stepped, epsilon: Array) -> Any:
    """(q, p, t) → (q1, p1, t1) and the status, with t the slow time for a system that has one."""
    equations, h, method, _ = stepped
    system, slow = equations.system, equations.system.slow_time
    plain = dataclasses.replace(system, slow_time=False)
    here = Equations(plain, epsilon, equations.args, equations.newton)

    def step(q, p, t):
        t1 = t + (epsilon * h if slow else h)
        q1, p1, info = method.step(here, Interval(t, t1, jnp.asarray(h, float)), q, p)
        return q1, p1, t1, info

    return step


@eqx.filter_jit
def batched_changes(stepped: Stepped, order: int, samples):
    """Values of the basis, Taylor coefficients in ε of their changes and of log |det DΦ_ε| (its
    order 0 is 0 here).

    Shapes (S, B), (S, z + 1, B), (S, z + 1); whether the steps succeed, (S,); slopes of the
    functions, (S, B, 2n + 1); z1 − z, and what z1 and z − z1 are rounded by in units of the last
    digit, (S, 2n + 1).
    """
    basis = stepped.basis

    def at_point(q, p, t):
        z = jnp.concatenate([q.ravel(), p.ravel(), jnp.asarray(t)[None]])

        def at(z):
            return z[: q.size].reshape(q.shape), z[q.size : -1].reshape(p.shape), z[-1]

        def mapped(z, epsilon):
            """(q1, p1, t1) as a vector, and again with the status."""
            q1, p1, t1, info = _map(stepped, epsilon)(*at(z))
            end = jnp.concatenate([q1.ravel(), p1.ravel(), t1[None]])
            return end, (q1, p1, t1, info.result == RESULTS.successful)

        def change(epsilon):
            *end, _ = mapped(z, epsilon)[1]
            return basis(*end) - basis(q, p, t)

        def both(epsilon):
            """The change, and the matrix DΦ."""
            D, (*end, _) = jax.jacfwd(mapped, has_aux=True)(z, epsilon)
            change = basis(*end) - basis(q, p, t)
            return jnp.concatenate([change, D[:-1, :-1].ravel()])

        zero, volumes = jnp.zeros(()), jnp.zeros(order + 1)
        if order == 0:
            terms = change(zero)[None]
        else:
            terms, D = jnp.split(taylor_coefficients(both, zero, order), [basis.size], axis=1)
            volumes = _log_determinant(D.reshape(order + 1, z.size - 1, z.size - 1))
        # Rounding of z moves z1 − z by as much as the derivative along some vector of its size.
        signs = jnp.asarray(np.random.default_rng(0).choice([-1.0, 1.0], z.size))
        z1, dz1, end = jax.jvp(lambda z: mapped(z, zero), (z,), (signs * jnp.abs(z),), has_aux=True)
        blur = jnp.abs(z1) + jnp.abs(dz1 - signs * jnp.abs(z))
        slopes = jax.jacfwd(lambda z: basis(*at(z)))(z)
        return basis(q, p, t), terms, volumes, end[3], slopes, z1 - z, blur

    return jax.vmap(at_point)(*samples)


def terms_in_pairs(stepped: Stepped, order: int, samples: Samples) -> Pair:
    """A_0 … A_z, shape (S, z + 1, B), with 31 digits: see `Changes`."""
    basis = stepped.basis

    def terms(q, p, t):
        def change(epsilon):
            *end, info = _map(stepped, epsilon)(q, p, t)
            good = info.result == RESULTS.successful
            return jnp.where(good, basis(*end) - basis(q, p, t), jnp.nan)

        return taylor_coefficients(change, jnp.zeros(()), order)

    (found,) = at_points_in_pairs(terms, *map(jnp.asarray, samples))
    # Numbers below 1e-290 have no lower part; above 1e300 it is NaN.
    what = "the change of the basis functions in a step, in pairs of numbers,"
    require_finite(found.lo, lambda *_: what, "scale the coordinates, or use dvi.FloatingPoint()")
    return found


def _log_determinant(D: Array) -> Array:
    """The series of log |det D|, without its order 0, from that of D, shape (z + 1, n, n): with
    D' = D X its derivative is tr X."""
    divide = jax.vmap(lanewise.solve, (None, 1), 1)
    growth: list[Array] = []
    for k in range(len(D) - 1):
        rest = sum((D[j] @ growth[k - j] for j in range(1, k + 1)), start=jnp.zeros_like(D[0]))
        growth.append(divide(D[0], (k + 1) * D[k + 1] - rest))
    traces = [jnp.trace(X) / (k + 1) for k, X in enumerate(growth)]
    return jnp.stack([jnp.zeros(()), *traces])


@eqx.filter_jit
def is_exact(stepped: Stepped, series, sizes, samples):
    """Whether Σ ε^m c_m·φ is conserved over many steps at ε that are not small; `sizes`: a typical
    change in a step, and the unit of 1/ε."""
    (typical, scale), basis = sizes, stepped.basis

    def at(epsilon):
        c = epsilon ** jnp.arange(series.shape[0]) @ series
        step = _map(stepped, epsilon)

        def value(q, p, t):
            def once(_, state):
                q, p, t, good = state
                q, p, t, info = step(q, p, t)
                return q, p, t, good & (info.result == RESULTS.successful)

            good = jnp.asarray(True)
            q1, p1, t1, good = jax.lax.fori_loop(0, _EXACT_STEPS, once, (q, p, t, good))
            before, after = basis(q, p, t), basis(q1, p1, t1)
            rounding = jnp.abs(c) @ (jnp.abs(before) + jnp.abs(after))
            # An orbit that leaves the range of numbers says nothing.
            good = good & jnp.all(jnp.isfinite(after))
            return c @ before, c @ after - c @ before, rounding, good

        before, change, rounding, good = jax.vmap(value)(*map(jnp.asarray, samples))
        moved = jnp.minimum(_EXACT_STEPS * typical, 1) * jnp.std(before)
        allowed = _EXACT * moved + _EXACT_STEPS * jnp.finfo(before.dtype).eps * rounding
        return (jnp.mean(good) > 0.5) & jnp.all(~good | (jnp.abs(change) <= allowed))

    return jnp.all(jax.vmap(at)(jnp.array(_TRIED) / scale))
