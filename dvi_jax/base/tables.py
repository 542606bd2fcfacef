"""Dictionaries with names as keys, whose errors help."""

import difflib
from collections.abc import Iterable
from typing import Any


class UnknownName(KeyError):
    """A `KeyError` whose message is a sentence, without quotes around it."""

    def __str__(self) -> str:
        return str(self.args[0])


class Table(dict[str, Any]):
    """A dict that **raises** an `UnknownName` with the nearest name and all names for a key that it
    does not have. It is not a pytree of JAX: args are a plain dict."""

    def __missing__(self, name: Any) -> Any:
        raise unknown_name(name, self)


def unknown_name(name: Any, names: Iterable[Any]) -> UnknownName:
    """The error for a name that is not among `names`."""
    spellings = {str(choice).lower(): choice for choice in names}
    close = difflib.get_close_matches(str(name).lower(), spellings, 1)
    hint = f" Did you mean {spellings[close[0]]!r}?" if close else ""
    allowed = ", ".join(map(str, spellings.values())) or "none"
    return UnknownName(f"there is no {name!r}.{hint} Allowed: {allowed}.")
