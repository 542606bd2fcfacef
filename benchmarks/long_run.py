"""Round-off over ten million steps: plain, compensated and fixed-point arithmetic.

The quantities have no error of the method, only that of the arithmetic:

- cubic oscillator: the map p1 = p0 − h q0 (1 + q0²)/(1 + h² q0²/2), q1 = q0 + h p1 keeps

      E = [p² + q q' + (q q')²/2]/2,    q' = q − h p,

  exactly (McMillan 1971, Suris 1989); as h → 0 it is q̈ = −q − q³ and its energy;
- Kepler, L: every composition keeps the angular momentum exactly;
- Kepler, H: the energy by KahanLi(8), whose error at this step lies below round-off.

The error is the root mean square over an ensemble of starts, relative to the value at the start.
Step sizes are powers of two: see the last table, where h = 0.05 and 0.1 make roundings repeat, so
that they add up.

Predictions, written down before the long runs (from trials of 1e5 and 1e6 steps):

1. Exponents of N between 0.35 and 0.65: a random walk, no drift.
2. At the end the compensated error is at least 5 times below the plain one.
3. Fixed point, its quantum near round-off of the state, is within a factor 5 of plain.
4. A compensated step takes at most 3 times as long as a plain one, a step in fixed point too.
5. At h = 0.05 and 0.1 the mean error of compensated runs is above 10 standard errors; at powers of
   two it is below 4.

Run: python benchmarks/long_run.py [--steps 10000000] [--picture docs/pictures/round_off.png]
"""

import argparse
import functools
import statistics
import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import dvi_jax as dvi
from dvi_jax import plot, systems

jax.config.update("jax_enable_x64", True)

STARTS = 32
ROUNDS = 7
ABOVE_FIRST = 3
"""An exponent is fitted where the error is this many times that of the first save, which is the
error of evaluating the observable."""

ARITHMETICS = {
    "plain": lambda quantum: dvi.FloatingPoint(),
    "compensated": lambda quantum: dvi.Compensated(),
    "fixed point": dvi.FixedPoint,
}


@jax.custom_jvp
def _potential(q, h):
    s = h**2 / 2
    return q**2 / (2 * s) / 2 + (1 - 1 / s) / (2 * s) * jnp.log1p(s * q**2) / 2


@_potential.defjvp
def _(primals, tangents):
    # Derived by hand: autodiff of the above has terms that cancel and are divided by h².
    q, h = primals
    return _potential(q, h), q * (1 + q**2) / (1 + h**2 * q**2 / 2) * tangents[0]


def cubic(t0, t1, q0, p1, args):
    """H_D = p²/2 + V_h(q): the map of the cubic oscillator above; args is h."""
    return jnp.sum(p1**2) / 2 + jnp.sum(_potential(q0, args))


def cubic_energy(t0, t1, q0, p0, q1, p1, args):
    """E above, at t1."""
    before = q1 - args * p1
    return jnp.sum(p1**2 + q1 * before + (q1 * before) ** 2 / 2) / 2


class Case(NamedTuple):
    """A system, how it is stepped, starts, the observable, and how many steps at most."""

    system: Any
    method: Any
    h: float
    q: Any
    p: Any
    args: Any
    observable: Any
    quantum: float
    most: int = 10**9


def cases():
    """The three curves' cases."""
    draw = np.random.default_rng(0).uniform
    one = (STARTS, 1)
    kepler = systems.kepler()
    start = draw(0.8, 1.2, one) * np.array([1.0, 0.0]), draw(0.9, 1.1, one) * np.array([0.0, 1.0])
    h = 2.0**-5
    return {
        "Energy of a cubic oscillator, TypeII": Case(
            dvi.System(cubic),
            dvi.TypeII(),
            h,
            draw(0.5, 1, one),
            draw(-0.5, 0.5, one),
            h,
            cubic_energy,
            2.0**-52,
        ),
        "Angular momentum, Kepler, Strang": Case(
            kepler.system,
            dvi.Strang(),
            2.0**-6,
            *start,
            {"K": 1.0},
            kepler.observables["angular_momentum"],
            2.0**-51,
        ),
        "Energy, Kepler, KahanLi(8)": Case(
            kepler.system,
            dvi.KahanLi(8),
            2.0**-6,
            *start,
            {"K": 1.0},
            kepler.observables["energy"],
            2.0**-51,
            10**6,
        ),
    }


@functools.partial(jax.jit, static_argnums=(0, 1, 2, 3, 4, 5))
def _values(system, method, arithmetic, observable, num_steps, every, h, q, p, args):
    def one(q, p):
        return dvi.integrate(
            system,
            q,
            p,
            h=h,
            num_steps=num_steps,
            args=args,
            method=method,
            arithmetic=arithmetic,
            save=dvi.Save(every=every),
            observe=observable,
        ).observed

    t = jnp.zeros(())
    first = jax.vmap(lambda q, p: observable(t, t, q, p, q, p, args))(q, p)
    return first, jax.vmap(one)(q, p)


def errors(case, arithmetic, num_steps, every):
    """(steps, relative errors), shapes (S,) and (STARTS, S)."""
    first, values = _values(
        case.system,
        case.method,
        arithmetic,
        case.observable,
        num_steps,
        every,
        case.h,
        jnp.asarray(case.q),
        jnp.asarray(case.p),
        case.args,
    )
    first, values = np.asarray(first)[:, None], np.asarray(values)
    return every * np.arange(1, values.shape[1] + 1), values / first - 1


