"""Checks that several parts of a fit make: each raises an error that names what is allowed."""

import importlib
from collections.abc import Sequence
from typing import Any

import numpy as np


def require_shape(name: str, value: Any, *shapes: tuple[int, ...], hint: str = "") -> None:
    """**Raises** `ValueError` unless an array has one of the shapes."""
    if (shape := np.shape(value)) not in shapes:
        text = " or ".join(map(str, shapes))
        raise ValueError(f"{name} must have shape {text}, got shape {shape}.{_sentence(hint)}")


def require_all(name: str, values: np.ndarray, fits: np.ndarray, rule: str, hint: str = "") -> None:
    """**Raises** `ValueError` with the first of the values for which `fits` is false."""
    if not fits.all():
        index = np.argwhere(~fits)[0].tolist()
        place = f" at index {index}" if index else ""
        value = values[tuple(index)]
        raise ValueError(f"{name} must be {rule}, got {value}{place}.{_sentence(hint)}")


def requires(fits: Any, subject: str, condition: str, value: str, hint: str = "") -> None:
    """**Raises** `ValueError` for arguments that do not fit together."""
    if not fits:
        raise ValueError(f"{subject} requires {condition}, got {value}.{_sentence(hint)}")


def enough_values(count: int, minimum: int, purpose: str) -> None:
    """**Raises** `ValueError` for fewer observed values than a fit needs."""
    if count < minimum:
        rule = f"{minimum} observed values, one for each of {purpose}"
        raise ValueError(f"data must have at least {rule}, got {count}.")


def same_parameters(name: str, names: Sequence[str], reference: Sequence[str], owner: str) -> None:
    """**Raises** `ValueError` unless a pytree has the parameters of another one."""
    if list(names) != list(reference):
        lacking, surplus = (
            ", ".join([x for x in a if x not in b][:8]) or "none"
            for a, b in ((reference, names), (names, reference))
        )
        raise ValueError(
            f"{name} must have the same parameters as {owner}. Missing: {lacking}. Unknown: "
            f"{surplus}."
        )


def same_fit(fits: bool, differences: str) -> None:
    """**Raises** `ValueError` unless a checkpoint belongs to this fit."""
    if not fits:
        raise ValueError(
            f"the checkpoint is of another fit: {differences} differ. Repeat its call unchanged, "
            "or give another path in checkpoint."
        )


def package(name: str, user: str, install: str) -> Any:
    """An optional package. **Raises** `ImportError` that names what to install."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ImportError(
            f"{user} requires {name}, but its import failed ({error}): pip install {install}"
        ) from None


def _sentence(hint: str) -> str:
    return f" {hint}" if hint else ""
