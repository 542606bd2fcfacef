"""Work-precision diagrams of the methods: error against evaluations and against time.

Three problems: Kepler's with eccentricity 0.6 and Hénon and Heiles' (both separable: explicit
steps), and a double pendulum that is damped and driven (not separable, forced: every step
implicit). The error is that of the state at the end, max(|Δq|/|q|, |Δp|/|p|) in the Euclidean
norm, against SciPy's DOP853; the difference of two runs of that at different tolerances is the
floor below which nothing is claimed.

Work is counted as the package does it. One evaluation is one gradient of H_D, both halves, with
the force W where there is one:

    explicit part of a step       1 (a half for p, a half for q)
    implicit part of a step       1 (guess, other half) and 3/2 + n w/2 an iteration
    Gauss, s stages               2 s (guess, end) and 3 s + 2 s n · s w an iteration
    Lobatto pair, s stages        3 m + s/2 (guess, end) and 3 m + 2 (s − 1) n · m w an iteration,
                                  m = s − 1/2
      where q is not in ∂H/∂p     3 m + s (guess, end) and 3 m + (s − 1) n · m w an iteration
      two stages without a solve  3.5
    RungeKutta4                   4

with n the dimension of q and w = JACOBIAN_WEIGHT what one column of a Jacobian costs at one point,
in evaluations. An iteration is a Jacobian and the three residuals that are corrected by it. Not
every step needs the last one, so that the number is an upper bound. How many iterations there are
is what Newton's method reports, not an assumption.

Kicks that meet between two parts are counted twice, as they are computed.

Times are those of a jitted run in one process, after compilation. For a run that takes longer than
SHORT its first part is timed, at the same step size, and scaled by evaluations: a part that fits
between two interruptions by other work. In each round, and in another order each time, a run is
the least of LEAST or of as many as fit into TAKEN seconds, divided by the least of the same for
`Strang` with REFERENCE_STEPS steps, right before it; the median over rounds is shown.

Run: python benchmarks/work_precision.py --out DIR [--redraw]
"""

import argparse
import csv
import math
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from PIL import Image
from scipy.integrate import solve_ivp

import dvi_jax as dvi
from dvi_jax import systems

jax.config.update("jax_enable_x64", True)

JACOBIAN_WEIGHT = 1.0
REFERENCE, REFERENCE_STEPS = "Strang", 8192
SHORT, TAKEN, LEAST = 5e-4, 5e-3, 7
"""How long a timed run is, if it can be; how long it is repeated in a round [s], how often."""

PIECE = 8
"""Steps in a compiled piece: any multiple of it runs without a new compilation."""

METHODS = {
    "TypeII": dvi.TypeII(),
    "Adjoint": dvi.Adjoint(),
    "Strang": dvi.Strang(),
    "GaussLegendre1": dvi.GaussLegendre(1),
    "LobattoIIIAIIIB2": dvi.LobattoIIIAIIIB(2),
    "RungeKutta4": dvi.RungeKutta4(),
    "Yoshida4": dvi.Yoshida(4),
    "Suzuki4": dvi.Suzuki(4),
    "BlanesMoan4": dvi.BlanesMoan(4),
    "McLachlan4": dvi.McLachlan(4),
    "GaussLegendre2": dvi.GaussLegendre(2),
    "LobattoIIIAIIIB3": dvi.LobattoIIIAIIIB(3),
    "Yoshida6": dvi.Yoshida(6),
    "BlanesMoan6": dvi.BlanesMoan(6),
    "McLachlan6": dvi.McLachlan(6),
    "KahanLi6": dvi.KahanLi(6),
    "GaussLegendre3": dvi.GaussLegendre(3),
    "LobattoIIIAIIIB4": dvi.LobattoIIIAIIIB(4),
    "Yoshida8": dvi.Yoshida(8),
    "McLachlan8": dvi.McLachlan(8),
    "KahanLi8": dvi.KahanLi(8),
    "GaussLegendre4": dvi.GaussLegendre(4),
    "LobattoIIIAIIIB5": dvi.LobattoIIIAIIIB(5),
}
"""Every method that is compared. One of a new class needs its cost in `cost`."""


class Problem(NamedTuple):
    """A system, its start and the end of the time over which the error is measured."""

    title: str
    system: dvi.System
    q0: Any
    p0: Any
    t_end: float
    epsilon: float = 0.0
    args: Any = None


