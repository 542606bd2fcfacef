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
    """Bad input: the key (or the option), what was seen, what is allowed."""

    def __init__(self, key: str, seen: str, allowed: str):
        super().__init__(f"{key}: {seen}\n  allowed: {allowed}")
        self.key, self.seen, self.allowed = key, seen, allowed


class InputErrors(InputError):
    """All errors of a file; `key`, `seen` and `allowed` are those of the first."""

    def __init__(self, found: Sequence[InputError]):
        super().__init__(found[0].key, found[0].seen, found[0].allowed)
        self.found = found

    def __str__(self) -> str:
        more = [f"… and {len(self.found) - _MOST} more"] if len(self.found) > _MOST else []
        return "\n".join([*map(str, self.found[:_MOST]), *more])


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


def shown(value: Any) -> str:
    """A value, shortened, and its type in the words of TOML."""
    kinds = ((bool, "a boolean"), (int, "a whole number"), (float, "a number"), (str, "text"))
    kinds += ((list, "an array"), (dict, "a table"))
    kind = next((name for t, name in kinds if isinstance(value, t)), type(value).__name__)
    text = str(value).lower() if isinstance(value, bool) else _SHORT.repr(value)
    return f"{text} ({kind})"


def nearest(seen: str, names: Iterable[str]) -> str:
    """The name that a mistyped one may have been, as " (did you mean …?)", or nothing."""
    lowered = {name.lower(): name for name in names}
    near = difflib.get_close_matches(seen.lower(), lowered, n=1)
    return f" (did you mean {lowered[near[0]]}?)" if near else ""


def one_of(names: Iterable[str], seen: str = "") -> str:
    """A list of names, and the nearest of them to what was seen."""
    names = list(names)
    return (", ".join(names) or "none") + nearest(seen, names)
