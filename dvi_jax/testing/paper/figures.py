"""The paper's figures, redrawn from the measurements, and those it lacks."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from ... import plot
from .experiments import Measurements
from .numbers import relative_spread, slope

BLUE, ORANGE, GREEN, PINK = plot.COLOURS[:4]
GREY = "#555555"
MARKERS = "osD^vP"
TIME = "time t (one period is 2π)"
KEPLER_TIME = "time t"

FIGURES: dict[str, tuple[Callable[[Measurements], Any], str]] = {}
"""File name → the function that makes the figure, and its caption."""


def _figure(name: str, caption: str, heading: str, size: tuple[float, float], **grid: Any):
    """Register a function that draws on new axes: two panels, or as `grid` says."""

    def register(draw_on: Callable[[Measurements, Any, Any], None]):
        def figure_of(m: Measurements) -> Any:
            figure, axes = plt.subplots(figsize=size, **{"ncols": 2, **grid})
            draw_on(m, figure, axes)
            figure.suptitle(heading, x=0.01, ha="left", fontsize=11.5, fontweight="bold")
            return figure

        FIGURES[name] = (figure_of, caption)
        return draw_on

    return register


@_figure(
    "fig1",
    "Energy error of the free oscillator: with equal steps the energy oscillates by O(h), and "
    "another quadratic form is conserved.",
    "Figure 1   Energy error of the variational method, h = 0.1, ε = 0",
    (9, 3.6),
    width_ratios=(1, 1.2),
)
def energy_error(m: Measurements, figure: Any, axes: Any) -> None:
    run, (full, close) = m.fixed_mesh, axes
    error = (run.mixed_energy[0] - run.mixed_energy[0, 0]) / 1e-6
    exact = (run.exact[0] - run.exact[0, 0]) / 1e-6
    t, low, high = _bands(run.ts, error, run.h)
    full.plot(t, high, color=BLUE)
    full.plot(t, low, color=BLUE, dashes=(5, 2))
    for values, text in ((high, "largest in each period"), (low, "smallest in each period")):
        full.text(500, np.mean(values) + 0.5, text, color=BLUE, ha="center")
    ylabel = "error in the energy  (10⁻⁶)"
    full.set(title="all 10 000 steps", xlabel=TIME, ylim=(-4.5, 14), ylabel=ylabel)
    part = run.ts < 3 * 2 * np.pi
    close.plot(run.ts[part], error[part], color=BLUE, marker="o", markersize=2.5, linewidth=0.8)
    close.plot(run.ts[part], exact[part], color=ORANGE, dashes=(5, 2))
    close.set(title="the first three periods", xlabel=TIME, ylim=(-4.5, 14), xticks=range(0, 19, 3))
    names = ["(p$_k$² + q$_{k−1}$²)/2, the paper's I₀", "(p² + q² − hqp)/2, exact invariant"]
    close.legend(names, loc="upper right")


@_figure(
    "fig2",
    "The same and the error of RK4, for the paper's number of steps.",
    "Figure 2   Energy error of the two methods, h = 0.1, 10 000 steps",
    (7.5, 4.2),
    ncols=1,
)
def against_rk4(m: Measurements, figure: Any, axes: Any) -> None:
    run = m.fixed_mesh
    variational = np.abs(run.mixed_energy[0] - run.mixed_energy[0, 0])
    rk4 = np.abs(run.rk4 - run.energy)
    # The error passes through zero twice a period, a filled band on a log axis: show the maxima.
    t, _, crests = _bands(run.ts, variational, run.h)
    axes.semilogy(t, crests, color=BLUE)
    axes.semilogy(run.ts, rk4, color=ORANGE, dashes=(5, 2))
    axes.set(xlabel=TIME, ylabel="|error in the energy|", ylim=(1e-12, 1e-3))
    axes.text(run.ts[-1], 2e-5, "variational: largest in each period", color=BLUE, ha="right")
    axes.text(run.ts[-1], 1.5e-9, "RK4: grows in proportion to t", color=ORANGE, ha="right")


@_figure(
    "fig3",
    "The adiabatic invariant (34): its oscillation O(h) hides the effect of ε; right, the "
    "invariant of the perturbed map.",
    "Figure 3   Adiabatic invariant (34) for different ε, h = 0.1",
    (9.4, 4.0),
)
def adiabatic_34(m: Measurements, figure: Any, axes: Any) -> None:
    run, (left, right) = m.fixed_mesh, axes
    part, step = run.ts < 4 * np.pi, slice(0, None, 97)
    for i in range(1, len(run.epsilons)):  # without ε = 0
        look = _look(i - 1) | {"marker": MARKERS[i - 1], "label": f"ε = {run.epsilons[i]:g}"}
        of_print, exact = (values[i] / values[i, 0] - 1 for values in (run.printed, run.exact))
        left.plot(run.ts[part], of_print[part] * 100, markevery=(3 * i, 14), **look)
        look |= {"markevery": (2 * i, 14), "linewidth": 0.9}
        right.plot(run.ts[step], exact[step] / 1e-14, **look)
    left.set(title="(34): the first two periods", xlabel=TIME, ylim=(-3, 20))
    left.set_ylabel("relative change of (34)  (%)")
    left.legend(ncols=2, loc="upper center")
    right.set(title="(p² + (1+ε)q² − h(1+ε)qp)/2: all steps", xlabel=TIME)
    right.set_ylabel("relative change  (10⁻¹⁴)")


@_figure(
    "fig4",
    "Phase diagrams, coloured by time. The + is the centre of attraction.",
    "Figure 4   Unperturbed Kepler orbit, h = 0.1, 100 000 steps",
    (9.6, 4.9),
    sharey=True,
)
def phase_diagrams(m: Measurements, figure: Any, axes: Any) -> None:
    runs = [m.long_runs[k] for k in ("RK4", "variational (order 1)")]
    names = ("a   RK4", "b   variational (the paper's map)")
    points = np.concatenate([run.qs for run in runs])
    low, high = points.min(0) - 0.6, points.max(0) + 0.6
    look: Any = {"cmap": "viridis", "linewidths": 0, "rasterized": True}
    colours: Any = None
    for run, name, axis in zip(runs, names, axes, strict=True):
        colours = axis.scatter(*run.qs.T, c=run.ts / 1000, s=0.15, **look)
        axis.plot(0, 0, "k+", markersize=8)
        axis.set(title=name, aspect="equal", xlim=(low[0], high[0]), ylim=(low[1], high[1] + 1.6))
        axis.set_xlabel("q₁")
        mantissa, exponent = f"{run.turn:.1e}".split("e")
        turn = rf"${mantissa}\times 10^{{{int(exponent)}}}$"
        text = (
            f"loop {run.width:.2g} wide at the apocentre\nellipse turns {turn} rad per revolution"
        )
        axis.text(0.03, 0.97, text, transform=axis.transAxes, va="top", fontsize=8.5)
    axes[0].set_ylabel("q₂")
    # The width of RK4's loop is not visible at full size: a window around the apocentre shows it.
    rk4 = runs[0]
    half_way = rk4.qs[len(rk4.qs) // 2 :][:500]  # more than one revolution
    far = half_way[np.argmax(np.linalg.norm(half_way, axis=1))]
    window = axes[0].inset_axes((0.06, 0.04, 0.34, 0.32))
    half = 1.2 * rk4.width
    in_window = np.max(np.abs(rk4.qs - far), axis=1) < half
    limits = {"vmin": 0, "vmax": rk4.ts[-1] / 1000}
    window.scatter(*rk4.qs[in_window].T, c=rk4.ts[in_window] / 1000, s=2.5, **limits, **look)
    window.set(xlim=far[0] + half * np.array([-1, 1]), ylim=far[1] + half * np.array([-1, 1]))
    window.set(xticks=[], yticks=[], aspect="equal")
    window.set_title(f"apocentre, {2 * half:.2g} across", fontsize=8, fontweight="normal")
    window.spines[["top", "right"]].set_visible(True)
    # The lines from the window to its place would cross the orbit; the rectangle marks the place.
    for line in axes[0].indicate_inset_zoom(window, edgecolor="black", alpha=1).connectors:
        line.set_visible(False)
    figure.colorbar(colours, ax=axes, label="time t  (thousands)", shrink=0.85)


@_figure(
    "fig4_errors",
    "The same runs, and compositions of the paper's map of order 2 and 4.",
    "Figure 4, continued   Errors of four methods, h = 0.1, ε = 0",
    (9.4, 3.9),
    sharex=True,
)
def long_run_errors(m: Measurements, figure: Any, axes: Any) -> None:
    (left, right), block = axes, 500
    for i, run in enumerate(m.long_runs.values()):
        look = _look(i) | {"label": run.name}
        count = len(run.energy_errors) // block
        t = run.ts[1:][block // 2 :: block][:count] / 1000
        for axis, errors in ((left, run.energy_errors), (right, run.momentum_errors)):
            crests = np.abs(errors[: count * block]).reshape(count, block).max(1)
            axis.semilogy(t, crests, **look)
    thousands = "time t  (thousands)"
    left.set(title=f"energy: largest in {block} steps", ylabel="|error|, relative")
    left.set_xlabel(thousands)
    right.set(title=f"angular momentum: largest in {block} steps", xlabel=thousands)
    right.set_ylabel("|error|")
    right.legend(loc="center")


@_figure(
    "fig5",
    "The adiabatic invariant (50) on the paper's time grid, and as h → 0.",
    "Figure 5   Adiabatic invariant (50) with time, force −εq",
    (9.4, 4.1),
)
def adiabatic_50(m: Measurements, figure: Any, axes: Any) -> None:
    sweep, small, (left, right) = m.mesh_sweep, m.small_step_sweep, axes
    part = sweep.ts < 100
    for i, epsilon in enumerate(sweep.epsilons[:4]):
        look = _look(i) | {"marker": MARKERS[i], "label": f"ε = {epsilon:g}"}
        left.plot(sweep.ts[part], sweep.values_50[i, part], markevery=(40 * i, 160), **look)
    left.set(title=f"the paper's map, h = {sweep.hs[0]:g}", xlabel=KEPLER_TIME)
    left.set_ylabel("adiabatic invariant (50)")
    low, high = left.get_ylim()
    left.set_ylim(low, high + 0.35 * (high - low))
    left.legend(ncols=2, loc="upper center")
    part = small.ts < 100
    for k, epsilon in enumerate(small.epsilons):
        for i in np.flatnonzero(sweep.epsilons == epsilon):  # one colour for one ε in both panels
            change = np.abs(small.values[k] - small.values[k, 0])[part]
            right.semilogy(small.ts[part], change, **_look(int(i)), label=f"ε = {epsilon:g}")
    right.set(title=f"as h → 0 (order 4, h = {small.h:g})", xlabel=KEPLER_TIME)
    right.set(ylabel="|change of invariant (50)|", ylim=(1e-11, 1))
    right.legend(ncols=2, loc="upper center")


@_figure(
    "crossover",
    "Energy error of RK4 until it exceeds the band of the variational method.",
    "Crossover   When RK4's energy error outgrows the variational band",
    (9.4, 3.9),
)
def rk4_crossover(m: Measurements, figure: Any, axes: Any) -> None:
    cross, (left, right) = m.crossover, axes
    left.loglog(cross.run_steps, cross.run_errors, color=ORANGE, dashes=(5, 2), label="RK4")
    left.axhline(cross.bands[0], color=BLUE, label="variational: width of its band")
    left.axvline(10_000, color=GREY, linewidth=0.9, linestyle=":")
    left.text(9000, 3e-6, "the paper's run", rotation=90, ha="right", va="top", color=GREY)
    if np.isfinite(cross.steps[0]):
        point, text = (cross.steps[0], cross.bands[0]), f"{cross.steps[0] / 1e6:.2f} million steps"
        left.plot(*point, "ko")
        left.annotate(text, point, (0, 9), textcoords="offset points", ha="right")
    left.set(title=f"h = {cross.hs[0]:g}", xlabel="steps", ylim=(1e-9, 1e-4))
    left.set_ylabel("|error in the energy|")
    left.legend(loc="upper left")
    fine = np.geomspace(0.9 * cross.hs[0], 1.1 * cross.hs[-1], 50)
    start = m.fixed_mesh.energy
    right.loglog(cross.hs, cross.steps, "o", color=BLUE, markersize=6, label="measured")
    bands = np.interp(fine, cross.hs, cross.bands)
    prediction = np.log1p(-bands / start) / np.log1p(-(fine**6) / 72)
    right.loglog(fine, prediction, color=GREY, dashes=(4, 2), label="loss of h⁶/72 per step")
    right.set(title="crossover against h", xlabel="step size h", ylabel="steps to the crossover")
    right.set_xticks(cross.hs, [f"{h:g}" for h in cross.hs])
    right.minorticks_off()
    right.legend()


@_figure(
    "sweep_34",
    "Range of (34) against ε, as printed and corrected.",
    "Equation (34)   An invariant of first order would have exponent 2",
    (7.5, 4.6),
    ncols=1,
)
def sweep_34(m: Measurements, figure: Any, axes: Any) -> None:
    small, mesh = m.small_step, m.fixed_mesh
    of_print, exact = (relative_spread(values)[1:] for values in (mesh.printed, mesh.exact))
    rows = (
        (mesh.epsilons[1:], of_print, "(34) as printed, h = 0.1"),
        (small.epsilons, small.printed, "(34) as printed, h → 0"),
        (small.epsilons, small.corrected, "(p² + (1+ε)q²)/2, h → 0"),
        (mesh.epsilons[1:], exact, "(p² + (1+ε)q² − h(1+ε)qp)/2, h = 0.1"),
    )
    for i, (x, y, label) in enumerate(rows):
        look = _look(i) | {"marker": MARKERS[i]}
        axes.loglog(x, y, **look, label=f"{label}:  exponent {slope(x, y):.2f}")
    axes.legend(loc="upper left")
    axes.set(xlabel="strength of the perturbation ε", ylim=(1e-15, 1e6))
    axes.set_ylabel("range over the run, relative")


@_figure(
    "sweep_49_50",
    "Range of (49) and (50) over ε and h; as h → 0 the drift minus that of ε = 0.",
    "Equations (49) and (50)   Sweep of ε and h, t = 200",
    (9.8, 4.6),
)
def sweep_50(m: Measurements, figure: Any, axes: Any) -> None:
    sweep, small, (left, right) = m.mesh_sweep, m.small_step_sweep, axes
    positive = sweep.epsilons[1:]
    for i, h in enumerate(sweep.hs):
        look = _look(i) | {"marker": MARKERS[i]}
        left.loglog(positive, sweep.spread_50[i, 1:], **look, label=f"equal steps, h = {h:g}")
    for drifts, label, look in (
        (small.attracting, "h → 0, force −εq", {"color": "k", "marker": "o"}),
        (small.repelling, "h → 0, force +εq", {"color": GREY, "marker": "x", "ls": "--"}),
    ):
        drifts = small.beyond_zero(drifts)
        left.loglog(small.epsilons[1:], drifts, **look, label=label)
        text, place = f"exponent {small.exponent(drifts):.2f}", (small.epsilons[1], drifts[0])
        look = {"color": look["color"], "va": "top"}
        left.annotate(text, place, (8, -4), textcoords="offset points", **look)
    left.axhline(small.literal[0], color=GREY, linewidth=0.9, linestyle=":")
    text = "error of the order-4 method: the drift of\n(1+ε)L − H − ε|q|²/2 for every ε"
    look = {"ha": "right", "va": "top", "fontsize": 8.5, "color": GREY}
    left.text(0.1, small.literal[0] / 1.4, text, **look)
    left.set(title="invariant (50) against ε", ylim=(1e-10, 300))
    left.set_xlabel("strength of the perturbation ε")
    left.set_ylabel("range of (50) (equal steps), drift (h → 0)")
    left.legend(fontsize=8.5, ncols=2, loc="upper center", columnspacing=1)
    for i, epsilon in enumerate(sweep.epsilons):
        if epsilon not in (0.0, 1e-2, 1e-1):
            continue
        look = _look(i) | {"marker": MARKERS[i]}
        right.loglog(sweep.hs, sweep.spread_50[:, i], **look, label=f"(50), ε = {epsilon:g}")
    largest_49 = np.max(sweep.relative_49, axis=1)
    right.loglog(sweep.hs, largest_49, "kP:", label="(49), relative, largest over ε")
    reference = sweep.spread_50[0, 0] * sweep.hs / sweep.hs[0] / 2.5
    right.loglog(sweep.hs, reference, color=GREY, linewidth=0.9, label="in proportion to h")
    right.set(title="invariants (50) and (49) against h", xlabel="step size h", ylim=(1e-15, 100))
    right.set_xticks(sweep.hs, [f"{h:g}" for h in sweep.hs])
    right.minorticks_off()
    right.set_ylabel("range over t = 200")
    right.legend(fontsize=8.5, ncols=2, loc="upper center", columnspacing=1)


def draw(measurements: Measurements, folder: Path) -> Iterator[Path]:
    """Every figure as a PNG in `folder`; yields each path once it is written."""
    with plot.style():
        for name, (function, _) in FIGURES.items():
            yield plot.save(function(measurements), folder / f"{name}.png")


def _look(i: int) -> dict[str, Any]:
    """Colour and dashes of curve i."""
    return {"color": plot.COLOURS[i], "linestyle": plot.DASHES[i]}


def _bands(ts: np.ndarray, values: np.ndarray, h: float) -> tuple[np.ndarray, ...]:
    """Middle, smallest and largest value of each period of the oscillator."""
    period = round(2 * np.pi / h)
    count = len(values) // period
    blocks = values[: count * period].reshape(count, period)
    return ts[period // 2 :: period][:count], blocks.min(1), blocks.max(1)
