"""Errors of the input: the key, what was seen, what is allowed."""

import difflib
import os
import re
import reprlib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = 60
_MAX_ERRORS = 8
"""Errors of one file that are shown."""


class InputError(ValueError):
    """Bad input: the key (or the option), what was seen, what is allowed.

    `errors`: this error, and after it all others of the same file.
    """

    def __init__(self, key: str, defect: str, rule: str, successors: Sequence["InputError"] = ()):
        super().__init__(f"{key}: {defect}\n  allowed: {rule}")
        self.key, self.seen, self.allowed = key, defect, rule
        self.errors = [self, *successors]

    def __str__(self) -> str:
        texts = [str(error.args[0]) for error in self.errors[:_MAX_ERRORS]]
        if len(self.errors) > _MAX_ERRORS:
            texts.append(f"… and {len(self.errors) - _MAX_ERRORS} more")
        return "\n".join(texts)


_TEXTS = ("method", "basis")
"""Keys whose values are the text of a call."""


def _argument(match: re.Match[str]) -> str:
    """An argument of Python with an object as value."""
    key, value = match.groups()
    return f'{key} = "{value}"' if key in _TEXTS else f"{key} = dvi\u200b.{value} in Python"


_IN_TOML: tuple[tuple[str, Any], ...] = (
    (r"dvi\.\w+\(\.\.\., (\w+)=\.\.\.\)", r"the key \1"),
    (r"\bobserve=\{\.\.\.\}", "a table [observables]"),
    (r"\bsave=dvi\.Save\(final=True\)", 'save = "final"'),
    (r"\bsave=dvi\.Save\(every=m\)", "every = m in [output] or save"),
    (r"\blattice=dvi\.Given\((\w*)\)", r"lattice = {times = […]}"),
    (r"\bsamples=\(qs, ps, ts\) with different times in ts", "times = [first, last] in [samples]"),
    (r"\btime=\((\w+), (\w+)\)", r"times = [\1, \2] in [domain]"),
    (r"\bstore=(\.\.\.|PATH)", "a store (--store)"),
    (r"\b(\w+)=dvi\.(\w+\((?:[^()]|\([^()]*\))*\))", _argument),
    (r"\bdvi\.(\w+\([^()]*\))", r'"\1"'),
    (r"\bdvi\.(\w)", r"\1"),
    ("\u200b", ""),
    (r"\b(\w+)=\.\.\.", r"\1 = …"),
    (r"\b([a-z]\w*)=(?=[\d.\[{\"'-])", r"\1 = "),
    (r"\bnum_steps\b", "steps"),
    (r"\bobserve\b ?=", "observables ="),
)
"""Pattern in a message of dvi_jax → the same in a TOML file, or "in Python" where it has no key."""


def in_toml(message: Any) -> str:
    """A message of dvi_jax, which names arguments of Python, with the keys of a TOML file."""
    text = str(message)
    for pattern, replacement in _IN_TOML:
        text = re.sub(pattern, replacement, text)
    return text


def require(fits: Any, key: str, defect: str, rule: str) -> None:
    """**Raises** `InputError` unless something `fits`."""
    if not fits:
        raise InputError(key, defect, rule)


@contextmanager
def as_input_error(
    key: str, rule: str, *kinds: type[BaseException], prefix: str = "", text: Any = in_toml
) -> Iterator[None]:
    """Within this an exception of these kinds, by default `ValueError` and `TypeError`, is an
    `InputError` with the prefix and what `text` makes of it."""
    kinds = kinds or (ValueError, TypeError)
    try:
        yield
    except InputError:
        raise
    except kinds as error:
        raise InputError(key, prefix + text(error), rule) from error


def require_name(
    key: str, name: str, names: Iterable[str], rule: str = "{}", defect: str = ""
) -> None:
    """**Raises** `InputError` unless a name is among `names`, which `rule` shows for {}."""
    names = list(names)
    require(name in names, key, defect or describe(name), rule.format(one_of(names, name)))


def user_path(key: str, path: str | Path) -> Path:
    """A path that a user gives, with ``~`` as the home directory. **Raises** `InputError`."""
    rule = "a path; ~ is the home directory, and ./~name a file whose name begins with ~"
    with as_input_error(key, rule, RuntimeError, ValueError, prefix=f"{path!s:.200}: "):
        expanded = Path(path).expanduser()
        with suppress(OSError):
            os.stat(expanded)  # raises ValueError for a name with a NUL
        return expanded


def require_file(key: str, path: Path, rule: str) -> Path:
    """The absolute path of a file. **Raises** `InputError` if it does not exist."""
    # For a name that no file can have.
    with as_input_error(key, rule, OSError, ValueError, prefix=f"{path}: ", text=reason):
        path = user_path(key, path).resolve()
        require(path.is_file(), key, f"there is no file {path}", rule)
    return path


def reason(error: BaseException) -> str:
    """The operating system's message without the path."""
    return getattr(error, "strerror", None) or str(error)


def toml_type(value: Any) -> str:
    """The type of a value in the words of TOML."""
    types = {bool: "boolean", int: "whole number", float: "number", str: "text"}
    types |= {list: "array", dict: "table"}
    return types.get(type(value), type(value).__name__)


def describe(value: Any) -> str:
    """As "the value is 3 (a whole number)": a value, shortened, and its type."""
    text = str(value).lower() if isinstance(value, bool) else _SHORT.repr(value)
    kind = toml_type(value)
    article = {"array": "an ", "text": ""}.get(kind, "a ")
    return f"the value is {text} ({article}{kind})"


def nearest(word: str, names: Iterable[str]) -> str:
    """The name that a mistyped one may have been, as " (did you mean …?)", or nothing."""
    originals = {name.lower(): name for name in names}
    matches = difflib.get_close_matches(word.lower(), originals, n=1)
    return f" (did you mean {originals[matches[0]]}?)" if matches else ""


def one_of(names: Iterable[str], word: str = "") -> str:
    """A list of names, and the nearest of them to what was seen."""
    names = list(names)
    return (", ".join(names) or "none") + nearest(word, names)
