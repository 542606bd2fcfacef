"""A warning where a method goes backwards in time against strong dissipation."""

import warnings
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._step import Equations
from .._types import Interval, State
from ._base import Method

_STRONG = 0.3
"""Damping over the longest part backwards from which on there is a warning."""


def warn_of_dissipation(
    method: Method,
    equations: Equations,
    first_interval: Callable[[], Interval],
    q0: State,
    p0: State,
) -> None:
    r"""A warning when a part that goes backwards meets strong dissipation at the start.

    Over a part of length ch with c < 0 a force εW = −γp makes p grow, as 1/(1 + cγh), which is
    infinite at −cγh = 1; the other parts take that back, but the errors grow with it. The warning
    comes from −cγh = 0.3 on, where (measured on a damped oscillator) `Strang` with the same work is
    as accurate as the triple jump, with γ the largest −∂(εW_i)/∂p_i at (q0, p0). Compositions of
    `TypeII` of order above 2 all have such parts.

    All values known, not traced; the system has a force. One evaluation of a Jacobian, and none for
    a method without negative parts.
    """
    backwards = -min(method.substeps())
    if backwards <= 0:
        return
    interval = first_interval()
    damping = float(_damping(equations, interval, q0, p0))
    growth = backwards * float(interval.h) * damping
    if growth > _STRONG and np.isfinite(growth):
        warnings.warn(
            f"{type(method).__name__} goes backwards by {backwards:.2g} of a step, and over that "
            f"the force damps (there: drives) by {growth:.3g} at the start, a rate of "
            f"{damping:.3g} per unit of time. The map breaks down at 1, and from {_STRONG} on its "
            "order is worth little: take a smaller h, or dvi.Strang(), which never goes "
            "backwards.",
            stacklevel=3,
        )


@eqx.filter_jit
def _damping(equations: Equations, interval: Interval, q0: State, p0: State):
    """The largest −∂(εW_i)/∂p_i over the components i."""

    def force(p):
        at = (interval.t0, interval.t1, q0, p.reshape(p0.shape), equations.epsilon)
        return equations.system.disturbing_force(*at, equations.args).ravel()

    return -jnp.min(jnp.diagonal(jax.jacfwd(force)(p0.ravel())))
