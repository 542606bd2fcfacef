"""Simulations of REBOUND as problems of the library, and back; archives as datasets."""

import contextlib
import itertools
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from os import PathLike
from typing import Any

import numpy as np

from ..base.checks import instance, one_of
from ..base.files import user_file
from ..base.inputs import refuse_unit_or_mask
from ..base.keywords import user_level
from ..base.precision import require_double
from ..base.printing import printable
from ..problem.elements import Keplerian
from ..systems import Problem
from ..systems.n_body import (
    PARAMETERS,
    attraction,
    check_bodies,
    check_restricted,
    hamiltonian,
    n_body,
    restricted,
)
from .extras import require

_NEWTONIAN = ("basic", "compensated", "jacobi", "mercurius", "trace")
"""Modules for gravity that evaluate Newton's law in full, whichever way they order the sums."""

_TURNED_ON = {
    "_additional_forces": "additional_forces (write it as force= of a dvi.System)",
    "_pre_timestep_modifications": "pre_timestep_modifications",
    "_post_timestep_modifications": "post_timestep_modifications",
    "_heartbeat": "heartbeat (use observe= and stop= of dvi.integrate)",
    "extras": "extras of REBOUNDx (write their effect as force= of a dvi.System)",
    "_N_odes": "additional ODEs",
    "exit_max_distance": "exit_max_distance (use stop=dvi.Stop(g))",
    "exit_min_distance": "exit_min_distance (use stop=dvi.Stop(g))",
    "N_var": "variational particles (use dvi.TangentMap(), dvi.MEGNO() or jax.jvp)",
}
"""Settings that change a simulation besides its bodies: name of the field → what to do."""

_ASTROPY = {
    **dict.fromkeys(("msun", "msolar", "solarmass", "sunmass"), "Msun"),
    **dict.fromkeys(("year", "years", "yrs", "jyr"), "yr"),
    **{"d": "day", "days": "day", "hr": "h", "kyr": "kyr", "myr": "Myr", "gyr": "Gyr"},
    **{"mearth": "Mearth", "mjupiter": "Mjup", "aus": "au", "parsec": "pc", "gram": "g"},
}
"""REBOUND's names of units → the usual ones; the others are the same."""


# REBOUND 5.2.2 replaces addresses of names one after the other. In the process that wrote the file
# new addresses may be among the old ones, and a body gets the name of another one. Two readings
# with different addresses cannot agree on a wrong name.
_READINGS = 10


@printable
@dataclass(frozen=True)
class ReboundProblem(Problem):
    """A `Problem` of N bodies from a simulation of REBOUND.

    - `t0`: its time. `h` is its dt, `q0` its positions, `p0` the momenta m v (v where m = 0).
    - `names` of the bodies, or their hashes (REBOUND 4), or None.
    - `velocities`: of the simulation, shape (bodies, 3); p0 / m may differ in the last digit.
    - `radii`: of the bodies [length]; there are no collisions here.
    - `integrator`: the name of REBOUND's; ours is chosen by ``method=``.
    - `rebound_units`: its units of length, time and mass, or none.
    """

    t0: float = 0.0
    names: tuple[Any, ...] = ()
    velocities: Any = None
    radii: Any = None
    integrator: str = ""
    rebound_units: tuple[str, ...] = ()


