"""Integration of quantities with units."""

import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

import dvi_jax as dvi

from ..base.checks import instance
from ..base.printing import printable
from ..systems import Problem
from .extras import require, system_of

_POWERS = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻", "0123456789-")


class UnitSystem:
    """The units of the numbers of a run: of q, p, t and of every parameter.

    All are products of powers of one unit each of length, time and mass (angles in rad), so that
    equations between quantities are also equations between the numbers.

    - `length`, `time`, `mass`: units of astropy, or their names.
    - `q`: ``"length"``, ``"angle"``. `p`: ``"momentum"``, ``"velocity"`` (unit mass), ``"angular
      momentum"``, ``"specific angular momentum"``. Both: ``"dimensionless"``, or a unit of astropy.
    - `args`: name of a parameter → a unit of the same dimension, ``{"mu": u.m**3 / u.s**2}``. A
      path, ``"planet.mass"``, names a nested parameter; a name applies to all parameters below it.
      Parameters that are not named are numbers without a unit.

    Its `q`, `p`, `t`, `energy` (p q/t) and `args` are the units of the numbers. `UnitSystem.of`
    reads those of a problem of the library.

    **Raises** `ImportError` without astropy; `ValueError` for a unit of a wrong dimension, and for
    an unknown name.
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
        u = require("astropy.units", "interop.UnitSystem")
        base_units = {"length": length, "time": time, "mass": mass}
        bases = L, T, M = [_unit(u, kind, word) for kind, word in base_units.items()]
        for kind, unit, like in zip(base_units, bases, (u.m, u.s, u.kg), strict=True):
            if not unit.is_equivalent(like):
                raise ValueError(
                    f"{kind} must be a unit of {kind} such as {like}, got {unit} "
                    f"({unit.physical_type})."
                )
        words = {"length": L, "angle": u.rad, "momentum": M * L / T, "velocity": L / T}
        words |= {"angular momentum": M * L**2 / T, "specific angular momentum": L**2 / T}
        words["dimensionless"] = u.dimensionless_unscaled
        other_units = [u.rad, u.A, u.K, u.mol, u.cd]

        def coherent(name: str, word: Any) -> Any:
            unit = words.get(word) if isinstance(word, str) else None
            unit = _unit(u, name, word) if unit is None else unit
            try:
                parts = unit.decompose(bases=[L, T, M, *other_units])
                return u.CompositeUnit(1.0, parts.bases, parts.powers)
            except (AttributeError, u.UnitConversionError):  # °C, magnitudes, photons
                raise ValueError(
                    f"the unit of {name} must be a constant times powers of m, s, kg, rad, A, K, "
                    f"mol and cd, got {unit}."
                ) from None

        units = {name: coherent(name, unit) for name, unit in (args or {}).items()}
        self._set(coherent("q", q), coherent("p", p), T, units)

    def _set(self, q: Any, p: Any, t: Any, args: dict[str, Any]) -> None:
        self.q, self.p, self.t, self.args = q, p, t, args
        self.energy = q * p / t

    @classmethod
    def of(cls, problem: Problem) -> "UnitSystem":
        """The units of a problem of the library: its `units`, and the brackets of `parameters`.

        **Raises** `ValueError` for a problem whose units are words, such as "period/2π".
        """
        u = require("astropy.units", "interop.UnitSystem")
        instance("problem", problem, Problem, "a problem of dvi_jax.systems")
        texts = {name: problem.units.get(name, "unknown units") for name in ("q", "p", "t")}
        read = {name: _read(u, text) for name, text in texts.items()}
        if bad := [name for name, unit in read.items() if unit is None]:
            raise ValueError(
                f"{problem.name} measures {bad[0]} in {texts[bad[0]]!r}, which is not a unit of "
                "astropy: call dvi.integrate, or give q0, p0, args and units."
            )
        brackets = {n: re.search(r"\[([^\]]*)\]\s*$", m) for n, m in problem.parameters.items()}
        args = {name: _read(u, match[1]) for name, match in brackets.items() if match}
        plain = u.dimensionless_unscaled
        args = {name: unit for name, unit in args.items() if unit is not None and unit != plain}
        system = cls.__new__(cls)
        system._set(read["q"], read["p"], read["t"], args)
        return system

    def __repr__(self) -> str:
        of_args = "".join(f", {name} [{unit}]" for name, unit in self.args.items())
        return f"UnitSystem(q [{self.q}], p [{self.p}], t [{self.t}]{of_args})"


@printable
@dataclass(frozen=True, eq=False)
class UnitSolution:
    """A computed trajectory with units.

    - `ts`, `qs`, `ps`, `hs`: as of a `Solution`, quantities of astropy.
    - `observed`: numbers in `units`: an energy is ``observed["energy"] * sol.units.energy``.
    - `units`: the `UnitSystem`. `solution`: the `Solution` in numbers.
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
        """The statistics of the `Solution`."""
        return self.solution.stats


