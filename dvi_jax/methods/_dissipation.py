"""A warning where a method goes backwards in time against strong dissipation."""

import warnings
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..base.keywords import user_level
from ..base.types import Interval, State
from ._base import Method
from .step import Equations

# Measured on a damped oscillator: from here on `Strang` with the same work is as accurate as the
# triple jump. At 1 the map is singular.
_STRONG = 0.3


def warn_of_dissipation(
    method: Method, equations: Equations, first_interval: Callable, q0: State, p0: State
) -> None:
    r"""Warn of substeps backwards in time if the dissipation at the initial state is strong.

    Over a substep ch with c < 0 a force εW = −γp amplifies p by 1/(1 + cγh), which is infinite at
    −cγh = 1. The other substeps reverse that, but the errors grow with it. γ is the largest
    −∂(εW_i)/∂p_i at (q0, p0). Compositions of `TypeII` of order above 2 all have such substeps.

    All values must be known, not traced, and the system must have a force.
    """
    backwards = -min(type(method).substeps(method))
    if backwards <= 0:  # without a substep backwards not even the Jacobian is evaluated
        return
    interval = first_interval()  # made only here: most methods do not need it
    damping = float(_damping(equations, interval, q0, p0))
    growth = backwards * float(interval.h) * damping
    if growth > _STRONG and np.isfinite(growth):
        warnings.warn(
            f"{type(method).__name__} may be inaccurate for this damping. The method has a "
            f"substep backwards in time of {backwards:.2g} h, and in this substep the damping "
            f"force amplifies the momenta. The damping rate at the initial conditions is "
            f"{damping:.3g} per unit of time; the rate times the length of this substep is "
            f"{growth:.3g}. Above {_STRONG} the map is not more accurate than a map of order 2; "
            "at 1 it is singular. Use a smaller h, or a method without substeps backwards in "
            "time, such as dvi.Strang() or dvi.GaussLegendre(2).",
            stacklevel=user_level(),
        )


@eqx.filter_jit
def _damping(equations: Equations, interval: Interval, q0: State, p0: State):
    """The largest −∂(εW_i)/∂p_i over the components i."""

    def force(p):
        point = (interval.t0, interval.t1, q0, p.reshape(p0.shape), equations.epsilon)
        return equations.system.disturbing_force(*point, equations.args).ravel()

    return -jnp.min(jnp.diagonal(jax.jacfwd(force)(p0.ravel())))