def from_rebound(simulation: Any, *, snapshot: int = -1) -> ReboundProblem:
    r"""The N-body problem of a simulation of REBOUND: masses, G, softening, state, time, names.

        q0 = (x, y, z),  p0 = m (v_x, v_y, v_z),  H = Σ p²/2m − G Σ_{i<j} m_i m_j / √(r_ij² + b²)

    with b REBOUND's softening: 0 gives the system `n_body`.

    - `simulation`: a ``rebound.Simulation``, or the path of a Simulationarchive, of which
      `snapshot` is taken (−1: the last).

    Bodies of mass 0 are test particles of `n_body`: ``args["masses"]`` ends before them.

    **Returns** a `ReboundProblem`, float64 arrays of shape (bodies, 3) in the simulation's units.

        sol = dvi.integrate(problem.system, problem.q0, problem.p0, args=problem.args,
                            t0=problem.t0, h=problem.h, num_steps=1000, method=dvi.KahanLi(8))

    **Raises** `ValueError` for features that cannot be converted: additional forces and other
    callbacks (``sim.copy()`` leaves them out), REBOUNDx, boundaries, collisions, gravity that is
    off, approximate or custom, shear (SEI), variational particles, exit distances, massive test
    particles, a simulation that is not synchronised; for a body of mass 0 before one with a mass;
    for numbers that are NaN or infinite; and for two bodies at the same place; `FileNotFoundError`
    for a path without a file; `ImportError` without rebound, `TypeError` for another object.

    **Accuracy** q, masses, G and t are the same bits; p0 = m v is rounded. Units: REBOUND's solar
    mass is GM☉/G with its own G, 3e-5 away from others; the numbers stay those of the simulation.

    **Source** Rein & Liu 2012, *Astron. Astrophys.* 537, A128.
    """
    rebound, names = require("rebound", "interop.from_rebound"), None
    if isinstance(simulation, str | PathLike):
        simulation = user_file("simulation", simulation)
        subject = f"snapshot {snapshot} of {str(simulation)!r} (0: the first, −1: the last)"
        with _reading(subject):
            simulation, names = _snapshot(rebound.Simulationarchive(str(simulation)), snapshot)
    elif snapshot != -1 and isinstance(simulation, rebound.Simulation):
        raise ValueError(
            f"snapshot requires the path of a Simulationarchive, got {snapshot} with a Simulation."
        )
    description = "a rebound.Simulation, or the path of a Simulationarchive"
    hint = "For snapshot i of an open archive give archive[i]."
    instance("simulation", simulation, rebound.Simulation, description, hint)
    names = tuple(_names(simulation) if names is None else names)
    _check_convertible(simulation)
    numbers = _finite("the simulation", simulation, ("t", "dt", "G", "softening"))
    texts = [str(name or f"body {i}") for i, name in enumerate(names)]
    columns = ("m", "x", "y", "z", "vx", "vy", "vz", "r")
    bodies = zip(texts, simulation.particles, strict=True)
    rows = np.array([list(_finite(text, b, columns).values()) for text, b in bodies])
    masses = _masses(simulation, rows[:, 0])
    q, v = rows[:, 1:4].copy(), rows[:, 4:7].copy()
    p, count = np.where(masses > 0, masses, 1.0)[:, None] * v, int(np.sum(masses > 0))
    of_massive = {"masses": masses[:count], "G": numbers["G"]}
    check_bodies(q[:count], p[:count], of_massive, texts[:count])
    physics = {"G": numbers["G"], "softening": numbers["softening"]}
    problem = n_body(masses, q, p, numbers["dt"], **physics)
    units, parameters = _texts(_units(simulation))
    changes: dict[str, Any] = {"name": "rebound", "source": "a simulation of REBOUND"}
    changes |= {"units": units, "parameters": {name: parameters[name] for name in problem.args}}
    changes |= {"names": names, "velocities": v, "radii": rows[:, 7], "t0": numbers["t"]}
    changes |= {"integrator": str(simulation.integrator), "rebound_units": _units(simulation)}
    same = {field.name: getattr(problem, field.name) for field in fields(problem)}
    return ReboundProblem(**{**same, **changes})


