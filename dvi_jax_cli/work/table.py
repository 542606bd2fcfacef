"""Tables of TOML files as pydantic models, errors that name the key with its path, and axes."""
# pyright: reportInvalidTypeForm=false

import math
import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from types import NoneType
from typing import TYPE_CHECKING, Annotated, Any, Generic, TypeVar, Union, get_args

import numpy as np
import pydantic
from pydantic import AfterValidator, BeforeValidator, Discriminator, Field, WithJsonSchema
from pydantic.json_schema import GenerateJsonSchema
from typing_extensions import TypeAliasType

from .._errors import InputError, as_input_error, describe, nearest, one_of, require, toml_type

NO_KEY = "the key is missing"


def key(default: Any, rule: str) -> Any:
    """A key with its default (``...``: the key is required) and its allowed values."""
    return Field(default, description=rule)


class TomlTable(pydantic.BaseModel):
    """A table of a TOML file. The description of a field is what its key allows."""

    model_config = pydantic.ConfigDict(
        extra="forbid", strict=True, frozen=True, arbitrary_types_allowed=True
    )

    # Each table converts its own errors, because only here the fields and their descriptions are
    # known; the table around it then puts its key in front.
    @pydantic.model_validator(mode="wrap")
    @classmethod
    def _name_the_keys(cls, value: Any, read: Callable[[Any], Any]) -> Any:
        try:
            return read(value)
        except pydantic.ValidationError as error:
            first, *successors = [e for entry in error.errors() for e in cls._errors(entry)]
            raise InputError(first.key, first.seen, first.allowed, successors) from None

    @classmethod
    def _errors(cls, entry: Any) -> list[InputError]:
        """An error of pydantic as errors with the key, relative to this table."""
        place, kind, context = entry["loc"], entry["type"], entry.get("ctx", {})
        inner, defect = context.get("error"), describe(entry["input"])
        if isinstance(inner, InputError):  # of a table within this one, or of a validator
            return [InputError(path(place, e.key), e.seen, e.allowed) for e in inner.errors]
        if not place:
            return [InputError("", defect, f"a table with the keys {one_of(cls.model_fields)}")]
        if kind == "extra_forbidden":
            names = one_of(cls.model_fields, str(place[-1]))
            return [InputError(path(place), "there is no such key", names)]
        rule = cls.model_fields[str(place[0])].description or ""
        if context.get("discriminator") == "'kind'":  # the key that selects a table of a union
            tag, kinds = context.get("tag", ""), context.get("expected_tags", rule)
            suggestion = nearest(tag, re.findall(r"\w+", kinds))
            defect = describe(tag) if tag else NO_KEY
            return [InputError(path(place, "kind"), defect, kinds + suggestion)]
        return [InputError(path(place), NO_KEY if kind == "missing" else defect, rule)]


_TAGS = {""}
"""Tags of the types of unions, which pydantic adds to the place of an error."""


def path(place: tuple[int | str, ...], inner: str = "") -> str:
    """A key with its path, such as ``state.q0[1].axis``, without the tags of a `union`."""
    text = ""
    for part in (*place, inner):
        if isinstance(part, int):
            text += f"[{part}]"
        elif part not in _TAGS:
            text += part if not text or part.startswith("[") else f".{part}"
    return text


T = TypeVar("T", bound=TomlTable)


def read_file(file: Path, model: type[T]) -> tuple[T, dict[str, Any]]:
    """The values of a TOML file, defaults included, and the file as it is.

    **Raises** `InputError` for a missing or unreadable file, TOML that does not parse, an
    unknown key and a value of the wrong type or out of range.
    """
    key, kinds = str(file), (OSError, UnicodeDecodeError)
    with as_input_error(key, "a TOML file in UTF-8", *kinds, text=_unreadable):
        # A pipe that has a name may never have a writer; those of a shell's <(…) have one.
        is_named_pipe = file.is_fifo() and not str(file).startswith(("/dev/", "/proc/"))
        require(not is_named_pipe, key, "it is a pipe", "a TOML file in UTF-8")
        text = file.read_text(encoding="utf-8-sig")  # some editors begin with a BOM
    kinds = ValueError, RecursionError  # of thousands of brackets
    with as_input_error(key, "https://toml.io", *kinds, prefix="it is not TOML: "):
        raw = tomllib.loads(text)
    try:
        return model.model_validate(raw), raw
    except pydantic.ValidationError as error:  # pydantic wraps the one of the outermost table
        context: Any = error.errors()[0].get("ctx")
        raise context["error"] from None


