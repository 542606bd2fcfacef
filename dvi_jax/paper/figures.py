"""The paper's figures, redrawn from the measurements, and those it lacks."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from .. import plot
from .experiments import Measurements
from .numbers import relative_spread, slope

BLUE, ORANGE, GREEN, PINK = plot.COLOURS[:4]
GREY = "#555555"
MARKERS = "osD^vP"
TIME = "time t (dimensionless; one period is 2π)"
KEPLER_TIME = "time t (dimensionless)"

FIGURES: dict[str, tuple[Callable[[Measurements], Any], str]] = {}
"""File name → the function that draws it and its caption."""


def _figure(name: str, caption: str):
    """Register the function that draws a figure."""

    def register(function: Callable[[Measurements], Any]):
        FIGURES[name] = (function, caption)
        return function

    return register


@_figure(
    "fig1",
    "Energy error of the free oscillator: on the fixed mesh the energy wiggles by O(h), and "
    "another quadratic form is kept.",
)
def energy_error(m: Measurements) -> Any:
    """Figure 1: energy error of the variational method, free oscillator."""
    run = m.fixed_mesh
    figure, (whole, close) = plt.subplots(1, 2, figsize=(9, 3.6), width_ratios=(1, 1.2))
    error = (run.mixed[0] - run.mixed[0, 0]) / 1e-6
    exact = (run.exact[0] - run.exact[0, 0]) / 1e-6
    t, low, high = _bands(run.ts, error, run.h)
    whole.fill_between(t, low, high, color=BLUE, alpha=0.25, linewidth=0)
    whole.plot(t, low, color=BLUE)
    whole.plot(t, high, color=BLUE)
    whole.text(500, np.mean(high) / 2, "swept twice a period", color=BLUE, ha="center")
    whole.set(title="all 10 000 steps", xlabel=TIME)
    whole.set_ylim(-4.5, 14)
    whole.set_ylabel("error in the energy  (10⁻⁶, dimensionless)")
    part = run.ts < 3 * 2 * np.pi
    close.plot(run.ts[part], error[part], color=BLUE, marker="o", markersize=2.5, linewidth=0.8)
    close.plot(run.ts[part], exact[part], color=ORANGE, dashes=(5, 2))
    close.set(title="the first three periods", xlabel=TIME, ylim=(-4.5, 14), xticks=range(0, 19, 3))
    close.legend(
        ["(p$_k$² + q$_{k−1}$²)/2, the paper's I₀", "(p² + q² − hqp)/2, kept exactly"],
        loc="upper right",
    )
    return _headed(
        figure, f"Figure 1   Energy error of the variational method, h = {run.h:g}, ε = 0"
    )


@_figure("fig2", "The same beside RK4, for the paper's number of steps.")
def against_rk4(m: Measurements) -> Any:
    """Figure 2: energy error of the variational method and of RK4."""
    run = m.fixed_mesh
    figure, axes = plt.subplots(figsize=(7.5, 4.2))
    variational = np.abs(run.mixed[0] - run.mixed[0, 0])
    rk4 = np.abs(run.rk4 - run.energy)
    # An error that passes through zero twice a period is a smear on a log axis: show its crests.
    t, _, crests = _bands(run.ts, variational, run.h)
    axes.semilogy(t, crests, color=BLUE)
    axes.semilogy(run.ts, rk4, color=ORANGE, dashes=(5, 2))
    axes.set(xlabel=TIME, ylabel="|error in the energy|  (dimensionless)", ylim=(1e-12, 1e-3))
    axes.text(run.ts[-1], 2e-5, "variational: largest in each period", color=BLUE, ha="right")
    axes.text(run.ts[-1], 1.5e-9, "RK4: grows in proportion to t", color=ORANGE, ha="right")
    return _headed(
        figure, f"Figure 2   Energy error of the two methods, h = {run.h:g}, 10 000 steps"
    )


@_figure(
    "fig3",
    "The adiabatic invariant (34): the wiggle O(h) hides ε; right, the form that the "
    "disturbed map keeps.",
)
def adiabatic_34(m: Measurements) -> Any:
    """Figure 3: relative change of the adiabatic invariant (34)."""
    run = m.fixed_mesh
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.4, 4.0))
    part = run.ts < 4 * np.pi
    for i, epsilon in enumerate(run.epsilons):
        if epsilon == 0:
            continue
        look = _look(i - 1)
        look |= {"marker": MARKERS[i - 1], "markevery": (3 * i, 14), "label": f"ε = {epsilon:g}"}
        values = run.printed[i]
        left.plot(run.ts[part], (values[part] / values[0] - 1) * 100, **look)
        values = run.exact[i]
        step = slice(0, None, 97)
        look["markevery"] = (2 * i, 14)
        right.plot(run.ts[step], (values[step] / values[0] - 1) / 1e-14, **look, linewidth=0.9)
    left.set(title="(34): the first two periods", xlabel=TIME)
    left.set_ylabel("relative change of (34)  (%)")
    left.set_ylim(-3, 20)
    left.legend(ncols=2, loc="upper center")
    right.set(title="(p² + (1+ε)q² − h(1+ε)qp)/2: all steps", xlabel=TIME)
    right.set_ylabel("relative change  (10⁻¹⁴)")
    return _headed(figure, f"Figure 3   Adiabatic invariant (34) for different ε, h = {run.h:g}")


@_figure("fig4", "Phase diagrams, coloured by time. The + is the centre of attraction.")
def phase_diagrams(m: Measurements) -> Any:
    """Figure 4: orbits by RK4 and by the variational method."""
    shown = [m.long_runs[k] for k in ("RK4", "variational (order 1)")]
    names = ("a   RK4", "b   variational (the paper's map)")
    figure, axes = plt.subplots(1, 2, figsize=(9.6, 4.9), sharey=True)
    points = np.concatenate([run.qs for run in shown])
    low, high = points.min(0) - 0.6, points.max(0) + 0.6
    look: Any = {"cmap": "viridis", "linewidths": 0, "rasterized": True}
    colours: Any = None
    for run, name, axis in zip(shown, names, axes, strict=True):
        colours = axis.scatter(*run.qs.T, c=run.ts / 1000, s=0.15, **look)
        axis.plot(0, 0, "k+", markersize=8)
        axis.set(title=name, aspect="equal", xlim=(low[0], high[0]), ylim=(low[1], high[1] + 1.6))
        axis.set_xlabel("q₁  (dimensionless)")
        axis.text(
            0.03,
            0.97,
            f"loop {run.width:.2g} wide at the apocentre\n"
            f"ellipse turns {_scientific(run.turn)} rad per revolution",
            transform=axis.transAxes,
            va="top",
            fontsize=8.5,
        )
    axes[0].set_ylabel("q₂  (dimensionless)")
    # RK4's width does not show at full size: a window around the apocentre.
    rk4 = shown[0]
    half_way = rk4.qs[len(rk4.qs) // 2 :][:500]  # more than one revolution
    far = half_way[np.argmax(np.linalg.norm(half_way, axis=1))]
    window = axes[0].inset_axes((0.06, 0.04, 0.34, 0.32))
    half = 1.2 * rk4.width
    near = np.max(np.abs(rk4.qs - far), axis=1) < half
    limits = {"vmin": 0, "vmax": rk4.ts[-1] / 1000}
    window.scatter(*rk4.qs[near].T, c=rk4.ts[near] / 1000, s=2.5, **limits, **look)
    window.set(xlim=far[0] + half * np.array([-1, 1]), ylim=far[1] + half * np.array([-1, 1]))
    window.set(xticks=[], yticks=[], aspect="equal")
    window.set_title(f"apocentre, {2 * half:.2g} across", fontsize=8, fontweight="normal")
    window.spines[["top", "right"]].set_visible(True)
    axes[0].indicate_inset_zoom(window, edgecolor=GREY)
    figure.colorbar(colours, ax=axes, label="time t  (thousands, dimensionless)", shrink=0.85)
    return _headed(figure, "Figure 4   Undisturbed Kepler orbit, h = 0.1, 100 000 steps")


@_figure("fig4_errors", "The same runs, and compositions of the paper's map of order 2 and 4.")
def long_run_errors(m: Measurements) -> Any:
    """What Figure 4 does not show: errors of energy and angular momentum."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.4, 3.9), sharex=True)
    block = 500
    for i, run in enumerate(m.long_runs.values()):
        look = _look(i) | {"label": run.name}
        count = len(run.energy_errors) // block
        t = run.ts[1:][block // 2 :: block][:count] / 1000
        for axis, errors in ((left, run.energy_errors), (right, run.momentum_errors)):
            crests = np.abs(errors[: count * block]).reshape(count, block).max(1)
            axis.semilogy(t, crests, **look)
    for axis in (left, right):
        axis.set_xlabel("time t  (thousands, dimensionless)")
    left.set(title=f"energy: largest in {block} steps", ylabel="|error|, relative")
    right.set(title=f"angular momentum: largest in {block} steps")
    right.set_ylabel("|error|  (dimensionless)")
    right.legend(loc="center")
    return _headed(figure, "Figure 4, continued   Errors of four methods, h = 0.1, ε = 0")


@_figure(
    "fig5", "The adiabatic invariant (50) on the paper's mesh, and with the mesh out of the way."
)
def adiabatic_50(m: Measurements) -> Any:
    """Figure 5: the adiabatic invariant (50) with time."""
    sweep, small = m.mesh_sweep, m.small_step_sweep
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.4, 4.1))
    part = sweep.ts < 100
    for i, epsilon in enumerate(sweep.epsilons[:4]):
        look = _look(i)
        look |= {"marker": MARKERS[i], "markevery": (40 * i, 160), "label": f"ε = {epsilon:g}"}
        left.plot(sweep.ts[part], sweep.values_50[i, part], **look)
    left.set(title=f"the paper's map, h = {sweep.hs[0]:g}", xlabel=KEPLER_TIME)
    left.set_ylabel("adiabatic invariant (50)  (dimensionless)")
    low, high = left.get_ylim()
    left.set_ylim(low, high + 0.35 * (high - low))
    left.legend(ncols=2, loc="upper center")
    part = small.ts < 100
    for k, epsilon in enumerate(small.epsilons):
        if epsilon not in sweep.epsilons:
            continue
        i = list(sweep.epsilons).index(epsilon)  # one colour for one ε in both pictures
        look = _look(i)
        change = np.abs(small.values[k] - small.values[k, 0])
        right.semilogy(small.ts[part], change[part], **look, label=f"ε = {epsilon:g}")
    right.set(title=f"as h → 0 (order 4, h = {small.h:g})", xlabel=KEPLER_TIME)
    right.set(ylabel="|change of (50)|  (dimensionless)", ylim=(1e-11, 1))
    right.legend(ncols=2, loc="upper center")
    return _headed(figure, "Figure 5   Adiabatic invariant (50) with time, force −εq")


