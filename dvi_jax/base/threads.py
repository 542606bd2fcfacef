"""The processors of this process, and an older function for a batch on all of them."""

import os
from collections.abc import Callable, Sequence
from typing import Any

from .checks import function as check_function, instance, whole


def over_threads(
    function: Callable[..., Any],
    threads: int | None = None,
    in_axes: int | Sequence[int | None] | None = 0,
    out_axes: int = 0,
) -> Callable[..., Any]:
    """`function` unchanged: a batch of trajectories uses all cores without this function.

    ``jax.jit(jax.vmap(one))`` divides a batch among the threads that XLA has for the processors of
    the process; `lanewise.set_threads` limits their number. This function remains for programs that
    call it.

    **Arguments** `function`: a function of arrays. The others have no effect.

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
    check_function(
        "the argument of over_threads", function, hint="Give jax.jit(jax.vmap(f)), for example."
    )
    if threads is not None:
        instance("threads", threads, int, "a positive integer or None")
        whole("threads", threads)

    def call(*args: Any) -> Any:
        return function(*args)

    return call


def processors() -> int:
    """The number of processors that this process may use."""
    # A container or `taskset` may allow fewer than the machine has; only Linux reports that.
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
