"""Flags of XLA's CPU compiler for loops over trajectories."""

import os

from lanewise.jaxprs.jaxapi import backends_are_initialized

_FLAGS = {
    "--xla_cpu_prefer_vector_width": "512",
    "--xla_backend_extra_options": "xla_cpu_small_while_loop_byte_threshold=1000000000",
}


def configure_cpu() -> None:
    """Set flags by which this process compiles loops for speed; before the first use of JAX.

    It adds to the environment variable XLA_FLAGS, which JAX reads once, when it starts:

    - ``--xla_cpu_prefer_vector_width=512``: the widest vectors of the processor;
    - ``--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1000000000``: a loop of
      any size is compiled as one piece, its state in registers, rather than operation by operation.

    The flags affect everything that the process compiles. Most programs gain ten per cent or
    nothing, since loops of arithmetic are one function already: see `docs/speed.md`. Numbers may
    differ in the last digit. Flags that XLA_FLAGS already has are not changed.

    **Raises** `RuntimeError` when JAX has started already, and would not read the flags.
    """
    if backends_are_initialized():
        raise RuntimeError(
            "configure_cpu() must be called before JAX makes its first array, but JAX has started "
            "already. Restart Python, and call configure_cpu() right after the imports. Or set "
            f'XLA_FLAGS="{_with_flags(os.environ.get("XLA_FLAGS", ""))}" before Python starts.'
        )
    os.environ["XLA_FLAGS"] = _with_flags(os.environ.get("XLA_FLAGS", ""))


def _with_flags(flags: str) -> str:
    parts = flags.split()
    named = {part.partition("=")[0] for part in parts}
    return " ".join([*parts, *(f"{k}={v}" for k, v in _FLAGS.items() if k not in named)])
