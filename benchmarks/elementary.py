"""Elementary functions of `engine/elementary` against those of the library, in a vectorised loop.

Each function is the middle of a `fori_loop` over 512 lanes in float64, x ← 0.3 + f(x)/20, without
flags but for wide vectors in the compiler options; the same loop without f is taken off. "pendulum"
is sin d, cos d, sin x and sin x/3 with a quotient, as in the forces of a double pendulum. XLA
spreads a loop body over threads from some 10⁵ operations on, which at 512 lanes costs several
times what it saves: the pass that does so is turned off for both sides.

Errors are in ulp against NumPy's longdouble, where that is longer than double; `--errors N` sets
the number of points for each function.

Predictions, written down before this file was run (from trials of the functions one by one):

1. sin and cos without hand-over 6 to 9 times faster than the library, with it 4 to 7; in the
   pendulum 7 to 10 and 3 to 5: a hand-over ends a fused loop.
2. asin, acos and half-integer powers 10 to 40 times; atan2 3 to 5, log 3 to 6, tan 2 to 3,
   atan 1.5 to 2.5.
3. Errors below 0.8 ulp for sin, cos and log, 1.5 for tan, 1.2 for acos, 1.6 for asin, atan, atan2.
4. In float64 no other primitive of the library costs ten times an exp here but those, the inverse
   hyperbolic functions, cbrt and pow with other exponents.

Run: python benchmarks/elementary.py
"""

import argparse
import statistics
import time

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from dvi_jax.engine import elementary

jax.config.update("jax_enable_x64", True)

LANES, STEPS, ROUNDS = 512, 2_000, 15
OPTIONS = {
    "xla_cpu_prefer_vector_width": 512,
    "xla_disable_hlo_passes": "cpu-parallel-task-assigner",
}


def pendulum(sin, cos):
    """Four sines and cosines of three angles, and a quotient."""

    def of(x):
        d = 1.7 * x
        return (sin(d) * cos(d) + sin(x)) / (1 + sin(d) ** 2) + sin(x / 3)

    return of


def power(y):
    """The library's x^y."""
    return lambda x: lax.pow(x, jnp.full_like(x, y))


OWN = elementary
PAIRS = {
    "sin": (lax.sin, OWN.sin),
    "sin, pure": (lax.sin, OWN.sin.pure),
    "cos, pure": (lax.cos, OWN.cos.pure),
    "tan, pure": (lax.tan, OWN.tan.pure),
    "pendulum": (pendulum(lax.sin, lax.cos), pendulum(OWN.sin, OWN.cos)),
    "pendulum, pure": (pendulum(lax.sin, lax.cos), pendulum(OWN.sin.pure, OWN.cos.pure)),
    "atan": (lax.atan, OWN.atan),
    "atan2": (lambda x: lax.atan2(x, x - 0.32), lambda x: OWN.atan2(x, x - 0.32)),
    "asin": (lax.asin, OWN.asin),
    "acos": (lax.acos, OWN.acos),
    "log": (lax.log, OWN.log),
    "x^(3/2)": (power(1.5), lambda x: OWN.pow(x, 1.5)),
    "x^(-1/2)": (power(-0.5), lambda x: OWN.pow(x, -0.5)),
    "x^(-3/2)": (power(-1.5), lambda x: OWN.pow(x, -1.5)),
}
LEFT = {
    "exp": lax.exp,
    "exp2": lax.exp2,
    "expm1": lax.expm1,
    "log1p": lax.log1p,
    "sinh": lax.sinh,
    "cosh": lax.cosh,
    "tanh": lax.tanh,
    "asinh": lax.asinh,
    "acosh": lambda x: lax.acosh(1 + x),
    "atanh": lax.atanh,
    "sqrt": lax.sqrt,
    "1/sqrt": lambda x: 1 / lax.sqrt(x),
    "cbrt": lax.cbrt,
    "x^1.3": power(1.3),
}


def loop(function):
    """A compiled loop over the lanes, to be called without arguments."""

    def body(_, x):
        return 0.3 + 0.05 * function(x)

    run = jax.jit(lambda x: lax.fori_loop(0, STEPS, body, x), compiler_options=OPTIONS)
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
    """The ratios, and what is left to the library."""
    runs = [loop(f) for f in (lambda x: x, *(f for pair in PAIRS.values() for f in pair))]
    times = nanoseconds(runs)
    times = times[:, 1:] - times[:, :1]
    print(f"{'':16s} library [ns]  own [ns]  ratio")
    for i, name in enumerate(PAIRS):
        library, own = times[:, 2 * i], times[:, 2 * i + 1]
        ratio = statistics.median(library / own)
        medians = statistics.median(library), statistics.median(own)
        print(f"{name:16s} {medians[0]:12.2f} {medians[1]:9.2f} {ratio:6.1f}")
    times = nanoseconds([loop(f) for f in (lambda x: x, *LEFT.values())])
    print("left to the library [ns]:")
    for name, column in zip(LEFT, (times[:, 1:] - times[:, :1]).T, strict=True):
        print(f"{name:16s} {statistics.median(column):12.2f}")


def points(name, n):
    """Arguments over the range, both signs where they are allowed."""
    rng = np.random.default_rng(2)
    signs = rng.choice([-1.0, 1.0], n)
    if name in ("sin", "cos", "tan"):
        parts = rng.uniform(0, 10, n), rng.uniform(0, OWN.LIMIT, n), 10 ** rng.uniform(-300, 8.1, n)
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
    """The largest errors [ulp], ours and the library's."""
    if np.finfo(np.longdouble).nmant <= np.finfo(np.float64).nmant:
        print("errors: not measured, longdouble is double on this machine")
        return
    references = {"atan": "arctan", "atan2": "arctan2", "asin": "arcsin", "acos": "arccos"}
    print(f"{'':16s} own [ulp]  library [ulp]  at {n} points")
    for name in ("sin", "cos", "tan", "atan", "atan2", "asin", "acos", "log"):
        xs = points(name, n)
        exact = getattr(np, references.get(name, name))(*(x.astype(np.longdouble) for x in xs))
        with np.errstate(under="ignore"):
            rounded = np.abs(exact).astype(np.float64)
        normal = rounded > np.finfo(float).tiny  # XLA takes smaller numbers for 0
        worst = []
        for function in (getattr(OWN, name), getattr(lax, name)):
            error = np.abs(np.asarray(function(*xs)) - exact)[normal] / np.spacing(rounded[normal])
            worst.append(float(np.max(error)))
        print(f"{name:16s} {worst[0]:9.3f} {worst[1]:14.3f}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--errors", type=int, default=1_000_000, help="points for each function")
    arguments = parser.parse_args()
    print_times()
    print_errors(arguments.errors)
