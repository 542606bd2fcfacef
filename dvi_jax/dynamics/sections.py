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
from ..sweep import Axis
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


class _Settings(eqx.Module):
    """The settings that all orbits of a section share; `options` are keywords of `integrate`."""

    system: System
    section: Section
    options: dict[str, Any]

    def orbit(self, start: tuple[Any, Any, Any], h, epsilon, args):
        """The crossings of one orbit from (t0, q0, p0), and the time and state at its end."""
        t0, q0, p0 = start
        options = {"observe": self.section, "save": Save(final=True), "throw": False}
        options |= {"t0": t0, "h": h, "epsilon": epsilon, "args": args, **self.options}
        sol = integrate(self.system, q0, p0, **options)
        crossed: Any = sol.observed
        result = judge(crossed.count, self.section.capacity, sol.result)
        found = PoincareSection(
            crossed.ts, crossed.qs, crossed.ps, crossed.count, result, sol.result, epsilon
        )
        return found, (sol.ts[-1], sol.qs[-1], sol.ps[-1])


def _settings(system: System, section: Section, keywords: Mapping[str, Any]) -> _Settings:
    integrator, others = integrator_of(keywords)
    num_steps = whole("num_steps", others["num_steps"])
    options = {"integrator": integrator, "num_steps": num_steps, "stop": others.get("stop")}
    return _Settings(system, section, options)


class _Varied(eqx.Module):
    """One value for each orbit."""

    values: Array


def _of_orbit(tree: Any, i: Array) -> Any:
    """The values of orbit i."""

    def is_varied(x):
        return isinstance(x, _Varied)

    return jax.tree.map(lambda x: x.values[i] if is_varied(x) else x, tree, is_leaf=is_varied)


@eqx.filter_jit
def _orbits(settings: _Settings, start, h, epsilon, args, count: int) -> PoincareSection:
    given = (start, h, epsilon, args)
    return jax.vmap(lambda i: settings.orbit(*_of_orbit(given, i))[0])(jnp.arange(count))


@eqx.filter_jit
def _one_after_another(settings: _Settings, start, h, epsilon, args, count: int) -> PoincareSection:
    """Each orbit from the final state of the one before; from the start if that one failed."""

    def one(state, i):
        found, end = settings.orbit(state, *_of_orbit((h, epsilon, args), i))
        good = found.run == RESULTS.successful
        return jax.tree.map(lambda a, b: jnp.where(good, a, b), end, start), found

    return lax.scan(one, start, jnp.arange(count))[1]


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
    - `stop`: where an orbit ends, an escape for instance.
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
    check_system(system)
    q, p = start_state(q0, p0)
    if q.ndim == 0 or q.shape[0] == 0:
        raise ValueError(
            f"q0 and p0 must have the orbits along the first axis, got shape {q.shape}. For one "
            "orbit give [q0] and [p0]."
        )
    section = Section(g, direction, whole("crossings", crossings), skip)
    orbits = _settings(system, section, settings)
    epsilon, args, varied = _of_orbits(system, settings)
    for name, length in varied.items():
        if length != q.shape[0]:
            raise ValueError(
                f"{name} must be a single number, or have one number for each orbit in q0 "
                f"(in all {q.shape[0]}), got length {length}."
            )
    start = (as_scalar("t0", settings.get("t0", 0.0), q.dtype), _Varied(q), _Varied(p))
    h = as_scalar("h", settings["h"], q.dtype, zero_allowed=False)
    try:
        found = _orbits(orbits, start, h, epsilon, args, q.shape[0])
    except Exception as error:
        if any("called with q0 of shape" in note for note in getattr(error, "__notes__", ())):
            error.add_note(
                f"(q0 and p0 have the orbits along the first axis: shape {q.shape} means "
                f"{q.shape[0]} orbits with q0 of shape {q.shape[1:]}. Give a single initial "
                "condition as q0[None], p0[None].)"
            )
        raise
    return _raise_on_failure(found, orbits) if settings.get("throw", True) else found


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
    check_system(system)
    q, p = start_state(q0, p0)
    section = Section(g, direction, whole("crossings", crossings), skip)
    orbits = _settings(system, section, settings)
    epsilon, args, varied = _of_orbits(system, settings)
    lengths = set(varied.values())
    if len(lengths) != 1 or 0 in lengths:
        seen = " and ".join(f"{name} of length {n}" for name, n in varied.items())
        rule = (
            "bifurcation requires a parameter that varies: give epsilon as a 1-D array of at least "
            "one value, or a dvi.Axis in args"
        )
        if len(lengths) > 1:
            rule = "all parameters of bifurcation that vary must have the same length"
        raise ValueError(f"{rule}, got {seen or 'only single numbers'}.")
    start = (as_scalar("t0", settings.get("t0", 0.0), q.dtype), q, p)
    h = as_scalar("h", settings["h"], q.dtype, zero_allowed=False)
    compute = _one_after_another if follow else _orbits
    found = compute(orbits, start, h, epsilon, args, lengths.pop())
    return _raise_on_failure(found, orbits) if settings.get("throw", True) else found


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


