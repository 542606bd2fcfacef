"""Poincaré sections, return maps, and what becomes of them as ε grows."""

import math
import warnings
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, PyTree

from lanewise import Layout
from lanewise.jaxapi import is_traced

from .._arithmetic import Arithmetic
from .._checks import finite, positive, whole
from .._inputs import as_parameter, as_scalar, start_state
from .._integrate import integrate
from .._integrator import Integrator, chosen, default_method
from .._results import RESULTS, status_name
from .._solution import Save
from .._system import System, check_system
from .._types import Args, Scalar, State
from ..engine.names import both_names
from ..engine.newton import RootSolver
from ..methods import Method, Strang
from ..observe import Section, Stop
from ..sweep import Axis
from .results import SECTION_RESULTS, SectionError, WithStatus, judge


class PoincareSection(WithStatus):
    """Where orbits crossed a section.

    - `ts`, `qs`, `ps`: times and states, shapes (orbits, crossings), (orbits, crossings, …); NaN
      where there was none.
    - `count`: how many crossings each orbit had after those skipped, shape (orbits,).
    - `result`: a `SECTION_RESULTS` for each orbit, `status` its name. `run`: how the trajectory
      itself ended.
    - `epsilon`: of each orbit, shape (orbits,).
    """

    ts: Array
    qs: Array
    ps: Array
    count: Array
    result: SECTION_RESULTS
    run: RESULTS
    epsilon: Array


def _chosen(system: System, integrator: Integrator | None, **given: Any) -> Integrator:
    """As `chosen`, with a warning where the default is another one than it was."""
    found = chosen(integrator, **given)
    if found.method is None and not isinstance(default_method(system), Strang):
        warnings.warn(
            "sections used Strang() by default, and now use the default of integrate, which is "
            "TypeII() for this system. Give method=: dvi.Strang() for the results of earlier "
            "versions, dvi.TypeII() for the map of H_D itself.",
            FutureWarning,
            stacklevel=4,
        )
    return found


class _Settings(eqx.Module):
    """What orbits of a section have in common."""

    system: System
    section: Section
    integrator: Integrator
    stop: Stop | None
    num_steps: int = eqx.field(static=True)

    def run(self, q, p, h, t0, epsilon, args):
        """A run with its crossings and its last state."""
        return integrate(
            self.system, q, p, h=h, num_steps=self.num_steps, t0=t0, epsilon=epsilon, args=args,
            integrator=self.integrator, stop=self.stop, observe=self.section,
            save=Save(final=True), throw=False,
        )  # fmt: skip

    def orbit(self, q, p, h, t0, epsilon, args):
        """The crossings of one orbit, and the state and time that it ends with."""
        sol = self.run(q, p, h, t0, epsilon, args)
        crossed = sol.observed
        result = judge(crossed.count, self.section.capacity, sol.result)
        found = PoincareSection(
            crossed.ts, crossed.qs, crossed.ps, crossed.count, result, sol.result, epsilon
        )
        return found, (sol.ts[-1], sol.qs[-1], sol.ps[-1])


class _Varied(eqx.Module):
    """One value for each orbit."""

    values: Array


def _of_orbit(tree: Any, i: Array) -> Any:
    """What belongs to orbit i."""

    def is_varied(x):
        return isinstance(x, _Varied)

    return jax.tree.map(lambda x: x.values[i] if is_varied(x) else x, tree, is_leaf=is_varied)


@eqx.filter_jit
def _orbits(settings: _Settings, start, h, epsilon, args, count: int) -> PoincareSection:
    def one(i):
        t, q, p = _of_orbit(start, i)
        return settings.orbit(q, p, h, t, _of_orbit(epsilon, i), _of_orbit(args, i))[0]

    return jax.vmap(one)(jnp.arange(count))


@eqx.filter_jit
def _one_after_another(settings: _Settings, start, h, epsilon, args, count: int) -> PoincareSection:
    """Each orbit from the state that the one before has ended in; from the start if it failed."""

    def one(state, i):
        t, q, p = state
        found, end = settings.orbit(q, p, h, t, _of_orbit(epsilon, i), _of_orbit(args, i))
        good = found.run == RESULTS.successful
        return jax.tree.map(lambda a, b: jnp.where(good, a, b), end, start), found

    return lax.scan(one, start, jnp.arange(count))[1]


