"""The ways of compiling: for each platform of JAX, in the order in which they are tried.

XLA is no target: it compiles what all targets refuse. The code for NVIDIA GPUs has not run on one
yet, and is used only if the environment variable ``LANEWISE_CUDA`` is ``on`` when this package is
imported.
"""

from collections.abc import Sequence
from typing import Any

from ..native.switches import is_on
from .elements import Elements
from .numbers import Numbers
from .target import Code as Code, CompiledProgram as CompiledProgram, Target as Target, compiled_by

CUDA_SWITCH = "LANEWISE_CUDA"

TARGETS: dict[str, tuple[Target, ...]] = {"cpu": (Elements(), Numbers())}


def targets_for(platform: str) -> tuple[Target, ...]:
    """The targets of a platform, also if they are switched off."""
    if platform == "cuda" and platform not in TARGETS:
        from .threads import Threads  # not before it is needed: nearly nobody has a GPU

        return (Threads(),)
    return TARGETS[platform]


if is_on(CUDA_SWITCH, default=False):
    TARGETS["cuda"] = targets_for("cuda")


def compile_program(
    program: Any, lane_flags: Sequence[bool], lanes: int | None, platform: str
) -> CompiledProgram:
    """A program as code for a platform. **Raises** `NotCompilable` with the reason."""
    return compiled_by(targets_for(platform), program, lane_flags, lanes)