class ReturnMap(eqx.Module):
    r"""Poincaré map: the map of a section g(t, q, p, args) = 0 onto itself.

    ``section_map(q, p, t0=0.0, epsilon=None, args=None)`` → `Return`.

    A function of JAX arrays: `jax.jacfwd` gives the derivative of the return map, which includes
    the change of the return time, `vmap` takes many points, `lax.scan` iterates. A point on the
    section is not its own return.

    **Arguments** `system`, `g`, `direction`, `method`, `root_finder` and `integrator` as for
    `poincare_section`;

    - `h`, `num_steps`: size and number of the steps, which are always all computed.
    - `returns`: which return, 1 for the first.

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

    def __check_init__(self):
        check_system(self.system)
        self._settings()

    def _settings(self) -> _Settings:
        section = Section(self.g, self.direction, whole("returns", self.returns))
        names = ("method", "root_finder", "integrator", "num_steps")
        return _settings(self.system, section, {name: getattr(self, name) for name in names})

    def __call__(
        self, q: Any, p: Any, t0: Any = 0.0, epsilon: Any = None, args: Args = None
    ) -> Return:
        found, _ = self._settings().orbit((t0, q, p), self.h, self.system.strength(epsilon), args)
        return Return(found.ts[-1], found.qs[-1], found.ps[-1], found.result)


def _is_axis(x: Any) -> bool:
    return isinstance(x, Axis)


def _of_orbits(system: System, settings: SectionSettings) -> tuple[Any, Any, dict[str, int]]:
    return _varied(system.strength(settings.get("epsilon")), settings.get("args"))


def _varied(epsilon: Any, args: Any) -> tuple[Any, Any, dict[str, int]]:
    """ε and args with a `_Varied` for what differs between orbits, and the lengths of those."""
    found = {}

    def known(name: str, x: Any) -> Any:
        if np.ndim(x) == 0:
            return as_parameter(x)
        if np.ndim(x) != 1:
            raise ValueError(f"{name} must be a number or a 1-D array, got shape {np.shape(x)}.")
        if not is_traced(x) and not np.isfinite(x).all():
            raise ValueError(f"{name} must be finite, got {x}.")
        found[name] = len(x)
        return _Varied(jnp.asarray(x))

    epsilon = known("epsilon", epsilon.values if _is_axis(epsilon) else epsilon)
    args = jax.tree.map(
        lambda x: known(x.name, x.values) if _is_axis(x) else as_parameter(x),
        args,
        is_leaf=_is_axis,
    )
    return epsilon, args, found


def _raise_on_failure(found: PoincareSection, settings: _Settings) -> PoincareSection:
    fine = found.result == SECTION_RESULTS.successful
    if is_traced(fine):
        message = "an orbit has too few crossings: give throw=False and read each orbit's status."
        return eqx.error_if(found, ~jnp.all(fine), message)
    bad = np.flatnonzero(~np.asarray(fine))
    if not bad.size:
        return found
    i, names = int(bad[0]), np.atleast_1d(found.status)
    text = SECTION_RESULTS[getattr(SECTION_RESULTS, str(names[i]))]
    own = str(np.atleast_1d(status_name(found.run))[i])
    wanted, num_steps = settings.section.capacity, settings.options["num_steps"]
    raise SectionError(
        f"{bad.size} of {len(names)} orbits did not cross the section {wanted} times (after skip = "
        f"{settings.section.skip} crossings) in {num_steps} steps. The first is orbit {i}, with "
        f"{int(found.count[i])} of {wanted} crossings. Its status is {names[i]}; the status of its "
        f"run is {own}. {text} {AS_ATTRIBUTE}",
        found,
    )
