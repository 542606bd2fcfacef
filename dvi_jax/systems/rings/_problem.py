"""A ring as a system: one step of a run is one turn."""

from typing import Any, ClassVar, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from lanewise.jaxprs.jaxapi import is_traced

from ...base.checks import in_range, instance, one_of
from ...base.results import RESULTS
from ...methods import Method
from ...methods.step import judge, no_solve
from ...problem.system import System
from ._maps import Particle
from ._ring import Ring
from ._turn import Passage, start

Planes = Literal["x", "xy", "xyz"]


class RingArgs(eqx.Module):
    """The parts of a ring in the order of passage, and δ where it does not change: `args`."""

    passage: Passage
    delta: Array

    @property
    def ends(self) -> Array:
        """s behind each row [m]; a row of an element ends where the element does."""
        first = jnp.diff(self.passage.numbers["element"], prepend=-1) > 0
        return jnp.cumsum(jnp.where(first, self.passage.rows["length"], 0.0))

    def particle(self, q: Array, p: Array) -> Particle:
        """The particle of a state, of which some planes may be missing."""
        one_of("shape of q0", q.shape, ((1,), (2,), (3,)), "(x,), (x, y) or (x, y, ζ) of a ring.")
        n = q.shape[0]
        x, y, zeta = [*q, *jnp.zeros(3 - n)]
        px, py, delta = [*p, *jnp.zeros(2 - min(n, 2)), *[self.delta] * (n < 3)]
        return Particle(x, px, y, py, zeta, delta)


class Turn(Method):
    """One turn of a ring, of a system of `problem` with h = 1.

    A step is the map of `track`, exact up to round-off: the order says nothing about it. A particle
    that is lost has the status `lost`. `losses`: False for the map without apertures and limits of
    the coordinates, of which `bound_drift` can prove a bound.

    The map exists for whole turns only: a part of one, such as at a time of `Save(ts=...)` that is
    not an integer, has the status `bad_step_size`.

    **Raises** `ValueError` for another system, one with a force, noise, slow time or a perturbation
    of its own, a first step other than 1, and the lattice `TimeTransformed`.
    """

    losses: bool = eqx.field(static=True, default=True)

    order: ClassVar[int] = 1
    is_symmetric: ClassVar[bool] = False
    is_symplectic: ClassVar[bool] = True
    is_invertible: ClassVar[bool] = True

    def step(self, equations, interval, q0, p0):
        _require_ring(equations.system)
        ring, epsilon = equations.args, equations.epsilon
        z, turn = ring.particle(q0, p0), jnp.round(interval.t0)
        if not self.losses:
            return _state(ring.passage.image(z, turn, epsilon), q0, interval.h)
        flight = ring.passage.fly(start(z), turn, epsilon)
        q, p, info = _state(flight.z, q0, interval.h)
        result = RESULTS.where(flight.row >= 0, RESULTS.lost, info.result)
        return q, p, info._replace(result=result)

    def inverse(self, equations, interval, q1, p1):
        ring, epsilon = equations.args, equations.epsilon
        turn, z = jnp.round(interval.t0), ring.particle(q1, p1)
        return _state(ring.passage.image(z, turn, epsilon, -1), q1, interval.h)

    def needs_no_solve(self, equations, interval, q) -> bool:
        return True

    inverse_needs_no_solve = needs_no_solve

    def check(self, equations, first_interval, q, p) -> None:
        _require_ring(equations.system)
        _require_args(equations.args)
        h = float(first_interval().h)
        if h != 1:
            raise ValueError(f"h must be 1, one turn, for a ring; got h = {h}.")


def _require_args(args: Any) -> None:
    hint = "Give args=problem.args with problem.system, or the problem itself."
    instance("args of the system of a ring", args, RingArgs, "those of rings.problem(ring)", hint)


def _require_ring(system: Any) -> None:
    """**Raises** `ValueError` for a system with more than a ring, which `Turn` would ignore."""
    more = [name for name in ("force", "noise", "slow_time") if getattr(system, name, None)]
    if not isinstance(getattr(system, "perturbation", None), _PlaceHamiltonian | None):
        more.append("perturbation")
    if not isinstance(system, System):
        more.append(type(system).__name__)
    if more or not isinstance(system.H_D, _PlaceHamiltonian):
        raise ValueError(
            "rings.Turn() computes the map of a ring alone: give it the system of "
            f"rings.problem(ring) as it is, got {', '.join(more) or 'another Hamiltonian'}. For "
            "a perturbation use ring.perturbed(...), for another time grid dvi.Given of integers."
        )


def _state(z: Particle, like: Array, h: Array) -> tuple[Array, Array, Any]:
    size = like.shape[0]
    q, p = jnp.stack([z.x, z.y, z.zeta])[:size], jnp.stack([z.px, z.py, z.delta])[:size]
    info = judge(no_solve(q), q, p)
    result = RESULTS.where(jnp.abs(h - 1) < 1e-6, info.result, RESULTS.bad_step_size)
    return q, p, info._replace(result=result)