def to_rebound(problem: Problem, q: Any = None, p: Any = None, t: Any = None) -> Any:
    """A simulation of REBOUND with the bodies of a problem, or with another state of them.

    - `problem`: a result of `from_rebound`, or another N-body problem (`n_body`, `solar_system`).
    - `q`, `p`: a state, shape (bodies, 2 or 3), such as ``sol.qs[-1], sol.ps[-1]``; the start of
      the problem when left out. `t`: its time.

    **Returns** a ``rebound.Simulation`` with masses, radii, names, G, softening, units, t, and
    dt = h. Its integrator is REBOUND's default, IAS15. The start of a problem of `from_rebound`
    has the same bits, as its `velocities` are stored. For a state given as q and p the
    velocities p/m are rounded: they differ by up to 2.2e-16, relative, from v in p = m v.

    **Raises** `TypeError` for another object than a problem, or for only one of q and p;
    `ValueError` for another system than Newton's N bodies or one with a force or a perturbation,
    for shapes that do not agree and for values that are not finite; `ImportError` without rebound.
    """
    rebound = require("rebound", "interop.to_rebound")
    instance("problem", problem, Problem, "a problem of dvi_jax.systems or of from_rebound")
    system, args = problem.system, problem.args
    differences = {
        "another Hamiltonian": system.H_D not in (hamiltonian, restricted),
        "args that are not a dict": not isinstance(args, Mapping),
        "a force": system.force not in (None, attraction),
        "a perturbation": system.perturbation is not None,
    }
    if any(differences.values()):
        raise ValueError(
            f"problem must be N bodies under Newton's law, got {problem.name} with "
            f"{' and '.join(name for name in differences if differences[name])}."
        )
    if (q is None) != (p is None):
        raise TypeError(f"give both q and p, or none; got only {'p' if q is None else 'q'}.")
    masses = np.asarray(args["masses"], float)
    theirs = problem if isinstance(problem, ReboundProblem) else None
    velocities = theirs.velocities if theirs is not None and q is None else None
    refuse_unit_or_mask("q", q)
    refuse_unit_or_mask("p", p)
    q, p = (np.asarray(x, float) for x in ((problem.q0, problem.p0) if q is None else (q, p)))
    t = float(t if t is not None else theirs.t0 if theirs is not None else 0.0)
    (check_restricted if system.H_D is restricted else check_bodies)(q, p, args)
    for name, values in (("q", q), ("p", p), ("t", np.array(t))):
        _check_finite(name, values)
    tests = (0, len(q) - len(masses))
    scale, masses = np.pad(masses, tests, constant_values=1.0)[:, None], np.pad(masses, tests)
    v = p / scale
    if velocities is not None and np.array_equal(p, scale * np.asarray(velocities)):
        v = np.asarray(velocities, float)  # neither p0 nor the masses have been replaced
    if q.shape[1] == 2:
        q, v = (np.column_stack([x, np.zeros(len(x))]) for x in (q, v))
    simulation = rebound.Simulation()
    if theirs is not None and theirs.rebound_units:
        simulation.units = theirs.rebound_units
    simulation.G = float(args.get("G", 1.0))  # after the units, which set it to their own
    simulation.softening = float(args.get("softening", 0.0))
    simulation.dt = float(problem.h)
    simulation.t = t
    names = getattr(theirs, "names", None) or (None,) * len(masses)
    radii = getattr(theirs, "radii", None)
    radii = np.zeros(len(masses)) if radii is None else radii
    for mass, (x, y, z), (vx, vy, vz), r, name in zip(masses, q, v, radii, names, strict=True):
        label = {} if name is None else {"name" if isinstance(name, str) else "hash": name}
        simulation.add(m=mass, x=x, y=y, z=z, vx=vx, vy=vy, vz=vz, r=r, **label)
    return simulation


