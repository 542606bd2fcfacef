"""Explicit adaptive steps: Kepler's problem with eccentricity 0.99, and close encounters.

Three tables and, with --picture, one picture. Adaptive steps are those of `AdaptiveReversible`,
with g = r^{3/2} for Kepler's problem and the time scale of encounters for three bodies.

1. Energy over 10⁵ revolutions, in ten runs, each continued by the ``resume_h`` of the one before:
   largest minus smallest energy in the first, the second and the last tenth. Next to it the number
   of constant steps with the same range of energy in three revolutions, and the ratio of the
   evaluated forces.
2. Processor time and range of energy next to the implicit steps of `TimeTransformed`, with the same
   g and the same number of steps in each revolution, and with steps for the same error.
3. The figure eight, periodic and with slowed bodies that meet closely, and the Pythagorean problem:
   differences from REBOUND's IAS15 and from a Taylor series of order 24 with 24 digits
   (python-flint), which is independent of both. IAS15 is run with two tolerances.

4. Processor time of an adaptive step, divided by that of a constant one, for one trajectory and in
   a batch of 512: Kepler's problem with eccentricity 0.5, and the figure eight.

The picture has the error of the position after ten revolutions against the processor time, for
this package, IAS15 and diffrax's Dopri8; and the error of the energy over 10⁵ revolutions.

Times are processor times on one core, without compilation: that of a longer run minus that of a
shorter one; the median of several, because the clock of a virtual machine can jump.

Run: python benchmarks/adaptive_steps.py [--picture FILE]      (2 minutes)
"""

import argparse
import functools
import statistics
import time

import jax
import jax.numpy as jnp
import numpy as np
from _taylor import taylor
from scipy.optimize import brentq

import dvi_jax as dvi
import lanewise
from dvi_jax import systems
from dvi_jax.systems.figure_eight import PERIOD
from dvi_jax.systems.n_body import encounter_time

jax.config.update("jax_enable_x64", True)

ECCENTRICITY = 0.99
KEPLER = dvi.System(dvi.discretise(lambda t, q, p, args: p @ p / 2 - 1 / jnp.sqrt(q @ q)))
APOCENTRE = (
    [-(1 + ECCENTRICITY), 0.0],
    [0.0, -float(np.sqrt((1 - ECCENTRICITY) / (1 + ECCENTRICITY)))],
)
PERICENTRE = (
    [1 - ECCENTRICITY, 0.0],
    [0.0, float(np.sqrt((1 + ECCENTRICITY) / (1 - ECCENTRICITY)))],
)
"""States of an orbit with the semi-major axis 1."""

METHODS = {"Strang": (dvi.Strang(), 400), "McLachlan(4)": (dvi.McLachlan(4), 100)}
METHODS |= {"KahanLi(8)": (dvi.KahanLi(8), 50)}
"""Methods, and their steps in a revolution."""


def speed(t, q, p, args):
    """g = r^{3/2}."""
    r = jnp.sqrt(q @ q)
    return r * jnp.sqrt(r)


def energy(q, p):
    """H of Kepler's problem."""
    return p @ p / 2 - 1 / jnp.sqrt(q @ q)


EXPLICIT, IMPLICIT = dvi.AdaptiveReversible(speed), dvi.TimeTransformed(speed)
ENCOUNTERS = dvi.AdaptiveReversible(encounter_time)


def fictitious_period() -> float:
    """∮ dt/g over one revolution."""
    E = 2 * np.pi * np.arange(20_000) / 20_000
    return float(2 * np.pi * np.mean((1 - ECCENTRICITY * np.cos(E)) ** -0.5))


def run(method, n, revolutions, lattice=EXPLICIT, start=APOCENTRE, h=None, **settings):
    """`revolutions` times n steps, of one revolution in g or (constant) in t; range of energy."""
    period = 2 * np.pi if lattice is None else fictitious_period()
    settings = {"save": dvi.Save(final=True), "observe": dvi.Range(energy)} | settings
    sol = dvi.integrate(
        KEPLER,
        *start,
        h=period / n if h is None else h,
        num_steps=n * revolutions,
        method=method,
        lattice=lattice,
        **settings,
    )
    return jax.block_until_ready(sol)


