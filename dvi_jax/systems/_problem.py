"""What the library knows of a system besides its equations."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .._system import System


@dataclass(frozen=True)
class Problem:
    """A system with parameters, a start, a step size and what is worth watching.

    - `system`: the `System`; `args` its parameters.
    - `q0`, `p0`, `h`: a start and a step size that suit it.
    - `observables`: name → function of one step ``(t0, t1, q0, p0, q1, p1, args)``.
    - `units`: what q, p, t and energy are measured in.
    - `source`: where equations and values come from.
    - `check`: function ``(q0, p0, args)`` that raises `ValueError` for a start that the system
      cannot go on from; or None.
    """

    name: str
    system: System
    q0: Any
    p0: Any
    h: float
    args: Any = None
    observables: Mapping[str, Callable[..., Any]] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    source: str = ""
    check: Callable[[Any, Any, Any], None] | None = None


def check_shape(q0: Any, p0: Any, fits: Callable[[tuple[int, ...]], bool], wanted: str) -> None:
    """Refuse q0 and p0 that are not of one shape for which `fits` holds.

    **Raises** `ValueError` with `wanted`, a sentence that says which shapes there are, and the
    shapes seen.
    """
    q, p = np.shape(q0), np.shape(p0)
    if q != p or not fits(q):
        raise ValueError(f"{wanted}; got q0 of shape {q} and p0 of shape {p}.")