def from_archive(archive: Any, *, elements: str | None = None) -> Any:
    r"""All snapshots of a Simulationarchive of REBOUND as one time series.

    - `archive`: the path of a Simulationarchive, or an open ``rebound.Simulationarchive``.
    - `elements`: ``"jacobi"`` or ``"heliocentric"`` adds the orbital elements a, e, inc, Omega,
      omega, M of all bodies but the first, see `dvi.elements`; Jacobi's are relative to the centre
      of mass of the bodies before them in the order of `body`.

    **Returns** a ``xarray.Dataset`` with the coordinates `time`, `body` and `component`: positions
    `q` and velocities `v` (time, body, component), masses `m` and radii `r` (time, body), and the
    number of bodies, `count` (time), in the units of the simulation (attribute ``units``, if it has
    some). Snapshots between half steps are synchronised.

    A body is identified by its name (REBOUND 4: its hash), those without one by their order; it is
    NaN while it does not exist. A warning says so if the number of bodies without a name changes:
    which of them was removed is then not known. Variational particles are left out.

    **Raises** `ValueError` for a file that REBOUND cannot read; `FileNotFoundError` for a path
    without a file; `ImportError` without rebound, `TypeError` for another object.
    """
    rebound, path = require("rebound", "interop.from_archive"), str(archive)
    import xarray as xr

    one_of("elements", elements, (None, "jacobi", "heliocentric"))
    with _reading(f"the archive {path!r}"):
        if isinstance(archive, str | PathLike):
            archive = rebound.Simulationarchive(str(user_file("archive", archive)))
        description = "the path of a Simulationarchive, or a rebound.Simulationarchive"
        instance("archive", archive, rebound.Simulationarchive, description)
        snapshots = [_row(*_snapshot(archive, i)) for i in range(len(archive))]
    columns: dict[Any, int] = {}
    places = [[columns.setdefault(key, len(columns)) for key in keys] for *_, keys in snapshots]
    tables = np.full((len(snapshots), len(columns), 8), np.nan)
    for table, place, (_, rows, _) in zip(tables, places, snapshots, strict=True):
        table[place] = rows
    totals = [Counter(name for name, _ in keys) for *_, keys in snapshots]
    ambiguous = {
        name
        for earlier, later in itertools.pairwise(totals)
        for name in {*earlier, *later}
        if earlier[name] != later[name] and max(earlier[name], later[name]) > 1
    }
    if ambiguous:
        warnings.warn(
            f"{path}: the number of bodies with the same name ({', '.join(map(str, ambiguous))}) "
            "changes between snapshots. They are identified by their order, which may be wrong. "
            "Give the bodies names in REBOUND.",
            stacklevel=user_level(),
        )
    q, v, first = tables[..., :3], tables[..., 3:6], archive[0]
    variables = {"q": q, "v": v, "m": tables[..., 6], "r": tables[..., 7]}
    if elements is not None:
        require_double("orbital elements")
        variables |= _orbits(q, v, tables[..., 6], first.G, elements)
    axes = ("time", "body", "component")
    data = xr.Dataset(
        {name: (axes[: values.ndim], values) for name, values in variables.items()},
        {
            "time": [moment for moment, *_ in snapshots],
            "body": [f"{name or 'body'} {column}" if number or name is None else str(name)
                     for (name, number), column in columns.items()],
            "component": list("xyz"),
        },
        {"G": first.G, "softening": first.softening, "integrator": str(first.integrator)},
    )  # fmt: skip
    data["count"] = "time", [len(keys) for *_, keys in snapshots]
    if units := _units(first):
        length, time, mass = (_ASTROPY.get(name, name) for name in units)
        texts = {"q": length, "v": f"{length}/{time}", "m": mass, "r": length, "time": time}
        texts |= {"a": length, **dict.fromkeys(Keplerian._fields[2:], "rad")}
        for name in texts.keys() & data.variables.keys():
            data[name].attrs["units"] = texts[name]
    return data


def _snapshot(archive: Any, i: int) -> tuple[Any, list[Any]]:
    """A snapshot, and the names of its bodies."""
    sim = _synchronised(archive, i)
    alive, readings, names = [sim], [], _names(sim)
    while any(names) and names not in readings:
        readings.append(names)
        alive.append(_synchronised(archive, i))  # so that no address is used again
        names = _names(alive[-1]) if len(alive) <= _READINGS else [None] * len(names)
    return sim, names


def _row(sim: Any, names: list[Any]) -> tuple[float, np.ndarray, list[tuple[Any, int]]]:
    """Time, rows (bodies, 8) of x, v, m, r, and the names, each with its number among equal ones,
    of a snapshot."""
    shapes = {"xyz": (sim.N, 3), "vxvyvz": (sim.N, 3), "m": sim.N, "r": sim.N}
    fields_of_bodies = {name: np.empty(shape) for name, shape in shapes.items()}
    sim.serialize_particle_data(**fields_of_bodies)
    number = {name: itertools.count() for name in names}
    keys = [(name, next(number[name])) for name in names]
    return sim.t, np.column_stack([*fields_of_bodies.values()])[: len(names)], keys


def _synchronised(archive: Any, i: int) -> Any:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "The simulation might not be synchronized")
        sim = archive[i]
    sim.synchronize()
    return sim


def _names(sim: Any) -> list[Any]:
    """Names of the bodies; REBOUND 4 counts variations in N."""
    return [_name(sim.particles[k]) for k in range(getattr(sim, "N_real", sim.N))]


def _orbits(q: Any, v: Any, masses: Any, G: float, frame: str) -> dict[str, np.ndarray]:
    """Elements of the bodies after the first, NaN for the first, each (times, bodies)."""
    centres, mass = [x[:, :1] for x in (q, v)], masses[:, :1] + masses[:, 1:]
    if frame == "jacobi":
        # Bodies that do not exist have no mass, except the first, without which all is NaN.
        weights = np.nan_to_num(masses)
        weights[:, :1] = masses[:, :1]
        total = np.cumsum(weights, axis=1)
        terms = [weights[..., None] * np.where(weights[..., None] > 0, x, 0.0) for x in (q, v)]
        centres = [np.cumsum(x, axis=1)[:, :-1] / total[:, :-1, None] for x in terms]
        mass = total[:, 1:]
    orbits = Keplerian.from_state(q[:, 1:] - centres[0], v[:, 1:] - centres[1], G * mass)
    pad = ((0, 0), (1, 0))
    return {
        name: np.pad(np.asarray(x), pad, constant_values=np.nan)
        for name, x in zip(Keplerian._fields, orbits, strict=True)
    }


