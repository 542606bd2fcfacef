"""Bodies that attract one another by Newton's law."""

from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from ..base.checks import array, finite, require
from ..discover.functions.generators import Generator
from ..discover.symmetries.library import rotation, scaling, space_translation, time_translation
from ..problem.system import System
from ._problem import (
    DIMENSIONLESS,
    Problem,
    at_end,
    bound,
    check_parameter,
    check_shape,
    of_state,
    parameter,
)

_PLACE, _SPEED = np.array([0.97000436, -0.24308753]), np.array([-0.93240737, -0.86473146])
EIGHT_POSITIONS = np.array([_PLACE, -_PLACE, np.zeros(2)])
EIGHT_MOMENTA = np.array([-_SPEED / 2, -_SPEED / 2, _SPEED])
"""Initial conditions of the figure eight: see `figure_eight`."""


def hamiltonian(t0, t1, q0, p1, args):
    r"""Newtonian N-body Hamiltonian.

        H_D = Σ_i |p1_i|² / (2 m_i) − G Σ_{i<j} m_i m_j / |q0_i − q0_j|

    - `q0`: positions [length], shape (bodies, dim); `p1`: momenta [mass length / time].
    - `args`: ``{"masses": (bodies,), "G": number}``; G is 1 when left out. With masses given as
      GM [length³/time²] and G = 1 momenta and energy carry one factor G more, and the orbits
      are the same.

    Two bodies at one point give −∞ here and NaN in the step, hence the status `not_finite`.

    **Raises** `ValueError` when the shapes of q0 and masses do not agree.
    """
    return energy_of(q0, p1, args)


def energy_of(q0, p1, args, softening=None):
    """`hamiltonian`, of Plummer's law where there is a `softening` [length]."""
    masses = masses_of(q0, args)
    kinetic = jnp.sum(jnp.sum(p1**2, axis=-1) / masses) / 2
    # Every pair twice, and a body with itself at distance 1 but with weight 0: dense arrays
    # that one kernel can run through, where a list of pairs would gather and scatter.
    diagonal = jnp.eye(masses.shape[0], dtype=bool)
    difference = q0[:, None, :] - q0[None, :, :]
    square = jnp.sum(difference**2, axis=-1)
    square = square if softening is None else square + softening**2
    distance = jnp.sqrt(jnp.where(diagonal, 1.0, square))
    weight = jnp.where(diagonal, 0.0, masses[:, None] * masses[None, :])
    return kinetic - args.get("G", 1.0) * jnp.sum(weight / distance) / 2


def masses_of(q, args):
    """The masses as an array. **Raises** `ValueError` where q has not as many bodies."""
    masses = jnp.asarray(args["masses"], q.dtype)
    array("positions", q, ("bodies", "dim"), integers=True, empty=True)
    return array("masses", masses, q.shape[:1], integers=True)


energy = at_end(hamiltonian)


def linear_momentum(t0, t1, q0, p0, q1, p1, args):
    """Σ p_i at t1 [mass length / time], shape (dim,)."""
    return jnp.sum(p1, axis=0)


def angular_momentum(t0, t1, q0, p0, q1, p1, args):
    """Σ q_i × p_i at t1 [mass length² / time]: shape (3,), or one number in the plane."""
    if q1.shape[-1] == 2:
        return jnp.sum(q1[:, 0] * p1[:, 1] - q1[:, 1] * p1[:, 0])
    return jnp.sum(jnp.cross(q1, p1), axis=0)


def encounter_time(t, q, p, args):
    r"""Time scale of the closest encounter, a `speed` for adaptive steps.

        g = 1/√(G Σ_{i<j} (m_i + m_j)/|q_i − q_j|³)   [time]

    For two bodies it is r^{3/2}/√(G(m_1 + m_2)), 1/2π of the period of a circular orbit of radius
    r. Arguments as of `hamiltonian`, with the momenta p, which have no effect.
    """
    masses = masses_of(q, args)
    i, j = np.triu_indices(masses.shape[0], 1)
    square = jnp.sum((q[i] - q[j]) ** 2, axis=-1)
    rates = (masses[i] + masses[j]) / (square * jnp.sqrt(square))
    return 1 / jnp.sqrt(args.get("G", 1.0) * jnp.sum(rates))


OBSERVABLES: dict[str, Callable[..., Any]] = {
    f.__name__: of_state(f) for f in (energy, linear_momentum, angular_momentum)
}