@_figure(
    "crossover", "RK4 run until its energy error has passed the band of the variational method."
)
def rk4_crossover(m: Measurements) -> Any:
    """When RK4's energy error passes the variational band."""
    cross = m.crossover
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.4, 3.9))
    left.loglog(cross.run_steps, cross.run_errors, color=ORANGE, dashes=(5, 2), label="RK4")
    left.axhline(cross.bands[0], color=BLUE, label="variational: width of its band")
    left.axvline(10_000, color=GREY, linewidth=0.9, linestyle=":")
    left.text(9000, 3e-6, "the paper's run", rotation=90, ha="right", va="top", color=GREY)
    if np.isfinite(cross.steps[0]):
        left.plot(cross.steps[0], cross.bands[0], "ko")
        left.annotate(
            f"{cross.steps[0] / 1e6:.2f} million steps",
            (cross.steps[0], cross.bands[0]),
            (0, 9),
            textcoords="offset points",
            ha="right",
        )
    left.set(title=f"h = {cross.hs[0]:g}", xlabel="steps", ylim=(1e-9, 1e-4))
    left.set_ylabel("energy error  (dimensionless)")
    left.legend(loc="upper left")
    fine = np.geomspace(0.9 * cross.hs[0], 1.1 * cross.hs[-1], 50)
    start = m.fixed_mesh.energy
    right.loglog(cross.hs, cross.steps, "o", color=BLUE, markersize=6, label="measured")
    bands = np.interp(fine, cross.hs, cross.bands)
    predicted = np.log1p(-bands / start) / np.log1p(-(fine**6) / 72)
    right.loglog(fine, predicted, color=GREY, dashes=(4, 2), label="loss of h⁶/72 per step")
    right.set(title="crossover against h", xlabel="step size h", ylabel="steps to the crossover")
    right.set_xticks(cross.hs, [f"{h:g}" for h in cross.hs])
    right.minorticks_off()
    right.legend()
    return _headed(figure, "Crossover   When RK4's energy error outgrows the variational band")