@both_names
def poincare_section(
    system: System,
    q0: Any,
    p0: Any,
    g: Callable[..., Any],
    *,
    h: Any,
    num_steps: int,
    crossings: int = 1000,
    direction: int = 1,
    skip: int = 0,
    t0: Any = 0.0,
    epsilon: Any = 0.0,
    args: PyTree = None,
    method: Method | None = None,
    newton: RootSolver | None = None,
    arithmetic: Arithmetic | None = None,
    layout: Layout | None = None,
    integrator: Integrator | None = None,
    stop: Stop | None = None,
    throw: bool = True,
) -> PoincareSection:
    r"""Where many orbits cross the surface g(t, q, p, args) = 0.

    All of them together, on the device; each crossing is solved for to round-off, on the curve of
    the method, see `Section`. For one orbit, or with other observables, observe a `Section`; for
    grids that outgrow the memory, do so under `sweep`.

    **Arguments** as for `integrate`, and

    - `q0`, `p0`: starts, the orbits in front: shape (orbits, …).
    - `g`, `direction`, `skip`: see `Section`; `crossings`: how many are wanted of each orbit.
    - `epsilon`: a number, or one for each orbit; so may be what in `args` is a `dvi.Axis`.
    - `stop`: where an orbit ends, an escape for instance.
    - `throw`: raise where an orbit has not as many crossings; otherwise read ``.status``.

    **Returns** a `PoincareSection`.

    **Raises** `ValueError` or `TypeError` for input that cannot be meant; `SectionError`, with what
    was found, when `throw` and a section is never crossed, too rarely, or an orbit escapes.

    **Source** Poincaré 1892; the crossing inside of a step: our own, compare Hénon 1982,
    *Physica D* 5, 412.

    **Example**

    ```python
    heiles = systems.henon_heiles()
    q0, p0 = np.array([[0.0, 0.1], [0.0, 0.2]]), np.array([[0.3, 0.0], [0.25, 0.1]])
    found = dvi.poincare_section(heiles.system, q0, p0, lambda t, q, p, args: q[0], h=0.1,
                                 num_steps=2000, crossings=25)
    print(found.qs.shape, bool(np.all(np.abs(found.qs[..., 0]) < 1e-12)))
    # (2, 25, 2) True
    ```
    """
    check_system(system)
    q, p = start_state(q0, p0)
    if q.ndim == 0 or q.shape[0] == 0:
        raise ValueError(
            f"q0 and p0 must have the orbits in front, (orbits, …); got shape {q.shape}. Give a "
            "single start as q0[None], p0[None]."
        )
    integrator = _chosen(
        system, integrator, method=method, root_finder=newton, arithmetic=arithmetic, layout=layout
    )
    section = Section(g, direction, whole("crossings", crossings), skip)
    settings = _Settings(system, section, integrator, stop, whole("num_steps", num_steps))
    epsilon, args, varied = _varied(epsilon, args)
    for name, length in varied.items():
        if length != q.shape[0]:
            raise ValueError(
                f"{name} must be one number or one for each of the {q.shape[0]} orbits, got "
                f"{length}."
            )
    start = (as_scalar("t0", t0, q.dtype), _Varied(q), _Varied(p))
    h = as_scalar("h", h, q.dtype, zero_allowed=False)
    try:
        found = _orbits(settings, start, h, epsilon, args, q.shape[0])
    except Exception as error:
        if any("called with q0 of shape" in note for note in getattr(error, "__notes__", ())):
            error.add_note(
                f"(q0 and p0 have the orbits in front: of shape {q.shape} they are {q.shape[0]} "
                f"orbits of q0 of shape {q.shape[1:]}. Give a single start as q0[None], p0[None].)"
            )
        raise
    return _raise_on_failure(found, crossings, num_steps) if throw else found


@both_names
def bifurcation(
    system: System,
    q0: Any,
    p0: Any,
    g: Callable[..., Any],
    *,
    epsilon: Any = 0.0,
    h: Any,
    num_steps: int,
    crossings: int = 100,
    skip: int = 100,
    direction: int = 1,
    follow: bool = False,
    t0: Any = 0.0,
    args: PyTree = None,
    method: Method | None = None,
    newton: RootSolver | None = None,
    arithmetic: Arithmetic | None = None,
    layout: Layout | None = None,
    integrator: Integrator | None = None,
    stop: Stop | None = None,
    throw: bool = True,
) -> PoincareSection:
    """What a section shows, after a transient, for each of many ε: a bifurcation diagram.

    **Arguments** as for `poincare_section`, with one start (q0, p0), and

    - `epsilon`: values, in the order in which they are to be followed. Or another parameter: a
      `dvi.Axis` in `args`, beside one ε or as many.
    - `skip`: crossings of the transient; `crossings`: those kept after it.
    - `follow`: False: every ε from the same start, all of them together. True: each from the state
      that the run before ended in, so that a branch is followed as far as it is stable; up and
      down (``epsilon[::-1]``) then show hysteresis. After a run that failed it begins anew from the
      start.

    **Returns** a `PoincareSection`, an orbit for each ε.

    **Raises** as `poincare_section`.
    """
    check_system(system)
    q, p = start_state(q0, p0)
    integrator = _chosen(
        system, integrator, method=method, root_finder=newton, arithmetic=arithmetic, layout=layout
    )
    section = Section(g, direction, whole("crossings", crossings), skip)
    settings = _Settings(system, section, integrator, stop, whole("num_steps", num_steps))
    epsilon, args, varied = _varied(epsilon, args)
    lengths = set(varied.values())
    if len(lengths) != 1 or 0 in lengths:
        raise ValueError(
            "a bifurcation diagram needs something that varies: epsilon as a one-dimensional array "
            "of values, or a dvi.Axis in args; several go together and must be equally long. Got "
            f"{varied if varied else 'one number for each'}."
        )
    start = (as_scalar("t0", t0, q.dtype), q, p)
    go = _one_after_another if follow else _orbits
    found = go(
        settings,
        start,
        as_scalar("h", h, q.dtype, zero_allowed=False),
        epsilon,
        args,
        lengths.pop(),
    )
    return _raise_on_failure(found, crossings, num_steps) if throw else found


