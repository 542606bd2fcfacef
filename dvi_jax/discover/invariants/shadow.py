"""The shadow Hamiltonian, which the map conserves in place of the energy."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from lanewise.jaxprs.dependence import depends_on
from lanewise.jaxprs.jaxapi import is_traced

from ...base.checks import instance, whole
from ...base.precision import refuse_double_without_x64
from ...base.printing import printable
from ...base.types import Args, Scalar, State
from ...problem.system import System, check_system
from ..algebra.taylor import taylor_coefficients
from ..functions.basis import check_step_size
from ..functions.generators import require_bound


@printable
class ShadowHamiltonian(eqx.Module):
    r"""The modified Hamiltonian of a discrete Hamiltonian, as a series up to h^order.

        H̃(t, q, p; h) = H̃_0 + h H̃_1 + … + h^r H̃_r,    r = order

    is the Hamiltonian whose flow over h *is*, as a power series in h, the unperturbed map of
    `TypeII`. Hence H̃_0 = H_D(t, t, q, p) and H̃_1 = ∂H_D/∂t1 − (∂H̃_0/∂t + ∂H̃_0/∂q·∂H̃_0/∂p)/2.
    For an H_D that depends on time at most through t1 − t0 it is conserved to O(h^{order+1}), for
    very long times, where the energy oscillates with amplitude O(h); where H_D depends on time H̃
    changes as an energy does. The full series diverges in general.

    It is an observable: give it to `integrate` as it is, alone or in a reduction. The run binds it
    to its system and ε, and evaluates it at the end of each step. Elsewhere call `evaluate` or
    `terms`.

    **Arguments**

    - `order`: the highest power of h, at least 0.
    - `system`: whose H_D (and perturbation, times ε) to take; None for the system of the run.
    - `epsilon`: ε of the perturbation; None for that of the run, and 0 outside of one.
    - `h`: step size [time] for use as an observable; None for t1 − t0 of each step, which has lost
      digits late in a long run.

    **What it does not cover**

    - A force W has no Hamiltonian and is left out: H̃ then drifts by the work of W. If W = −∂V/∂q0
      with V(t0, t1, q0), the perturbed map is that of H_D + εV, so give
      ``ShadowHamiltonian(order, System(H_D, perturbation=V))``.
    - `Adjoint`, `Strang`, all compositions and `RungeKutta4` are other maps, with other
      modified Hamiltonians or none. An observable does not know the method: use this one with
      `TypeII` only.
    - On a lattice with unequal steps each step has its own H̃, and none of them is conserved.
    - H_D has to be smooth, in t1 also at t1 = t0 (a division by t1 − t0 gives NaN).

    **Raises** `ValueError` for an order that is not an integer of at least 0, a step size that is
    zero or not finite, q and p of different shapes, or when no system is known; `TypeError`
    for anything but a `System`, or float64 in a process that computes in float32.

    **Accuracy** round-off, which grows with the term: relative 1e-13 for H̃_3, 1e-10 for H̃_6.
    Nested forward mode: the time to compile about doubles with each order (at order 4 a second or
    two for one to three degrees of freedom, five or more for a double pendulum); the work is
    (order + 1)² Taylor series of the gradient of H_D, or 2 (order + 1) where the step is explicit.
    Gradients in all inputs but `order`.

    **Source** existence: Hairer, Lubich & Wanner 2006, *Geometric Numerical Integration*, IX.3.2
    (methods based on generating functions). The formula computed by `terms` is our own; compare
    Skeel & Hardy 2001, *SIAM J. Sci. Comput.* 23, 1172.

    **Example**

    ```python
    kepler = systems.kepler()
    watched = {f"order {k}": dvi.MaxDrift(dvi.ShadowHamiltonian(k)) for k in (0, 1, 2)}
    sol = dvi.integrate(kepler.system, kepler.q0, kepler.p0, args=kepler.args, h=0.01,
                        num_steps=2000, observe=watched, save=dvi.Save(final=True))
    print({name: f"{float(drift):.0e}" for name, drift in sol.observed.items()})
    # {'order 0': '5e-03', 'order 1': '4e-05', 'order 2': '1e-07'}
    ```
    """

    order: int = eqx.field(static=True)
    system: System | None = None
    epsilon: Any = None
    h: Any = None

    def __check_init__(self):
        whole("order", self.order, low=0)
        if self.system is not None:
            hint = "Wrap the discrete Hamiltonian: dvi.System(H_D)."
            instance("system", self.system, System, "a dvi.System or None", hint)
        if self.h is not None and not is_traced(self.h):
            check_step_size(self.h)

    def bind(self, system: System, epsilon: Any) -> "ShadowHamiltonian":
        """The same Hamiltonian for this system and ε, unless they were given before."""
        check_system(system, "ShadowHamiltonian")
        system = system if self.system is None else self.system
        epsilon = epsilon if self.epsilon is None else self.epsilon
        return ShadowHamiltonian(self.order, system, epsilon, self.h)

    def terms(self, t: Any, q: Any, p: Any, args: Args = None) -> Float[Array, " order+1"]:
        r"""H̃_0, …, H̃_{order} at (t, q, p), shape (order + 1,); H̃_i in [energy / time^i].

        Let q_0 = q, p_0 = p, q_1, p_1, … be iterates of the map, as power series in h. The
        discrete action p_{k+1}·(q_{k+1} − q_k) − h H_D of a step is the action ∫ p dq − H̃ dt of the
        modified flow over that step. The sum over n steps, differentiated in n at n = 0, gives

            H̃ = Σ_j (−1)^j/(j + 1) Δ^j b_0,    b_k = H_D − (p_{k+1} − p_0)·∂H_D/∂p_{k+1},

        H_D at (t + kh, t + (k+1)h, q_k, p_{k+1}), Δ b_k = b_{k+1} − b_k. Since [h^i] b_k is a
        polynomial of degree i in k, its differences Δ^j with j > i vanish.
        """
        system = require_bound(self, "system", self.system)
        for name, value in (("q", q), ("p", p)):
            if not is_traced(value):
                refuse_double_without_x64(name, getattr(value, "dtype", np.float32))
        q, p = jnp.asarray(q), jnp.asarray(p)
        if q.shape != p.shape:
            raise ValueError(f"q and p must have the same shape, got {q.shape} and {p.shape}.")
        dtype = jnp.result_type(q.dtype, p.dtype, float)
        epsilon = jnp.asarray(0.0 if self.epsilon is None else self.epsilon, dtype)
        t, q, p = jnp.asarray(t, dtype), q.astype(dtype), p.astype(dtype)
        system.check_shapes(t, q, p, epsilon, args)

        def hamiltonian(t0, t1, q0, p1):
            return system.hamiltonian(t0, t1, q0, p1, epsilon, args)

        difference = _series_along_orbit(hamiltonian, self.order, t, q, p)
        total = jnp.zeros_like(difference[0])
        for j in range(self.order + 1):
            total = total + (-1) ** j / (j + 1) * difference[0]
            difference = jnp.diff(difference, axis=0)
        return total

    def evaluate(self, t: Any, q: Any, p: Any, h: Any, args: Args = None) -> Scalar:
        """H̃(t, q, p; h), a scalar [energy]."""
        terms = self.terms(t, q, p, args)
        return _horner(terms, jnp.asarray(h, terms.dtype))

    def __call__(self, t0, t1, q0, p0, q1, p1, args):
        return self.evaluate(t1, q1, p1, t1 - t0 if self.h is None else self.h, args)


def _series_along_orbit(
    hamiltonian: Callable[..., Scalar], order: int, t: Scalar, q: State, p: State
) -> Float[Array, "k i"]:
    """[h^i] b_k for k, i = 0 … order: see `ShadowHamiltonian.terms`.

    A power series in h is the array of its coefficients, [h^0] first.
    """
    n = q.size

    def energy_and_slopes(k, qs, ps):
        """The series of H_D, ∂H_D/∂q0, ∂H_D/∂p1 in step k, for those of q_k and p_{k+1}."""

        def action_terms(h):
            ends = t + k * h, t + (k + 1) * h
            point = _horner(qs, h).reshape(q.shape), _horner(ps, h).reshape(q.shape)
            H, (dq, dp) = jax.value_and_grad(hamiltonian, argnums=(2, 3))(*ends, *point)
            return jnp.concatenate([H[None], dq.ravel(), dp.ravel()])

        series = taylor_coefficients(action_terms, jnp.zeros((), q.dtype), order)
        return series[:, 0], series[:, 1 : n + 1], series[:, n + 1 :]

    # p_{k+1} = p_k − h ∂H_D/∂q0: each pass of the fixed-point iteration gains one power of h, and
    # the last one has H_D and its slopes at the p_{k+1} of the pass before.
    slope = jax.grad(hamiltonian, argnums=2)
    is_explicit = not depends_on(lambda p1: slope(t, t, q, p1), 0, jnp.zeros_like(p))
    passes = min(order, 1) + 1 if is_explicit else order + 1

    def step(state, k):
        qs, ps = state

        def one_pass(_, values):
            H, dq, dp = energy_and_slopes(k, qs, values[-1])
            return H, dp, ps - _times_h(dq)

        H, dp, ps1 = lax.fori_loop(0, passes, one_pass, (ps[:, 0], ps, ps))
        return (qs + _times_h(dp), ps1), H - _product(ps1 - first, dp)

    first = _constant(p, order)
    steps = jnp.arange(order + 1, dtype=q.dtype)
    return lax.scan(step, (_constant(q, order), first), steps)[1]


def _constant(value: State, order: int) -> Float[Array, "order+1 n"]:
    """The series with this value and no more."""
    return jnp.zeros((order + 1, value.size), value.dtype).at[0].set(value.ravel())


def _horner(series: Array, h: Scalar) -> Array:
    """The sum of a series at h (Horner)."""
    value = series[-1]
    for coefficient in series[-2::-1]:
        value = coefficient + h * value
    return value


def _times_h(series: Array) -> Array:
    return jnp.concatenate([jnp.zeros_like(series[:1]), series[:-1]])


def _product(a: Array, b: Array) -> Array:
    """The series of the inner product a·b."""
    orders = range(len(a))
    return jnp.stack([sum((a[i] @ b[m - i] for i in range(m + 1)), 0.0) for m in orders])