@_figure("sweep_34", "Range of (34) against ε, as printed and corrected.")
def sweep_34(m: Measurements) -> Any:
    """Drift of (34) and of its corrected forms against ε."""
    small, mesh = m.small_step, m.fixed_mesh
    figure, axes = plt.subplots(figsize=(7.5, 4.6))
    rows = (
        (mesh.epsilons[1:], relative_spread(mesh.printed)[1:], "(34) as printed, h = 0.1"),
        (small.epsilons, small.printed, "(34) as printed, h → 0"),
        (small.epsilons, small.corrected, "(p² + (1+ε)q²)/2, h → 0"),
        (
            mesh.epsilons[1:],
            relative_spread(mesh.exact)[1:],
            "(p² + (1+ε)q² − h(1+ε)qp)/2, h = 0.1",
        ),
    )
    for i, (x, y, label) in enumerate(rows):
        look = _look(i) | {"marker": MARKERS[i]}
        axes.loglog(x, y, **look, label=f"{label}:  exponent {slope(x, y):.2f}")
    axes.legend(loc="upper left")
    axes.set(xlabel="strength of the disturbance ε", ylim=(1e-15, 1e6))
    axes.set_ylabel("range over the run, relative")
    return _headed(figure, "Equation (34)   An invariant of first order would have exponent 2")


