"""The conditions on a symmetry at sampled points, linear in its coefficients in a basis."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from ...base.results import RESULTS
from ...base.types import Interval
from ...methods.step import Equations, step
from ..algebra.taylor import taylor_coefficients
from ..functions.generators import LatticePoint
from ..functions.sampling import Displacements, SamplePoints, require_finite
from .determining import discrete_equations


class Conditions(NamedTuple):
    """Conditions at S samples, as Taylor coefficients in ε up to z; C components, B functions.

    Contributions of the first and of the second point are separate, in the axis of length 2. A
    row of Noether's identity is its value, or a derivative by a component of q1 or p0.
    """

    determining: Any  # (S, z + 1, 2, 2n, C, B)
    identity: Any  # (S, z + 1, 2, 1 + 2n, C, B)
    gauge: Any  # (S, z + 1, 1 + 2n, gauge functions)
    clock: Any  # (S, z + 1, 2n): ∂F/∂t1
    later: Any  # (S, z + 1, 2, 2n): F at the same states but later
    values: Any  # (S, z + 1, 2, B): φ at both points
    slopes: Any  # (S, z + 1, B, 1 + 2n): ∂φ/∂(t, q, p) at the first
    jacobian: Any  # (S, z + 1, 2n, 2, C): ∂F/∂(t, q, p) of both points
    points: Any  # (S, z + 1, 2, 1 + 2n): both points (t, q, p)
    good: Any  # (S, z + 1): at z = 0, 1 where the step succeeds

    @property
    def all_good(self) -> bool:
        """Whether all steps succeed at ε = 0, and all is finite."""
        return bool(self.good[:, 0].all()) and all(np.isfinite(x).all() for x in self)

    def displacements(self, samples: SamplePoints) -> Displacements:
        """What the step changes (q, p) by at the samples."""
        return Displacements(samples, np.diff(self.points[:, 0, :, 1:], axis=1)[:, 0])

    def depends_on_time(self, samples: SamplePoints, h: float, shift: float) -> bool:
        """Whether the equations differ at a later time, by more than rounding; `shift`: the
        largest shift of `later`."""
        size = abs(h) * np.max(np.abs(self.clock)) + np.finfo(float).tiny
        # (q1 − q0)/h is rounded by the last digits of q1, and of t1 − t0 = h at a later time.
        largest = max(np.max(np.abs(x)) for x in (samples.q, samples.p))
        displacement = np.max(np.abs(np.diff(self.points[:, 0, :, 1:], axis=1)))
        later = (np.max(np.abs(samples.t)) + shift) / abs(h)
        rounding = 64 * np.finfo(float).eps * (largest + later * displacement) / abs(h)
        return not np.max(np.abs(self.later)) <= 1e-8 * size + rounding  # True for NaN


@eqx.filter_jit
def at_samples(equations, h, basis, gauge_basis, order, samples, later) -> Conditions:
    """`later`: shifts of the time, shape (2,), for `Conditions.depends_on_time`."""
    system, args, shape = equations.system, equations.args, samples.q.shape[1:]
    n = int(np.prod(shape, dtype=int))

    def flat(parts):
        return jnp.concatenate([jnp.ravel(part) for part in parts])

    def point(x):
        return LatticePoint(x[0], x[1 : 1 + n].reshape(shape), x[1 + n :].reshape(shape))

    def functions(x):
        t, q, p = point(x)
        return jnp.append(basis(q, p, t), gauge_basis(q, p, t))

    def conditions(epsilon, q, p, t):
        discrete = Equations(system, epsilon, args, equations.newton)
        q1, p1, info = step(discrete, Interval(t, t + h, h), q, p)
        pair = jnp.stack([flat((t, q, p)), flat((t + h, q1, p1))])
        values, slopes = jax.vmap(functions)(pair), jax.vmap(jax.jacfwd(functions))(pair)

        def F(pair):
            a, b = map(point, pair)
            return flat(discrete_equations(system, a, b, epsilon, args))

        def action(pair):
            a, b = map(point, pair)
            H = system.hamiltonian(a.t, b.t, a.q, b.p, epsilon, args)
            return jnp.sum(b.p * (b.q - a.q)) - (b.t - a.t) * H

        def identity(shifted_pair):
            """The factors of both points' components, and of the gauge, at a pair close by."""
            functions_near = values + jnp.einsum("jbi,ji->jb", slopes, shifted_pair - pair)
            phi, gauge = functions_near[:, : basis.size], functions_near[:, basis.size :]
            a, b = map(point, shifted_pair)
            force = system.disturbing_force(a.t, b.t, a.q, b.p, epsilon, args)
            power = jnp.sum(force * (b.q - a.q)) / h
            work = flat((-power, force, jnp.zeros_like(force)))
            factors = jax.grad(action)(shifted_pair) / h + jnp.stack([work, jnp.zeros_like(work)])
            return jnp.einsum("jc,jb->jcb", factors, phi), (gauge[1] - gauge[0]) / h

        def rows(value, by_pair):
            """The value, and the derivatives by q1 and by p0."""
            by_q1, by_p0 = by_pair[..., 1, 1 : 1 + n], by_pair[..., 0, 1 + n :]
            return jnp.concatenate([value[None], *(jnp.moveaxis(x, -1, 0) for x in (by_q1, by_p0))])

        by_pair = jax.jacfwd(F)(pair)  # (2n, 2, C)
        noether, gauge = map(rows, identity(pair), jax.jacfwd(identity)(pair))
        later_equations = jax.vmap(lambda shift: F(pair.at[:, 0].add(shift)))(later)
        phi, good = values[:, : basis.size], jnp.where(info.result == RESULTS.successful, 1.0, 0.0)
        return Conditions(
            determining=jnp.einsum("rjc,jb->jrcb", by_pair, phi),
            identity=jnp.moveaxis(noether, 0, 1),
            gauge=gauge,
            clock=by_pair[:, 1, 0],
            later=later_equations,
            values=phi,
            slopes=slopes[0, : basis.size],
            jacobian=by_pair,
            points=pair,
            good=good,
        )

    def at_point(q, p, t):
        shapes = jax.eval_shape(lambda epsilon: conditions(epsilon, q, p, t), jnp.zeros(()))
        zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        as_conditions = ravel_pytree(zeros)[1]

        def flat_conditions(epsilon):
            return ravel_pytree(conditions(epsilon, q, p, t))[0]

        return jax.vmap(as_conditions)(taylor_coefficients(flat_conditions, jnp.zeros(()), order))

    return jax.vmap(at_point)(*map(jnp.asarray, samples))


def require_finite_conditions(raw: Conditions) -> None:
    """Reject conditions that are not finite: at the samples, or where the step leads."""
    hint = "keep the samples and the ends of their steps away from singularities"
    require_finite(raw.determining, lambda *_: "the left side of a determining equation", hint)
    require_finite(raw.identity, lambda *_: "a term of Noether's identity", hint)
    require_finite(raw.gauge, lambda *_: "a function of the gauge basis", hint)
