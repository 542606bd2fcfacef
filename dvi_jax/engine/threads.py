"""The processors of this process, and the older name for a batch on all of them."""

import os
from collections.abc import Callable, Sequence
from typing import Any


def over_threads(
    function: Callable[..., Any],
    threads: int | None = None,
    in_axes: int | Sequence[int | None] | None = 0,
    out_axes: int = 0,
) -> Callable[..., Any]:
    """`function` itself: a batch of trajectories uses all cores without it.

    It cut a batch into pieces, one for each thread, when a compiled loop over steps ran on one
    core. Now ``jax.jit(jax.vmap(one))`` divides a batch among the threads that XLA has for the
    processors of the process. The function stays for programs that call it.

    **Arguments**

    - `function`: a function of arrays, for example ``jax.jit(jax.vmap(one))``.
    - `threads`, `in_axes`, `out_axes`: have no effect any more; `lanewise.set_threads` limits the
      number of threads.

    **Returns** a function that calls `function` with the same arguments.

    **Raises** `TypeError` if `function` cannot be called or `threads` is not an integer or None,
    `ValueError` if `threads` is not positive.

    **Example**

    ```python
    kepler = systems.kepler()
    def final(epsilon):
        return dvi.integrate(kepler.system, kepler.q0, kepler.p0, args=kepler.args, h=0.1,
                             num_steps=1000, epsilon=epsilon, save=dvi.Save(final=True)).qs[-1]
    print(dvi.over_threads(jax.jit(jax.vmap(final)))(jnp.linspace(0.0, 0.01, 64)).shape)
    # (64, 2)
    ```
    """
    if not callable(function):
        raise TypeError(
            f"over_threads takes a function, e.g. jax.jit(jax.vmap(one)), got {function!r}."
        )
    if threads is not None:
        if isinstance(threads, bool) or not isinstance(threads, int):
            raise TypeError(f"threads must be a positive integer or None, got {threads!r}.")
        if threads < 1:
            raise ValueError(f"threads must be at least 1, got {threads}.")

    def call(*args: Any) -> Any:
        return function(*args)

    return call


def processors() -> int:
    """How many processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
