"""Elementary functions of generated machine code against those of XLA, in a vectorised loop.

    python benchmarks/elementary.py [--errors N]

Each function is the middle of a loop over 512 trajectories in float64, x ← 0.3 + f(x)/20, once
through `lanewise.batched` and once through XLA under `jax.vmap`; the same loop without f is
subtracted on each side. "pendulum" is sin d, cos d, sin x and sin x/3 with a quotient, as in the
forces of a double pendulum. One thread for both sides: XLA would divide a loop body among threads
from some 10⁵ operations on, which at 512 trajectories costs several times what it saves.

Errors are in units in the last place (ulp) against NumPy's longdouble, where that is longer than
double; `--errors N` sets the number of points for each function.
"""

import argparse
import statistics
import time

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

import lanewise

jax.config.update("jax_enable_x64", True)

LANES, STEPS, ROUNDS = 512, 2_000, 15
OPTIONS = {
    "xla_cpu_prefer_vector_width": 512,
    "xla_disable_hlo_passes": "cpu-parallel-task-assigner",
}


def pendulum(x):
    """Four sines and cosines of three angles, and a quotient."""
    d = 1.7 * x
    return (lax.sin(d) * lax.cos(d) + lax.sin(x)) / (1 + lax.sin(d) ** 2) + lax.sin(x / 3)


def power(y):
    """x → x^y."""
    return lambda x: lax.pow(x, jnp.full_like(x, y))


FUNCTIONS = {
    "sin": lax.sin,
    "cos": lax.cos,
    "tan": lax.tan,
    "pendulum": pendulum,
    "atan": lax.atan,
    "atan2": lambda x: lax.atan2(x, x - 0.32),
    "asin": lax.asin,
    "acos": lax.acos,
    "log": lax.log,
    "log1p": lax.log1p,
    "exp": lax.exp,
    "exp2": lax.exp2,
    "expm1": lax.expm1,
    "sinh": lax.sinh,
    "cosh": lax.cosh,
    "tanh": lax.tanh,
    "asinh": lax.asinh,
    "acosh": lambda x: lax.acosh(1 + x),
    "atanh": lax.atanh,
    "erf": lax.erf,
    "erfc": lax.erfc,
    "sqrt": lax.sqrt,
    "1/sqrt": lambda x: 1 / lax.sqrt(x),
    "cbrt": lax.cbrt,
    "x^(3/2)": power(1.5),
    "x^(-3/2)": power(-1.5),
    "x^1.3": power(1.3),
}


def loop(function, through):
    """A compiled loop over the trajectories, to be called without arguments."""

    def one(x):
        return lax.fori_loop(0, STEPS, lambda _, y: 0.3 + 0.05 * function(y), x)

    run = jax.jit(through(one), compiler_options=OPTIONS)
    start = jnp.asarray(np.random.default_rng(0).uniform(0.3, 0.9, LANES))
    run(start).block_until_ready()
    return lambda: run(start).block_until_ready()


def nanoseconds(runs):
    """Time of an element [ns]: of each run, in each round; shape (R, len(runs))."""
    order, times = np.random.default_rng(1), np.empty((ROUNDS, len(runs)))
    for row in times:
        for i in order.permutation(len(runs)):
            begin = time.perf_counter()
            runs[i]()
            row[i] = (time.perf_counter() - begin) / (STEPS * LANES) * 1e9
    return times


def print_times():
    """Time of each function on both sides, and the ratio."""
    functions = (lambda x: x, *FUNCTIONS.values())
    sides = []
    for through in (jax.vmap, lanewise.batched):
        times = nanoseconds([loop(f, through) for f in functions])
        sides.append(times[:, 1:] - times[:, :1])
    print(f"{'':16s} XLA [ns]  lanewise [ns]  ratio")
    for i, name in enumerate(FUNCTIONS):
        xla, own = (statistics.median(side[:, i]) for side in sides)
        print(f"{name:16s} {xla:8.2f} {own:14.2f} {xla / own:6.1f}")


def points(name, n):
    """Arguments over the range, both signs where they are allowed."""
    rng = np.random.default_rng(2)
    signs = rng.choice([-1.0, 1.0], n)
    if name in ("sin", "cos", "tan"):
        parts = rng.uniform(0, 10, n), rng.uniform(0, 1e8, n), 10 ** rng.uniform(-300, 8.1, n)
        return (signs * np.choose(rng.integers(0, 3, n), parts),)
    if name in ("asin", "acos"):
        return (
            signs * np.where(rng.random(n) < 0.3, 10 ** rng.uniform(-300, 0, n), rng.random(n)),
        )
    sizes = np.where(rng.random(n) < 0.2, 10 ** rng.uniform(-300, 300, n), rng.uniform(0, 5, n))
    if name == "atan2":
        return signs * rng.permutation(sizes), rng.permutation(signs) * sizes
    return (sizes if name == "log" else signs * sizes,)


def print_errors(n):
    """The largest errors [ulp] on both sides."""
    if np.finfo(np.longdouble).nmant <= np.finfo(np.float64).nmant:
        print("errors: not measured, longdouble is double on this machine")
        return
    references = {"atan": "arctan", "atan2": "arctan2", "asin": "arcsin", "acos": "arccos"}
    print(f"{'':16s} XLA [ulp]  lanewise [ulp]  at {n} points")
    for name in ("sin", "cos", "tan", "atan", "atan2", "asin", "acos", "log"):
        xs = points(name, n)
        exact = getattr(np, references.get(name, name))(*(x.astype(np.longdouble) for x in xs))
        with np.errstate(under="ignore"):
            rounded = np.abs(exact).astype(np.float64)
        normal = rounded > np.finfo(float).tiny  # XLA takes smaller numbers for 0
        function, worst = getattr(lax, name), []
        for side in (function, lanewise.batched(function)):
            error = np.abs(np.asarray(jax.jit(side)(*xs)) - exact)[normal]
            worst.append(float(np.max(error / np.spacing(rounded[normal]))))
        print(f"{name:16s} {worst[0]:9.3f} {worst[1]:15.3f}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--errors", type=int, default=1_000_000, help="points for each function")
    arguments = parser.parse_args()
    lanewise.set_threads(1)
    print_times()
    print_errors(arguments.errors)