def check_bodies(q0: Any, p0: Any, args: Any, names: Sequence[str] | None = None) -> None:
    """Require initial conditions that the N-body Hamiltonian is regular at.

    Arguments as in `hamiltonian`, with values (not under jit); `names` of the bodies for the
    message, else their indices.

    **Raises** `ValueError` for shapes that do not agree, a mass that is not positive (its
    momentum would determine no velocity), a G that is not finite, and two bodies closer than the
    rounding of their positions.
    """
    q, p = np.asarray(q0, float), np.asarray(p0, float)
    masses = np.asarray(parameter(args, "masses"), float)
    if "G" in args:
        check_parameter(args, "G", finite)
    rule = "q0 and p0 of N bodies must both have shape (bodies, 2) or (bodies, 3)"
    check_shape(q, p, lambda shape: len(shape) == 2 and shape[1] in (2, 3), rule)
    array("masses", masses, q.shape[:1], integers=True)

    def label(i: int) -> str:
        return names[i] if names is not None and len(names) == len(masses) else f"body {i}"

    bad = ~(np.isfinite(masses) & (masses > 0))
    if bad.any():
        i = int(np.argmax(bad))
        raise ValueError(
            f"the mass of {label(i)} must be positive and finite, got {masses[i]}. For a test "
            "particle give a very small one."
        )
    separation = np.linalg.norm(q[:, None, :] - q[None, :, :], axis=-1)
    size = np.linalg.norm(q, axis=-1)
    rounding = 4 * np.finfo(float).eps * np.maximum(size[:, None], size[None, :])
    i, j = np.nonzero(np.triu(separation <= rounding, k=1))
    if i.size:
        a, b = int(i[0]), int(j[0])
        raise ValueError(
            f"{label(a)} and {label(b)} must have different positions, got {q[a].tolist()} for "
            "both, up to rounding."
        )


PARAMETERS = {"masses": "of the bodies [mass]", "G": "gravity [length³/(mass time²)]"}
INVARIANTS = tuple(OBSERVABLES)


def symmetries(dim: int) -> dict[str, Generator]:
    """Galilean symmetries in `dim` dimensions, and the scaling of Kepler's third law."""
    axes = "xyz"[:dim]
    generators = {"time": time_translation(), "scaling": scaling(q=1.0, p=-0.5, t=1.5)}
    for i, x in enumerate(axes):
        generators[f"translation_{x}"] = space_translation(np.eye(dim)[i])
        generators[f"boost_{x}"] = _boost(np.eye(dim)[i])
        for j in range(i + 1, dim):
            generators[f"rotation_{x}{axes[j]}"] = rotation(i, j)
    return generators


def _boost(direction):
    """`library.boost` for the masses of args: ξ = t v, η_i = m_i v."""
    return Generator(xi=bound(_xi, direction), eta=bound(_eta, direction))


def _xi(direction, t, q, p, args):
    return t * jnp.broadcast_to(jnp.asarray(direction, q.dtype), q.shape)


def _eta(direction, t, q, p, args):
    return jnp.asarray(args["masses"], p.dtype)[:, None] * jnp.asarray(direction, p.dtype)[None]


def n_body(
    masses: Any = None, q0: Any = None, p0: Any = None, h: float = 0.01, G: float = 1.0
) -> Problem:
    """N bodies with the given masses and initial conditions; by default the figure eight of three.

    - `masses`: shape (bodies,). `q0`: positions, `p0`: momenta, shape (bodies, 2 or 3).
    - `h`: a suitable step size [time]. `G`: the gravitational constant.

    **Raises** `ValueError` for initial conditions that `check_bodies` rejects, `TypeError` when
    only some of masses, q0 and p0 are given.

    **Source** figure eight: see `figure_eight`.
    """
    if masses is None and q0 is None and p0 is None:
        masses, q0, p0 = np.ones(3), EIGHT_POSITIONS, EIGHT_MOMENTA
    hint = "Give all of masses, q0 and p0, or none."
    require("n_body", {"masses": masses, "q0": q0, "p0": p0}, hint=hint)
    args = {"masses": np.asarray(masses, float), "G": finite("G", G)}
    check_bodies(q0, p0, args)
    return Problem(
        name="n_body",
        system=System(hamiltonian),
        q0=np.asarray(q0, float),
        p0=np.asarray(p0, float),
        h=h,
        args=args,
        observables=OBSERVABLES,
        units=DIMENSIONLESS,
        source="Chenciner & Montgomery 2000, Ann. Math. 152, 881 (the figure eight)",
        check=check_bodies,
        parameters=PARAMETERS,
        invariants=INVARIANTS,
        symmetries=symmetries(np.asarray(q0).shape[-1]),
    )