def _unreadable(error: Any) -> str:
    is_missing = isinstance(error, FileNotFoundError)
    return "there is no such file" if is_missing else f"it cannot be read: {error}"


class JsonSchema(GenerateJsonSchema):
    """A JSON schema of TOML: no null, and no titles made of the names of Python."""

    def nullable_schema(self, schema: Any) -> Any:
        """The schema of the value: a key that is absent is not null."""
        return self.generate_inner(schema["schema"])

    def default_schema(self, schema: Any) -> Any:
        """The schema; null and tables are not shown as defaults."""
        definition = super().default_schema(schema)
        if isinstance(definition.get("default"), dict | NoneType):
            definition.pop("default", None)
        return definition

    def field_title_should_be_set(self, schema: Any) -> bool:
        """False: the names of the keys are enough."""
        return False


# Types of values


def type_tag(value: Any) -> str:
    """The tag of a value, by which the types of a union are distinguished."""
    return f"<{toml_type(value).removeprefix('whole ')}>"


def union(tag_of: Callable[[Any], str] = type_tag, **kinds: Any) -> Any:
    """The union of types: type of a value in TOML, or what `tag_of` returns → type."""
    members = [Annotated[kind, pydantic.Tag(f"<{name}>")] for name, kind in kinds.items()]
    _TAGS.update(f"<{name}>" for name in kinds)
    return Annotated[Union[tuple(members)], Discriminator(tag_of)]  # noqa: UP007


def union_by_kind(*tables: type[TomlTable]) -> Any:
    """The union of tables that differ in the values of their key ``kind``."""
    for table in tables:
        _TAGS.update(get_args(table.model_fields["kind"].annotation))
    return Annotated[Union[tables], Discriminator("kind")]  # noqa: UP007


def check(is_allowed: Callable[[Any], Any]) -> AfterValidator:
    """Reject a value of the right type that is not allowed."""

    def validate(value: Any) -> Any:
        if not is_allowed(value):
            raise ValueError
        return value

    return AfterValidator(validate)


def _is_finite(value: int | float) -> bool:
    try:
        return math.isfinite(value)
    except OverflowError:  # a whole number of more than 300 digits
        return False


Text = Annotated[str, pydantic.StringConstraints(pattern=r"\S")]
Count = Annotated[int, Field(ge=1)]
NonNegative = Annotated[int, Field(ge=0)]
Number = Annotated[float, Field(allow_inf_nan=False)]
Fraction = Annotated[Number, Field(gt=0, lt=1)]
StepSize = Annotated[Number, check(lambda h: h != 0)]
Limit = Annotated[float, check(lambda x: not math.isnan(x))]
Scalar = Annotated[int | float, check(_is_finite)]
"""A number; whole ones stay whole."""

V = TypeVar("V")
NonEmpty = Annotated[list[V], Field(min_length=1)]
Two = Annotated[list[V], Field(min_length=2, max_length=2)]

Rows = TypeAliasType("Rows", union(number=Number, array=NonEmpty["Rows"]))
if TYPE_CHECKING:
    Array = np.ndarray
else:
    Array = Annotated[NonEmpty[Rows], AfterValidator(lambda rows: np.asarray(rows, float))]
"""Nested arrays of finite numbers, all rows of one length, as an array of NumPy."""

NumberOrArray = union(number=Number, array=Array)

AnyValue = TypeAliasType(
    "AnyValue",
    union(
        boolean=bool,
        number=Scalar,
        array=NonEmpty["AnyValue"],
        text=Text,
        table=dict[str, "AnyValue"],
    ),
)
"""A parameter of a force: numbers, texts, arrays and tables of these."""


# Axes of a sweep, in the place of numbers

AN_AXIS = "{linspace = [a, b, n]}, {geomspace = [a, b, n]} or {values = […]}"
KINDS = ("linspace", "geomspace", "values")
_RANGE = "[first, last, how many]"
_VALUE = "each of which is a value that this key takes without an axis"
_MAX_VALUES = 10_000_000
"""Values of an axis, which are all in memory."""


