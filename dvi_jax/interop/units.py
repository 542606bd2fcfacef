"""A front door for quantities with units; behind it, numbers."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

import dvi_jax as dvi

from ..systems import Problem
from .extras import needed, system_of

_POWERS = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻", "0123456789-")
_BY = "interop.UnitSystem"


class UnitSystem:
    r"""The units that the numbers of a run are in: of q, p, t and of every parameter.

    All are made of one unit each of length, time and mass (angles in rad), so that no factor is
    left between them: an H_D that is right in any such system is right in this one.

    - `length`, `time`, `mass`: units of astropy, or their names.
    - `q`, `p`: what positions and momenta are: ``"length"``, ``"angle"``; ``"momentum"``,
      ``"velocity"`` (unit mass), ``"angular momentum"``, ``"specific angular momentum"``;
      ``"dimensionless"``; or any unit of that kind.
    - `args`: name of a parameter → some unit of its kind, ``{"mu": u.m**3 / u.s**2}``; of nested
      ones by path, ``"planet.mass"``. What is not named is a number without a unit.

    It has the units `q`, `p`, `t`, `energy` (p q/t) and `args` of the numbers. `UnitSystem.of`
    reads those of a problem of the library.

    **Raises** `ImportError` without astropy; `ValueError` for a unit of another kind than length,
    time or mass, and for names that are not known.
    """

    def __init__(
        self,
        length: Any,
        time: Any,
        mass: Any,
        *,
        q: Any = "length",
        p: Any = "momentum",
        args: Mapping[str, Any] | None = None,
    ):
        u = needed("astropy.units", _BY)
        given = {"length": length, "time": time, "mass": mass}
        bases = {}
        for kind, like in (("length", u.m), ("time", u.s), ("mass", u.kg)):
            unit = bases[kind] = _unit(u, kind, given[kind])
            if not unit.is_equivalent(like):
                raise ValueError(
                    f"{kind} must be a unit of {kind} such as {like}, got {unit} "
                    f"({unit.physical_type})."
                )
        L, T, M = bases.values()
        words = {
            "length": L, "angle": u.rad, "momentum": M * L / T, "velocity": L / T,
            "angular momentum": M * L**2 / T, "specific angular momentum": L**2 / T,
            "dimensionless": u.dimensionless_unscaled,
        }  # fmt: skip
        others = [u.rad, u.A, u.K, u.mol, u.cd]

        def coherent(name: str, what: Any) -> Any:
            unit = words[what] if isinstance(what, str) and what in words else _unit(u, name, what)
            parts = unit.decompose(bases=[L, T, M, *others])
            return u.CompositeUnit(1.0, parts.bases, parts.powers)

        named = {name: coherent(name, unit) for name, unit in (args or {}).items()}
        self._set(coherent("q", q), coherent("p", p), T, named)

    def _set(self, q: Any, p: Any, t: Any, args: dict[str, Any]) -> None:
        self.q, self.p, self.t, self.args = q, p, t, args
        self.energy = q * p / t

    @classmethod
    def of(cls, problem: Problem) -> "UnitSystem":
        """The units that a problem of the library is written in, read from its `units` and from
        the brackets of its `parameters`.

        **Raises** `ValueError` for a problem whose units are words, such as "period/2π".
        """
        u = needed("astropy.units", _BY)
        if not isinstance(problem, Problem):
            raise TypeError(f"UnitSystem.of takes a problem, got {type(problem).__name__}.")
        read = {name: _read(u, problem.units.get(name, "?")) for name in ("q", "p", "t")}
        if None in read.values():
            bad = next(name for name, unit in read.items() if unit is None)
            raise ValueError(
                f"{problem.name} measures {bad} in {problem.units.get(bad, '?')!r}, which is no "
                "unit of astropy: give its numbers to dvi.integrate, or say units=UnitSystem(...)."
            )
        args = {}
        for name, meaning in problem.parameters.items():
            bracket = re.search(r"\[([^\]]*)\]\s*$", meaning)
            unit = _read(u, bracket[1]) if bracket else None
            if unit is not None and unit != u.dimensionless_unscaled:
                args[name] = unit
        found = cls.__new__(cls)
        found._set(read["q"], read["p"], read["t"], args)
        return found

    def __repr__(self) -> str:
        of_args = "".join(f", {name} [{unit}]" for name, unit in self.args.items())
        return f"UnitSystem(q [{self.q}], p [{self.p}], t [{self.t}]{of_args})"


@dataclass(frozen=True, eq=False)
class UnitSolution:
    """A computed trajectory with units.

    - `ts`, `qs`, `ps`, `hs`: as of a `Solution`, quantities of astropy.
    - `observed`: numbers in `units`: an energy is ``observed["energy"] * sol.units.energy``.
    - `units`: the `UnitSystem`. `solution`: the `Solution` behind it, all in numbers.
    """

    ts: Any
    qs: Any
    ps: Any
    hs: Any
    observed: Any
    units: UnitSystem
    solution: dvi.Solution

    @property
    def result(self) -> Any:
        """The status, one of `RESULTS`."""
        return self.solution.result

    @property
    def status(self) -> Any:
        """The name of `result`."""
        return self.solution.status

    @property
    def stats(self) -> dict[str, Any]:
        """As of a `Solution`."""
        return self.solution.stats


def integrate(
    system: Any,
    q0: Any = None,
    p0: Any = None,
    *,
    h: Any,
    num_steps: int,
    units: UnitSystem | None = None,
    t0: Any = None,
    epsilon: Any = 0.0,
    args: Any = None,
    ts: Any = None,
    **options: Any,
) -> UnitSolution:
    r"""One trajectory, from quantities of astropy to quantities of astropy.

    At the door every quantity becomes a number in `units`; the run is that of ``dvi.integrate``,
    and what comes out of it is given its unit. H_D, W, observables, `Stop` and `Section` see plain
    numbers, in `units`.

    - `system`: a `System`; or a problem of the library, whose start and parameters stand in for
      what is left out, and whose units are taken where `units` is.
    - `q0`, `p0`: quantities of the shape of the start. `h`, `t0` (zero when left out): times.
    - `num_steps`, and `options`: as for ``dvi.integrate``.
    - `units`: the `UnitSystem` behind the door.
    - `epsilon`: a number. `args`: pytree; a quantity where `units` names a unit, else a number.
    - `ts`: times at which states are kept, for ``dvi.Save(ts=...)``, as a quantity.

    **Returns** a `UnitSolution`.

    **Raises** `TypeError` for a number where a unit is needed, `ValueError` for a quantity of
    another kind, with what was seen and what is allowed; and as ``dvi.integrate``. `ImportError`
    without astropy.

    **Accuracy** one rounding for each number that is converted; the same orbit in two systems of
    units agrees to round-off. Nothing here can be traced: quantities are values. For `jax.grad`,
    `jax.jit` and `jax.vmap` call ``dvi.integrate`` on numbers in one system of units.
    """
    u = needed("astropy.units", "interop.integrate")
    problem = system if isinstance(system, Problem) else None
    system = system_of(system, "interop.integrate")
    own = units is None and problem is not None
    if units is None:
        if problem is None:
            raise TypeError(
                "a dvi.System does not say what its numbers are: give units=interop.UnitSystem("
                "length=u.au, time=u.day, mass=u.Msun, args={...})."
            )
        units = UnitSystem.of(problem)
    if not isinstance(units, UnitSystem):
        raise TypeError(f"units must be an interop.UnitSystem, got {units!r}.")
    save, lattice = options.get("save"), options.get("lattice")
    if getattr(save, "ts", None) is not None or isinstance(lattice, dvi.Given):
        raise TypeError(
            "dvi.Save(ts=...) and dvi.Given(ts) hold times without a unit: give ts= a quantity in "
            "place of the first; for the second call dvi.integrate on numbers."
        )
    if ts is not None:
        if save is not None:
            raise TypeError("ts= says which states are kept: leave save out.")
        options["save"] = dvi.Save(ts=_number(u, "ts", ts, units.t))
    if own and problem is not None:
        start = {"q0": problem.q0 if q0 is None else None, "p0": problem.p0 if p0 is None else None}
    else:
        start = {"q0": None, "p0": None}
    numbers = _arguments(u, args, units)
    if own and problem is not None and isinstance(problem.args, Mapping):
        numbers = {**problem.args, **(numbers or {})}
    q, p = (
        _number(u, name, value, unit) if start[name] is None else start[name]
        for name, value, unit in (("q0", q0, units.q), ("p0", p0, units.p))
    )
    sol = dvi.integrate(
        system,
        q,
        p,
        h=_number(u, "h", h, units.t),
        num_steps=num_steps,
        t0=0.0 if t0 is None else _number(u, "t0", t0, units.t),
        epsilon=_number(u, "epsilon", epsilon, u.dimensionless_unscaled),
        args=numbers,
        **options,
    )
    with_unit = [
        u.Quantity(np.asarray(x), unit)
        for x, unit in ((sol.ts, units.t), (sol.qs, units.q), (sol.ps, units.p), (sol.hs, units.t))
    ]
    return UnitSolution(*with_unit, observed=sol.observed, units=units, solution=sol)


def _arguments(u: Any, args: Any, units: UnitSystem) -> Any:
    """The same pytree with every quantity as a number."""
    seen = set()

    def number(path: Any, leaf: Any) -> Any:
        name = ".".join(str(getattr(k, "key", getattr(k, "idx", k))) for k in path) or "args"
        if name in units.args:
            seen.add(name)
            return _number(u, f"args {name}", leaf, units.args[name])
        if isinstance(leaf, u.Quantity) and leaf.unit != u.dimensionless_unscaled:
            raise TypeError(
                f"args has {name} in {leaf.unit}, and the units do not say what it should be in: "
                f'declare it, UnitSystem(..., args={{"{name}": u.Unit("{leaf.unit}")}}).'
            )
        return _number(u, f"args {name}", leaf, u.dimensionless_unscaled)

    return jax.tree.map_with_path(number, args)


def _number(u: Any, name: str, given: Any, unit: Any) -> Any:
    """The value in this unit."""
    value = given
    if isinstance(given, list | tuple) and any(isinstance(x, u.Quantity) for x in given):
        try:
            value = u.Quantity(given)
        except (TypeError, u.UnitsError) as error:
            raise TypeError(
                f"{name} mixes quantities and numbers, or units that do not go together: {error}."
            ) from None
    if not isinstance(value, u.Quantity):
        if unit == u.dimensionless_unscaled:
            return value
        seen = "is missing" if value is None else f"= {value!r} has no unit"
        raise TypeError(
            f"{name} {seen}: everything that has a unit must say so at this door, such as "
            f"{name.split()[-1]} * u.Unit({str(unit)!r}) or another unit of that kind."
        )
    try:
        return value.to_value(unit, equivalencies=u.dimensionless_angles())
    except u.UnitConversionError:
        raise ValueError(
            f"{name} is in {str(value.unit) or 1} ({value.unit.physical_type}); it has to be "
            f"convertible to {str(unit) or 1} ({unit.physical_type})."
        ) from None


def _unit(u: Any, name: str, what: Any) -> Any:
    try:
        return u.Unit(what)
    except (ValueError, TypeError) as error:
        raise ValueError(
            f"the unit of {name}, {what!r}, is not known to astropy: {error}"
        ) from None


def _read(u: Any, text: str) -> Any:
    """The unit that a problem of the library names, or None for one that is in words."""
    text = re.sub("[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+", lambda m: f"**{m[0].translate(_POWERS)}", text.strip())
    text = re.sub(r"\byear\b", "yr", text).replace(" ", "*")
    if text == "1":
        return u.dimensionless_unscaled
    try:
        return u.Unit(text)
    except (ValueError, TypeError):
        return None