def growth(case, arithmetic, num_steps):
    """(steps, rms error) at about 60 numbers of steps, evenly in the logarithm."""
    pieces = []
    for n in (10**4, num_steps):
        steps, error = errors(case, arithmetic, n, max(n // 1000, 1))
        rms = np.sqrt(np.mean(error**2, axis=0))
        keep = steps > (pieces[-1][0][-1] if pieces else 0)
        pieces.append((steps[keep], rms[keep]))
    steps, rms = (np.concatenate(x) for x in zip(*pieces, strict=True))
    wanted = np.geomspace(steps[0], steps[-1], 60)
    nearest = np.unique(np.abs(np.log(steps[:, None] / wanted)).argmin(axis=0))
    return steps[nearest], rms[nearest]


def exponent(steps, rms):
    """Slope of log rms over log N, without the error of the first save; NaN if nothing is left."""
    keep = (rms > ABOVE_FIRST * rms[0]) & (steps >= 1000)
    if keep.sum() < 5:
        return np.nan
    grown = np.sqrt(rms[keep] ** 2 - rms[0] ** 2)
    return np.polyfit(np.log(steps[keep]), np.log(grown), 1)[0]


def seconds(case, arithmetic, lanes, num_steps):
    """Wall time of a run [s]."""
    cut = case._replace(q=case.q[:lanes], p=case.p[:lanes])
    begin = time.perf_counter()
    errors(cut, arithmetic, num_steps, num_steps)
    return time.perf_counter() - begin


def print_cost(case, num_steps=20_000):
    """Time a step, interleaved medians, for one trajectory and for the ensemble."""
    made = {a: make(case.quantum) for a, make in ARITHMETICS.items()}
    for lanes in (1, STARTS):
        for arithmetic in made.values():
            seconds(case, arithmetic, lanes, num_steps)
        rounds = [
            [seconds(case, a, lanes, num_steps) for a in made.values()] for _ in range(ROUNDS)
        ]
        plain = statistics.median(r[0] for r in rounds)
        ratios = ", ".join(
            f"{a} {statistics.median(r[i + 1] / r[0] for r in rounds):.2f}"
            for i, a in enumerate(list(made)[1:])
        )
        print(f"  {lanes:2d} lanes: plain {plain / num_steps * 1e6:.2f} µs a step; times {ratios}")


def print_mean_errors(num_steps):
    """The mean error over 200 starts: systematic or not, for several h."""
    draw = np.random.default_rng(1).uniform
    base = cases()["Energy of a cubic oscillator, TypeII"]
    print(f"mean error of E over 200 starts after {num_steps} steps, in standard errors:")
    for h in (2.0**-5, 2.0**-4, 0.05, 0.1):
        case = base._replace(h=h, args=h, q=draw(0.5, 1, (200, 1)), p=draw(-0.5, 0.5, (200, 1)))
        texts = []
        for name, make in ARITHMETICS.items():
            _, error = errors(case, make(case.quantum), num_steps, num_steps)
            mean, deviation = error[:, -1].mean(), error[:, -1].std(ddof=1)
            texts.append(f"{name} {mean:+.1e} ({abs(mean) / deviation * 200**0.5:.1f})")
        print(f"  h = {h:<8g}" + ", ".join(texts))


def picture(curves, path):
    """Errors over steps, one panel a case."""
    with plot.style():
        figure, axes = plt.subplots(1, len(curves), figsize=(11.5, 4.0))
        for axis, (title, lines) in zip(axes, curves.items(), strict=True):
            for (name, (steps, rms)), colour, dash in zip(
                lines.items(), plot.COLOURS, plot.DASHES, strict=False
            ):
                slope = exponent(steps, rms)
                axis.loglog(steps, rms, dash, color=colour, label=f"{name}, $N^{{{slope:.2f}}}$")
            steps, rms = lines["plain"]
            guide = rms[-1] * 10 * np.sqrt(steps / steps[-1])
            axis.loglog(steps, guide, color="0.6", linewidth=1, label="$\\sqrt{N}$")
            axis.set_title(title)
            axis.set_xlabel("number N of steps")
            axis.legend()
        axes[0].set_ylabel(f"rms relative error of {STARTS} runs")
        plot.save(figure, path)


def main():
    """Print and draw the results."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=10**7)
    parser.add_argument("--picture", default=None)
    options = parser.parse_args()
    curves = {}
    for title, case in cases().items():
        n = min(options.steps, case.most)
        print(f"{title}, h = {case.h:g}, {STARTS} starts, N = {n}")
        curves[title] = {}
        for name, make in ARITHMETICS.items():
            begin = time.perf_counter()
            steps, rms = curves[title][name] = growth(case, make(case.quantum), n)
            print(
                f"  {name:12s} rms {rms[-1]:.2e} at the end, N^{exponent(steps, rms):.2f}"
                f"   ({time.perf_counter() - begin:.0f} s)",
                flush=True,
            )
        print_cost(case)
    print_mean_errors(options.steps // 10)
    if options.picture:
        picture(curves, options.picture)


if __name__ == "__main__":
    main()
