"""The Chandler wobble from measured poles: its period, its damping, and how well they are known.

Four arcs of eight years have common parameters, and an initial state each. The formal errors are
much too small, because the excitation by atmosphere and ocean is not white noise. Errors that
include it come from fits that leave out each arc in turn (jackknife).

Run: python examples/polar_motion.py [--out DIR] [--years N]
"""

import argparse
from dataclasses import dataclass
from pathlib import Path

import jax
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np

import dvi_jax as dvi
from dvi_jax import plot
from dvi_jax.systems import polar_motion
from dvi_jax.systems.planets.polar_motion import REFERENCE, YEAR, read_polar_motion

STARTS = (42778, 45700, 48622, 51544)  # MJD: 1976-01-01, 1984-01-01, 1992-01-01, 2000-01-01
EVERY = 10  # days
PERIOD, PERIOD_ERROR = 433.0, 1.1  # Wilson & Vicente 1990
Q, Q_RANGE = 127, (56, 255)  # Nastula & Gross 2015
NAMES = ("args.period", "args.inverse_Q")


@dataclass
class Jackknife:
    """The results with each arc left out in turn.

    - `fits`: one for each arc. `error`: of period [day] and 1/Q, √((n − 1)/n Σ (x_i − mean)²).
    """

    fits: list[dvi.FitResult]
    error: np.ndarray


def arcs(years=8.0):
    """The pole (x, y) [arcsec] every ten days from each of the starts, t [day] since 2000."""
    pole = read_polar_motion()
    found = []
    for start in STARTS:
        first = int(np.searchsorted(pole.mjd, start))
        rows = first + EVERY * np.arange(int(years * YEAR / EVERY) + 1)
        t, xy = pole.mjd[rows] - REFERENCE, np.stack([pole.x, pole.y], axis=1)[rows]
        # Published errors are far below what the model leaves out: all weigh alike, no sigma.
        found.append(dvi.Observations(t, xy, observe="state"))
    return found


def fitted(data, args=None):
    """The parameters that the arcs share, and the start of each, fitted."""
    problem = polar_motion()
    model = dvi.Model(problem.system, h=5.0, epsilon=1.0, method=dvi.Yoshida(4))
    first = np.stack([arc.values[0] for arc in data])
    params = {"args": args or problem.args, "q0": first[:, :1], "p0": first[:, 1:]}
    return dvi.fit(model, data, params, check_curvature=False)


def jackknife(data, args):
    """The same fit without each arc; `args` to begin with."""
    fits = [fitted(data[:i] + data[i + 1 :], args) for i in range(len(data))]
    x = np.stack([shared(fit)[0] for fit in fits])
    n = len(x)
    return Jackknife(fits, np.sqrt((n - 1) / n * np.sum((x - x.mean(axis=0)) ** 2, axis=0)))


def shared(fit):
    """Period [day] and 1/Q, and their formal errors."""
    at = [fit.names.index(name) for name in NAMES]
    return fit.x[at], fit.sigma[at]


def report(fit, knife):
    """The results as text."""
    (period, inverse_q), formal = shared(fit)
    honest = knife.error
    r = fit.residuals
    lag = np.sum([np.sum(a[1:] * a[:-1]) for a in r]) / np.sum([np.sum(a**2) for a in r])
    lines = [
        f"{len(fit.ts)} arcs, {fit.num_observed} values, rms {1e3 * fit.rms:.2f} mas, "
        f"{len(fit.history['loss'])} steps in {fit.seconds:.1f} s; neighbouring residuals "
        f"correlate by {lag:.2f}",
        f"{'':20} {'fit':>10} {'formal ±':>10} {'jackknife ±':>12}   literature",
        f"{'period [day]':20} {period:10.2f} {formal[0]:10.2f} {honest[0]:12.2f}   "
        f"{PERIOD} ± {PERIOD_ERROR}",
        f"{'1/Q':20} {inverse_q:10.4f} {formal[1]:10.4f} {honest[1]:12.4f}   "
        f"{1 / Q:.4f} ({1 / Q_RANGE[1]:.4f} to {1 / Q_RANGE[0]:.4f})",
    ]
    for i, one in enumerate(knife.fits):
        x, _ = shared(one)
        lines.append(f"  without arc {i + 1}: period {x[0]:.2f} days, 1/Q {x[1]:+.4f}")
    ratio = honest / formal
    lines.append(
        f"Formal errors are {ratio[0]:.0f} (period) and {ratio[1]:.0f} (1/Q) times too small. The "
        f"period is {period:.0f} ± {max(honest[0], 0.5):.0f} days;"
    )
    away = abs(inverse_q) / honest[1]
    lines.append(
        f"1/Q is {away:.1f} of its errors from zero: "
        + ("Q is not determined." if away < 3 else "Q is determined.")
    )
    return "\n".join(lines)