def integrate(
    system: Any,
    q0: Any = None,
    p0: Any = None,
    *,
    h: Any,
    num_steps: int,
    units: UnitSystem | None = None,
    args: Any = None,
    ts: Any = None,
    **options: Any,
) -> UnitSolution:
    r"""One trajectory, from quantities of astropy to quantities of astropy.

    Every quantity becomes a number in `units`, ``dvi.integrate`` runs, and its output is given its
    unit. H_D, W, observables, `Stop` and `Section` receive plain numbers, in `units`.

    - `system`: a `System`; or a problem of the library, whose initial condition and parameters
      replace what is left out, in its own units, which are taken where `units` is left out too.
    - `q0`, `p0`: quantities of the shape of the state. `h`: a time.
    - `num_steps`, and `options`: as for ``dvi.integrate``, where `t0` is a time (zero when left
      out) and `epsilon` a number. `units`: the `UnitSystem`.
    - `args`: pytree; a quantity where `units` names a unit, else a number.
    - `ts`: times at which states are saved, for ``dvi.Save(ts=...)``, as a quantity.

    **Returns** a `UnitSolution`.

    **Raises** `TypeError` for a number where a unit is needed, `ValueError` for a quantity of
    another kind, for masked values, for parameters that the problem does not have, and where
    `units` and `args` have different names; and as ``dvi.integrate``. `ImportError` without
    astropy.

    **Accuracy** one rounding for each number that is converted; the same orbit in two systems of
    units agrees to round-off. Quantities are values that cannot be traced: for `jax.grad`,
    `jax.jit` and `jax.vmap` call ``dvi.integrate`` on numbers in one system of units.
    """
    u = require("astropy.units", "interop.integrate")
    problem = system if isinstance(system, Problem) else None
    system = system_of(system)
    own_units = None
    if problem is not None:  # units that are words will do where others are given
        with suppress(*[] if units is None else [ValueError]):
            own_units = UnitSystem.of(problem)
    example = "interop.UnitSystem(length=u.au, time=u.day, mass=u.Msun, args={...})"
    selection: Any = own_units if units is None else units
    target: UnitSystem = instance("units", selection, UnitSystem, example)
    save, lattice = options.get("save"), options.get("lattice")
    is_grid = isinstance(lattice, dvi.Given)
    if is_grid or getattr(save, "ts", None) is not None:
        source = f"lattice={lattice!r:.100}" if is_grid else f"save={save!r:.100}"
        raise TypeError(f"the times in {source} have no unit: give ts=... to interop.integrate.")
    if ts is not None and save is not None:
        raise TypeError(f"ts and save exclude each other: leave save out, got {save!r:.100}.")
    if ts is not None:
        options["save"] = dvi.Save(ts=_number(u, "ts", ts, target.t))
    q0, p0, args = _with_defaults(u, problem, own_units, q0, p0, args)
    inputs = ("q0", q0, target.q), ("p0", p0, target.p), ("h", h, target.t)
    inputs += (("epsilon", options.pop("epsilon", None), u.dimensionless_unscaled),)
    if (t0 := options.pop("t0", None)) is not None:
        inputs += (("t0", t0, target.t),)
    numbers = {name: _number(u, name, x, unit) for name, x, unit in inputs}
    numbers |= {"args": _arguments(u, args, target), "num_steps": num_steps}
    sol = dvi.integrate(system, **numbers, **options)
    arrays = (sol.ts, target.t), (sol.qs, target.q), (sol.ps, target.p), (sol.hs, target.t)
    with_unit = [u.Quantity(np.asarray(x), unit) for x, unit in arrays]
    return UnitSolution(*with_unit, observed=sol.observed, units=target, solution=sol)


