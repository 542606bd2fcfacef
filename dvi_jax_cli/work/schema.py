"""The TOML files of run, sweep, fit, discover and bound: their keys, types, ranges, defaults."""
# pyright: reportInvalidTypeForm=false

import datetime
import re
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, WithJsonSchema, model_validator
from pydantic.json_schema import models_json_schema
from typing_extensions import TypeAliasType

from .._errors import describe, require
from .._names import FILES as KINDS
from . import table as toml
from .ring import RingFile
from .table import (
    Array,
    Count,
    NonEmpty,
    NonNegative,
    Number,
    Text,
    TomlTable,
    Two,
    check,
    key,
    union,
)

ARRAY = "an array of finite numbers, or of such arrays with rows of one length"
COUNT = "a positive whole number"
FINITE = "a finite number"
FRACTION = "a number between 0 and 1"
FILE = '"file.py:name"'
ARGS = "a table of numbers, booleans, arrays of numbers, or tables of these"
METHOD = 'text such as "TypeII", "Strang" or "Yoshida(4)"'
STEP_SIZE = "a finite number that is not zero (negative runs backwards)"
BOOLEAN = "true or false"
BOX = "{q = […], p = […]}: numbers, or arrays of the shape of q"
NEW_DIRECTORY = "the path of a directory that does not exist yet"
OR_AXIS = f"; or an axis, {toml.AN_AXIS}"
SEED = "a whole number that is not negative"
TIMES = "at least two times, all increasing or all decreasing"

# The system, its state and its parameters

Date = Annotated[
    Any,
    check(lambda day: type(day) in (str, int, float, datetime.date, datetime.datetime)),
    WithJsonSchema({"type": ["string", "number"]}),
]
Parameter = TypeAliasType(
    "Parameter", union(boolean=bool, number=toml.Scalar, array=Array, table=dict[str, "Parameter"])
)


class State(TomlTable):
    """The initial condition."""

    q0: Array | None = key(None, ARRAY)
    p0: Array | None = key(None, ARRAY)
    date: Date | None = key(None, 'a day, "1900-01-01", or a Julian date; for solar_system')

    @model_validator(mode="after")
    def _date_or_arrays(self) -> Any:
        fits = self.date is None or (self.q0 is None and self.p0 is None)
        require(fits, "date", "it is given together with q0 or p0", "either date, or q0 and p0")
        return self


class SystemFile(TomlTable):
    """The common keys of the files of run, fit, discover and bound."""

    system: Text = key(..., f"the name of a system in the library, ring, or {FILE}")
    ring: RingFile | None = key(None, "a table with file = …; for system = ring")
    state: State = State()
    args: dict[str, Parameter] | None = key(None, ARGS)
    force: NonEmpty[dict[str, toml.AnyValue]] | None = key(
        None, "tables [[force]] with name = a class of dvi.forces, and its parameters"
    )
    t0: Number = key(0.0, FINITE)
    h: toml.StepSize | None = key(None, STEP_SIZE)
    method: Text = key("TypeII", METHOD)


class Output(TomlTable):
    """The directory of the results, and whether there are pictures."""

    dir: Text | None = key(None, NEW_DIRECTORY)
    plots: bool = key(True, BOOLEAN)


# A run


def _in_order(times: np.ndarray) -> bool:
    steps = np.diff(times) if times.ndim == 1 else np.zeros(1)
    return steps.size > 0 and bool((steps > 0).all() or (steps < 0).all())


class Times(TomlTable):
    """The times of the steps."""

    times: Annotated[Array, check(_in_order)] = key(..., TIMES)


def _check_names(observables: dict[str, str]) -> dict[str, str]:
    rule = "a name without / and \\, because it becomes the name of a file in an archive"
    for name in observables:
        require(not re.search(r"[/\\\x00-\x1f]", name), "", f"the name is {name!r}", rule)
    return observables