def draw(fit, knife):
    """Data and fit of the arcs, residuals, and period and 1/Q compared with the literature."""
    figure = plt.figure(figsize=(10, 6.6))
    left, right = figure.subfigures(1, 2, width_ratios=[2.3, 1])
    rows = left.subplots(3, 1, sharex=True)
    for i, name in enumerate(("x", "y")):
        axis = rows[i]
        for t, seen, found in zip(fit.ts, fit.observed, fit.predicted, strict=True):
            year = 2000 + t / YEAR
            first = t is fit.ts[0]
            axis.plot(year, seen[:, i], ".", ms=2, color="0.55", label="measured" if first else "")
            axis.plot(
                year, found[:, i], lw=1.0, color=plot.COLOURS[0], label="fit" if first else ""
            )
            axis.axvline(year[0], color="0.8", lw=0.8, zorder=0)
        axis.set(ylabel=f"{name} [arcsec]")
        if i == 0:
            axis.set_title("Position of the pole, four arcs fitted together")
            axis.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=2, markerscale=3)
    axis = rows[2]
    for t, off in zip(fit.ts, fit.residuals, strict=True):
        first = t is fit.ts[0]
        for i, name in enumerate(("x", "y")):
            axis.plot(
                2000 + t / YEAR,
                1e3 * off[:, i],
                lw=0.9,
                color=plot.COLOURS[i],
                label=name if first else "",
            )
    axis.axhline(0, color="0.4", lw=0.8)
    axis.set(xlabel="year", ylabel="measured − fit [mas]")
    axis.legend(loc="lower right", bbox_to_anchor=(1, 0.96), ncols=2)
    x, formal = shared(fit)
    literature = (
        (PERIOD, PERIOD - PERIOD_ERROR, PERIOD + PERIOD_ERROR),
        (1 / Q, 1 / Q_RANGE[1], 1 / Q_RANGE[0]),
    )
    labels = "period [day]", "1/Q"
    for k, axis in enumerate(right.subplots(2, 1)):
        middle, low, high = literature[k]
        axis.axhspan(low, high, color=plot.COLOURS[2], alpha=0.25, lw=0)
        axis.axhline(middle, color=plot.COLOURS[2], lw=1.2, label="literature")
        axis.errorbar(0, x[k], formal[k], fmt="o", color=plot.COLOURS[0], capsize=3)
        axis.errorbar(1, x[k], knife.error[k], fmt="s", color=plot.COLOURS[1], capsize=3)
        each = [shared(one)[0][k] for one in knife.fits]
        axis.plot(2 + np.linspace(-0.2, 0.2, len(each)), each, "D", color=plot.COLOURS[3])
        axis.set(ylabel=labels[k], xlim=(-0.5, 2.5))
        axis.set_xticks([0, 1, 2], ["formal", "jack-\nknife", "each arc\nleft out"])
        axis.grid(False, axis="x")
        if k == 0:
            axis.set_title("Period and damping")
            axis.legend(loc="lower right", handlelength=1.2)
        else:
            axis.axhline(0, color="0.4", lw=0.8, ls=":")
    return figure


def main():
    """Fit, leave each arc out in turn, print, draw."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--out", type=Path, default=Path("."), help="directory for the picture")
    parser.add_argument("--years", type=float, default=8.0, help="length of each arc")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    data = arcs(given.years)
    fit = fitted(data)
    knife = jackknife(data, fit.params["args"])
    print(report(fit, knife))
    with plot.style():
        print(f"written: {plot.save(draw(fit, knife), given.out / 'polar_motion.png')}")


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    mpl.use("Agg")
    main()
