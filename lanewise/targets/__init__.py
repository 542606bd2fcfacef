"""The ways of compiling: for each platform of JAX, in the order in which they are tried.

XLA is no target: it compiles what all targets refuse.
"""

from collections.abc import Sequence
from typing import Any

from .elements import Elements
from .numbers import Numbers
from .target import Code as Code, CompiledProgram as CompiledProgram, Target as Target, compiled_by

TARGETS: dict[str, tuple[Target, ...]] = {"cpu": (Elements(), Numbers())}


def compile_program(
    program: Any, lane_flags: Sequence[bool], lanes: int | None, platform: str
) -> CompiledProgram:
    """A program as code for a platform. **Raises** `NotCompilable` with the reason."""
    return compiled_by(TARGETS[platform], program, lane_flags, lanes)
