"""Tables of TOML files as pydantic models, and errors that name the key with its path."""
# pyright: reportInvalidTypeForm=false

import math
import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from types import NoneType
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, Union, get_args

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    StringConstraints,
    Tag,
    ValidationError,
    model_validator,
)
from pydantic.json_schema import GenerateJsonSchema
from typing_extensions import TypeAliasType

from .._errors import InputError, nearest, one_of, shown, toml_type

MISSING = "the key is missing"


def key(default: Any, allowed: str) -> Any:
    """A key with its default, ``...`` where there is none, and what it allows."""
    return Field(default, description=allowed)


class Table(BaseModel):
    """A table of a TOML file. The description of a field is what its key allows."""

    model_config = ConfigDict(
        extra="forbid", strict=True, frozen=True, arbitrary_types_allowed=True
    )

    # Each table converts its own errors, because only here the fields and their descriptions are
    # known; the table around it then puts its key in front.
    @model_validator(mode="wrap")
    @classmethod
    def _name_the_keys(cls, given: Any, read: Callable[[Any], Any]) -> Any:
        try:
            return read(given)
        except ValidationError as error:
            first, *more = [e for one in error.errors() for e in cls._errors(one)]
            raise InputError(first.key, first.seen, first.allowed, more) from None

    @classmethod
    def _errors(cls, found: Any) -> list[InputError]:
        """An error of pydantic as errors with the key, relative to this table."""
        place, kind, context = found["loc"], found["type"], found.get("ctx", {})
        inner, seen = context.get("error"), shown(found["input"])
        if isinstance(inner, InputError):  # of a table within this one, or of a validator
            return [InputError(path(place, e.key), e.seen, e.allowed) for e in inner.found]
        if not place:
            return [InputError("", seen, f"a table with the keys {one_of(cls.model_fields)}")]
        if kind == "extra_forbidden":
            names = one_of(cls.model_fields, str(place[-1]))
            return [InputError(path(place), "there is no such key", names)]
        allowed = cls.model_fields[str(place[0])].description or ""
        if context.get("discriminator") == "'kind'":  # the key that tells the tables of a union
            tag, kinds = context.get("tag", ""), context.get("expected_tags", allowed)
            near = nearest(tag, re.findall(r"\w+", kinds))
            return [InputError(path(place, "kind"), repr(tag) if tag else MISSING, kinds + near)]
        return [InputError(path(place), MISSING if kind == "missing" else seen, allowed)]


_TAGS = {""}
"""Tags of the types of unions, which pydantic adds to the place of an error."""


def path(place: tuple[int | str, ...], inner: str = "") -> str:
    """A key with its path, such as ``state.q0[1].axis``, without the tags of a `union`."""
    whole = ""
    for part in (*place, inner):
        if isinstance(part, int):
            whole += f"[{part}]"
        elif part not in _TAGS:
            whole += part if not whole or part.startswith("[") else f".{part}"
    return whole


T = TypeVar("T", bound=Table)


def read_file(file: Path, model: type[T]) -> tuple[T, dict[str, Any]]:
    """The values of a TOML file, defaults included, and the file as it is.

    **Raises** `InputError` for a missing or unreadable file, TOML that does not parse, an
    unknown key and a value of the wrong type or out of range.
    """
    try:
        raw = tomllib.loads(file.read_text(encoding="utf-8-sig"))  # some editors begin with a BOM
    except FileNotFoundError:
        raise InputError(str(file), "there is no such file", "the path of a TOML file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(str(file), f"cannot be read: {error}", "a TOML file in UTF-8") from None
    except (ValueError, RecursionError) as error:  # also thousands of digits, of brackets
        raise InputError(str(file), f"is not TOML: {error}", "https://toml.io") from None
    try:
        return model.model_validate(raw), raw
    except ValidationError as error:  # pydantic wraps the one of the outermost table
        context: Any = error.errors()[0].get("ctx")
        raise context["error"] from None


class JsonSchema(GenerateJsonSchema):
    """A JSON schema of TOML: no null, and no titles made of the names of Python."""

    def nullable_schema(self, schema: Any) -> Any:
        """The schema of the value: a key that is absent is not null."""
        return self.generate_inner(schema["schema"])

    def default_schema(self, schema: Any) -> Any:
        """The schema; null and tables are not shown as defaults."""
        found = super().default_schema(schema)
        if isinstance(found.get("default"), dict | NoneType):
            found.pop("default", None)
        return found

    def field_title_should_be_set(self, schema: Any) -> bool:
        """False: the names of the keys are enough."""
        return False


# Types of values


def type_tag(value: Any) -> str:
    """The tag of a value, by which the types of a union are distinguished."""
    return f"<{toml_type(value).removeprefix('whole ')}>"


def union(tag_of: Callable[[Any], str] = type_tag, **kinds: Any) -> Any:
    """The union of types: type of a value in TOML, or what `tag_of` returns → type."""
    tagged = [Annotated[kind, Tag(f"<{name}>")] for name, kind in kinds.items()]
    _TAGS.update(f"<{name}>" for name in kinds)
    return Annotated[Union[tuple(tagged)], Discriminator(tag_of)]  # noqa: UP007


def union_by_kind(*tables: type[Table]) -> Any:
    """The union of tables that differ in the values of their key ``kind``."""
    for table in tables:
        _TAGS.update(get_args(table.model_fields["kind"].annotation))
    return Annotated[Union[tables], Discriminator("kind")]  # noqa: UP007


def check(is_allowed: Callable[[Any], Any]) -> AfterValidator:
    """Reject a value of the right type that is not allowed."""

    def checked(value: Any) -> Any:
        if not is_allowed(value):
            raise ValueError
        return value

    return AfterValidator(checked)


def _is_finite(value: int | float) -> bool:
    try:
        return math.isfinite(value)
    except OverflowError:  # a whole number of more than 300 digits
        return False


Text = Annotated[str, StringConstraints(pattern=r"\S")]
Count = Annotated[int, Field(ge=1)]
Whole = Annotated[int, Field(ge=0)]
Number = Annotated[float, Field(allow_inf_nan=False)]
Fraction = Annotated[Number, Field(gt=0, lt=1)]
StepSize = Annotated[Number, check(lambda h: h != 0)]
Limit = Annotated[float, check(lambda x: not math.isnan(x))]
Scalar = Annotated[int | float, check(_is_finite)]
"""A number; whole ones stay whole."""

V = TypeVar("V")
Many = Annotated[list[V], Field(min_length=1)]
Two = Annotated[list[V], Field(min_length=2, max_length=2)]

Rows = TypeAliasType("Rows", union(number=Number, array=Many["Rows"]))
if TYPE_CHECKING:
    Array = np.ndarray
else:
    Array = Annotated[Many[Rows], AfterValidator(lambda rows: np.asarray(rows, float))]
"""Nested arrays of finite numbers, all rows of one length, as an array of NumPy."""

NumberOrArray = union(number=Number, array=Array)
