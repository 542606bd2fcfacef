"""The arguments of `sweep` as one object, and the definition of the sweep that they make."""

import dataclasses
import os
from collections.abc import Mapping, Sequence
from typing import Any, TypedDict

import jax

from lanewise import Layout
from lanewise.jaxprs.jaxapi import ClosedJaxpr

from ..base.checks import instance, whole
from ..base.precision import require_double
from ..engine.newton import RootSolver
from ..integration.arithmetic import Arithmetic
from ..integration.integrator import Integrator, chosen
from ..lattices import Given, Lattice
from ..methods import Method
from ..observe import Jump, Stop
from ..observe.solution import Save
from ..problem.paths import as_path
from ..problem.system import System, check_system, of_problem
from .axes import Axis, as_axis, axes_in, is_axis, lengths
from .plan import make_plan, on_devices
from .program import Sweep, SweepProgram, trace
from .starts import Starts
from .variables import Variable, refuse_reserved_name, variables


class SweepSettings(TypedDict, total=False):
    """Keywords of `integrate` that `sweep` accepts, some of which may be an `Axis` or a list; and
    `start`, which generates initial conditions."""

    h: Any
    num_steps: Any
    t0: Any
    epsilon: Any
    args: Any
    method: Any
    lattice: Lattice | None
    root_finder: RootSolver | None
    arithmetic: Arithmetic | None
    layout: Layout | None
    integrator: Integrator | None
    observe: Any
    stop: Stop | None
    jump: Jump | Sequence[Jump] | None
    path: Any
    start: Starts | None
    save: Save | None
    devices: Sequence[Any] | None
    lanes_per_task: int | None


class SweepCostSettings(SweepSettings, total=False):
    """Keywords of `sweep`, those included that have no effect on its cost."""

    units: Mapping[str, str] | None
    store: str | os.PathLike | None
    client: Any
    threads: int | None
    progress: Any