def stroboscope(period: float, phase: float = 0.0) -> Callable[..., Any]:
    """The surface t = phase + k·period, for a section of a driven system with direction 1.

    g = sin(2π(t − phase)/period), which grows with time there.

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


@both_names
class ReturnMap(eqx.Module):
    r"""The map of a section g(t, q, p, args) = 0 onto itself.

    ``section_map(q, p, t0=0.0, epsilon=0.0, args=None)`` → `Return`.

    A function of JAX arrays: `jax.jacfwd` of it is the derivative of the return map, the change of
    the return time included, `vmap` takes many points, `lax.scan` iterates. A point on the section
    is not its own return.

    **Arguments** `system`, `g`, `direction`, `method`, `newton` and `integrator` as for
    `poincare_section`;

    - `h`, `num_steps`: steps that are taken at most, and always.
    - `returns`: which return, 1 for the first.

    The status is `never_crossed` or `too_few_crossings` where it does not come back within the
    steps, `failed` where the trajectory fails; the state is then NaN.
    """

    system: System
    g: Callable[..., Any]
    h: Any
    num_steps: int = eqx.field(static=True)
    direction: int = eqx.field(static=True, default=1)
    returns: int = eqx.field(static=True, default=1)
    method: Method | None = None
    newton: RootSolver | None = None
    integrator: Integrator | None = None

    def __check_init__(self):
        check_system(self.system)
        _chosen(self.system, self.integrator, method=self.method, root_finder=self.newton)
        Section(self.g, self.direction, whole("returns", self.returns))
        whole("num_steps", self.num_steps)

    def __call__(
        self, q: Any, p: Any, t0: Any = 0.0, epsilon: Any = 0.0, args: Args = None
    ) -> Return:
        section = Section(self.g, self.direction, self.returns)
        integrator = chosen(self.integrator, method=self.method, root_finder=self.newton)
        settings = _Settings(self.system, section, integrator, None, self.num_steps)
        sol = settings.run(q, p, self.h, t0, epsilon, args)
        crossed: Any = sol.observed
        result = judge(crossed.count, self.returns, sol.result)
        return Return(crossed.ts[-1], crossed.qs[-1], crossed.ps[-1], result)


def _varied(epsilon: Any, args: Any) -> tuple[Any, Any, dict[str, int]]:
    """ε and args with `_Varied` for what there is one of for each orbit, and how many there are."""
    found = {}

    def known(name: str, x: Any) -> Any:
        values = x.values if isinstance(x, Axis) else x
        values = np.asarray(values) if isinstance(x, Axis) or name == "epsilon" else None
        if values is None or values.ndim == 0:
            return as_parameter(x)
        if values.ndim != 1:
            raise ValueError(
                f"{name} must be a number or a one-dimensional array, got shape {values.shape}."
            )
        if not np.isfinite(values).all():
            raise ValueError(f"{name} must be finite, got {values}.")
        found[name] = len(values)
        return _Varied(jnp.asarray(values))

    def is_axis(x):
        return isinstance(x, Axis)

    if not is_traced(epsilon):
        epsilon = known("epsilon", epsilon)
    elif jnp.ndim(epsilon) == 1:
        found["epsilon"] = epsilon.shape[0]
        epsilon = _Varied(epsilon)
    args = jax.tree.map(
        lambda x: known(x.name, x) if is_axis(x) else as_parameter(x), args, is_leaf=is_axis
    )
    return epsilon, args, found


def _raise_on_failure(found: PoincareSection, wanted: int, num_steps: int) -> PoincareSection:
    fine = found.result == SECTION_RESULTS.successful
    if is_traced(fine):
        said = "a section was crossed too rarely: with throw=False read the status of each orbit."
        return eqx.error_if(found, ~jnp.all(fine), said)
    bad = np.flatnonzero(~np.asarray(fine))
    if not bad.size:
        return found
    i, names = int(bad[0]), np.atleast_1d(found.status)
    text = SECTION_RESULTS[getattr(SECTION_RESULTS, str(names[i]))]
    own = str(np.atleast_1d(status_name(found.run))[i])
    raise SectionError(
        f"{bad.size} of {len(names)} orbits did not cross the section {wanted} times in "
        f"{num_steps} steps; the first is orbit {i}, with {int(found.count[i])} crossings: "
        f"{names[i]} (run: {own}). {text} With throw=False what was found is returned with its "
        "statuses; here it is the `found` attribute of this error.",
        found,
    )