def forces(method) -> int:
    """Forces in a step: those of a kick at the end and at the beginning are evaluated twice."""
    return len(method.substeps())


# 1. Energy over many revolutions


def tenths(method, n, revolutions):
    """Ranges of energy in ten runs, each the continuation of the one before, and the times."""
    start, h, t0, ranges = APOCENTRE, None, 0.0, []
    for _ in range(10):
        sol = run(method, n, revolutions // 10, start=start, h=h, t0=t0)
        ranges.append(float(sol.observed))
        start, h, t0 = (sol.qs[-1], sol.ps[-1]), sol.stats["resume_h"], sol.ts[-1]
    return ranges


def constant_steps(method, error, n=4096):
    """The number of constant steps in a revolution for this range of energy, interpolated."""
    known = None
    while True:
        found = float(run(method, n, 3, lattice=None).observed)
        if found <= error and known is not None:
            part = np.log(known / error) / np.log(known / found)
            return round(n / 2 * 2**part)
        known, n = found, 2 * n


def long_runs(revolutions):
    """The first table."""
    print(f"\nKepler, e = {ECCENTRICITY}, {revolutions} revolutions: range of energy (E = -0.5)")
    print("| method | steps | first tenth | second | last | constant steps | ratio of forces |")
    print("|---|---|---|---|---|---|---|")
    for name, (method, n) in METHODS.items():
        ranges = tenths(method, n, revolutions)
        constant = constant_steps(method, max(ranges))
        shown = " | ".join(f"{ranges[i]:.9e}" for i in (0, 1, -1))
        print(f"| {name} | {n} | {shown} | {constant} | {constant / n:.0f} |", flush=True)


# 2. Time, next to implicit adaptive steps


def seconds(make, short, long, rounds=3):
    """Processor time of one revolution, from runs of two lengths."""
    middle = []
    for revolutions in (short, long):
        make(revolutions)
        taken = []
        for _ in range(rounds):
            begin = time.process_time()
            make(revolutions)
            taken.append(time.process_time() - begin)
        middle.append(statistics.median(taken))
    return (middle[1] - middle[0]) / (long - short)


def measured(method, n, lattice, start=APOCENTRE):
    """Microseconds of a revolution, and the range of energy in 200 revolutions."""
    found = float(run(method, n, 200, lattice, start).observed)
    short, long = (500, 5000) if lattice is EXPLICIT else (100, 700)

    def make(revolutions):
        return run(method, n, revolutions, lattice, start)

    return 1e6 * seconds(make, short, long), found


def against_implicit():
    """The second table."""
    print("\nExplicit and implicit adaptive steps: processor time [µs] of a revolution")
    print("| method | steps | explicit: time, range of E | implicit | ratio | for equal errors |")
    print("|---|---|---|---|---|---|")
    rows = [(name, APOCENTRE) for name in METHODS] + [("Strang", PERICENTRE)]
    for name, start in rows:
        method, n = METHODS[name]
        (ours, error), (theirs, wanted) = (
            measured(method, n, lattice, start) for lattice in (EXPLICIT, IMPLICIT)
        )
        equal = ours / theirs * (error / wanted) ** (1 / method.order)
        shown = f"{ours:.1f}, {error:.1e} | {theirs:.1f}, {wanted:.1e} | {ours / theirs:.2f}"
        name += " from the pericentre" * (start is PERICENTRE)
        print(f"| {name} | {n} | {shown} | {equal:.2f} |", flush=True)


# 3. Close encounters


def ias15(problem, times, epsilon=1e-9):
    """Positions of the bodies at the times by REBOUND's IAS15, shape (times, bodies, 2)."""
    import rebound

    simulation = rebound.Simulation()
    simulation.integrator = "ias15"
    options = getattr(simulation, "ri_ias15", simulation.integrator)  # before and since REBOUND 5
    options.epsilon = epsilon
    for m, q, p in zip(problem.args["masses"], problem.q0, problem.p0, strict=True):
        simulation.add(m=m, x=q[0], y=q[1], vx=p[0] / m, vy=p[1] / m)
    found = []
    for t in times:
        simulation.integrate(t)
        found.append([[body.x, body.y] for body in simulation.particles])
    return np.array(found)


def encounters(problem, times, h, arithmetic=dvi.FloatingPoint()):
    """The same by `KahanLi(8)` with adaptive steps, and the number of steps."""
    a = {"problem": problem, "h": h, "arithmetic": arithmetic}
    counted = _encounters(**a, save=dvi.Save(every=1), num_steps=20_000)
    steps = int(np.sum(np.asarray(counted.ts) < times[-1]))
    sol = _encounters(**a, save=dvi.Save(ts=times), num_steps=steps + 8)
    return np.asarray(sol.qs), steps


def _encounters(problem, **settings):
    start = {"q0": problem.q0, "p0": problem.p0, "args": problem.args}
    how = {"method": dvi.KahanLi(8), "lattice": ENCOUNTERS}
    return dvi.integrate(problem.system, **start, **how, **settings)


@functools.cache
def eight(factor):
    """The figure eight with the velocities times a factor."""
    problem = systems.figure_eight()
    start = problem.q0, factor * problem.p0
    return systems.n_body(problem.args["masses"], *start)


CASES = {
    "figure eight, 10 periods": (
        lambda: eight(1.0),
        PERIOD * np.arange(1, 11),
        0.2,
        "FloatingPoint",
    ),
    "figure eight, half velocities": (
        lambda: eight(0.5),
        [5.0, 10.0, 15.0, 20.0],
        0.1,
        "Compensated",
    ),
    "Pythagorean": (systems.pythagorean, [20.0, 40.0, 50.0, 60.0], 0.03, "DoubleDouble"),
}
"""Problem, times, δ, arithmetic."""


def close_encounters():
    """The third table."""
    print("\nThree bodies: largest difference of a position from the Taylor series at each time")
    print("| problem | t | this package (steps) | IAS15, epsilon = 1e-9 | IAS15, 1e-11 |")
    print("|---|---|---|---|---|")
    for name, (make, times, h, arithmetic) in CASES.items():
        exact = taylor(make(), times)
        ours, steps = encounters(make(), times, h, getattr(dvi, arithmetic)())
        rows = [ours, ias15(make(), times), ias15(make(), times, 1e-11)]
        off = [np.abs(x - exact).max((1, 2)) for x in rows]
        for i in range(0, len(times), 3 if len(times) > 4 else 1):
            shown = [f"{x[i]:.1e}" for x in off]
            shown[0] += f" ({arithmetic}, {steps})"
            print(f"| {name} | {times[i]:.4g} | {' | '.join(shown)} |", flush=True)


# 4. The cost of a step

SLOW_KEPLER = systems.Problem(
    "kepler", KEPLER, np.array([0.5, 0.0]), np.array([0.0, np.sqrt(3.0)]), h=0.02
)


def cost(problem, method, lattice, batch, num_steps):
    """Processor time of a step of one trajectory [ns]."""
    scale = 1 + 1e-3 * jnp.arange(batch) / batch

    def end(factor):
        sol = dvi.integrate(
            problem.system,
            factor * problem.q0,
            factor * problem.p0,
            args=problem.args,
            h=0.02,
            num_steps=num_steps,
            method=method,
            lattice=lattice,
            save=dvi.Save(final=True),
            throw=False,
        )
        return sol.qs[-1], sol.result

    every = jax.jit(jax.vmap(end)) if batch > 1 else jax.jit(lambda factors: end(factors[0]))
    taken = []
    for _ in range(6):  # the first one compiles
        begin = time.process_time()
        jax.block_until_ready(every(scale))
        taken.append(time.process_time() - begin)
    return 1e9 * statistics.median(taken[1:]) / batch / num_steps


def costs():
    """The fourth table."""
    print("\nProcessor time [ns] of a step: adaptive, constant, ratio")
    print("| problem | method | alone | in a batch of 512 |")
    print("|---|---|---|---|")
    cases = {"Kepler": (SLOW_KEPLER, EXPLICIT), "figure eight": (eight(1.0), ENCOUNTERS)}
    for name, (problem, lattice) in cases.items():
        for method in (dvi.Strang(), dvi.KahanLi(8)):
            shown = []
            for batch, num_steps in ((1, 300_000), (512, 3000)):
                grids = (lattice, dvi.Uniform())
                a, b = (cost(problem, method, grid, batch, num_steps) for grid in grids)
                shown.append(f"{a:.1f}, {b:.1f}, {a / b:.2f}")
            print(f"| {name} | {type(method).__name__} | {' | '.join(shown)} |", flush=True)


# The picture


def exact_place(t):
    """The position at t on the orbit that begins at the apocentre."""
    e, M = ECCENTRICITY, (t + np.pi) % (2 * np.pi)
    E = brentq(lambda E: E - e * np.sin(E) - M, -1, 7, xtol=1e-15)
    return np.array([np.cos(E) - e, np.sqrt(1 - e * e) * np.sin(E)])


TIME = 20 * np.pi + 1.0
"""Ten revolutions and a part of one, so that the body is not at an apsis."""


def peers():
    """Installed packages: name → (function of a tolerance, like `ours`; tolerances)."""
    found = {}
    try:
        import rebound

        def by_rebound(tolerance):
            def prepare():
                simulation = rebound.Simulation()
                simulation.integrator = "ias15"
                options = getattr(simulation, "ri_ias15", simulation.integrator)
                options.epsilon = tolerance
                simulation.add(m=1.0)
                (x, y), (u, v) = APOCENTRE
                simulation.add(m=0.0, x=x, y=y, vx=u, vy=v)
                return simulation

            def go(simulation):
                simulation.integrate(TIME)
                sun, body = simulation.particles
                return np.array([body.x - sun.x, body.y - sun.y])

            return prepare, go

        found["REBOUND IAS15"] = by_rebound, [1e-4, 1e-6, 1e-8, 1e-9]
    except ImportError:
        pass
    try:
        import diffrax

        def field(t, z, args):
            r = jnp.sqrt(z[0] ** 2 + z[1] ** 2)
            return jnp.concatenate([z[2:], -z[:2] / r**3])

        @jax.jit
        def solved(tolerance):
            sol = diffrax.diffeqsolve(
                diffrax.ODETerm(field),
                diffrax.Dopri8(),
                0.0,
                TIME,
                None,
                jnp.concatenate([jnp.asarray(x) for x in APOCENTRE]),
                stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
                max_steps=100_000,
            )
            assert sol.ys is not None
            return sol.ys[0, :2]

        def by_diffrax(tolerance):
            return lambda: tolerance, lambda tolerance: np.asarray(solved(tolerance))

        found["diffrax Dopri8"] = by_diffrax, [1e-4, 1e-6, 1e-8, 1e-10, 1e-12, 1e-13]
    except ImportError:
        pass
    return found


def ours(method, lattice, n):
    """Functions that prepare a run by n steps in a revolution, and that return its position."""
    period = 2 * np.pi if lattice is None else fictitious_period()
    count = round(10.6 * n)  # the last part has fewer steps than its fraction of t
    save = dvi.Save(ts=np.array([TIME]))

    def solved(h):
        start = {"q0": APOCENTRE[0], "p0": APOCENTRE[1]}
        how = {"method": method, "lattice": lattice, "save": save, "throw": False}
        return dvi.integrate(KEPLER, **start, h=h, num_steps=count, **how).qs[0]

    compiled = jax.jit(solved)
    return lambda: period / n, lambda h: np.asarray(compiled(h))


def points(make, sizes):
    """(time in milliseconds, relative error of the position) for each size."""
    found = []
    exact = exact_place(TIME)
    for size in sizes:
        prepare, go = make(size)
        place, taken = go(prepare()), []
        for _ in range(5):
            prepared, begin = prepare(), time.process_time()
            go(prepared)
            taken.append(time.process_time() - begin)
        found.append(
            (1e3 * statistics.median(taken), np.linalg.norm(place - exact) / np.linalg.norm(exact))
        )
    return np.array(found).T


def picture(file, revolutions):
    """Error against time, and error of the energy over many revolutions."""
    import matplotlib.pyplot as plt

    from dvi_jax.plot.style import COLOURS, MARKERS

    plt.switch_backend("agg")
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.6, 4.4), dpi=110, layout="constrained")
    lines = {
        "KahanLi(8), AdaptiveReversible": (
            dvi.KahanLi(8),
            EXPLICIT,
            [24, 32, 48, 64, 96, 128, 192],
        ),
        "Strang, AdaptiveReversible": (dvi.Strang(), EXPLICIT, [200, 800, 3200, 12800, 51200]),
        "KahanLi(8), TimeTransformed": (dvi.KahanLi(8), IMPLICIT, [24, 32, 48, 64, 96]),
        "KahanLi(8), constant steps": (dvi.KahanLi(8), None, [2000, 4000, 8000, 16000, 32000]),
    }
    drawn = {
        name: points(functools.partial(ours, method, lattice), sizes)
        for name, (method, lattice, sizes) in lines.items()
    }
    drawn |= {name: points(*peer) for name, peer in peers().items()}
    for i, (name, (taken, error)) in enumerate(drawn.items()):
        look = {"color": COLOURS[i % len(COLOURS)], "marker": MARKERS[i], "ms": 4, "lw": 1.3}
        left.loglog(taken, error, label=name, **look)
        print(
            f"{name}: "
            + ", ".join(f"{a:.2g} ms {b:.1e}" for a, b in zip(taken, error, strict=True))
        )
    left.set(xlabel="processor time [ms]", ylabel="relative error of the position", ylim=(1e-13, 1))
    left.set_title("after ten revolutions", fontsize=10, loc="left")
    counts = [10, 100, 1000, 10_000, 100_000]
    counts = [n for n in counts if n <= revolutions]
    for i, (name, (method, n)) in enumerate(METHODS.items()):
        off = [float(run(method, n, m, observe=dvi.MaxDrift(energy)).observed) for m in counts]
        look = {"color": COLOURS[i], "marker": MARKERS[i], "ms": 4, "lw": 1.3}
        right.loglog(counts, off, label=f"{name}, {n} steps", **look)
    right.set(xlabel="revolutions", ylabel="largest error of the energy so far", ylim=(1e-6, 1))
    right.set_title("AdaptiveReversible, E = −0.5", fontsize=10, loc="left")
    for axis in (left, right):
        axis.grid(True, which="major", color="0.93", lw=0.6)
        axis.set_axisbelow(True)
        axis.spines[["top", "right"]].set_visible(False)
    right.legend(fontsize=8, frameon=False)
    figure.legend(
        *left.get_legend_handles_labels(),
        loc="outside lower left",
        ncols=3,
        fontsize=8,
        frameon=False,
    )
    figure.suptitle(f"Kepler's problem, e = {ECCENTRICITY}", fontsize=11, x=0.01, ha="left")
    figure.savefig(file)
    plt.close(figure)


def main(words=None):
    """Print the tables; draw the picture."""
    parser = argparse.ArgumentParser(description="Explicit adaptive steps: error, time, drift.")
    parser.add_argument("--picture", help="file of the picture")
    parser.add_argument("--revolutions", type=int, default=100_000, help="default 100000")
    parser.add_argument("--only", choices=["long", "implicit", "encounters", "cost"])
    options = parser.parse_args(words)
    lanewise.set_threads(1)
    if options.only in (None, "long"):
        long_runs(options.revolutions)
    if options.only in (None, "implicit"):
        against_implicit()
    if options.only in (None, "encounters"):
        close_encounters()
    if options.only in (None, "cost"):
        costs()
    if options.picture:
        picture(options.picture, options.revolutions)


if __name__ == "__main__":
    main()