def _range_reader(kind: str) -> Callable[[Any], list[float]]:
    """A reader of ``[first, last, how many]``: the values that this describes."""

    def read(value: Any) -> list[float]:
        types = [type_tag(x) for x in value] if isinstance(value, list) else []
        fits = types == ["<number>"] * 3 and isinstance(value[2], int) and value[2] >= 1
        require(fits, "", describe(value), f"{_RANGE}: two numbers and a positive whole number")
        a, b, n = value
        limit = f"at most {_MAX_VALUES} values; more are generated by [start]"
        require(n <= _MAX_VALUES, "[2]", describe(n), limit)
        fits = kind == "linspace" or a * b > 0
        require(fits, "", describe(value), f"{_RANGE}, both ends above zero or both below")
        return getattr(np, kind)(a, b, n).tolist()

    return read


def _axis_name(name: str) -> str:
    from dvi_jax.sweep.variables import RESERVED_NAMES

    rule = f"a name such as x1, except {', '.join(RESERVED_NAMES)}"
    require(name.isidentifier() and name not in RESERVED_NAMES, "", describe(name), rule)
    return name


AxisName = Annotated[str, AfterValidator(_axis_name)]
_THREE = WithJsonSchema(
    {"type": "array", "items": {"type": "number"}, "minItems": 3, "maxItems": 3}
)


class AxisTable(TomlTable, Generic[V]):
    """An axis of a sweep: the values that a number takes."""

    linspace: Annotated[list[V], BeforeValidator(_range_reader("linspace")), _THREE] | None = key(
        None, f"{_RANGE}, evenly spaced values, {_VALUE}"
    )
    geomspace: Annotated[list[V], BeforeValidator(_range_reader("geomspace")), _THREE] | None = key(
        None, f"{_RANGE}, values with one ratio, {_VALUE}"
    )
    values: Annotated[NonEmpty[V], check(lambda rows: len({*map(np.shape, rows)}) == 1)] | None = (
        key(None, f"an array of at least one value, values of one shape, {_VALUE}")
    )
    axis: AxisName | None = key(None, "a name for this axis, by default the key")
    units: str = key("", 'text such as "m/s"')

    @pydantic.model_validator(mode="after")
    def _one_kind(self) -> Any:
        fields = {name: getattr(self, name) for name in self.model_fields_set}
        fits = len(fields.keys() & {*KINDS}) == 1
        require(fits, "", describe(fields), f"exactly one of {AN_AXIS}")
        return self

    @classmethod
    def model_parametrized_name(cls, params: Any) -> str:
        """The name in a JSON schema, without the type of the values."""
        return cls.__name__

    @property
    def kind(self) -> str:
        """The key that has the values."""
        return next(kind for kind in KINDS if getattr(self, kind) is not None)

    @property
    def elements(self) -> list[Any]:
        """The values."""
        return getattr(self, self.kind)


class NamedAxis(AxisTable[V], Generic[V]):
    """An axis of a sweep that has no key of its own to be named after."""

    axis: AxisName = key(..., 'a name for this axis, such as axis = "x"')


def number_or_axis(number: Any, of_axis: Any = None) -> Any:
    """A number or an axis of them."""
    return union(number=number, table=AxisTable[of_axis or number])


def select(value: Any, index: int) -> Any:
    """An argument with every axis in it at one of its values."""
    if isinstance(value, AxisTable):
        return value.elements[index]
    if isinstance(value, dict):
        return {name: select(v, index) for name, v in value.items()}
    return [select(v, index) for v in value] if isinstance(value, list) else value


def axes_in(value: Any) -> list[AxisTable]:
    """The axes in an argument."""
    if isinstance(value, AxisTable):
        return [value]
    parts = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return [axis for part in parts for axis in axes_in(part)]


# Arrays and parameters with axes


def _array_or_axes(components: list[Any]) -> Any:
    """An array, or nested lists with axes in them; `ValueError` for rows of unequal length."""
    array = np.asarray(select(components, 0), float)
    return components if axes_in(components) else array


Component = TypeAliasType(
    "Component", union(number=Number, table=NamedAxis[Number], array=NonEmpty["Component"])
)
Components = Annotated[NonEmpty[Component], AfterValidator(_array_or_axes)]
StateOrAxis = union(array=Components, table=NamedAxis[Array])


def _parameter_tag(value: Any) -> str:
    is_axis = isinstance(value, dict) and any(name in value for name in (*KINDS, "axis"))
    return "<axis>" if is_axis else type_tag(value)


_Single = union(number=Scalar, array=Array)
_KINDS = {"boolean": bool, "number": Scalar, "array": Components, "axis": AxisTable[_Single]}
SweepParameter = TypeAliasType(
    "SweepParameter", union(_parameter_tag, **_KINDS, table=dict[str, "SweepParameter"])
)
