"""How objects print: at most eight lines; in notebooks a table, or the whole report."""

import dataclasses
import html
import textwrap
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lanewise.jaxprs.jaxapi import is_traced

T = TypeVar("T", bound=type)

_LINES, _WIDTH, _NUMBERS = 8, 100, 6
"""Lines of an object, characters of a line, numbers of an array that are shown one by one."""


def printable(kind: T) -> T:
    """Decorator of a class whose objects print as said above.

    A class with a report (its own `__str__`) shows the first lines of it, another one its fields.
    `print` shows a whole report.
    """
    has_report = kind.__str__ is not object.__str__

    def __repr__(self: Any) -> str:
        # Under jit a report, which formats numbers, would raise.
        if has_report and not _has_tracers(self):
            return first_lines(str(self))
        entries = [f"{name} = {text}" for name, text in fields_of(self)]
        if len(entries) < _LINES:
            lines = [f"  {entry}" for entry in entries]
        else:
            options: Any = {"initial_indent": "  ", "subsequent_indent": "  "}
            lines = textwrap.wrap(", ".join(entries), _WIDTH, **options)
        return first_lines("\n".join([f"{type(self).__name__}:", *lines]), "")

    def _repr_html_(self: Any) -> str:
        if has_report and not _has_tracers(self):
            return f"<pre>{html.escape(str(self))}</pre>"
        cells = ((html.escape(name), html.escape(text)) for name, text in fields_of(self))
        rows = "".join(f"<tr><th>{name}</th><td>{text}</td></tr>" for name, text in cells)
        return f"<table><caption>{html.escape(type(self).__name__)}</caption>{rows}</table>"

    # Set after the class is made: dataclasses and named tuples write a __repr__ of their own.
    methods: list[Callable[..., Any]] = [__repr__, _repr_html_]
    for method in methods:
        method.__qualname__ = f"{kind.__qualname__}.{method.__name__}"
        setattr(kind, method.__name__, method)
    return kind


def first_lines(text: str, hint: str = ": print shows them") -> str:
    """At most eight lines, none of them longer than a few lines of a terminal."""
    lines = text.splitlines()
    excess = len(lines) - _LINES
    # The last line says how many are missing, so that nobody takes the beginning for the whole.
    if excess > 0:
        lines[_LINES - 1 :] = [f"… and {excess + 1} more lines{hint}"]
    return "\n".join(line if len(line) <= 500 else f"{line[:500]} …" for line in lines)


def fields_of(thing: Any) -> list[tuple[str, str]]:
    """Name and short text of each field of a dataclass, of a named tuple or of another object."""
    if dataclasses.is_dataclass(thing):
        names = [field.name for field in dataclasses.fields(thing) if field.repr]
    else:
        names = list(getattr(thing, "_fields", ())) or [n for n in vars(thing) if n[0] != "_"]
    # An object of a library that maps pytrees may lack a field.
    return [(name, short(getattr(thing, name, None))) for name in names]


def short(value: Any) -> str:
    """One line: numbers if they are few, else type and shape; of other objects the beginning."""
    if isinstance(value, np.ndarray | jax.Array) and not is_traced(value):
        # NumPy cannot convert keys of random numbers.
        if jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
            return f"key of shape {value.shape}"
        if value.size > _NUMBERS:
            return f"{value.dtype} of shape {value.shape}"
        text = np.array2string(np.asarray(value), precision=6, separator=", ")
    elif isinstance(value, str | float):
        text = repr(value) if isinstance(value, str) else f"{value:.8g}"
    elif isinstance(value, list | tuple) and len(value) > _NUMBERS:
        text = f"{type(value).__name__} of {len(value)}"
    else:
        text = eqx.tree_pformat(value)
    text = " ".join(text.split())
    return text if len(text) <= _WIDTH else f"{text[:_WIDTH]} …"


def _has_tracers(thing: Any) -> bool:
    return any(map(is_traced, jax.tree.leaves(thing)))
