"""From Lagrangians and other generating functions to a discrete Hamiltonian H_D(t0, t1, q0, p1)."""

import functools
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax

import lanewise
from lanewise.jaxprs.dependence import depends_on

from ..base.checks import array
from ..base.signature import accepts, check_takes, signature_of, takes_state, with_time
from ..base.types import Args, ForceFn, HamiltonianFn, Scalar, State
from ..engine.newton import NestedNewton, Newton, Vector, find_root

_DEFECT = 1e-4
"""Fraction of the initial defect at which the damped search ends and Newton's method begins."""

_MOST_TRIALS = 100
"""Maximum number of trials of the damped search, halvings included."""


# The Hamiltonians below are modules, not closures: their fields are compared, so that one that is
# made again needs no new compilation, and `reads` finds the user's functions in them.
class _LegendreTransform(eqx.Module):
    """H(t, q, p, args) = p·v − L(t, q, v, args), for `discretise`."""

    L: Callable[..., Any]
    root_finder: Newton

    def __call__(self, t: Scalar, q: State, p: State, args: Args) -> Scalar:
        name = "L(t, q, v, args)"
        return _legendre_transform(lambda v: self.L(t, q, v, args), p, self.root_finder, name)


class _DiscreteLegendreTransform(eqx.Module):
    """H_D(t0, t1, q0, p1, args) = p1·v − L_D(t0, t1, q0, v, args), for `System`."""

    L_D: Callable[..., Any]
    root_finder: Newton

    def __call__(self, t0: Scalar, t1: Scalar, q0: State, p1: State, args: Args) -> Scalar:
        L, name = (lambda v: self.L_D(t0, t1, q0, v, args)), "L_D(t0, t1, q0, v, args)"
        return _legendre_transform(L, p1, self.root_finder, name)


class _FromLagrangian(eqx.Module):
    """The Legendre transform in v = (q1 − q0)/h of L_d(t0, t1, q0, q0 + hv, args)/h."""

    L_d: Callable[..., Any]
    root_finder: Newton

    step_is_from_times: ClassVar[bool] = True

    def __call__(self, t0: Scalar, t1: Scalar, q0: State, p1: State, args: Args) -> Scalar:
        h, name = t1 - t0, "L_d(t0, t1, q0, q1, args)"
        # The unknown is v, not q1: it stays of order one as h → 0.
        return _legendre_transform(
            lambda v: self.L_d(t0, t1, q0, q0 + h * v, args) / h, p1, self.root_finder, name, q0 / h
        )


class _FromTypeIII(eqx.Module):
    """H⁻(t0, t1, q0 + hv, p1 − hf) + h f·v where it is stationary in v and f."""

    H_minus: Callable[..., Any]
    root_finder: Newton

    step_is_from_times: ClassVar[bool] = True

    def __call__(self, t0: Scalar, t1: Scalar, q0: State, p1: State, args: Args) -> Scalar:
        h = t1 - t0
        shape = (2, *q0.shape)

        def energy(q1, p0):
            H = self.H_minus(t0, t1, q1, p0, args)
            return _scalar(H, "H_minus(t0, t1, q1, p0, args)")

        def ends(v, f):
            return q0 + h * v, p1 - h * f

        def rates(q1, p0):
            fall, v = jax.grad(energy, argnums=(0, 1))(q1, p0)
            return jnp.stack([v, -fall])

        # A fixed-point form, x = rates(x): its Jacobian is near the identity for small h.
        def residual(x):
            return x - rates(*ends(*x.reshape(shape))).ravel()

        guess = rates(q0, p1).ravel()
        v, f = _root(residual, guess, guess, self.root_finder).reshape(shape)
        return energy(*ends(v, f)) + h * jnp.sum(f * v)


class _VelocityForce(eqx.Module):
    """W(t0, t1, q0, p1, args) = F(t0, t1, q0, ∂H_D/∂p1, args)."""

    H_D: HamiltonianFn
    F: Callable[..., Any]

    def __call__(self, t0: Scalar, t1: Scalar, q0: State, p1: State, args: Args) -> State:
        v = jax.grad(self.H_D, argnums=3)(t0, t1, q0, p1, args)
        return self.F(t0, t1, q0, v, args)