class Integration(TomlTable):
    """The common keys of the files of run and sweep."""

    lattice: union(text=Literal["uniform"], table=Times) = key(
        "uniform", f'"uniform", or {{times = [t0, t1, …]}} with {TIMES}'
    )
    observables: Annotated[dict[str, Text], AfterValidator(_check_names)] | None = key(
        None, 'a table of texts, such as energy = "energy" or drift = "MaxDrift(energy)"'
    )
    jump: Text | None = key(None, f"{FILE}, a dvi.Jump or a list of them")

    @model_validator(mode="after")
    def _times_or_steps(self) -> Any:
        file: Any = self  # of a run or of a sweep, with h, steps and t0
        if isinstance(self.lattice, Times):
            for name in ("h", "steps"):
                value, rule = getattr(file, name), "no value: lattice.times gives the steps"
                require(value is None, name, describe(value), rule)
            fits = file.t0 in (0.0, self.lattice.times[0])
            require(fits, "t0", describe(file.t0), "no value: the run begins at lattice.times[0]")
        return self


class RunOutput(Output):
    """The results of a run."""

    every: Count = key(1, f"{COUNT}: steps from one saved state to the next")


class RunFile(SystemFile, Integration):
    """One trajectory."""

    steps: Count | None = key(None, COUNT)
    epsilon: Number | None = key(None, FINITE)
    output: RunOutput = RunOutput()


# A sweep


class SweepState(State):
    """The initial condition, with axes."""

    q0: toml.StateOrAxis | None = key(None, f"{ARRAY}; numbers in it may be axes")
    p0: toml.StateOrAxis | None = key(None, f"{ARRAY}; numbers in it may be axes")


class StatePair(TomlTable):
    """Two values, for q and for p."""

    q: toml.NumberOrArray = key(..., "a number, or an array of the shape of q")
    p: toml.NumberOrArray = key(..., "a number, or an array of the shape of q")


class _Start(TomlTable):
    count: Count = key(..., COUNT)
    seed: NonNegative = key(0, SEED)
    name: toml.AxisName = key("start", "a name such as start")


class BoxStart(_Start):
    """Points in a box."""

    kind: Literal["halton", "random"]
    low: StatePair = key(..., BOX)
    high: StatePair = key(..., BOX)


class NormalStart(_Start):
    """Normally distributed points."""

    kind: Literal["normal"]
    q0: Array | None = key(None, ARRAY)
    p0: Array | None = key(None, ARRAY)
    sigma: StatePair = key(..., "{q = …, p = …}: standard deviations, numbers or arrays")


class EnergyShellStart(_Start):
    """Points of one energy."""

    kind: Literal["energy_shell"]
    H: Text = key(..., f"{FILE}, a function (t, q, p, args)")
    energy: Number = key(..., FINITE)
    low: Array = key(..., f"a corner of the box of q, {ARRAY}")
    high: Array = key(..., f"a corner of the box of q, {ARRAY}")


class OwnStart(TomlTable):
    """Initial conditions of a Python file."""

    kind: Literal["own"]
    starts: Text = key(..., f"{FILE}, a dvi.starts.Starts")


Start = toml.union_by_kind(BoxStart, NormalStart, EnergyShellStart, OwnStart)


class SaveEvery(TomlTable):
    """Every n-th state is saved."""

    every: Count = key(..., COUNT)


class SweepOutput(TomlTable):
    """The store of a sweep."""

    store: Text | None = key(None, NEW_DIRECTORY)
    lanes_per_task: Count | None = key(None, f"{COUNT}: trajectories of one task")


def _to_integer(value: Any) -> Any:  # linspace makes 100.0
    return int(value) if isinstance(value, float) and value.is_integer() else value


class SweepFile(SystemFile, Integration):
    """Many trajectories: the keys of a run with axes in the place of numbers."""

    state: SweepState = SweepState()
    start: Start | None = key(None, "a table, kind = halton, random, normal, energy_shell or own")
    args: dict[str, toml.SweepParameter] | None = key(
        None, f"{ARGS}; a number may be an axis, {toml.AN_AXIS}"
    )
    stop: Text | None = key(None, f"{FILE}, a dvi.Stop that ends trajectories")
    t0: toml.number_or_axis(Number) = key(0.0, FINITE + OR_AXIS)
    h: toml.number_or_axis(toml.StepSize) | None = key(None, STEP_SIZE + OR_AXIS)
    steps: toml.number_or_axis(Count, Annotated[Count, BeforeValidator(_to_integer)]) | None = key(
        None, f"{COUNT}{OR_AXIS} of such numbers"
    )
    epsilon: toml.number_or_axis(Number) | None = key(None, FINITE + OR_AXIS)
    method: union(text=Text, array=NonEmpty[Text], table=toml.AxisTable[Text]) = key(
        "TypeII", f"{METHOD}; or an array of such texts"
    )
    save: union(text=Literal["final"], table=SaveEvery) | None = key(None, '"final", {every = n}')
    output: SweepOutput = SweepOutput()

    @model_validator(mode="after")
    def _start_or_state(self) -> Any:
        for name in ("q0", "p0", "date"):
            fits = self.start is None or getattr(self.state, name) is None
            require(fits, f"state.{name}", "it is given with [start]", "[state] or [start]")
        return self


