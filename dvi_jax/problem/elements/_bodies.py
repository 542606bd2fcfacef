"""Elements of the orbits of N bodies."""

from collections.abc import Mapping
from typing import Any, Literal, get_args

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from lanewise.jaxprs.jaxapi import is_traced

from ...base.checks import (
    all_finite,
    array,
    in_range,
    instance,
    one_of,
    only_one,
    positive,
    require,
    whole,
)
from ...base.inputs import real_numbers
from ...base.types import Args, Scalar, State
from ..flows import value_of
from ..frames import Barycentric, Heliocentric, Jacobi
from ._orbit import (
    Delaunay,
    Equinoctial,
    Keplerian,
    ModifiedEquinoctial,
    Poincare,
    broadcast,
    program,
    real_array,
)

Frame = Literal["jacobi", "heliocentric", "barycentric"]
_FRAMES = {"jacobi": Jacobi, "heliocentric": Heliocentric, "barycentric": Barycentric}
_KINDS = {
    kind.__name__: kind
    for kind in (Keplerian, Equinoctial, ModifiedEquinoctial, Delaunay, Poincare)
}


def of_bodies(
    q: Any, p: Any, masses: Any, G: Any = 1.0, *, frame: Frame = "jacobi", kind: Any = Keplerian
) -> Any:
    """The elements of all bodies but the first.

    - `q`, `p`: positions [length] and momenta, shape (…, bodies, 2 or 3). `masses`: of those with a
      mass, shape (m,). `G`: the gravitational constant. `frame`: see `dvi.elements`.
    - `kind`: `Keplerian`, or another class of elements.

    **Returns** a `kind`, each element of shape (…, bodies − 1).

    **Raises** `ValueError` for shapes that do not fit and for another frame or kind.

    **Example**

    ```python
    outer = systems.outer_solar_system()
    orbits = dvi.elements.of_bodies(outer.q0, outer.p0, outer.args["masses"], outer.args["G"])
    print(np.round(orbits.a, 2))                                # [au]
    # [ 5.2   9.54 19.2  30.07 39.49]
    ```
    """
    q, p = real_array("q", q), real_array("p", p)
    one_of("the last axis of q", q.shape[-1:], ((2,), (3,)))
    whole("the number of axes of q, (…, bodies, dim),", q.ndim, 2)
    whole("the number of bodies", q.shape[-2], 2)
    all_masses, scale, G = _masses(masses, q.shape[-2], G)
    array("p", p, q.shape)
    return _of_kind(kind).from_state(*_orbits(_frame(frame)(all_masses), q, p, scale, G))


@program
def _orbits(coordinates: Any, q: Array, p: Array, scale: Array, G: Array) -> tuple[Array, ...]:
    """Relative positions and velocities, and μ."""
    # Only the axis of the bodies is mixed; times and trajectories are before it.
    positions, velocities = (
        jnp.vectorize(function, signature="(n,d)->(n,d)")
        for function in (coordinates.from_bodies, coordinates.velocities_of)
    )
    v = p / jnp.broadcast_to(scale[:, None], p.shape)
    mu = jnp.broadcast_to(G * coordinates.central_mass(), (*q.shape[:-2], q.shape[-2] - 1))
    return positions(q)[..., 1:, :], velocities(v)[..., 1:, :], mu


def to_bodies(
    elements: Any, masses: Any, G: Any = 1.0, *, frame: Frame = "jacobi", dim: int = 3
) -> tuple[Array, Array]:
    """Positions and momenta of all bodies, the centre of mass at rest at the origin.

    - `elements`: of all bodies but the first, such as ``Keplerian(a, e, inc, Omega, omega, M)``,
      numbers or arrays of shape (bodies − 1,). `masses`, `G`, `frame`: as for `of_bodies`.

    **Returns** q and p of shape (bodies, dim).

    **Raises** `ValueError` for shapes that do not fit; `TypeError` for elements of no kind.

    **Example**

    ```python
    planet = dvi.elements.Keplerian([1.0], [0.1], [0.0], [0.0], [0.0], [0.0])
    q0, p0 = dvi.elements.to_bodies(planet, masses=[1.0, 1e-3])
    print(np.round(q0[1], 4), np.round(p0[1], 6))
    # [0.8991 0.     0.    ] [0.       0.001105 0.      ]
    ```
    """
    instance("elements", elements, (*_KINDS.values(),), "elements, such as dvi.elements.Keplerian")
    values = [value if isinstance(value, np.ndarray) else jnp.asarray(value) for value in elements]
    shape = jnp.broadcast_shapes(*(value.shape for value in values))
    elements = type(elements)(*(broadcast(value, shape) for value in values))
    array("the elements", elements[0], ("bodies − 1",), integers=True)
    all_masses, scale, G = _masses(masses, len(elements[0]) + 1, G)
    coordinates = _frame(frame)(all_masses)
    return _states(coordinates, scale, *elements.state(G * coordinates.central_mass(), dim))