def legendre(L: Callable[..., Any], root_finder: Newton = Newton()) -> Callable[..., Any]:
    r"""The Hamiltonian of a Lagrangian, discrete or continuous, by the Legendre transform.

        p1 = ∂L_D/∂v (t0, t1, q0, v),    H_D(t0, t1, q0, p1) = p1·v − L_D,    v = (q1 − q0)/h

    Each evaluation solves for v, to round-off. A continuous L(t, q, v, args) gives in the same way
    H(t, q, p, args) for `discretise`. ∂H_D/∂p1 is that v.

    **Arguments**

    - `L`: L_D, function ``(t0, t1, q0, v, args)`` → scalar [energy]; or L, function
      ``(q, v)`` or ``(t, q, v, args)`` → scalar [energy]. v is an array like q0.
    - `root_finder`: settings of the inner solve.

    **Returns** for five arguments a function ``(t0, t1, q0, p1, args)`` → scalar for `System`, for
    four a function ``(t, q, p, args)`` → scalar for `discretise`; [energy].

    **Raises** `TypeError` for a function that takes neither four nor five arguments, or both (with
    defaults or ``*rest``); `ValueError` for one that does not return a scalar.

    **Accuracy** round-off; derivatives to any order are those of the implicit function theorem, in
    q0, p1, t and args. Only for regular Lagrangians, with ∂²L/∂v² invertible, that are smooth at
    v = 0. If L is quadratic in v, which is read from its jaxpr, one linear solve is exact, and a
    separable system stays explicit. Otherwise Newton's method starts from the v of the quadratic
    part at v = 0, with steps halved until they reduce the defect (so that no speed limit of L is
    exceeded). Where no v is found H_D is NaN or infinite, and the status of the step reports it: a
    Lagrangian linear in v gives `not_finite`.

    **Source** the paper, (36); Marsden & West 2001, *Acta Numerica* 10, 357, 1.4.
    """
    if callable(L) and takes_state(L) and not (accepts(L, 4) or accepts(L, 5)):
        L = with_time("L", L, "(t, q, v, args)")
    # The number of arguments decides; a function that takes four and five cannot be classified.
    discrete, continuous = (callable(L) and accepts(L, count) for count in (5, 4))
    if discrete == continuous:
        description = signature_of(L) if callable(L) else repr(L)  # the value of a number, say
        raise TypeError(
            f"L must be a function of (q, v), (t, q, v, args) or of (t0, t1, q0, v, args), got "
            f"{description}, which accepts {'both' if discrete else 'neither'}."
        )
    return (_DiscreteLegendreTransform if discrete else _LegendreTransform)(L, root_finder)


def from_lagrangian(L_d: Callable[..., Any], root_finder: Newton = Newton()) -> HamiltonianFn:
    r"""The discrete Hamiltonian of a discrete Lagrangian, the type I generating function.

        p0 = −∂L_d/∂q0 (t0, t1, q0, q1),    p1 = ∂L_d/∂q1 (t0, t1, q0, q1)

        H_D(t0, t1, q0, p1) = [p1·(q1 − q0) − L_d(t0, t1, q0, q1)] / h,    h = t1 − t0

    where each evaluation solves the second equation for q1, at which the bracket is stationary. The
    map (12)–(13) is that of L_d, and satisfies the discrete Euler–Lagrange equations, with a force

        ∂L_d/∂q1 (q_{k−1}, q_k) + ∂L_d/∂q0 (q_k, q_{k+1}) + h ε W_k = 0.

    In terms of forced discrete Lagrangians W is the left discrete force, f_d⁻ = hεW and f_d⁺ = 0.
    A right force f_d⁺(q_{k−1}, q_k) belongs to the step before and cannot be a W of this step.
    `velocity_force` converts a force on v, or on q1 = q0 + hv.

    The trapezoidal L_d = h/2 [L(q0, v) + L(q1, v)], v = (q1 − q0)/h, is Störmer–Verlet (`Strang`)
    for L = |v|²/2 − V(q); the midpoint L_d = h L((q0 + q1)/2, v) is `GaussLegendre(1)`.

    **Arguments**

    - `L_d`: function ``(t0, t1, q0, q1, args)`` → scalar [action = energy · time], about h L.
      Adjoint steps call it with t1 < t0; it should then be −L_d(t1, t0, q1, q0) or close to it.
    - `root_finder`: settings of the inner solve.

    **Returns** a function ``(t0, t1, q0, p1, args)`` → scalar [energy], for `System`.

    **Raises** `TypeError` for a function that does not take the five arguments, `ValueError` for
    one that does not return a scalar, and in `System` with `slow_time`, where t1 − t0 is not h.

    **Accuracy** as `legendre`, of L_d(q0, q0 + hv)/h in v. The step is computed as t1 − t0, which
    loses digits late in a long run. H_D(t, t, …) does not exist: methods on the continuous
    equations (`RungeKutta4`, `GaussLegendre`, `LobattoIIIAIIIB`) end with `not_finite` at once.

    **Source** Marsden & West 2001, *Acta Numerica* 10, 357, 1.5 and 3.2 (forces); Hairer, Lubich &
    Wanner 2006, *Geometric Numerical Integration*, VI.5 and VI.6.

    **Example**

    ```python
    def midpoint(t0, t1, q0, q1, args):                      # L_d, an action over one step
        v, middle = (q1 - q0) / (t1 - t0), (q0 + q1) / 2
        return (t1 - t0) * (v @ v - middle @ middle) / 2
    oscillator = dvi.System(dvi.from_lagrangian(midpoint))
    sol = dvi.integrate(oscillator, [1.0], [0.0], h=0.1, num_steps=10)
    print(round(float(sol.qs[-1, 0]), 4), round(float(np.cos(1.0)), 4))
    # 0.541 0.5403
    ```
    """
    check_takes("L_d", L_d, "(t0, t1, q0, q1, args)")
    return _FromLagrangian(L_d, root_finder)