def double_pendulum(t0, t1, q0, p1, args):
    """Two unit masses on unit rods, unit gravity: canonical angles and momenta."""
    difference = q0[0] - q0[1]
    kinetic = (p1[0] ** 2 + 2 * p1[1] ** 2 - 2 * p1[0] * p1[1] * jnp.cos(difference)) / (
        2 * (1 + jnp.sin(difference) ** 2)
    )
    return kinetic - 2 * jnp.cos(q0[0]) - jnp.cos(q0[1])


def damped_and_driven(t0, t1, q0, p1, args):
    """W = −p1 + (cos t0, 0)."""
    return -p1 + jnp.stack([jnp.cos(t0), jnp.zeros_like(t0)])


def kepler(eccentricity=0.6):
    """The Kepler problem from perihelion, semi-major axis 1: a little over three revolutions."""
    problem, e = systems.kepler(), eccentricity
    start = [1 - e, 0.0], [0.0, ((1 + e) / (1 - e)) ** 0.5]
    undisturbed = dvi.System(problem.system.H_D)
    return Problem(f"Kepler, e = {e:g}", undisturbed, *start, 20.0, args=problem.args)


def henon_heiles():
    """The library's orbit of energy 1/12."""
    problem = systems.henon_heiles()
    return Problem("Hénon–Heiles, E = 1/12", problem.system, problem.q0, problem.p0, 40.0)


def driven_pendulum():
    """Two pendula that swing by less than a right angle, so that no error is blown up."""
    system = dvi.System(double_pendulum, force=damped_and_driven)
    title = "double pendulum, damped and driven"
    return Problem(title, system, [0.8, -0.4], [0.2, 0.4], 20.0, epsilon=0.2)


PROBLEMS = {"kepler": kepler, "henon_heiles": henon_heiles, "double_pendulum": driven_pendulum}


# The reference


class Reference(NamedTuple):
    """State at the end, and how well it is known."""

    q: np.ndarray
    p: np.ndarray
    floor: float

    def error(self, q, p):
        """The larger of the relative errors of q and p, Euclidean norms."""
        pairs = ((self.q, q), (self.p, p))
        return max(float(np.linalg.norm(b - a) / np.linalg.norm(a)) for a, b in pairs)


def reference(problem: Problem) -> Reference:
    """SciPy's DOP853 on the continuous equations, at two tolerances."""
    system, args, epsilon = problem.system, problem.args, problem.epsilon

    @jax.jit
    def field(t, z):
        q, p = jnp.split(z, 2)
        of_q, of_p = jax.grad(system.H_D, argnums=(2, 3))(t, t, q, p, args)
        fall = of_q - system.disturbing_force(t, t, q, p, jnp.asarray(epsilon), args)
        return jnp.concatenate([of_p, -fall])

    def end(rtol, atol):
        run = solve_ivp(
            lambda t, z: np.asarray(field(t, z)),
            (0.0, problem.t_end),
            [*problem.q0, *problem.p0],
            method="DOP853",
            rtol=rtol,
            atol=atol,
        )
        return np.split(run.y[:, -1], 2)

    best = Reference(*end(2.3e-14, 1e-16), 0.0)  # the smallest rtol that SciPy takes
    return best._replace(floor=max(best.error(*end(1e-13, 1e-15)), 1e-14))


# One method on one problem


class Cost(NamedTuple):
    """Evaluations of a step, evaluations and points of Jacobian columns of a Newton iteration."""

    of_step: float
    of_iteration: float
    columns: float

    def evaluations(self, num_steps, iterations):
        """Evaluations of a whole run, Jacobians included."""
        each = self.of_iteration + JACOBIAN_WEIGHT * self.columns
        return num_steps * self.of_step + iterations * each


def cost(method: dvi.Method, problem: Problem) -> Cost:
    """Cost of a step of the method, see the head of this file.

    **Raises** `TypeError` for a method of a class that it does not know.
    """
    n, q = len(problem.q0), jnp.asarray(problem.q0)
    if isinstance(method, dvi.RungeKutta4):
        return Cost(4, 0, 0)
    if isinstance(method, dvi.GaussLegendre):
        s = method.stages
        return Cost(2 * s, 3 * s, 2 * s * n * s)
    if isinstance(method, dvi.LobattoIIIAIIIB):
        directions = (dvi.TypeII(), dvi.Adjoint())
        explicit = [m.is_explicit(problem.system, q, problem.args) for m in directions]
        return lobatto_cost(method.stages, n, *explicit)
    base = method.method if isinstance(method, dvi.Adjoint) else method
    if isinstance(base, dvi.TypeII):
        parts = 1
    elif hasattr(method, "fractions") and isinstance(method.base, dvi.TypeII):
        parts = len(method.fractions())
    else:
        raise TypeError(f"what does a step of {method!r} cost? Say so in cost().")
    return Cost(parts, 3 / 2, n / 2)


