"""How the tests compile: flags of XLA, set before JAX starts."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version

HAS_BOTH_EMITTERS = tuple(int(part) for part in version("jaxlib").split(".")[:2]) < (0, 11)
"""Whether XLA still has the older emitters: a flag that it does not know ends the process."""

FLAGS = "--xla_cpu_parallel_codegen_split_count=1 --xla_backend_optimization_level=1"
if HAS_BOTH_EMITTERS:
    FLAGS = "--xla_cpu_use_fusion_emitters=false " + FLAGS
"""The emitters that XLA:CPU uses by default take twice as long to compile the same program, and
more than half of the processor time of the tests is compilation. A lower level of optimisation
takes a sixth of it away. A second thread of compilation saves no time when a second worker runs.
Numbers may differ in the last digit. The machine code of `lanewise` is not affected."""


def set_flags() -> None:
    """Add the flags to XLA_FLAGS, which JAX and the processes that tests start read."""
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {FLAGS}".strip()


def flags_of_users() -> str:
    """XLA_FLAGS without those of the tests: notebooks, the README and the pages of the
    documentation compile as they do for users."""
    return os.environ["XLA_FLAGS"].replace(FLAGS, "").strip()


AS_FOR_USERS = {"xla_cpu_use_fusion_emitters": True} if HAS_BOTH_EMITTERS else {}
"""`compiler_options` of a `jit` whose results are compared bit by bit with those of another one."""


_OPEN: list[list[str]] = []
"""The lists of `programs_of_xla`, after one that is never read."""


def _listen(event: str, seconds: float, **_) -> None:
    if event.endswith("backend_compile_duration"):
        for programs in _OPEN[1:]:
            programs.append(event)


@contextmanager
def programs_of_xla() -> Iterator[list[str]]:
    """A list that gets an entry for each program that XLA compiles inside."""
    import jax  # after the flags

    if not _OPEN:
        jax.monitoring.register_event_duration_secs_listener(_listen)
        _OPEN.append([])
    _OPEN.append([])
    yield _OPEN[-1]
    _OPEN.pop()
