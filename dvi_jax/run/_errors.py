"""What is said about input that cannot be meant."""

import difflib
import reprlib
from collections.abc import Iterable
from typing import Any

_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = 60


class InputError(ValueError):
    """Bad input of a run: the key, what was seen, what is allowed."""

    def __init__(self, key: str, seen: str, allowed: str):
        super().__init__(f"{key}: {seen}\n  allowed: {allowed}")
        self.key, self.seen, self.allowed = key, seen, allowed


def reason(error: BaseException) -> str:
    """Why a path is none, without the path."""
    return getattr(error, "strerror", None) or str(error)


def shown(value: Any) -> str:
    """A value as TOML would name it: itself, shortened, and its kind."""
    kinds = ((bool, "a boolean"), (int, "a whole number"), (float, "a number"), (str, "text"))
    kinds += ((list, "an array"), (dict, "a table"))
    kind = next((name for t, name in kinds if isinstance(value, t)), type(value).__name__)
    text = {True: "true", False: "false"}[value] if isinstance(value, bool) else _SHORT.repr(value)
    return f"{text} ({kind})"


def one_of(names: Iterable[str], seen: str = "") -> str:
    """A list of names, with the nearest to what was seen in front."""
    names = list(names)
    lowered = {n.lower(): n for n in names}
    near = difflib.get_close_matches(seen.lower(), lowered, n=1)
    hint = f" (did you mean {lowered[near[0]]}?)" if near else ""
    return (", ".join(names) or "none") + hint