def from_type_iii(H_minus: Callable[..., Any], root_finder: Newton = Newton()) -> HamiltonianFn:
    r"""The discrete Hamiltonian, type II, of a type III one.

    The type III generating function is S(p0, q1) = −p0·q1 + h H⁻(t0, t1, q1, p0), with

        q0 = −∂S/∂p0:  q1 = q0 + h ∂H⁻/∂p0 (t0, t1, q1, p0)
        p1 = −∂S/∂q1:  p1 = p0 − h ∂H⁻/∂q1 (t0, t1, q1, p0)

    and the type II discrete Hamiltonian of the same map is

        H_D(t0, t1, q0, p1) = H⁻(t0, t1, q0 + hv, p1 − hf) + h f·v,    h = t1 − t0

    where it is stationary in v and f, that is v = ∂H⁻/∂p0 = (q1 − q0)/h and
    f = −∂H⁻/∂q1 = (p1 − p0)/h; each evaluation solves for both. Without a force it is the map of
    ``Adjoint(TypeII())`` on H_D(t0, t1, q0, p1) = H⁻(t1, t0, q0, p1), which needs no inner solve:
    use that for the map alone, and this function for tools that work on H_D.

    **Arguments**

    - `H_minus`: H⁻, function ``(t0, t1, q1, p0, args)`` → scalar [energy].
    - `root_finder`: settings of the inner solve.

    **Returns** a function ``(t0, t1, q0, p1, args)`` → scalar [energy], for `System`.

    **Raises** `TypeError` for a function that does not take the five arguments, `ValueError` for
    one that does not return a scalar, and in `System` with `slow_time`, where t1 − t0 is not h.

    **Accuracy** round-off; derivatives to any order are those of the implicit function theorem. The
    step is computed as t1 − t0, which loses digits late in a long run. A solve that fails gives
    NaN, and the status of the step reports it.

    **Source** Leok & Zhang 2011, *IMA J. Numer. Anal.* 31, 1497 (types II and III); the form of
    H_D: our own, from L_d = p0·(q1 − q0) − h H⁻ = p1·(q1 − q0) − h H_D.
    """
    check_takes("H_minus", H_minus, "(t0, t1, q1, p0, args)")
    return _FromTypeIII(H_minus, root_finder)


def velocity_force(H_D: HamiltonianFn, F: Callable[..., Any]) -> ForceFn:
    r"""The perturbing force W(q0, p1) of a force F(q0, v).

        W(t0, t1, q0, p1) = F(t0, t1, q0, v),    v = ∂H_D/∂p1 = (q1 − q0)/h

    For a left discrete force on the ends, f_d⁻(q0, q1) = h ε f, it is F = f(q0, q0 + (t1 − t0) v).

    **Arguments**

    - `H_D`: the discrete Hamiltonian of the same `System`; v does not include its perturbation.
    - `F`: function ``(q0, v)`` or ``(t0, t1, q0, v, args)`` → array like q0 [energy / unit of q].

    **Returns** a function ``(t0, t1, q0, p1, args)`` → array like q0, for `System`.

    **Raises** `TypeError` for functions that do not take the five arguments.

    **Accuracy** that of ∂H_D/∂p1; gradients in all inputs.

    **Source** (12); Marsden & West 2001, 3.2.1.
    """
    check_takes("H_D", H_D, "(t0, t1, q0, p1, args)")
    return _VelocityForce(H_D, with_time("F", F, "(t0, t1, q0, v, args)"))