@contextlib.contextmanager
def _reading(subject: str) -> Iterator[None]:
    try:
        yield
    except (RuntimeError, ValueError, IndexError) as error:
        raise ValueError(f"REBOUND cannot read {subject}: {error}") from None


def _check_convertible(sim: Any) -> None:
    """Raise an error that names all that a problem of N bodies cannot represent."""
    of_bodies = {"_N_odes": 1} if str(sim.integrator) == "bs" else {}  # its own equations
    features = [
        text
        for field, text in _TURNED_ON.items()
        if (getattr(sim, field, None) or 0) != of_bodies.get(field, 0)
    ]
    settings = (("boundary", ("none",)), ("collision", ("none",)), ("gravity", _NEWTONIAN))
    for field, choices in settings:
        if (value := getattr(sim, field)) not in choices:
            features.append(f"{field} = {value!r} (allowed: {', '.join(map(repr, choices))})")
    if str(sim.integrator) == "sei":
        features.append("the shearing sheet, integrator sei (see the system hill)")
    if not sim.is_synchronized:
        features.append("a state in the middle of a step (call sim.synchronize())")
    if sim.N == 0:
        features.append("no bodies (call sim.add(...))")
    if features:
        raise ValueError(
            f"from_rebound cannot convert a simulation with {'; '.join(features)}. Remove this, or "
            "convert sim.copy(), which has no callbacks."
        )


def _finite(owner: str, source: Any, fields: Sequence[str]) -> dict[str, float]:
    """Numbers of a simulation or a body, which must be finite."""
    numbers = {name: float(getattr(source, name)) for name in fields}
    for name, value in numbers.items():
        _check_finite(f"{name} of {owner}", np.array(value))
    return numbers


def _check_finite(name: str, values: np.ndarray) -> None:
    if (bad := ~np.isfinite(values)).any():
        raise ValueError(f"{name} must be finite, got {values[bad][0]}: give an earlier state.")


def _masses(sim: Any, masses: np.ndarray) -> np.ndarray:
    """The masses, zeros last. **Raises** `ValueError` for another order or massive test bodies."""
    count = int(sim.N_active)
    active = len(masses) if not 0 <= count < len(masses) else count  # −1, 2⁶⁴ − 1: all of them
    heavy = np.flatnonzero(masses[active:]) + active
    if heavy.size and (sim.testparticle_type == 0 or len(masses) - active > 1):
        raise ValueError(
            f"test particles must have mass 0, got {masses[heavy[0]]:g} of body {heavy[0]} with "
            f"N_active = {active}: set sim.N_active = {len(masses)}, or their masses to 0."
        )
    empty = masses == 0
    if empty.all() or np.any(masses[int(np.argmax(empty)) :] * empty.any()):
        raise ValueError(
            f"bodies of mass 0 must be last, after one with a mass at least, got mass 0 at index "
            f"{int(np.argmax(empty))}: add them to the simulation after all others."
        )
    return masses


def _name(body: Any) -> Any:
    if (name := getattr(body, "name", None)) is not None:
        return name
    value = getattr(getattr(body, "hash", None), "value", 0)  # REBOUND 4
    return value or None


def _units(sim: Any) -> tuple[str, ...]:
    """REBOUND's units of length, time and mass; none where it has none."""
    names = tuple(sim.units.get(k) for k in ("length", "time", "mass"))
    return names if all(names) else ()


def _texts(units: tuple[str, ...]) -> tuple[dict[str, str], dict[str, str]]:
    """The `units` and the `parameters` of a problem in these units."""
    if not units:
        return {"q": "1", "p": "1", "t": "1", "energy": "1"}, dict(PARAMETERS)
    length, time, mass = (_ASTROPY.get(name, name) for name in units)
    of_state = {"q": length, "p": f"{mass} {length}/{time}", "t": time}
    of_state["energy"] = f"{mass} {length}²/{time}²"
    parameters = {"masses": f"of the bodies [{mass}]", "softening": f"b [{length}]"}
    return of_state, parameters | {"G": f"gravity [{length}³/({mass} {time}²)]"}
