"""Particles of one species and one energy in a field: SI units, initial conditions, losses."""

import dataclasses
import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from numpy.polynomial.polynomial import polyval

from ...base.checks import array, electronvolts, finite, in_range, instance, one_of, positive
from ...base.printing import printable
from ...observe import Crossings, Section, Stop
from ...problem.discretise import discretise
from ...problem.system import System
from ._bounce import Pitch, SecondInvariant, at_crossings, centre_of, complete
from ._classes import Trapping, largest_strength
from ._field import Field, polynomial
from ._motion import Angles, Breaking, Regular, continuous_hamiltonian, flux

# CODATA 2018: e and the electronvolt exactly, and the mass of the alpha particle.
_EV = 1.602176634e-19
_ALPHA_MASS = 6.6446573357e-27
_CHARTS = ("regular", "angles")


@printable
class Coordinates(NamedTuple):
    """Boozer coordinates of guiding centres: s = ψ/ψ_edge, θ and ζ [rad], v∥ [m/s], |B| [T]."""

    s: Array
    theta: Array
    zeta: Array
    v_parallel: Array
    B: Array


@printable
class GuidingCentres(eqx.Module):
    r"""Guiding centres of particles of one species and one energy in a magnetic field.

    Canonical equations of motion in Boozer coordinates, in units of the particles (see `seconds`
    and `step`): lengths in m, speeds in units of v0 = √(2E/m), fields in T.

        H = u²/2 + μB,   p_θ = ψ/ρ + u I/B,   p_ζ = −χ/ρ + u G/B,   u = v∥/v0,   ρ = m v0/(Ze)

    The state is q = (Y, ζ), p = (X, p_ζ) with X + iY = √(2p_θ) e^{iθ}, or for a negative charge
    Y + iX = √(−2p_θ) e^{iθ} (`coordinates="regular"`: smooth at the magnetic axis), or q = (θ, ζ),
    p = (p_θ, p_ζ) (`"angles"`). There are no collisions, no electric field and no finite
    gyroradius: H is the drift Hamiltonian of first order in ρ. The energy is H = 1/2.

    **Arguments**

    - `field`: a `Field`.
    - `energy`: of the particles [eV]; `mass` [kg] and `charge` [e]. The defaults are the alpha
      particles of fusion, 3.5 MeV.
    - `breaking`: coefficients of further modes (from `Field.split`): ``epsilon`` of a run is their
      factor. None: the field is complete.
    - `coordinates`: "regular" or "angles".

    **Source** Littlejohn 1983, *J. Plasma Phys.* 29, 111; White & Chance 1984, *Phys. Fluids* 27,
    2455; with symplectic integrators: Albert, Kasilov & Kernbichler 2020, *J. Comput. Phys.* 403,
    109065. (A discretisation of the Lagrangian in the coordinates (ψ, θ, ζ, v∥), which is linear
    in velocities, is a *degenerate* variational integrator, as in Qin & Guan 2008, *Phys. Rev.
    Lett.* 100, 035006. The integrators here are those of canonical coordinates.)
    """

    field: Field
    energy: float = eqx.field(static=True, default=3.5e6)
    mass: float = eqx.field(static=True, default=_ALPHA_MASS)
    charge: float = eqx.field(static=True, default=2.0)
    breaking: Any = None
    coordinates: str = eqx.field(static=True, default="regular")

    def __check_init__(self):
        instance("field", self.field, Field, "a Field, such as boozer.precise_qa()")
        electronvolts("energy of the particles", self.energy, 10.0)
        in_range("mass", self.mass, 1e-31, 1e-24, "The unit is kg: 4 u are 6.64e-27.")
        in_range("|charge|", abs(finite("charge", self.charge)), 0.01, 200.0, "The unit is e.")
        one_of("coordinates", self.coordinates, _CHARTS)
        if self.breaking is not None:
            shape, hint = self.field.coefficients.shape, "Take the result of Field.split."
            array("breaking", jnp.asarray(self.breaking), shape, integers=True, hint=hint)

    @property
    def speed(self) -> float:
        """v0 = √(2E/m) [m/s]."""
        return float(np.sqrt(2 * self.energy * _EV / self.mass))

    @property
    def rho(self) -> float:
        """ρ = m v0/(Ze) [T m]: the gyroradius times the field."""
        return self.mass * self.speed / (self.charge * _EV)

    @property
    def chart(self) -> Any:
        return Angles() if self.coordinates == "angles" else Regular(1 if self.charge > 0 else -1)

    @property
    def system(self) -> System:
        """The `System`: continuous equations, for `GaussLegendre`."""
        hamiltonian = continuous_hamiltonian(self.field, self.chart)
        extra = None if self.breaking is None else Breaking(self.chart)
        return System(discretise(hamiltonian), perturbation=extra)

    @property
    def h(self) -> float:
        """A step for `GaussLegendre(2)` [m]: 0.4/k, k = max |mι − n| |B|/|G + ιI| of modes and s.

        Each mode is weighted by (amplitude/|B|)^{1/5}, as in an error of fourth order. The energy
        then oscillates by less than about 1e-5 of itself; check it with `MaxDrift`. The modes of
        `breaking` count as at ε = 1; ``at_epsilon(ε).h`` is the step of another ε.
        """
        # NumPy, so that it is a number also while a function that uses it is traced.
        field, s = self.field, np.linspace(0, 1, 33)
        I = np.zeros(1) if field.I is None else field.I  # noqa: E741
        iota, G, I = (polyval(s, np.asarray(c)) for c in (field.iota, field.G, I))  # noqa: E741
        c = np.asarray(field.coefficients)
        c = c if self.breaking is None else c + np.asarray(self.breaking)
        m, n = np.array(field.modes).T
        size = np.abs(polyval(s, np.moveaxis(c, -1, 0))).sum(0).reshape(-1, len(s))
        size = size * s ** (m[:, None] / 2)
        wave = (m != 0) | (n != 0)
        B = size[~wave][0]
        k = np.abs(np.outer(m, iota) - n[:, None])[wave] * (size[wave] / B) ** 0.2
        # A passing particle goes around the axis as the mode (1, 0).
        largest = np.max(np.vstack([np.abs(iota), k]) * B / np.abs(G + iota * I))
        return float(0.4 / largest) if largest > 0 else float(np.min(np.abs(G) / B))

    def step(self, seconds: Any) -> Any:
        """The h or t of a run [m] for a time in seconds."""
        return self.speed * seconds

    def steps(self, seconds: float, h: float | None = None) -> int:
        """The number of steps `h` (default: `self.h`) that cover a time."""
        return int(np.ceil(self.step(positive("seconds", seconds)) / (self.h if h is None else h)))

    def seconds(self, t: Any) -> Any:
        """The time in seconds of a t of a run."""
        return t / self.speed

    def args(self, mu: Any) -> dict[str, Any]:
        """The args of a run, for the moment μ [1/T], in units of m v0²."""
        parameters = {"field": self.field, "mu": mu, "rho": self.rho}
        return parameters if self.breaking is None else {**parameters, "breaking": self.breaking}

    def start(self, s: Any, theta: Any, zeta: Any, pitch: Any) -> tuple[Array, Array, dict]:
        """(q0, p0, args) at s, θ, ζ with the pitch v∥/v0; arrays of one shape, which is that of
        the batch: map `integrate` over q0, p0 and args["mu"]. |B| is that of the field without
        `breaking`, so that a start does not depend on ε: the energy is 1/2 at ε = 0.

        **Raises** `ValueError` for s outside of [0, 1], or a pitch outside of [−1, 1].
        """
        for name, value, low in (("s", s, 0.0), ("pitch", pitch, -1.0)):
            in_range(name, value, low, 1.0)
        s, theta, zeta, pitch = jnp.broadcast_arrays(
            *(jnp.asarray(values, jnp.result_type(float)) for values in (s, theta, zeta, pitch))
        )
        q, p, mu = _state(self, s, theta, zeta, pitch)
        return q, p, self.args(mu)

    def state(self, s: Any, theta: Any, zeta: Any, pitch: Any) -> tuple[Array, Array, dict]:
        """`start` without checks, for traced arrays of one shape."""
        field, rho = self.field, self.rho
        # Of the field without `breaking`, so that a start does not depend on ε.
        B = field.strength(s, theta, zeta)
        p_theta = field.psi_edge * s / rho
        if field.I is not None:
            p_theta = p_theta + pitch * polynomial(field.I, s) / B
        p_zeta = pitch * polynomial(field.G, s) / B - field.poloidal_flux(s) / rho
        q, p = self.chart.state(theta, zeta, p_theta, p_zeta)
        return q, p, self.args((1 - pitch**2) / (2 * B))

    def coordinates_of(self, q: Any, p: Any, epsilon: Any = None) -> Coordinates:
        """Boozer coordinates of states: q, p of shape (…, 2) → arrays of shape (…).

        - `epsilon`: that of the run, required if `breaking` is given: v∥ and |B| depend on it.
        """
        self._require(epsilon)

        return _coordinates(self, jnp.asarray(q), jnp.asarray(p), epsilon)

    def second_invariant(self, q: Any, p: Any, args: Any, epsilon: Any = None) -> Array:
        """J∥ = ∮ v∥ dl [m] of one state, in the well of |B| where it lies; NaN for a passing
        particle. See `boozer.second_invariant`; E is that of the state, H(q, p). `epsilon`: see
        `coordinates_of`."""
        self._require(epsilon)
        return SecondInvariant(self.chart, epsilon).value(q, p, args)

    def bounces(self, max_crossings: int = 100, direction: int = 0) -> Section:
        """Observable: the bounce points v∥ = 0 of an orbit, a `dvi.Section`.

        - `direction`: 1 for those where v∥ increases, −1 where it decreases, 0 for both.

        `second_invariant_at` gives J∥ at the points that it records.
        """
        return Section(Pitch(self.chart), direction, max_crossings)

    def second_invariant_at(self, bounces: Crossings, args: Any, epsilon: Any = None) -> Array:
        """J∥ [m] at the bounce points of one orbit, NaN after the last one; `epsilon`: see
        `coordinates_of`."""
        self._require(epsilon)
        return at_crossings(SecondInvariant(self.chart, epsilon), bounces, args)

    def _require(self, epsilon: Any) -> None:
        if self.breaking is not None and epsilon is None:
            raise ValueError("epsilon must be that of the run, as `breaking` is given, got None.")

    @property
    def observables(self) -> dict[str, Any]:
        """Observables by name, for `integrate`: "second_invariant" [m], and "trapping" [1] where
        the field is complete. The first uses the ε of the run."""
        functions: dict[str, Any] = {"second_invariant": SecondInvariant(self.chart)}
        return functions if self.breaking is not None else {**functions, "trapping": self.trapping}

    @property
    def trapping(self) -> Any:
        """Observable: the margin 1 − μ B_max(s)/E of a state, with the largest |B| on its surface.

        A particle with a negative margin bounces, one with a positive margin does not while it is
        on this surface: see `boozer.classify`. B_max is that of `field` when this property is read.

        **Raises** `ValueError` where `breaking` is given: use ``at_epsilon(ε).trapping``, and
        integrate these particles.
        """
        if self.breaking is not None:
            raise ValueError(
                "trapping requires a complete field, got one with `breaking` of unknown ε. Use "
                "centres.at_epsilon(ε)."
            )
        return Trapping(self.chart, largest_strength(self.field))

    def at_epsilon(self, epsilon: Any) -> "GuidingCentres":
        """The same particles in the field with ε·breaking included, without `breaking`."""
        field = complete(self.args(0.0), epsilon)
        return dataclasses.replace(self, field=field, breaking=None)

    @property
    def loss(self) -> Stop:
        """Ends a run where the guiding centre reaches the edge, s = 1."""
        return self.loss_at(1.0)

    def loss_at(self, s: float) -> Stop:
        """Ends a run where the guiding centre reaches s, which may be a wall beyond the plasma:
        for s > 1 the polynomials of the field are continued, whose error grows quickly."""
        return Stop(_Edge(self.chart, positive("s", s)))


# Each of these is one program: as many small ones, it would take seconds.
@eqx.filter_jit
def _state(particles: GuidingCentres, *start: Array) -> tuple[Array, Array, Array]:
    q, p, args = particles.state(*start)
    return q, p, args["mu"]


@eqx.filter_jit
def _coordinates(particles: GuidingCentres, q: Array, p: Array, epsilon: Any) -> Coordinates:
    @functools.partial(jnp.vectorize, signature="(n),(n)->(),(),(),(),()")
    def coordinates(q, p):
        centre = centre_of(particles.chart, q, p, particles.args(0.0), epsilon)
        return *centre[:3], particles.speed * centre.u, centre.B

    return Coordinates(*coordinates(q, p))


class _Edge(eqx.Module):
    chart: Any
    s: float = eqx.field(static=True)

    def __call__(self, t, q, p, args):
        return flux(self.chart, q, p, args) - self.s