def _legendre_transform(
    L: Callable[[State], Any], p: State, root_finder: Newton, name: str, scale: State | None = None
) -> Scalar:
    """p·v − L(v) at the v with ∂L/∂v = p; NaN where none is found. `scale`: a scale of the
    round-off of v, q0/h where v is a difference of positions."""

    def lagrangian(v):
        return _scalar(L(v.reshape(p.shape)), name)

    momentum = p.ravel()
    # A custom derivative may not close over traced values: they become arguments.
    free, closed_over = jax.closure_convert(lagrangian, momentum)
    scale = jnp.zeros_like(momentum) if scale is None else scale.ravel()
    return _stationary(free, root_finder, momentum, closed_over, scale)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _stationary(
    L: Callable[..., Scalar], root_finder: Newton, p: Vector, parameters: list, scale: Vector
) -> Scalar:
    """p·v − L(v, *parameters) where it is stationary in v."""
    v = _velocity(L, root_finder, p, parameters, scale)
    return jnp.sum(p * v) - L(v, *parameters)


@_stationary.defjvp
def _(L, root_finder, inputs, changes):
    # The value is stationary in v: its first derivative is that at constant v. Higher ones follow,
    # since v itself has derivatives by the implicit function theorem.
    v = _velocity(L, root_finder, *inputs)

    def value(p, parameters):
        return jnp.sum(p * v) - L(v, *parameters)

    return jax.jvp(value, inputs[:2], changes[:2])


def _velocity(
    L: Callable[..., Scalar], root_finder: Newton, p: Vector, parameters: list, scale: Vector
) -> Vector:
    def slope(v):
        return jax.grad(L)(v, *parameters)

    # The matrix ∂²L/∂v² of a Lagrangian that is quadratic in v does not depend on v. This is
    # decided from the jaxpr, so that ∂H_D/∂p1 of a separable system is independent of q0 too.
    zero = jnp.zeros_like(p)
    if not depends_on(jax.jacfwd(slope), 0, zero):
        return lanewise.solve(jax.jacfwd(slope)(zero), p - slope(zero))
    start = _start(slope, p, zero)
    # Where v is small next to terms of p that cancel, its scale is that of their round-off.
    of_terms = lanewise.solve(jax.jacfwd(slope)(start), p)
    scale = jnp.maximum(jnp.abs(scale), jnp.abs(start) + jnp.abs(of_terms))
    return _root(lambda v: slope(v) - p, start, scale, root_finder)


def _root(residual: Callable, guess: Vector, scale: Vector, root_finder: Newton) -> Vector:
    x, info = find_root(residual, guess, scale, NestedNewton(**vars(root_finder)))
    # An H_D has no status: NaN reports a failure, from which the step gets its status.
    return jnp.where(info.converged, x, jnp.nan)


def _start(slope: Callable[[Vector], Vector], p: Vector, zero: Vector) -> Vector:
    """A v with slope(v) near p, by Newton's method with step halving, from rest."""
    # Without derivatives: a root does not depend on the start of the search.
    free, closed_over = jax.closure_convert(slope, zero)
    closed_over, p = lax.stop_gradient((closed_over, p))

    def defect(v):
        return free(v, *closed_over) - p

    def size(v):
        return jnp.max(jnp.abs(defect(v)), initial=0.0)

    def far(state):
        _, left, _, trials = state
        # Relative to the defect at rest, since an absolute limit would depend on the units.
        return (left > _DEFECT * size(zero)) & (trials < _MOST_TRIALS)

    def closer(state):
        v, left, part, trials = state
        trial = v - part * lanewise.solve(jax.jacfwd(defect)(v), defect(v))
        new = size(trial)
        gain = new < left  # false for NaN, beyond the domain of L
        # Doubled after a success, so that the search ends with full Newton steps.
        part = jnp.where(gain, jnp.minimum(2 * part, 1), part / 2)
        return jnp.where(gain, trial, v), jnp.where(gain, new, left), part, trials + 1

    return lax.while_loop(far, closer, (zero, size(zero), jnp.ones((), zero.dtype), 0))[0]


def _scalar(value: Any, name: str) -> Scalar:
    return array(name, jnp.asarray(value), (), verb="return", hint="Use jnp.sum or jnp.real.")
