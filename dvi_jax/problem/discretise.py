"""From a continuous Hamiltonian to a discrete one."""

from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..base.checks import whole
from ..base.signature import warn_of_exchanged, with_time
from ..base.types import Args, HamiltonianFn, Scalar, State


# A module and not a closure: `is_first_order` recognises it.
class _LeftRule(eqx.Module):
    H: Callable[..., Any]

    def __call__(self, t0: Scalar, t1: Scalar, q0: State, p1: State, args: Args) -> Scalar:
        del t1
        return self.H(t0, q0, p1, args)


_MIDPOINT = ((0.5,), (1.0,), ((0.5,),))
_ROOT = 3.0**0.5 / 6
_TWO_POINTS = ((0.5 - _ROOT, 0.5 + _ROOT), (0.5, 0.5), ((0.25, 0.25 - _ROOT), (0.25 + _ROOT, 0.25)))
# Order: Gauss nodes c, weights b and integrals a of collocation, and the number of passes. Two
# passes would suffice for order 4 (the error of a curve enters a stationary value squared), but
# then terms of h⁵ exceed that of h⁴ at usual steps.
_RULES = {2: (_MIDPOINT, 1), 3: (_TWO_POINTS, 1), 4: (_TWO_POINTS, 3)}


class _ActionRule(eqx.Module):
    H: Callable[..., Any]
    order: int = eqx.field(static=True)

    # h is t1 − t0, which is not the step in a slow time: `System` raises an error for that.
    step_is_from_times: ClassVar[bool] = True

    def __call__(self, t0: Scalar, t1: Scalar, q0: State, p1: State, args: Args) -> Scalar:
        table, passes = _RULES[self.order]
        c, b, a = (np.asarray(part, p1.dtype) for part in table)  # no promotion of float32
        h = t1 - t0
        each_node = (0, 0, 0, None)
        energy = jax.vmap(self.H, in_axes=each_node)
        slope = jax.vmap(jax.grad(self.H, argnums=(1, 2)), in_axes=each_node)
        times = t0 + c * h
        qs = jnp.broadcast_to(q0, (len(c), *q0.shape))
        ps = jnp.broadcast_to(p1, qs.shape)
        q_rates = qs
        for _ in range(passes):
            p_falls, q_rates = slope(times, qs, ps, args)
            qs = q0[None] + h * jnp.tensordot(a, q_rates, 1)
            ps = p1[None] + h * jnp.tensordot(b[None] - a, p_falls, 1)
        pq = jnp.sum(((ps - p1[None]) * q_rates).reshape(len(c), -1), axis=1)
        return jnp.dot(b, energy(times, qs, ps, args) - pq)


_DISCRETE = "A discrete Hamiltonian H_D(t0, t1, q0, p1, args) is passed to dvi.System directly."


def is_first_order(H_D: Any) -> bool:
    """Whether a discrete Hamiltonian is a continuous one, evaluated at (t0, q0, p1)."""
    return isinstance(H_D, _LeftRule)


def refuse_step_from_times(name: str, H_D: Any) -> None:
    """**Raises** `ValueError` for an H_D that computes the step as t1 − t0, where that is not h."""
    if getattr(H_D, "step_is_from_times", False):
        raise ValueError(
            f"{name} must not compute the step as t1 − t0, as dvi.discretise(H, order) with order "
            "≥ 2, dvi.from_lagrangian and dvi.from_type_iii do. Use dvi.discretise(H, order=1) or "
            "dvi.legendre(L)."
        )


def discretise(H: Callable[..., Any], order: int = 1) -> HamiltonianFn:
    r"""The discrete Hamiltonian of order r of a continuous one.

    Order 1 is the paper's rule,

        H_D(t0, t1, q0, p1) = H(t0, q0, p1).

    The exact H_D, whose map (12)–(13) is the flow itself, is the stationary value of an action over
    curves with q(0) = q0 and p(1) = p1:

        H_D = ∫₀¹ [H(t0 + σh, q, p) − (p − p1)·q'/h] dσ,    h = t1 − t0

    Orders 2, 3 and 4 evaluate it on the first Picard iterates of the solution,

        q ← q0 + h ∫₀^σ ∂H/∂p,    p ← p1 + h ∫_σ¹ ∂H/∂q    from q = q0, p = p1,

    with the integrals at Gauss nodes: one node and one pass (order 2), two nodes and one pass
    (order 3), two nodes and three passes (order 4; many passes: the Gauss method of two stages).

    For every r the map is symplectic, as the map of one H_D, and every tool for H_D applies. H_D is
    invariant under all linear maps and translations of q under which H is. Orders 2 to 4 couple q0
    and p1 even where H is separable, so that each step needs a solve: for a separable H a
    composition (`Yoshida`, `BlanesMoan`, `KahanLi`) is cheaper. `Strang` on order 3 has order 4.

    **Arguments**

    - `H`: function ``(q, p)`` or ``(t, q, p, args)`` → scalar [energy]; smooth.
    - `order`: r = 1, 2, 3 or 4.

    **Returns** a function ``(t0, t1, q0, p1, args)`` → scalar [energy], for `System`.

    **Raises** `TypeError` for a function that does not take the four arguments,
    `ValueError` for any other order.

    **Accuracy** H_D − H_{D,exact} = O(h^r). A force or a perturbation of `System` is not changed,
    and adds an error O(εh) if it is evaluated at (q0, p1): put a perturbation into H through args,
    and compose a forced map. Orders 2 to 4 compute h as t1 − t0, which loses digits late in a long
    run. With `slow_time` it is not the step, and `System` raises an error.

    **Source** order 1: the paper, (36)–(37) and the text before (32). The action: Leok & Zhang
    2011, *IMA J. Numer. Anal.* 31, 1497 (type II). Picard iterates in it: our own. The first r
    terms in h are those of the Hamilton–Jacobi recursion (Hairer, Lubich & Wanner 2006, VI.5),
    which nests r − 1 derivatives where this takes one: measured on Kepler at order 3, four times
    as long to compile and five times as long to run.

    **Example**

    ```python
    def H(t, q, p, args):
        return p[0] ** 2 / 2 - jnp.cos(q[0])
    pendulum = dvi.System(dvi.discretise(H, order=4))
    sol = dvi.integrate(pendulum, [1.0], [0.0], h=0.1, num_steps=10)
    print(round(float(sol.qs[-1, 0]), 5))
    # 0.60009
    ```
    """
    H = with_time("H", H, hints={5: _DISCRETE})
    warn_of_exchanged("H", H, "(t, q, p, args)")
    order = whole("order", order, 1, 4, "A composition has more, such as method=dvi.Yoshida(6).")
    return _LeftRule(H) if order == 1 else _ActionRule(H, order)