def lobatto_cost(s, n, step_is_explicit, inverse_is_explicit) -> Cost:
    """Cost for s stages.

    The flags: whether p enters no rate of p, and q no rate of q (the P_i then suffice).
    """
    if s == 2 and step_is_explicit and inverse_is_explicit:
        return Cost(3.5, 0, 0)  # halves: one sweep of 2 + 1, 2 for Q, 2 at the end
    sweep = s - 1 / 2  # s halves for Q, s − 1 for P
    unknowns = (1 if inverse_is_explicit else 2) * (s - 1) * n
    end = s if inverse_is_explicit else s / 2  # forces, and velocities unless Q is an unknown
    return Cost(3 * sweep + end, 3 * sweep, unknowns * sweep)  # three sweeps for the guess


class Run(NamedTuple):
    """A compiled run ``(h, pieces) → (q, p, iterations, good)`` over ``PIECE * pieces`` steps."""

    function: Callable[..., Any]
    problem: Problem

    def __call__(self, num_steps):
        return self.function(self.problem.t_end / num_steps, num_steps // PIECE)

    def first_part(self, num_steps):
        """Pieces of a run of so many steps that take as long as SHORT; all, if they take less."""
        h, pieces, whole = self.problem.t_end / num_steps, 1, num_steps // PIECE
        while pieces < whole and self.seconds(h, pieces) < SHORT:
            pieces = min(2 * pieces, whole)
        return pieces

    def seconds(self, h, pieces):
        """The least time that so many pieces take [s]."""
        taken = []
        while sum(taken) < TAKEN or len(taken) < LEAST:
            begin = time.perf_counter()
            jax.block_until_ready(self.function(h, pieces))
            taken.append(time.perf_counter() - begin)
        return min(taken)


def compiled(method: dvi.Method, problem: Problem) -> Run:
    """The run, compiled once for all numbers of steps."""

    def run(h, pieces):
        def piece(k, state):
            q, p, iterations, good = state
            sol = dvi.integrate(
                problem.system,
                q,
                p,
                h=h,
                num_steps=PIECE,
                t0=k * PIECE * h,
                epsilon=problem.epsilon,
                args=problem.args,
                method=method,
                save=dvi.Save(final=True),
                adjoint=dvi.Direct(),
                newton=dvi.Newton(),  # whose iterations are priced
                throw=False,
            )
            iterations = iterations + sol.stats["newton_iterations"]
            return sol.qs[-1], sol.ps[-1], iterations, good & (sol.result == dvi.RESULTS.successful)

        start = (jnp.asarray(problem.q0), jnp.asarray(problem.p0), jnp.asarray(0, jnp.int32), True)
        return jax.lax.fori_loop(0, pieces, piece, start)

    return Run(jax.jit(run).lower(1.0, 1).compile(), problem)


class Point(NamedTuple):
    """One run: its size, its work and its error; `time` in runs of the reference method."""

    problem: str
    method: str
    order: int
    num_steps: int
    h: float
    newton_iterations: int
    evaluations: float
    error: float
    time: float = math.nan


def sweep(name, method_name, run: Run, truth: Reference, budgets) -> list[Point]:
    """The method at steps that meet the budgets [evaluations], until the floor is reached."""
    method, problem = METHODS[method_name], run.problem
    price, points, iterations = cost(method, problem), [], 3.0
    solves = price.evaluations(1, 0) != price.evaluations(1, 1)
    is_implicit = solves and not method.is_explicit(
        problem.system, jnp.asarray(problem.q0), problem.args
    )
    for budget in budgets:
        if is_implicit:  # from the iterations in a step that the last run took
            per_step = price.evaluations(1, iterations)
        else:
            per_step = price.of_step
        num_steps = PIECE * max(1, round(budget / per_step / PIECE))
        if points and num_steps <= points[-1].num_steps:
            continue
        q, p, used, good = run(num_steps)
        if not (bool(good) and np.isfinite(q).all()):
            continue  # a step that is too large for the solve, or a blow-up: no point
        iterations = int(used) / num_steps
        error = truth.error(np.asarray(q), np.asarray(p))
        work = price.evaluations(num_steps, int(used))
        h = problem.t_end / num_steps
        points.append(Point(name, method_name, method.order, num_steps, h, int(used), work, error))
        if sum(point.error < 3 * truth.floor for point in points) >= 2:
            break
    return points


def slope(points, floor, of="evaluations"):
    """The measured order: −d log error/d log `of`, fitted to the last three points that count.

    Those are the points with errors between 30 times the floor and 1e-2; NaN when there are
    fewer than two. For implicit methods `of` should be "num_steps": iterations in a step grow
    fewer as steps grow small, which makes the slope in evaluations steeper than the order.
    """
    kept = [p for p in points if 30 * floor < p.error < 1e-2][-3:]
    if len(kept) < 2:
        return math.nan
    x, y = (np.log([getattr(p, name) for p in kept]) for name in (of, "error"))
    return -float(np.polyfit(x, y, 1)[0])


def timed(points: list[Point], runs: dict[str, Run], rounds: int) -> list[Point]:
    """The points with their times, measured in turn, in another order each round."""
    shuffle = np.random.default_rng(0).permutation
    ratios: list[list[float]] = [[] for _ in points]

    def whole_run(method, num_steps, evaluations):
        """How to time it: the run, its step, pieces that are timed, and what to scale them by."""
        run = runs[method]
        h, pieces = run.problem.t_end / num_steps, run.first_part(num_steps)
        iterations = int(run.function(h, pieces)[2])
        part = cost(METHODS[method], run.problem).evaluations(PIECE * pieces, iterations)
        return run, h, pieces, evaluations / part

    say("  timing, how much of each run")
    run = runs[REFERENCE]
    iterations = int(run(REFERENCE_STEPS)[2])
    work = cost(METHODS[REFERENCE], run.problem).evaluations(REFERENCE_STEPS, iterations)
    unit = whole_run(REFERENCE, REFERENCE_STEPS, work)
    whole_runs = [whole_run(p.method, p.num_steps, p.evaluations) for p in points]
    for k in range(rounds):
        say(f"  timing, round {k + 1} of {rounds}")
        for i in shuffle(len(points)):
            one, other = (
                scale * run.seconds(h, pieces) for run, h, pieces, scale in (unit, whole_runs[i])
            )
            ratios[i].append(other / one)
    return [p._replace(time=statistics.median(r)) for p, r in zip(points, ratios, strict=True)]


def measure(name, methods, budgets, rounds) -> tuple[list[Point], Reference]:
    """All methods on one problem."""
    problem = PROBLEMS[name]()
    truth = reference(problem)
    say(f"{problem.title}: reference known to {truth.floor:.1e}")
    runs = {}
    points = []
    wanted = [REFERENCE, *(m for m in methods if m != REFERENCE)]
    for i, method in enumerate(wanted):
        begin = time.perf_counter()
        runs[method] = compiled(METHODS[method], problem)
        found = sweep(name, method, runs[method], truth, budgets)
        points += found if method in methods else []
        say(
            f"  {i + 1:2d}/{len(wanted)} {method}: {len(found)} points, slope "
            f"{slope(found, truth.floor, 'num_steps'):.2f}, {time.perf_counter() - begin:.1f} s"
        )
    return (timed(points, runs, rounds) if rounds else points), truth


def say(text):
    """Progress, out of the way of the tables."""
    print(text, file=sys.stderr, flush=True)


# Tables


def at_error(points, wanted, of):
    """`of` where the error crosses `wanted` for good, between points in logarithms; or NaN."""
    above = [i for i, p in enumerate(points) if p.error > wanted]
    last = above[-1] if above else -1
    if last < 0 or last + 1 >= len(points):
        return math.nan
    a, b = points[last : last + 2]
    share = math.log(a.error / wanted) / math.log(a.error / b.error)
    x, y = (math.log(getattr(p, of)) for p in (a, b))
    return math.exp(x + share * (y - x))


WANTED = (1e-4, 1e-7, 1e-10)


def table(points: list[Point], floors: dict[str, float]) -> str:
    """Markdown: work and time that each method needs for three errors, the least in bold."""
    lines = []
    for name in dict.fromkeys(p.problem for p in points):
        of_method: dict[str, list[Point]] = {}
        for p in points:
            if p.problem == name:
                of_method.setdefault(p.method, []).append(p)
        heads = [f"{kind} {e:.0e}" for kind in ("evals", "time") for e in WANTED]
        lines += [f"\n### {PROBLEMS[name]().title} (floor {floors[name]:.0e})\n"]
        lines += ["| method | order | slope | " + " | ".join(heads) + " |"]
        lines += ["|---|---|---|" + "---|" * len(heads)]
        columns = [(of, e) for of in ("evaluations", "time") for e in WANTED]
        values = {m: [at_error(ps, e, of) for of, e in columns] for m, ps in of_method.items()}
        best = [
            min((v[i] for v in values.values() if v[i] > 0), default=math.nan)
            for i in range(len(columns))
        ]
        for m, row in values.items():
            cells = []
            for (of, _), x, least in zip(columns, row, best, strict=True):
                text = (
                    "–" if math.isnan(x) else (f"{x:,.0f}" if of == "evaluations" else f"{x:.3g}")
                )
                cells.append(f"**{text}**" if x == least else text)
            measured = slope(of_method[m], floors[name], "num_steps")
            shown = "–" if math.isnan(measured) else f"{measured:.2f}"
            lines.append(f"| {m} | {METHODS[m].order} | {shown} | " + " | ".join(cells) + " |")
    return "\n".join(lines).lstrip() + "\n"


def write_csv(path: Path, points: list[Point]) -> None:
    """One row for each point."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(Point._fields)
        writer.writerows(points)


def read_csv(path: Path) -> list[Point]:
    """The points that `write_csv` wrote."""
    kinds = Point.__annotations__
    with path.open(newline="", encoding="utf-8") as file:
        return [
            Point(**{name: kinds[name](text) for name, text in row.items()})
            for row in csv.DictReader(file)
        ]


# Pictures

STYLES = {
    "TypeII": ("#999999", "o"),
    "Adjoint": ("#CC79A7", "x"),
    "Strang": ("#000000", "s"),
    "Yoshida": ("#E69F00", "^"),
    "Suzuki": ("#CC79A7", "v"),
    "BlanesMoan": ("#0072B2", "D"),
    "McLachlan": ("#56B4E9", "P"),
    "KahanLi": ("#009E73", "*"),
    "GaussLegendre": ("#D55E00", "o"),
    "LobattoIIIAIIIB": ("#6A3D9A", "p"),
    "RungeKutta": ("#999999", "X"),
}
"""Colour (Okabe & Ito, and a violet) and marker of each family."""

BEST: dict[str, Any] = {"color": "0.8", "lw": 5, "solid_capstyle": "round"}
SLOPE: dict[str, Any] = {"color": "0.3", "lw": 1, "ls": ":"}
SHADED = "0.92"

GROUPS = {"order 1 and 2": (1, 2), "order 4": (4,), "order 6": (6,), "order 8": (8,)}


def picture(points: list[Point], floor: float) -> plt.Figure:
    """Error against evaluations (above) and time (below), one column for each order.

    In grey the best of all methods at each work, in every panel the same; dotted the slope of the
    order; errors below that of the reference, `floor`, shaded.
    """
    axes_of = {
        "evaluations": "evaluations of ∇H",
        "time": f"time [{REFERENCE_STEPS} steps of {REFERENCE}]",
    }
    has_time = any(not math.isnan(p.time) for p in points)
    rows = list(axes_of)[: 2 if has_time else 1]
    figure, axes = plt.subplots(
        len(rows),
        len(GROUPS),
        figsize=(12.5, 3.4 * len(rows) + 0.4),
        sharey=True,
        sharex="row",
        squeeze=False,
        dpi=110,
        layout="constrained",
    )
    for of, row in zip(rows, axes, strict=True):
        best = envelope([p for p in points if p.error > floor], of)
        for (title, orders), ax in zip(GROUPS.items(), row, strict=True):
            inside = [p for p in points if p.order in orders]
            ax.loglog(*best, **BEST, zorder=1)
            for method in dict.fromkeys(p.method for p in inside):
                mine = [p for p in inside if p.method == method]
                colour, marker = STYLES[method.rstrip("0123456789")]
                ax.loglog(
                    [getattr(p, of) for p in mine],
                    [p.error for p in mine],
                    color=colour,
                    marker=marker,
                    ms=4,
                    lw=1.3,
                    label=method.replace("LobattoIIIAIIIB", "Lobatto "),
                )
            ax.axhspan(1e-16, floor, color=SHADED, zorder=-1)
            if of == "evaluations":
                ax.set_title(title, fontsize=10, loc="left")
                for order in orders:
                    guide(ax, inside, order)
            ax.set_xlabel(axes_of[of])
            ax.grid(True, which="major", color="0.93", lw=0.6)
            ax.set_axisbelow(True)
            if ax in axes[0] and inside:
                ax.legend(fontsize=7, frameon=False, loc="lower left", handlelength=1.8)
            ax.spines[["top", "right"]].set_visible(False)
        row[0].set_ylabel("relative error at the end")
    axes[0, 0].set_ylim(floor / 8, 1)
    title = PROBLEMS[points[0].problem]().title
    figure.suptitle(f"Error against work: {title}", fontsize=11, weight="bold", x=0.01, ha="left")
    entries = [
        Line2D([], [], label="best of all methods", **BEST),
        Line2D([], [], label="slope of the order", **SLOPE),
        Patch(label="below the error of the reference solution", color=SHADED),
    ]
    figure.legend(handles=entries, loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    return figure


def envelope(points, of):
    """The least error that any method has at work up to each point's: two arrays."""
    ordered = sorted((getattr(p, of), p.error) for p in points)
    work, error = np.array(ordered).T
    least = np.minimum.accumulate(error)
    kept = np.concatenate([[True], np.diff(least) < 0])
    return work[kept], least[kept]


def guide(ax, points, order):
    """A dotted line of the slope of the order, next to the last points of that order."""
    mine = [p for p in points if p.order == order and 1e-9 < p.error < 1e-1]
    if not mine:
        return
    right = max(mine, key=lambda p: p.evaluations)
    x = right.evaluations * np.array([0.25, 1.0]) * 2
    ax.loglog(x, right.error * (x / right.evaluations / 2) ** -order, **SLOPE)
    ax.annotate(
        f" {order}", (x[1], right.error), fontsize=8, color="0.3", va="center", annotation_clip=True
    )


def save(figure, path: Path) -> None:
    """As SVG, and as PNG with a palette of 256 colours, half the size."""
    figure.savefig(path.with_suffix(".svg"))
    figure.canvas.draw()
    picture = Image.fromarray(np.asarray(figure.canvas.buffer_rgba())).convert("RGB")
    picture.quantize(256, dither=Image.Dither.NONE).save(path.with_suffix(".png"), optimize=True)


# The command


def budgets(least, most, ratio):
    """Budgets in evaluations, geometric."""
    count = round(math.log(most / least, ratio)) + 1
    return np.geomspace(least, most, count)


def main(words=None):
    """Measure, write tables and pictures; returns the points and the floors."""
    parser = argparse.ArgumentParser(
        description="Error against evaluations and time, for every method on three problems."
    )
    parser.add_argument("--out", type=Path, required=True, help="folder for tables and pictures")
    parser.add_argument("--problem", choices=PROBLEMS, action="append", help="only this (repeat)")
    parser.add_argument("--method", choices=METHODS, action="append", help="only this (repeat)")
    parser.add_argument(
        "--redraw", action="store_true", help="measure nothing, take the CSV file in the folder"
    )
    parser.add_argument("--rounds", type=int, default=7, help="of timing; 0 for none (default 7)")
    parser.add_argument(
        "--quick", action="store_true", help="Hénon–Heiles, fewer steps, one round of timing"
    )
    options = parser.parse_args(words)
    if options.rounds < 0:
        parser.error(f"--rounds must not be negative, got {options.rounds}.")
    names = options.problem or (["henon_heiles"] if options.quick else list(PROBLEMS))
    rounds = min(options.rounds, 1) if options.quick else options.rounds
    work = budgets(2**8, 2**16, 2**0.5) if options.quick else budgets(2**7, 2**18, 2**0.5)
    methods = [m for m in METHODS if options.method is None or m in options.method]

    options.out.mkdir(parents=True, exist_ok=True)
    file = options.out / "work_precision.csv"
    known = read_csv(file) if options.redraw else []
    if options.redraw:
        names = list(dict.fromkeys(point.problem for point in known))
    points: list[Point] = []
    floors = {}
    for name in names:
        if options.redraw:
            found, truth = [p for p in known if p.problem == name], reference(PROBLEMS[name]())
        else:
            found, truth = measure(name, methods, work, rounds)
        points += found
        floors[name] = truth.floor
        figure = picture(found, truth.floor)
        save(figure, options.out / f"work_precision_{name}")
        plt.close(figure)
    write_csv(file, points)
    text = table(points, floors)
    (options.out / "work_precision.md").write_text(text, encoding="utf-8")
    print(text)
    return points, floors


if __name__ == "__main__":
    plt.switch_backend("agg")
    main()