# A fit


def _flat(table: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Parameter → pair: ``[bounds] args.k`` is a table in TOML, ``"args.k"`` is not."""
    pairs: dict[str, Any] = {}
    for k, inner in table.items():
        pairs |= _flat(inner, f"{prefix}{k}.") if isinstance(inner, dict) else {prefix + k: inner}
    return pairs


Limits = TypeAliasType("Limits", union(number=toml.Limit, array=list["Limits"]))
Bounds = TypeAliasType("Bounds", union(array=Two[Limits], table=dict[str, "Bounds"]))
Priors = TypeAliasType("Priors", union(array=Two[toml.NumberOrArray], table=dict[str, "Priors"]))


def _sigma_tag(value: Any) -> str:
    is_names = isinstance(value, list) and value and isinstance(value[0], str)
    return "<names>" if is_names else toml.type_tag(value)


Sigma = union(
    _sigma_tag,
    number=Annotated[Number, check(lambda sigma: sigma > 0)],
    array=Annotated[Array, check(lambda sigma: (sigma > 0).all())],
    text=Annotated[Text, AfterValidator(lambda name: [name])],
    names=list[Text],
)
Period = Annotated[toml.Limit, check(lambda period: period > 0)]


class Data(TomlTable):
    """The observations."""

    file: Text = key(..., "the path of a CSV or npz file, from the folder of this one")
    time: Text = key("t", "the name of the column with the times")
    columns: NonEmpty[Text] | None = key(
        None, "an array of names of columns; all but time and sigma if not given"
    )
    observe: Text = key(
        "positions", f'"positions", "momenta", "state", or {FILE} of a function (t, q, p, args)'
    )
    sigma: Sigma | None = key(
        None,
        "standard errors: a positive number, an array of them, one for each column, or names of "
        "columns",
    )
    period: union(number=Period, array=NonEmpty[Period]) | None = key(
        None,
        "period of angles, such as 360: a positive number, or an array, one for each column, with "
        "inf for columns that are not periodic",
    )


class Options(TomlTable):
    """The options of a fit."""

    loss: Literal["LeastSquares", "SoftL1", "Cauchy"] = key(
        "LeastSquares", "LeastSquares, SoftL1, Cauchy"
    )
    segments: Count | None = key(None, f"{COUNT}: segments of multiple shooting")
    horizons: union(text=Literal["auto", "none"], array=list[Number]) = key(
        "auto", '"auto", "none", or an array of growing times'
    )
    max_steps: Count | None = key(None, COUNT)
    tolerance: toml.Fraction = key(1e-4, FRACTION)
    curvature: bool = key(True, BOOLEAN)


class FitFile(SystemFile):
    """Parameters from observations."""

    t0: Number | None = key(
        None, f"{FINITE}: the time of [state]; that of the first observation if not given"
    )
    epsilon: Number | None = key(None, FINITE)
    parameters: NonEmpty[Text] = key(..., 'an array of names: "epsilon", "q0", "p0", "args.NAME"')
    bounds: Annotated[dict[str, Bounds], AfterValidator(_flat)] = key(
        {}, "[lower, upper], numbers or arrays; -inf, inf for none"
    )
    priors: Annotated[dict[str, Priors], AfterValidator(_flat)] = key(
        {}, "[mean, standard error], numbers or arrays"
    )
    data: Data = key(..., "[data], a table with the observations")
    options: Options = Options()
    output: Output = Output()


# A discovery


class SampleBox(TomlTable):
    """The box that samples are taken from."""

    count: Count | None = key(None, f"{COUNT}; not given: four for each function")
    low: StatePair = key(..., f"a corner of the box, {BOX}")
    high: StatePair = key(..., f"a corner of the box, {BOX}")
    times: Annotated[Two[Number], check(lambda span: span[0] < span[1])] | None = key(
        None, "[first, last]: times of the samples (τ for a slow time), all at t0 if not given"
    )
    seed: NonNegative = key(0, SEED)


def _strengths(value: Any) -> list[float]:
    strengths = value.elements if isinstance(value, toml.AxisTable) else value
    if len(strengths) < 3 or min(strengths) <= 0 or len(set(strengths)) < len(strengths):
        raise ValueError
    return strengths


class Drift(TomlTable):
    """How drifts are measured."""

    epsilons: Annotated[
        union(array=list[Number], table=toml.AxisTable[Number]), AfterValidator(_strengths)
    ] = key(
        [1e-4, 3e-4, 1e-3, 3e-3, 1e-2, 3e-2],
        "three numbers or more above zero, no two the same: an array, or {geomspace = [a, b, n]}",
    )
    steps: Count = key(1000, COUNT)
    starts: Count = key(8, f"{COUNT}: trajectories from the box")
    measure: bool = key(True, f"{BOOLEAN}: whether drifts are measured")


class DiscoverFile(SystemFile):
    """A search for invariants of a map."""

    basis: Text = key(
        ...,
        f'text such as "Polynomials(4)", "Polynomials(2) + Radial((-1,))", or {FILE} of a basis',
    )
    order: NonNegative = key(1, SEED)
    tolerance: toml.Fraction | None = key(None, f"{FRACTION}; not given: exact invariants alone")
    representative: Literal["least", "simplest"] = key("least", '"least" or "simplest"')
    samples: SampleBox = key(..., "[samples], a table with the box of the samples")
    drift: Drift = Drift()
    output: Output = Output()


# A proof


Above0 = Annotated[Number, check(lambda value: value > 0)]
Interval = Annotated[Two[Number], check(lambda ends: ends[0] < ends[1])]


class Domain(TomlTable):
    """The states for which a bound is proved."""

    low: StatePair = key(..., f"a corner of the box, {BOX}")
    high: StatePair = key(..., f"a corner of the box, {BOX}")
    inside: Text | None = key(None, f"{FILE} of a function (q, p) that is ≥ 0 in the domain")
    periodic: union(boolean=bool, array=NonEmpty[bool]) = key(False, "true, or booleans like q")
    times: Interval | None = key(
        None, "[first, last]: times at which steps begin (τ for a slow time), if the map has a time"
    )


class Bound(TomlTable):
    """How far the domain is divided, and the change for which steps are counted."""

    change: Above0 = key(1e-3, "a number above zero")
    ratio: Annotated[Number, check(lambda ratio: ratio > 1)] = key(2.0, "a number above 1")
    max_boxes: Count = key(2000, COUNT)
    max_seconds: Above0 = key(300.0, "a number above zero")


class BoundFile(SystemFile):
    """A proof of how much invariants change."""

    invariants: Text = key(..., f"{FILE} of a Discovery, or of a function (q, p[, epsilon])")
    epsilon: Interval | None = key(None, "[least, largest], if the system has a perturbation")
    domain: Domain = key(..., "[domain], a table with the box of the states")
    bound: Bound = Bound()
    output: Output = Output()


_MODELS = (RunFile, SweepFile, FitFile, DiscoverFile, BoundFile)
FILES: dict[str, type[TomlTable]] = dict(zip(KINDS, _MODELS, strict=True))
"""Kind of file → its model."""


def json_schema(kind: str | None = None) -> dict[str, Any]:
    """The JSON schema of the files of one kind, or of a file of any kind."""
    models = [FILES[kind]] if kind else list(FILES.values())
    inputs: Any = [(model, "validation") for model in models]
    refs, definitions = models_json_schema(inputs, schema_generator=toml.JsonSchema)
    definitions["anyOf"] = [refs[model, "validation"] for model in models]
    title = f"dvi-jax {kind or 'TOML'} file"
    return {"$schema": toml.JsonSchema.schema_dialect, "title": title} | definitions
