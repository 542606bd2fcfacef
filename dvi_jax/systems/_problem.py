"""What the library knows of a system besides its equations."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

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
