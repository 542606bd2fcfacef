"""χ² of 40 transit times and its gradient: this package and jnkepler, on one thread.

    python benchmarks/transit_times.py

The data and the model are those of `examples/transit_times.py`. jnkepler (`pip install jnkepler`)
is measured where it is installed; it takes steps of 0.5 days with its "fast" transit times, this
package steps of 1 day with the scheme (8, 2). Both have the same parameters: masses, periods, times
of transit, e cos ω and e sin ω of two planets. The errors are those of the computed times without
noise; their reference is `KahanLi(8)` with steps of 0.05 days.
"""

import importlib.util
import os
import sys
import time
from pathlib import Path

# jnkepler advises this flag for its loops on CPUs; it must be set before JAX is imported.
os.environ.setdefault(
    "XLA_FLAGS", "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=65536"
)
sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))

import jax
import jax.numpy as jnp
import numpy as np
import transit_times as example

import dvi_jax as dvi
import lanewise


class _NoNoise:
    def normal(self, size):
        return np.zeros(size)


def least(run, *args, repeats=7):
    """First call [s of wall clock] and the least processor time of further calls [ms]."""
    began = time.perf_counter()
    jax.block_until_ready(run(*args))
    first, found = time.perf_counter() - began, []
    for _ in range(repeats):
        start = time.process_time()
        jax.block_until_ready(run(*args))
        found.append(time.process_time() - start)
    return first, 1e3 * min(found)


def report(name, value, x, error):
    """One row: time of the value and of its gradient, and the error of the times."""
    (_, of_value), (first, of_gradient) = (least(jax.jit(f), x) for f in (value, jax.grad(value)))
    print(f"{name:10} {of_value:10.3f} {of_gradient:10.3f} {first:12.1f} {error:14.2g}", flush=True)


def ours(times, exact):
    posterior = dvi.Posterior(example.model, example.observations(times), example.TRUTH)
    truth = np.concatenate([example.TRUTH[key] for key in sorted(example.TRUTH)])
    data = example.observations(exact)
    spec = example.model(example.TRUTH)
    late = dvi.integrate(
        **{k: v for k, v in spec.items() if k != "h"}, h=spec["h"], save=dvi.Save(ts=data.ts),
        num_steps=int(data.ts[-1] / spec["h"]) + 2,
    )  # fmt: skip
    delays = jax.vmap(lambda t, q, p: example.delay(t, q, p, spec["args"]))(
        data.ts, late.qs, late.ps
    )
    error = 86400 * np.abs(np.asarray(delays))[~np.isnan(data.values)].max()
    report("dvi_jax", posterior.potential, jnp.asarray(posterior.to_u(truth)), error)


def theirs(times, exact):
    from jnkepler.jaxttv import JaxTTV

    truth, end = example.TRUTH, max(t[-1] for t in times) + 1
    errors = [np.full(t.size, example.SIGMA) for t in times]
    made = JaxTTV(0.0, end, 0.5, times, truth["period"], errorobs=errors, print_info=False)
    fixed = {"cosi": jnp.zeros(2), "lnode": jnp.zeros(2), "smass": 1.0}
    names = {"period": "period", "ecosw": "ecos", "esinw": "esin", "tic": "transit"}
    x = {name: jnp.asarray(truth[key]) for name, key in names.items()}
    x["pmass"] = jnp.asarray(truth["mass"])
    observed = jnp.concatenate([jnp.asarray(t) for t in times])

    def value(x):
        computed, _ = made.get_transit_times_obs({**fixed, **x})
        return jnp.sum(((computed - observed) / example.SIGMA) ** 2) / 2

    computed, _ = made.get_transit_times_obs({**fixed, **x})
    error = 86400 * np.abs(np.asarray(computed) - np.concatenate(exact)).max()
    report("jnkepler", value, x, error)


def main():
    lanewise.set_threads(1)
    times = example.simulated(np.random.default_rng(1))
    exact = example.simulated(_NoNoise())
    print(f"{'':10} {'χ² [ms]':>10} {'grad [ms]':>10} {'1st call [s]':>12} {'error [s]':>14}")
    ours(times, exact)
    if importlib.util.find_spec("jnkepler") is None:
        print("jnkepler is not installed: pip install jnkepler")
    else:
        theirs(times, exact)


if __name__ == "__main__":
    main()
