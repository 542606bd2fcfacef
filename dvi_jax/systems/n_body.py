"""Bodies that attract one another by Newton's law."""

from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from ..base.checks import array, finite, positive, require
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

        H_D = Σ_i |p1_i|² / (2 m_i) − G Σ_{i<j} m_i m_j / √(|q0_i − q0_j|² + b²)

    - `q0`: positions [length], shape (bodies, dim); `p1`: momenta [mass length / time].
    - `args`: ``{"masses": (bodies,), "G": number, "softening": b}``; G is 1 and b is 0 when left
      out (b > 0: Plummer's law). With masses given as GM [length³/time²] and G = 1 momenta and
      energy carry one factor G more, and the orbits are the same.

    Without a softening two bodies at one point give −∞ here and NaN in the step, hence the status
    `not_finite`.

    **Raises** `ValueError` when the shapes of q0 and masses do not agree.
    """
    masses = masses_of(q0, args)
    kinetic = jnp.sum(jnp.sum(p1**2, axis=-1) / masses) / 2
    # Every pair twice, and a body with itself at distance 1 but with weight 0: dense arrays
    # that one kernel can run through, where a list of pairs would gather and scatter.
    diagonal = jnp.eye(masses.shape[0], dtype=bool)
    difference = q0[:, None, :] - q0[None, :, :]
    square = softened(jnp.sum(difference**2, axis=-1), args)
    distance = jnp.sqrt(jnp.where(diagonal, 1.0, square))
    weight = jnp.where(diagonal, 0.0, masses[:, None] * masses[None, :])
    return kinetic - args.get("G", 1.0) * jnp.sum(weight / distance) / 2


def softened(square, args):
    """r² + b² of a squared distance r²."""
    return square + args["softening"] ** 2 if "softening" in args else square


def restricted(t0, t1, q0, p1, args):
    r"""`hamiltonian` of the massive bodies, the first of q0, plus the free motion of the others.

        H_D = H(Q, P) + Σ_k |u_k|²/2,    q0 = (Q, x),  p1 = (P, u)

    The test particles x_k, those without an entry in ``args["masses"]``, have the velocity u_k as
    their momentum (per unit mass); `attraction` is the force on them.
    """
    m = len(args["masses"])
    return hamiltonian(t0, t1, q0[:m], p1[:m], args) + jnp.sum(p1[m:] ** 2) / 2


def attraction(t0, t1, q0, p1, args):
    r"""W: zero for massive bodies, −G Σ_j m_j (x_k − Q_j)/(|x_k − Q_j|² + b²)^{3/2} for the others.

    It is a force and not a part of H_D, because a Hamiltonian that attracts the test particles
    would pull the massive bodies with the opposite force.
    """
    masses = jnp.asarray(args["masses"], q0.dtype)
    m = masses.shape[0]
    difference = q0[m:, None, :] - q0[None, :m, :]
    square = softened(jnp.sum(difference**2, axis=-1), args)
    weight = -args.get("G", 1.0) * masses[None, :] / (square * jnp.sqrt(square))
    pull = jnp.sum(weight[:, :, None] * difference, axis=1)
    return jnp.concatenate([jnp.zeros_like(q0[:m]), pull])


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
    square = softened(jnp.sum((q[i] - q[j]) ** 2, axis=-1), args)
    rates = (masses[i] + masses[j]) / (square * jnp.sqrt(square))
    return 1 / jnp.sqrt(args.get("G", 1.0) * jnp.sum(rates))


def centre_of_mass(t0, t1, q0, p0, q1, p1, args):
    """(Σ m_i q_i − t1 Σ p_i)/Σ m_i, shape (dim,): the centre of mass at t = 0, a constant."""
    masses = masses_of(q1, args)
    return (jnp.sum(masses[:, None] * q1, axis=0) - t1 * jnp.sum(p1, axis=0)) / jnp.sum(masses)


def _of_massive(observable, t0, t1, q0, p0, q1, p1, args):
    """The observable of the bodies with a mass, without the test particles."""
    m = len(args["masses"])
    return observable(t0, t1, q0[:m], p0[:m], q1[:m], p1[:m], args)


def test_energies(t0, t1, q0, p0, q1, p1, args):
    """|u_k|²/2 − G Σ_j m_j/√(|x_k − Q_j|² + b²) of the test particles at t1, per unit mass."""
    masses = jnp.asarray(args["masses"], q1.dtype)
    m = masses.shape[0]
    square = jnp.sum((q1[m:, None, :] - q1[None, :m, :]) ** 2, axis=-1)
    potential = jnp.sum(masses[None, :] / jnp.sqrt(softened(square, args)), axis=1)
    return jnp.sum(p1[m:] ** 2, axis=-1) / 2 - args.get("G", 1.0) * potential


OBSERVABLES: dict[str, Callable[..., Any]] = {
    f.__name__: of_state(f) for f in (energy, linear_momentum, angular_momentum)
}
RESTRICTED: dict[str, Callable[..., Any]] = {
    name: of_state(bound(_of_massive, f)) for name, f in OBSERVABLES.items()
} | {"test_energies": of_state(test_energies)}
"""The observables of a problem with test particles: those of the massive bodies, and theirs."""


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
    if "softening" in args:
        check_parameter(args, "softening", _not_negative)
    rule = "q0 and p0 of N bodies must both have shape (bodies, 2) or (bodies, 3)"
    check_shape(q, p, lambda shape: len(shape) == 2 and shape[1] in (2, 3), rule)
    array("masses", masses, q.shape[:1], integers=True)

    def label(i: int) -> str:
        return names[i] if names is not None and len(names) == len(masses) else f"body {i}"

    bad = ~(np.isfinite(masses) & (masses > 0))
    if bad.any():
        i = int(np.argmax(bad))
        raise ValueError(
            f"the mass of {label(i)} must be positive and finite, got {masses[i]}. Bodies of "
            "mass 0 are test particles: systems.n_body takes them after all others."
        )
    separation = np.linalg.norm(q[:, None, :] - q[None, :, :], axis=-1)
    size = np.linalg.norm(q, axis=-1)
    rounding = 4 * np.finfo(float).eps * np.maximum(size[:, None], size[None, :])
    check_apart(np.triu(separation <= rounding, k=1), q, label)


def check_apart(close: Any, q: Any, label: Callable[[int], str]) -> None:
    """**Raises** `ValueError` if a pair (i, j) of `close` is at one position, with their labels."""
    if close.any():
        i, j = map(int, np.argwhere(close)[0])
        raise ValueError(
            f"{label(i)} and {label(j)} must have different positions, got {q[i].tolist()} for "
            "both, up to rounding."
        )


def check_restricted(q0: Any, p0: Any, args: Any) -> None:
    """`check_bodies` of the massive bodies, and shapes and places of the test particles."""
    m = np.size(parameter(args, "masses"))
    q, p = np.asarray(q0, float), np.asarray(p0, float)
    rule = f"q0 and p0 must both have shape (bodies, 2) or (bodies, 3) with more than {m} bodies"
    check_shape(q, p, lambda shape: len(shape) == 2 and shape[1] in (2, 3) and shape[0] > m, rule)
    check_bodies(q[:m], p[:m], args)
    if not args.get("softening"):
        touches = np.all(q[:, None] == q[None], axis=-1)
        touches[:, :m] = touches[m:] = False
        check_apart(touches, q, lambda i: f"test particle {i}" if i >= m else f"body {i}")


def _not_negative(name, value):
    positive(name, value, zero=True)


PARAMETERS = {
    "masses": "of the bodies [mass]",
    "G": "gravity [length³/(mass time²)]",
    "softening": "b of Plummer's law [length]",
}
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
    masses: Any = None, q0: Any = None, p0: Any = None, h: float = 0.01, G: float = 1.0, *,
    softening: float = 0.0,
) -> Problem:  # fmt: skip
    r"""N bodies with the given masses and initial conditions; by default the figure eight of three.

        H = Σ_i |p_i|²/(2 m_i) − G Σ_{i<j} m_i m_j/√(|q_i − q_j|² + b²)

    - `masses`: shape (bodies,). `q0`: positions, `p0`: momenta, shape (bodies, 2 or 3).
    - `h`: a suitable step size [time]. `G`: the gravitational constant.
    - `softening`: b of Plummer's law [length].

    **Test particles** are bodies of mass exactly 0, given after all others. The momentum m v of
    such a body is zero and determines no velocity. Therefore its row of p is the velocity u
    (momentum per unit mass), and its motion is

        dx/dt = u,    du/dt = −G Σ_j m_j (x − Q_j)/(|x − Q_j|² + b²)^{3/2} .

    The massive bodies (Q, P) do not depend on it. For given Q(t) the motion of x is Hamiltonian,
    but that of all bodies together is not: a Hamiltonian with a term that attracts x would pull the
    bodies Q_j with the opposite force. Therefore the attraction of the test particles is the force
    W of the system, with ε = 1, and in H_D they move freely. W depends on positions only: explicit
    methods stay explicit, Q and P are those of a run without test particles, and the step map of
    (x, u) for given Q is symplectic. With another ε the attraction has another strength; put the
    strength of a perturbation of your own into args.

    ``args["masses"]`` has the masses of the massive bodies only. The observables are those of the
    massive bodies, and `test_energies`.

    **Raises** `ValueError` for initial conditions that `check_bodies` rejects, for a body of mass 0
    before one with a mass, and for a negative softening; `TypeError` when only some of masses, q0
    and p0 are given.

    **Source** figure eight: see `figure_eight`. Restricted problem: Szebehely 1967, *Theory of
    Orbits*, 1; softening: Aarseth 2003, *Gravitational N-Body Simulations*, 2.1.
    """
    if masses is None and q0 is None and p0 is None:
        masses, q0, p0 = np.ones(3), EIGHT_POSITIONS, EIGHT_MOMENTA
    hint = "Give all of masses, q0 and p0, or none."
    require("n_body", {"masses": masses, "q0": q0, "p0": p0}, hint=hint)
    masses = np.asarray(masses, float)
    count = int(np.max(np.flatnonzero(masses), initial=-1)) + 1  # bodies before the test particles
    has_tests = 0 < count < np.size(masses) and np.ndim(masses) == 1
    args: dict[str, Any] = {"masses": masses[:count] if has_tests else masses, "G": finite("G", G)}
    if softening:
        args["softening"] = positive("softening", softening)
    if has_tests:
        array("masses", masses, np.asarray(q0).shape[:1], integers=True)
    check = check_restricted if has_tests else check_bodies
    check(q0, p0, args)
    known = symmetries(np.asarray(q0).shape[-1])
    if softening:
        del known["scaling"]
    if has_tests:  # boosts are written for bodies with a mass
        known = {name: g for name, g in known.items() if not name.startswith("boost")}
    return Problem(
        name="n_body",
        system=System(restricted, force=attraction, epsilon=1.0)
        if has_tests
        else System(hamiltonian),
        q0=np.asarray(q0, float),
        p0=np.asarray(p0, float),
        h=h,
        args=args,
        observables=RESTRICTED if has_tests else OBSERVABLES,
        units=DIMENSIONLESS,
        source="Chenciner & Montgomery 2000, Ann. Math. 152, 881 (the figure eight)",
        check=check,
        parameters={name: PARAMETERS[name] for name in args},
        invariants=INVARIANTS,
        symmetries=known,
    )
