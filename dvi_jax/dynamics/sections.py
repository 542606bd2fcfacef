"""Poincaré sections, return maps, bifurcation diagrams."""

import math
from collections.abc import Callable, Mapping
from typing import Any, Unpack

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from lanewise.jaxprs.jaxapi import is_traced

from ..base.checks import finite, positive, whole
from ..base.inputs import as_parameter, as_scalar, start_state
from ..base.keywords import checked_keywords
from ..base.printing import printable
from ..base.reads import Reads, reads
from ..base.results import RESULTS, status_name
from ..base.types import Args, Scalar, State
from ..engine.newton import RootSolver
from ..integration.integrate import integrate
from ..integration.integrator import Integrator
from ..integration.keywords import SectionSettings, integrator_of
from ..methods import Method
from ..observe import Section
from ..observe.solution import Save
from ..problem.system import System, check_system
from ..sweep.axes import is_axis, refuse_non_finite
from .results import AS_ATTRIBUTE, SECTION_RESULTS, SectionError, WithStatus, judge


class PoincareSection(WithStatus):
    """Crossings of a section by orbits.

    - `ts`, `qs`, `ps`: times and states, shapes (orbits, crossings), (orbits, crossings, …); NaN
      for missing crossings.
    - `count`: number of crossings of each orbit after those skipped, shape (orbits,).
    - `result`: a `SECTION_RESULTS` for each orbit, `status` its name. `run`: status of the
      trajectory itself.
    - `epsilon`: of each orbit, shape (orbits,).
    """

    ts: Array
    qs: Array
    ps: Array
    count: Array
    result: SECTION_RESULTS
    run: RESULTS
    epsilon: Array


class _SectionRun(eqx.Module):
    """The settings that all orbits of a section share; `options` are keywords of `integrate`."""

    system: System
    section: Section
    options: dict[str, Any]

    def orbit(self, start: tuple[Any, Any, Any], h, epsilon, args):
        """The crossings of one orbit from (t0, q0, p0), and the time and state at its end."""
        t0, q0, p0 = start
        options = {"observe": self.section, "save": Save(final=True), "throw": False}
        options |= {"t0": t0, "h": h, "epsilon": epsilon, "args": args, **self.options}
        solution = integrate(self.system, q0, p0, **options)
        crossings: Any = solution.observed
        result = judge(crossings.count, self.section.capacity, solution.result)
        states = crossings.ts, crossings.qs, crossings.ps
        section = PoincareSection(*states, crossings.count, result, solution.result, epsilon)
        return section, (solution.ts[-1], solution.qs[-1], solution.ps[-1])


def _section_run(system: System, section: Section, keywords: Mapping[str, Any]) -> _SectionRun:
    integrator, settings = integrator_of(keywords)
    num_steps = whole("num_steps", settings["num_steps"])
    options = {name: settings.get(name) for name in ("stop", "jump")}
    options |= {"integrator": integrator, "num_steps": num_steps}
    return _SectionRun(system, section, options)


class _PerOrbit(eqx.Module):
    """One value for each orbit."""

    values: Array


def _of_orbit(tree: Any, i: Array) -> Any:
    """The values of orbit i."""

    def is_per_orbit(x):
        return isinstance(x, _PerOrbit)

    return jax.tree.map(lambda x: x.values[i] if is_per_orbit(x) else x, tree, is_leaf=is_per_orbit)


# The last argument, of both functions, is a part of the key of compiled programs.
@eqx.filter_jit
def _orbits(run: _SectionRun, start, h, epsilon, args, count: int, _: Reads) -> PoincareSection:
    inputs = (start, h, epsilon, args)
    return jax.vmap(lambda i: run.orbit(*_of_orbit(inputs, i))[0])(jnp.arange(count))


@eqx.filter_jit
def _one_after_another(
    run: _SectionRun, start, h, epsilon, args, count: int, _: Reads
) -> PoincareSection:
    """Each orbit from the final state of the one before; from the start if that one failed."""

    def advance(state, i):
        section, end = run.orbit(state, *_of_orbit((h, epsilon, args), i))
        good = section.run == RESULTS.successful
        return jax.tree.map(lambda a, b: jnp.where(good, a, b), end, start), section

    return lax.scan(advance, start, jnp.arange(count))[1]


