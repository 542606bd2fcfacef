"""Environment variables that switch a part of the compiler on or off."""

import functools
import os
import warnings

_WORDS = {**dict.fromkeys(("on", "1", "yes", "true"), True),
          **dict.fromkeys(("off", "0", "no", "false"), False)}  # fmt: skip


def is_on(variable: str, default: bool) -> bool:
    """Whether a variable is ``on``; `default` without a value, or with a wrong one, which warns."""
    setting = os.environ.get(variable, "").strip()
    word = setting.lower()
    if setting and word not in _WORDS:
        _warn_once(variable, setting, "on" if default else "off")
    return _WORDS.get(word, default)


def is_off(setting: str) -> bool:
    """Whether a value of a variable is one of the words for ``off``."""
    return not _WORDS.get(setting.lower(), True)


@functools.cache
def _warn_once(variable: str, setting: str, default: str) -> None:
    warnings.warn(
        f"{variable}={setting!r} is neither on nor off: it has no effect, as {variable}={default}.",
        stacklevel=4,
    )