@jax.custom_jvp
def _value_only(energy: Array) -> Array:
    return energy


@_value_only.defjvp
def _(primals, tangents):
    # Every other method, and all that examines equations (12)–(13), needs this derivative. Edges,
    # thin elements, cavities and misalignments are not in it: the motion would be another one.
    raise ValueError(
        "the system of rings.problem(ring) has no equations of motion other than its one-turn map: "
        "use method=rings.Turn(), the default, and functions that examine the map."
    )


class _PlaceHamiltonian(eqx.Module):
    """The paraxial Hamiltonian at the place s = t C, over one turn of length C, or its derivative
    by ε, with b' in place of b. It has values only; see `_value_only`."""

    is_slope: bool = eqx.field(static=True, default=False)
    own_method: ClassVar[Method] = Turn()

    def __call__(self, t0, t1, q0, p1, args):
        return _value_only(self.value(t0, t1, q0, p1, args))

    def value(self, t0, t1, q0, p1, args):
        _require_args(args)
        ends = args.ends
        z = args.particle(q0, p1)
        row = jnp.searchsorted(ends, (t0 - jnp.floor(t0)) * ends[-1], side="right")
        element = args.passage.numbers["element"]
        row = jnp.searchsorted(element, element[row], side="right") - 1
        rows, slopes = (
            {n: lax.dynamic_index_in_dim(c, row, keepdims=False) for n, c in table.items()}
            for table in (args.passage.rows, args.passage.slopes)
        )
        free = (z.px**2 + z.py**2) / (2 * (1 + z.delta))
        h = rows.get("h", 0.0)
        focusing = h * z.x * (h * z.x / 2 - z.delta)
        energy, power = 0.0, 1.0 + 0j
        for n in range(12):
            power = power * (z.x + 1j * z.y)
            b, a = ((slopes if self.is_slope else rows).get(f"{k}{n}", 0.0) for k in "ba")
            energy = energy + jnp.real((b + 1j * a) * power) / (n + 1)
        return ends[-1] * (energy if self.is_slope else free + focusing + energy)


class RingProblem(NamedTuple):
    """A ring as a problem for `integrate`, `sweep` and others: one step is one turn."""

    system: System
    q0: Array
    p0: Array
    h: float
    args: RingArgs


def problem(ring: Ring, planes: Planes = "xyz", delta: Any = 0.0) -> RingProblem:
    r"""The one-turn map of a ring as a system with q = (x, y, ζ), p = (px, py, δ) and h = 1.

    Runs have the method `Turn`; other methods raise `ValueError`. ε multiplies what
    `Ring.perturbed` set aside. The value of the Hamiltonian is that of the bodies of the elements
    at the place s = t C, (px² + py²)/(2 (1 + δ)) − h x δ + h² x²/2 +
    Re Σ (b_n + i a_n)(x + i y)^{n+1}/(n+1). Edges, thin elements, cavities and misalignments are
    not in it, so that it cannot be differentiated.

    **Arguments** `planes`: "x": q = (x,), p = (px,), with y = py = 0; "xy": q = (x, y); both with
    ζ = 0 at the start of each turn and δ = `delta`.

    **Example** Invariants of a cell, to order 1 in its sextupoles:

    ```python
    ring = rings.Ring([rings.quadrupole("QF", 0.5, k1=0.6), rings.drift("D", 2.0),
                       rings.sextupole("SF", 0.1, b2=2.0),
                       rings.quadrupole("QD", 0.5, k1=-0.6), rings.drift("D", 2.0)])
    cell = rings.problem(ring.perturbed("S*", "b2"), planes="x")
    samples = 0.01 * np.random.default_rng(0).uniform(-1, 1, (2, 300, 1))
    found = dvi.discover_invariants(cell.system, dvi.Polynomials(3), order=1, h=1.0,
                                    samples=samples, args=cell.args)
    print(len(found.invariants), "adiabatic invariant of order 1")
    # 1 adiabatic invariant of order 1
    ```
    """
    instance("ring", ring, Ring, "a rings.Ring")
    one_of("planes", planes, ("x", "xy", "xyz"))
    if not is_traced(loss := ring.columns.get("loss", jnp.zeros(1))):
        hint = "A system has a symplectic map: use rings.radiating(ring, None)."
        in_range("loss of the magnets", loss, 0.0, 0.0, hint)
    passage = jax.tree.map(jnp.asarray, Passage.from_ring(ring))
    args = RingArgs(passage, jnp.asarray(delta, float))
    perturbation = _PlaceHamiltonian(is_slope=True) if ring.extra else None
    zero = jnp.zeros(len(planes))
    system = System(_PlaceHamiltonian(), perturbation=perturbation)
    return RingProblem(system, zero, zero, 1.0, args)