def _with_defaults(
    u: Any, problem: Problem | None, basis: UnitSystem | None, q0: Any, p0: Any, args: Any
) -> tuple[Any, Any, Any]:
    """q0, p0 and args, in which quantities of the problem replace what was left out."""
    if problem is None:
        return q0, p0, args
    defaults = problem.args
    if args is not None and defaults is not None:
        instance(f"args of {problem.name}", args, Mapping, "a mapping from name to value")
        if extra := [name for name in args if name not in defaults]:
            raise ValueError(
                f"args has {extra[0]!r}, but {problem.name} has no such parameter, only "
                f"{', '.join(defaults)}."
            )
    if basis is None:  # the units of its numbers are not known
        return q0, p0, args
    q0 = u.Quantity(problem.q0, basis.q) if q0 is None else q0
    p0 = u.Quantity(problem.p0, basis.p) if p0 is None else p0
    if isinstance(defaults, Mapping):
        units = basis.args
        of_args = {n: u.Quantity(v, units[n]) if n in units else v for n, v in defaults.items()}
        args = of_args | dict(args or {})
    return q0, p0, args


def _arguments(u: Any, args: Any, units: UnitSystem) -> Any:
    """The same pytree with every quantity as a number."""
    matches, bare = set(), []

    def number(path: Any, leaf: Any) -> Any:
        words = [str(getattr(k, "key", getattr(k, "idx", k))) for k in path]
        # A unit goes for all that is below its name: "masses" for each of a list of masses.
        paths = [".".join(words[:i]) for i in range(len(words), 0, -1)]
        name = paths[0] if paths else "args"
        if path_of_unit := next((x for x in paths if x in units.args), None):
            matches.add(path_of_unit)
            return _number(u, f"args {name}", leaf, units.args[path_of_unit])
        if isinstance(leaf, u.Quantity) and leaf.unit != u.dimensionless_unscaled:
            key, subject = (name, f"{name} in args") if path else ("name", "args")
            advice = f'add the unit: UnitSystem(..., args={{"{key}": u.Unit("{leaf.unit}")}})'
            as_dict = "" if path else 'give args as a dict {"name": value} and '
            raise TypeError(
                f"{subject} has the unit {leaf.unit}, but units has no unit for {name}: "
                f"{as_dict}{advice}."
            )
        bare.append(name)
        return _number(u, f"args {name}", leaf, u.dimensionless_unscaled)

    numbers = jax.tree.map_with_path(number, args)
    unmet = [name for name in units.args if name not in matches]
    if unmet and bare:  # a mistyped name would let a bare number through
        names, bare_names = (", ".join(map(repr, group)) for group in (unmet, bare))
        kind = f"args is of type {type(args).__name__}, whose entries have no names: give a dict."
        if isinstance(args, Mapping):
            kind = f"Entries of args without a unit: {bare_names}. Use the same names in both."
        raise ValueError(f"UnitSystem(args=...) has units for {names}, which args lacks. {kind}")
    return numbers


def _number(u: Any, name: str, entry: Any, unit: Any) -> Any:
    """The value in this unit."""
    value = entry
    if isinstance(entry, list | tuple) and any(isinstance(x, u.Quantity) for x in entry):
        try:
            value = u.Quantity(entry)
        except (TypeError, u.UnitsError) as error:
            raise TypeError(
                f"all entries of {name} must be quantities in {str(unit)!r} or another such unit, "
                f"got {entry!r:.100} ({error})."
            ) from None
    if np.any(getattr(value, "mask", False)):
        raise ValueError(f"{name} must not have masked values, got {value!r:.200}.")
    if not isinstance(value, u.Quantity):
        if unit == u.dimensionless_unscaled:
            return value
        fault = "is missing" if value is None else f"= {value!r:.100} has no unit"
        raise TypeError(
            f"{name} {fault}: give a quantity, such as {name.split()[-1]} * u.Unit({str(unit)!r})."
        )
    try:
        return value.to_value(unit, equivalencies=u.dimensionless_angles())
    except u.UnitConversionError:
        to_kelvin = f" Convert it: {name.split()[-1]}.to(u.K, u.temperature())."
        is_celsius = value.unit == u.deg_C and unit.is_equivalent(u.K)
        raise ValueError(
            f"{name} is in {str(value.unit) or 1} ({value.unit.physical_type}), but must be in "
            f"{str(unit) or 1} ({unit.physical_type}).{to_kelvin * is_celsius}"
        ) from None


def _unit(u: Any, name: str, text_or_unit: Any) -> Any:
    try:
        return u.Unit(text_or_unit)
    except (ValueError, TypeError) as error:
        words = "" if name in ("length", "time", "mass") else ", or a word such as 'momentum'"
        raise ValueError(
            f"{name} must be a unit of astropy or its name{words}, got {text_or_unit!r:.100} "
            f"({error})."
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