@checked_keywords
def poincare_section(
    system: System,
    q0: Any,
    p0: Any,
    g: Callable[..., Any],
    *,
    crossings: int = 1000,
    direction: int = 1,
    skip: int = 0,
    **settings: Unpack[SectionSettings],
) -> PoincareSection:
    r"""Poincaré section: crossings of the surface g(t, q, p, args) = 0 by many orbits.

    All orbits are computed together, on the device; each crossing is solved for to round-off, on
    the curve of the method, see `Section`. For one orbit, or with other observables, observe a
    `Section`; for grids that exceed the memory, do so in a `sweep`.

    **Arguments** as for `integrate`, and

    - `q0`, `p0`: initial conditions, with the orbits along the first axis: shape (orbits, …).
    - `g`, `direction`, `skip`: see `Section`; `crossings`: number of crossings for each orbit.
    - `epsilon`: a number, or one for each orbit; so may be a `dvi.Axis` in `args`.
    - `stop`: where an orbit ends, an escape for instance. `jump`: bounces and the like.
    - `throw`: raise if an orbit has fewer crossings; otherwise read ``.status``.

    **Returns** a `PoincareSection`.

    **Raises** `ValueError` or `TypeError` for invalid input; `SectionError`, with the result, when
    `throw` and an orbit crosses the section never or too rarely, or escapes.

    **Source** Poincaré 1892; the crossing inside a step: our own, compare Hénon 1982,
    *Physica D* 5, 412.

    **Example**

    ```python
    heiles = systems.henon_heiles()
    q0, p0 = np.array([[0.0, 0.1], [0.0, 0.2]]), np.array([[0.3, 0.0], [0.25, 0.1]])
    found = dvi.poincare_section(heiles.system, q0, p0, lambda t, q, p, args: q[0], h=0.1,
                                 num_steps=2000, crossings=25, method=dvi.Strang())
    print(found.qs.shape, bool(np.all(np.abs(found.qs[..., 0]) < 1e-12)))
    # (2, 25, 2) True
    ```
    """
    section = Section(g, direction, whole("crossings", crossings), skip)
    run, (t0, q, p), inputs, lengths = _prepare(system, q0, p0, section, settings)
    if q.ndim == 0 or q.shape[0] == 0:
        raise ValueError(
            f"q0 and p0 must have the orbits along the first axis, got shape {q.shape}: give [q0] "
            "and [p0] for one orbit."
        )
    for name, length in lengths.items():
        if length != q.shape[0]:
            raise ValueError(
                f"{name} must be a number or one for each of the {q.shape[0]} orbits in q0, got "
                f"length {length}."
            )
    try:
        orbits = _orbits(run, (t0, _PerOrbit(q), _PerOrbit(p)), *inputs, q.shape[0], reads(run))
    except Exception as error:
        if any("called with q0 of shape" in note for note in getattr(error, "__notes__", ())):
            error.add_note(
                f"(q0 and p0 have the orbits along the first axis: shape {q.shape} means "
                f"{q.shape[0]} orbits with q0 of shape {q.shape[1:]}. Give a single initial "
                "condition as q0[None], p0[None].)"
            )
        raise
    return _require_crossings(orbits, run, settings)


@checked_keywords
def bifurcation(
    system: System,
    q0: Any,
    p0: Any,
    g: Callable[..., Any],
    *,
    crossings: int = 100,
    direction: int = 1,
    skip: int = 100,
    follow: bool = False,
    **settings: Unpack[SectionSettings],
) -> PoincareSection:
    """Bifurcation diagram: section points after a transient, for many values of ε.

    **Arguments** as for `poincare_section`, with one initial condition (q0, p0), and

    - `epsilon`: values, in the order in which they are followed. Or another parameter: a
      `dvi.Axis` in `args`, with one ε or as many.
    - `skip`: crossings of the transient; `crossings`: those stored after it.
    - `follow`: False: every ε from the same initial condition, all of them together. True: each
      from the final state of the run before, so that a branch is followed as far as it is stable;
      up and down (``epsilon[::-1]``) then show hysteresis. After a run that failed it begins again
      from the initial condition.

    **Returns** a `PoincareSection`, an orbit for each ε.

    **Raises** as `poincare_section`.
    """
    section = Section(g, direction, whole("crossings", crossings), skip)
    run, start, inputs, lengths = _prepare(system, q0, p0, section, settings)
    counts = set(lengths.values())
    if len(counts) != 1 or 0 in counts:
        text = " and ".join(f"{name} of length {length}" for name, length in lengths.items())
        raise ValueError(
            "bifurcation requires an array for epsilon or a dvi.Axis in args, all of one length, "
            f"got {text or 'only numbers'}."
        )
    compute = _one_after_another if follow else _orbits
    sections = compute(run, start, *inputs, counts.pop(), reads(run))
    return _require_crossings(sections, run, settings)


def stroboscope(period: float, phase: float = 0.0) -> Callable[..., Any]:
    """Stroboscopic section of a driven system: the surface t = phase + k·period, direction 1.

    g = sin(2π(t − phase)/period), which increases with time there.

    **Raises** `ValueError` for a period that is not positive, or a phase that is not finite.
    """
    positive("the period of a stroboscope", period)
    finite("the phase of a stroboscope", phase)

    def g(t, q, p, args):
        return jnp.sin(2 * math.pi * ((t - phase) / period))

    return g


