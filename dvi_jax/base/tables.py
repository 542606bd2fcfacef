"""Dictionaries with names as keys, whose errors help."""

import difflib
from collections.abc import Iterable
from typing import Any

import jax


class UnknownName(KeyError):
    """A `KeyError` whose message is a sentence, without quotes around it."""

    def __str__(self) -> str:
        return str(self.args[0])


class Table(dict[str, Any]):
    """A dict that **raises** an `UnknownName` with the nearest name and all names for a key that it
    does not have; a pytree as a dict is, so that ``observe=problem.observables`` works."""

    def __missing__(self, name: Any) -> Any:
        raise unknown_name(name, self)


def _flatten(table: Table) -> tuple[tuple[Any, ...], tuple[str, ...]]:
    names = tuple(sorted(table))
    return tuple((jax.tree_util.DictKey(name), table[name]) for name in names), names


jax.tree_util.register_pytree_with_keys(
    Table, _flatten, lambda names, values: Table(zip(names, values, strict=True))
)


def unknown_name(name: Any, names: Iterable[Any]) -> UnknownName:
    """The error for a name that is not among `names`."""
    spellings = {str(choice).lower(): choice for choice in names}
    close = difflib.get_close_matches(str(name).lower(), spellings, 1)
    hint = f" Did you mean {spellings[close[0]]!r}?" if close else ""
    allowed = ", ".join(map(str, spellings.values())) or "none"
    return UnknownName(f"there is no {name!r}.{hint} Allowed: {allowed}.")