@program
def _states(coordinates: Any, scale: Array, q: Array, v: Array) -> tuple[Array, Array]:
    # Row 0 is the centre of mass, for positions and velocities.
    X, V = (jnp.concatenate([jnp.zeros((1, x.shape[-1])), x]) for x in (q, v))
    return coordinates.to_bodies(X), scale[:, None] * coordinates.velocities_back(V)


def _of_kind(kind: Any) -> Any:
    """The class of elements, from the class or its name. **Raises** `ValueError` for another."""
    return _KINDS[one_of("kind", getattr(kind, "__name__", kind), _KINDS)]


class Elements(eqx.Module):
    """Observable: the elements of a state.

    - `kind`: `Keplerian`, or another class of elements.
    - `frame`: of N bodies, as for `of_bodies`, with ``args["masses"]`` and ``args["G"]`` (1 without
      it). None: q is one position, (2,) or (3,), and p the momentum for unit mass.
    - `mu`: without a `frame`, μ [length³/time²], a number or a function of args; None:
      ``args["mu"]``.

    **Raises** `TypeError` for both, and for parameters that args lacks.

    Its value has the shape (bodies − 1, 6), without a frame (6,), the elements in their order.

    **Example**

    ```python
    outer = systems.outer_solar_system()
    observe = {"orbits": dvi.elements.Elements(frame="jacobi")}
    sol = dvi.integrate(outer, num_steps=3, method=dvi.WisdomHolman(), observe=observe)
    print(np.round(sol.observed["orbits"][-1, :, :2], 3))  # a [au] and e
    # [[5.2020e+00 4.8000e-02]
    #  [9.5440e+00 5.3000e-02]
    #  [1.9196e+01 4.7000e-02]
    #  [3.0073e+01 9.0000e-03]
    #  [3.9488e+01 2.4900e-01]]
    ```
    """

    kind: Any = eqx.field(static=True, default=Keplerian, converter=_of_kind)
    frame: Frame | None = eqx.field(static=True, default=None)
    mu: Any = None

    def __check_init__(self):
        only_one(TypeError, frame=self.frame, mu=self.mu)
        if self.frame is not None:
            _frame(self.frame)
        if not (self.mu is None or callable(self.mu) or is_traced(self.mu)):
            positive("mu of elements.Elements", self.mu)

    def __call__(self, t: Scalar, q: State, p: State, args: Args) -> Array:
        if self.frame is None:
            mu = _parameter(args, "mu") if self.mu is None else value_of(self.mu, args, q)
            return jnp.stack(self.kind.from_state(q, p, mu), -1)
        masses, G = _parameter(args, "masses"), args.get("G", 1.0)
        return jnp.stack(of_bodies(q, p, masses, G, frame=self.frame, kind=self.kind), -1)


def _frame(frame: Any) -> Any:
    return _FRAMES[one_of("frame", frame, get_args(Frame))]


def _parameter(args: Args, name: str) -> Any:
    value = args.get(name) if isinstance(args, Mapping) else None
    require("elements.Elements", {f"args[{name!r}]": value}, hint="Or give mu, or frame.")
    return value


def _masses(masses: Any, bodies: int, G: Any) -> tuple[Array, Array, Any]:
    """The masses of all bodies, p/v, which is 1 for a test particle, and G."""
    masses = real_numbers("masses", masses)
    array("masses", masses, ("bodies",))
    if not is_traced(masses):
        all_finite("the mass of body 0", masses[0], positive=True)
        in_range("masses", masses, 0.0, np.finfo(float).max)
    G = array("G", real_numbers("G", G), ())
    if not is_traced(G):
        positive("G", G)
    # The momentum of a test particle would be 0 and determine no velocity.
    tests = bodies - whole("the number of masses", len(masses), 1, bodies)
    all_masses = jnp.pad(masses, (0, tests)) if tests else masses
    return all_masses, jnp.where(all_masses == 0, 1.0, all_masses), G
