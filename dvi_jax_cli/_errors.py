"""Errors of the input: the key, what was seen, what is allowed."""

import difflib
import reprlib
from collections.abc import Iterable, Sequence
from typing import Any

_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = 60
_MOST = 8
"""Errors of one file that are shown."""


class InputError(ValueError):
    """Bad input: the key (or the option), what was seen, what is allowed.

    `found`: this error, and after it all others of the same file.
    """

    def __init__(self, key: str, seen: str, allowed: str, more: Sequence["InputError"] = ()):
        super().__init__(f"{key}: {seen}\n  allowed: {allowed}")
        self.key, self.seen, self.allowed = key, seen, allowed
        self.found = [self, *more]

    def __str__(self) -> str:
        texts = [str(error.args[0]) for error in self.found[:_MOST]]
        if len(self.found) > _MOST:
            texts.append(f"… and {len(self.found) - _MOST} more")
        return "\n".join(texts)


def require(fits: Any, key: str, seen: str, allowed: str) -> None:
    """**Raises** `InputError` unless something `fits`."""
    if not fits:
        raise InputError(key, seen, allowed)


def known(key: str, name: str, names: Iterable[str], allowed: str = "{}", seen: str = "") -> None:
    """**Raises** `InputError` unless a name is among `names`, which `allowed` shows for {}."""
    names = list(names)
    require(name in names, key, seen or shown(name), allowed.format(one_of(names, name)))


def reason(error: BaseException) -> str:
    """The operating system's message without the path."""
    return getattr(error, "strerror", None) or str(error)


def toml_type(value: Any) -> str:
    """The type of a value in the words of TOML."""
    types = {bool: "boolean", int: "whole number", float: "number", str: "text"}
    types |= {list: "array", dict: "table"}
    return types.get(type(value), type(value).__name__)


def shown(value: Any) -> str:
    """As "the value is 3 (a whole number)": a value, shortened, and its type."""
    text = str(value).lower() if isinstance(value, bool) else _SHORT.repr(value)
    kind = toml_type(value)
    article = {"array": "an ", "text": ""}.get(kind, "a ")
    return f"the value is {text} ({article}{kind})"


def nearest(seen: str, names: Iterable[str]) -> str:
    """The name that a mistyped one may have been, as " (did you mean …?)", or nothing."""
    lowered = {name.lower(): name for name in names}
    near = difflib.get_close_matches(seen.lower(), lowered, n=1)
    return f" (did you mean {lowered[near[0]]}?)" if near else ""


def one_of(names: Iterable[str], seen: str = "") -> str:
    """A list of names, and the nearest of them to what was seen."""
    names = list(names)
    return (", ".join(names) or "none") + nearest(seen, names)
