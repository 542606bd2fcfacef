"""Keywords of `integrate` that other functions accept too, as types of ``**settings``.

A function declares ``**settings: Unpack[OrbitSettings]``, which type checkers compare with its
calls; `checked_keywords` makes the same comparison when the program runs.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Required, TypedDict

from lanewise import Layout

from ..engine.newton import RootSolver
from ..lattices import Lattice
from ..methods import Method
from ..observe import Jump, Stop
from .arithmetic import Arithmetic
from .integrator import Integrator, chosen


class MapSettings(TypedDict, total=False):
    """Keywords of functions that examine the paper's map, of `TypeII()`.

    - `t0`: initial time, by default 0. `args`: pytree that H_D, W and the observables receive.
    - `root_finder`: the solver of implicit steps.
    - `integrator`: an `Integrator` in place of these and other options.
    """

    t0: Any
    args: Any
    root_finder: RootSolver | None
    integrator: Integrator | None


class MethodSettings(MapSettings, total=False):
    """The same, and `method`: an object, or its name such as "strang"."""

    method: Method | str | None


class ArithmeticSettings(MethodSettings, total=False):
    """The same, and `arithmetic`: the representation of the state."""

    arithmetic: Arithmetic | None


class OrbitSettings(ArithmeticSettings, total=False):
    """Keywords of functions that run trajectories. The same, and

    - `epsilon`: strength of the perturbation.
    - `lattice`: the time grid. `layout`: machine code or arrays.
    """

    epsilon: Any
    lattice: Lattice | None
    layout: Layout | None


class IntegrationSettings(OrbitSettings, total=False):
    """The same, and `h`: step size [time]; `num_steps`: number of steps."""

    h: Any
    num_steps: int | None


class TangentSettings(IntegrationSettings, total=False):
    """The same, and `jump`: events that change the state; `throw`: raise an error if the trajectory
    fails (True by default)."""

    jump: Jump | Sequence[Jump] | None
    throw: bool


class SectionSettings(OrbitSettings, total=False):
    """As `OrbitSettings`, and

    - `h`: step size [time], and `num_steps`: number of steps; both are necessary.
    - `stop`: a `Stop`, the condition of an early end. `jump`: events that change the state.
    - `throw`: raise an error if an orbit has too few crossings (True by default).
    """

    h: Required[Any]
    num_steps: Required[int]
    stop: Stop | None
    jump: Jump | Sequence[Jump] | None
    throw: bool


# Those of `Integrator`, and the object itself: a call gives either the object or single options.
_FIELDS = ("method", "lattice", "root_finder", "arithmetic", "layout", "integrator")


def integrator_of(settings: Mapping[str, Any]) -> tuple[Integrator, dict[str, Any]]:
    """The `Integrator` that the keywords of a call describe, and the other keywords."""
    options = {name: value for name, value in settings.items() if name in _FIELDS}
    arguments = {name: value for name, value in settings.items() if name not in _FIELDS}
    return chosen(**options), arguments