@dataclasses.dataclass(frozen=True)
class Request:
    """What a sweep computes: arguments as in the call of `sweep`, with their defaults."""

    system: Any
    q0: Any = None
    p0: Any = None
    h: Any = None
    num_steps: Any = None
    t0: Any = 0.0
    epsilon: Any = None
    args: Any = None
    method: Any = None
    lattice: Any = None
    root_finder: Any = None
    arithmetic: Any = None
    layout: Any = None
    integrator: Any = None
    observe: Any = None
    stop: Any = None
    jump: Any = None
    path: Any = None
    start: Any = None
    save: Any = None
    devices: Any = None
    lanes_per_task: int | None = None

    def prepare(self) -> tuple[SweepProgram, dict[str, Variable], list[ClosedJaxpr]]:
        """The program of the sweep, divided into tasks, the variables of its result, and the
        jaxprs. **Raises** `ValueError` or `TypeError` for arguments that define no sweep."""
        definition = self._with_defaults()._sweep()
        shapes, programs = trace(definition)
        arrays = variables(definition, shapes)
        size = sum(variable.bytes for variable in arrays.values())
        devices = jax.local_devices() if self.devices is None else [*self.devices]
        for device in devices:
            instance("each of devices", device, jax.Device, "one of jax.local_devices()")
        whole("the number of devices", len(devices))
        limits, weight = on_devices(devices, programs[0].jaxpr)
        grid = definition.dims, definition.compiled_dims, weight * definition.most_steps
        plan = make_plan(*grid, size, self.lanes_per_task, limits)
        return SweepProgram(definition, plan, devices), arrays, programs

    def _with_defaults(self) -> "Request":
        """The same, with the defaults of a problem of the library."""
        has_start = self.start is not None or isinstance(self.system, System)
        values = self.q0, self.p0, self.h, self.args
        system, *values = of_problem(self.system, *values, has_start, jumps_allowed=True)
        check_system(system, noise_allowed=True)
        fields = dict(zip(("q0", "p0", "h", "args"), values, strict=True))
        jumps = getattr(self.system, "jumps", None) if self.jump is None else self.jump
        epsilon = system.strength(self.epsilon)
        fields = {**fields, "system": system, "epsilon": epsilon, "jump": jumps or None}
        return dataclasses.replace(self, **fields)

    def _sweep(self) -> Sweep:
        inputs = self._inputs()
        if self.observe is None and self.save is None and self.stop is None:
            raise ValueError(
                "observe, save and stop are all missing: give observe={...} or "
                "save=dvi.Save(final=True)."
            )
        # The name of the axis is not "method", which has another meaning in xarray's sel.
        method: Any = _as_axis_of_list("integrator", self.method)
        num_steps = _as_axis_of_list("num_steps", self.num_steps)
        integrator = self._integrator(method)
        method = method if is_axis(method) else integrator.method_for(self.system)
        list_axes = [
            (axis.name, len(axis), argument)
            for argument, axis in (("method", method), ("num_steps", num_steps))
            if is_axis(axis)
        ]
        axes = [*list_axes, *((axis.name, len(axis), place) for place, axis in axes_in(inputs))]
        if (start := self.start) is not None:
            Axis(start.name, [0])  # raises for a name that is not an identifier
            if start.name in (name for name, *_ in axes):
                raise ValueError(
                    f"start has the name of an axis, {start.name!r}: give it another name=..."
                )
            axes.append((start.name, start.count, "start"))
        dims = lengths(axes)
        _check_dims(dims)
        _check_steps(num_steps, integrator.lattice, inputs)
        options = {
            "save": self.save,
            "observe": self.observe,
            "stop": self.stop,
            "lattice": integrator.lattice,
            "newton": integrator.root_finder,
            "arithmetic": integrator.arithmetic,
            "layout": integrator.layout,
        }
        if self.jump is not None:  # stores of sweeps without one are described without it
            options["jump"] = self.jump
        separate = len({name for name, *_ in list_axes})
        return Sweep(self.system, inputs, start, method, num_steps, options, dims, separate)

    def _inputs(self) -> dict[str, Any]:
        """The arguments that may have axes."""
        # Integers would make a program of their own.
        numbers = {
            name: as_axis(name, float(value) if type(value) is int else value)
            for name, value in (("epsilon", self.epsilon), ("h", self.h), ("t0", self.t0))
        }
        inputs = numbers | {"args": self.args, **self._states()}
        # Only where there is one: stores of sweeps without noise are described without it.
        if self.path is not None:
            inputs["path"] = self.path if axes_in({"path": self.path}) else as_path(self.path)
        return inputs

    def _states(self) -> dict[str, Any]:
        """q0 and p0, unless they come from a `start`."""
        states = {"q0": self.q0, "p0": self.p0}
        if self.start is not None:
            hint = 'For your own states use q0=dvi.Axis("start", ...), p0=dvi.Axis("start", ...).'
            instance("start", self.start, Starts, "one of dvi.starts, such as Random(...)", hint)
            if self.q0 is None and self.p0 is None:
                return {}
        elif self.q0 is not None and self.p0 is not None:
            return states
        arguments = states | {"start": self.start}
        names = [name for name, value in arguments.items() if value is not None]
        raise ValueError(
            "give both q0 and p0, or only start=dvi.starts.Random(...) or similar, got "
            f"{', '.join(names) or 'neither'}."
        )

    def _integrator(self, method: Any) -> Integrator:
        for value in method.values if is_axis(method) else ():
            label = f"each value of the axis {method.name!r} of method"
            instance(label, value, Method, "a dvi.Method")
        names = ("lattice", "root_finder", "arithmetic", "layout")
        parts = {name: getattr(self, name) for name in names}
        return chosen(self.integrator, method=None if is_axis(method) else method, **parts)


def _check_dims(dims: Mapping[str, int]) -> None:
    if not dims:
        raise ValueError(
            "nothing varies in this sweep: give start, an array for epsilon, h or t0, or a "
            "dvi.Axis for another number. For one trajectory use dvi.integrate."
        )
    for name, length in dims.items():
        refuse_reserved_name("axis", name)
        if length >= 2**31:
            require_double(f"the axis {name!r} of 2³¹ values or more, {length},")


def _check_steps(num_steps: Any, lattice: Lattice, inputs: Mapping[str, Any]) -> None:
    if isinstance(lattice, Given):
        superfluous = [f"the axis of {name}" for name in ("h", "t0") if is_axis(inputs[name])]
        superfluous += ["num_steps"] if num_steps is not None else []
        if superfluous:
            raise ValueError(
                f"leave out {' and '.join(superfluous)}: dvi.Given(ts) determines the steps."
            )
        return
    for count in num_steps.values if is_axis(num_steps) else [num_steps]:
        whole("num_steps", count, hint="It is the number of steps of each trajectory.")


def _as_axis_of_list(name: str, value: Any) -> Any:
    return Axis(name, value) if isinstance(value, list | tuple) else value
