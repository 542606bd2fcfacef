"""What the CPU compiler of XLA is to be told for loops over lanes."""

import os

from lanewise.jaxapi import backends_are_initialized

_FLAGS = {
    "--xla_cpu_prefer_vector_width": "512",
    "--xla_backend_extra_options": "xla_cpu_small_while_loop_byte_threshold=1000000000",
}


def configure_cpu() -> None:
    """Have this process compile loops for speed: call it before the first computation with JAX.

    It adds to the environment variable XLA_FLAGS, which JAX reads once, when it starts:

    - ``--xla_cpu_prefer_vector_width=512``: vectors as wide as the processor has;
    - ``--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1000000000``: a loop of
      any size is compiled as one piece, its state in registers, rather than operation by operation.

    They hold for everything that the process compiles. Most programs gain some ten per cent or
    nothing, since loops of arithmetic alone are one function already: see `docs/speed.md`. Numbers
    may differ in the last digit. What XLA_FLAGS sets already is left as it is.

    **Raises** `RuntimeError` when JAX has started already: the flags would not be read any more.
    """
    if backends_are_initialized():
        raise RuntimeError(
            "configure_cpu() comes too late: JAX has started, and reads XLA_FLAGS only then. Call "
            "it before the first array is made (right after the imports), or set the variable "
            f'before Python starts: XLA_FLAGS="{_with_flags("")}".'
        )
    os.environ["XLA_FLAGS"] = _with_flags(os.environ.get("XLA_FLAGS", ""))


def _with_flags(flags: str) -> str:
    parts = flags.split()
    named = {part.partition("=")[0] for part in parts}
    return " ".join([*parts, *(f"{k}={v}" for k, v in _FLAGS.items() if k not in named)])