class Return(WithStatus):
    """A point of a section after one return: its time and state, and a `SECTION_RESULTS`."""

    t: Scalar
    q: State
    p: State
    result: SECTION_RESULTS


@printable
class ReturnMap(eqx.Module):
    r"""Poincaré map: the map of a section g(t, q, p, args) = 0 onto itself.

    ``section_map(q, p, t0=0.0, epsilon=None, args=None)`` → `Return`.

    A function of JAX arrays: `jax.jacfwd` gives the derivative of the return map, which includes
    the change of the return time, `vmap` takes many points, `lax.scan` iterates. A point on the
    section is not its own return.

    **Arguments** `system`, `g`, `direction`, `method`, `root_finder` and `integrator` as for
    `poincare_section`;

    - `h`, `num_steps`: size and number of the steps, which are always all computed.
    - `returns`: which return, 1 for the first. `jump`: events that change the state.

    The status is `never_crossed` or `too_few_crossings` if the orbit does not return within the
    steps, `failed` if the trajectory fails; the state is then NaN.
    """

    system: System
    g: Callable[..., Any]
    h: Any
    num_steps: int = eqx.field(static=True)
    direction: int = eqx.field(static=True, default=1)
    returns: int = eqx.field(static=True, default=1)
    method: Method | None = None
    root_finder: RootSolver | None = None
    integrator: Integrator | None = None
    jump: Any = None

    def __check_init__(self):
        check_system(self.system)
        self._section_run()

    def _section_run(self) -> _SectionRun:
        section = Section(self.g, self.direction, whole("returns", self.returns))
        names = ("method", "root_finder", "integrator", "num_steps", "jump")
        return _section_run(self.system, section, {name: getattr(self, name) for name in names})

    def __call__(
        self, q: Any, p: Any, t0: Any = 0.0, epsilon: Any = None, args: Args = None
    ) -> Return:
        epsilon = self.system.strength(epsilon)
        section, _ = self._section_run().orbit((t0, q, p), self.h, epsilon, args)
        return Return(section.ts[-1], section.qs[-1], section.ps[-1], section.result)


def _prepare(
    system: System, q0: Any, p0: Any, section: Section, settings: SectionSettings
) -> tuple[_SectionRun, tuple[Any, Any, Any], tuple[Any, Any, Any], dict[str, int]]:
    """The settings of all orbits, (t0, q0, p0), and (h, ε, args) with a `_PerOrbit` for what
    differs between orbits; and the lengths of those by name."""
    check_system(system)
    q, p = start_state(q0, p0)
    run = _section_run(system, section, settings)
    lengths: dict[str, int] = {}

    def value_of(name: str, values: Any) -> Any:
        if np.ndim(values) == 0:
            return as_parameter(values)
        if np.ndim(values) != 1:
            shape = np.shape(values)
            raise ValueError(f"{name} must be a number or a 1-D array, got shape {shape}.")
        if not is_traced(values):
            refuse_non_finite(name, np.asarray(values))
        lengths[name] = len(values)
        return _PerOrbit(jnp.asarray(values))

    epsilon = system.strength(settings.get("epsilon"))
    epsilon = value_of("epsilon", epsilon.values if is_axis(epsilon) else epsilon)
    args = jax.tree.map(
        lambda leaf: value_of(leaf.name, leaf.values) if is_axis(leaf) else as_parameter(leaf),
        settings.get("args"),
        is_leaf=is_axis,
    )
    t0 = as_scalar("t0", settings.get("t0", 0.0), q.dtype)
    h = as_scalar("h", settings["h"], q.dtype, zero_allowed=False)
    return run, (t0, q, p), (h, epsilon, args), lengths


def _require_crossings(orbits: PoincareSection, run: _SectionRun, settings: SectionSettings) -> Any:
    """The orbits. **Raises** `SectionError` for those with too few crossings, if `throw`."""
    if not settings.get("throw", True):
        return orbits
    is_good = orbits.result == SECTION_RESULTS.successful
    if is_traced(is_good):
        message = "an orbit has too few crossings: give throw=False and read each orbit's status."
        return eqx.error_if(orbits, ~jnp.all(is_good), message)
    bad = np.flatnonzero(~np.asarray(is_good))
    if not bad.size:
        return orbits
    i, names = int(bad[0]), np.atleast_1d(orbits.status)
    text = SECTION_RESULTS[getattr(SECTION_RESULTS, str(names[i]))]
    run_status = str(np.atleast_1d(status_name(orbits.run))[i])
    raise SectionError(
        f"{bad.size} of {len(names)} orbits did not cross the section {run.section.capacity} times "
        f"(after skip = {run.section.skip}) in {run.options['num_steps']} steps. The first is "
        f"orbit {i}: {int(orbits.count[i])} crossings, status {names[i]}, status of the run "
        f"{run_status}. {text} {AS_ATTRIBUTE}",
        orbits,
    )