@_figure(
    "sweep_49_50", "Range of (49) and (50) over ε and h; as h → 0 the drift beyond that of ε = 0."
)
def sweep_50(m: Measurements) -> Any:
    """Range of (49) and (50) over ε and h."""
    sweep, small = m.mesh_sweep, m.small_step_sweep
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.8, 4.6))
    positive = sweep.epsilons[1:]
    for i, h in enumerate(sweep.hs):
        look = _look(i) | {"marker": MARKERS[i]}
        left.loglog(positive, sweep.spread_50[i, 1:], **look, label=f"fixed mesh, h = {h:g}")
    for drifts, label, look in (
        (small.attracting, "h → 0, force −εq", {"color": "k", "marker": "o"}),
        (small.repelling, "h → 0, force +εq", {"color": GREY, "marker": "x", "ls": "--"}),
    ):
        drifts = small.beyond_zero(drifts)
        left.loglog(small.epsilons[1:], drifts, **look, label=label)
        left.annotate(
            f"exponent {small.exponent(drifts):.2f}",
            (small.epsilons[1], drifts[0]),
            (8, -4),
            textcoords="offset points",
            color=look["color"],
            va="top",
        )
    left.axhline(small.literal[0], color=GREY, linewidth=0.9, linestyle=":")
    left.text(
        0.1,
        small.literal[0] / 1.4,
        "error of the order-4 method: all of the drift of\n(1+ε)L − H − ε|q|²/2, whatever ε is",
        ha="right",
        va="top",
        fontsize=8.5,
        color=GREY,
    )
    left.set(title="(50) against ε", xlabel="strength of the disturbance ε", ylim=(1e-10, 300))
    left.set_ylabel("range (fixed mesh), drift (h → 0)")
    left.legend(fontsize=8.5, ncols=2, loc="upper center", columnspacing=1)
    for i, epsilon in enumerate(sweep.epsilons):
        if epsilon not in (0.0, 1e-2, 1e-1):
            continue
        look = _look(i) | {"marker": MARKERS[i]}
        right.loglog(sweep.hs, sweep.spread_50[:, i], **look, label=f"(50), ε = {epsilon:g}")
    right.loglog(
        sweep.hs, np.max(sweep.relative_49, axis=1), "kP:", label="(49), relative, largest over ε"
    )
    reference = sweep.spread_50[0, 0] * sweep.hs / sweep.hs[0] / 2.5
    right.loglog(sweep.hs, reference, color=GREY, linewidth=0.9, label="in proportion to h")
    right.set(title="(50) and (49) against h", xlabel="step size h", ylim=(1e-15, 100))
    right.set_xticks(sweep.hs, [f"{h:g}" for h in sweep.hs])
    right.minorticks_off()
    right.set_ylabel("range over t = 200")
    right.legend(fontsize=8.5, ncols=2, loc="upper center", columnspacing=1)
    return _headed(figure, "Equations (49) and (50)   Sweep of ε and h, t = 200")


def draw(measurements: Measurements, folder: Path) -> Iterator[Path]:
    """Every figure as a PNG in `folder`; yields each path once it is written."""
    with plot.style():
        for name, (function, _) in FIGURES.items():
            yield plot.save(function(measurements), folder / f"{name}.png")


def _headed(figure: Any, text: str) -> Any:
    figure.suptitle(text, x=0.01, ha="left", fontsize=11.5, fontweight="bold")
    return figure


def _look(i: int) -> dict[str, Any]:
    """Colour and dashes of curve i."""
    return {"color": plot.COLOURS[i], "linestyle": plot.DASHES[i]}


def _bands(ts: np.ndarray, values: np.ndarray, h: float) -> tuple[np.ndarray, ...]:
    """Middle, smallest and largest value of each period of the oscillator."""
    period = round(2 * np.pi / h)
    count = len(values) // period
    blocks = values[: count * period].reshape(count, period)
    return ts[period // 2 :: period][:count], blocks.min(1), blocks.max(1)


def _scientific(value: float) -> str:
    mantissa, exponent = f"{value:.1e}".split("e")
    return rf"${mantissa}\times 10^{{{int(exponent)}}}$"
