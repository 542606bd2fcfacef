"""Close encounters and chaos in `WisdomHolman` against REBOUND: energy, MEGNO, times of escape.

    python benchmarks/encounters.py [--rows energy megno escapes] [--check] [--picture FILE]

`energy`: largest and median relative energy error of three problems. `megno`: two planets at eight
distances and two eccentricities. `escapes`: times at which the first of three planets is 20 times
as far from the star as the innermost at first, for 128 systems in each program, drawn with other
seeds from one distribution; their distributions are compared by a Kolmogorov–Smirnov test.
`--check` exits with 1 if a limit is exceeded. Requires the extra interop.
"""

import argparse
import sys

import jax
import jax.numpy as jnp
import numpy as np
import rebound
from scipy.stats import ks_2samp

import dvi_jax as dvi
from dvi_jax import elements, systems

jax.config.update("jax_enable_x64", True)

YEAR = 2 * np.pi
FINAL = dvi.Save(final=True)


def problem_of(masses, orbits, h, G=1.0):
    q, p = elements.to_bodies(orbits, masses, G=G)
    return systems.n_body(masses, q, p, h=h, G=G)


def heavy_planets():
    """Jupiter and Saturn with 50 times their masses, which scatter (Duncan, Levison & Lee 1998)."""
    outer = systems.outer_solar_system()
    masses, q = np.array(outer.args["masses"])[:3], np.array(outer.q0)[:3]
    v = np.array(outer.p0)[:3] / masses[:, None]
    masses[1:] *= 50
    q, v = (x - masses @ x / masses.sum() for x in (q, v))
    return systems.n_body(masses, q, masses[:, None] * v, h=40.0, G=outer.args["G"]), 40_000


def three_jupiters():
    numbers = np.arange(3.0)
    a, e, inc = np.array([[5.0, 6.7, 9.0], [0.02, 0.05, 0.03], [0.01, 0.02, 0.03]])
    orbits = elements.Keplerian(a, e, inc, numbers, numbers, 2 * numbers)
    G = systems.outer_solar_system().args["G"]
    return problem_of(np.array([1.0, 1e-3, 1e-3, 1e-3]), orbits, 100.0, G), 100_000


def comet():
    """A planet with e = 0.98 inside of the orbit of another one; 25 steps in its revolution would
    be 0.2 at the angular velocity of its pericentre."""
    orbits = elements.Keplerian(np.array([1.0, 5.2]), np.array([0.98, 0.05]), 0.01, 1.0, 2.0, 2.0)
    return problem_of(np.array([1.0, 1e-3, 1e-3]), orbits, 0.05), 40_000


PROBLEMS = {f.__name__: f for f in (heavy_planets, three_jupiters, comet)}


def simulation(problem, q, p, integrator):
    sim, masses = rebound.Simulation(), np.asarray(problem.args["masses"])
    sim.G, sim.integrator, sim.dt = float(problem.args["G"]), integrator, float(problem.h)
    for m, x, v in zip(masses, np.asarray(q), np.asarray(p) / masses[:, None], strict=True):
        names = ("x", "y", "z", "vx", "vy", "vz")
        sim.add(m=float(m), **dict(zip(names, map(float, (*x, *v)), strict=True)))
    return sim


def error_of_rebound(problem, steps, integrator, every=50):
    """The largest and the median relative energy error."""
    sim = simulation(problem, problem.q0, problem.p0, integrator)
    start, errors = sim.energy(), []
    for k in range(1, steps // every + 1):
        sim.integrate(every * k * problem.h, exact_finish_time=0)
        errors.append(abs(sim.energy() / start - 1))
    return max(errors), float(np.median(errors))


def error_of_ours(problem, steps, every=50, **switches):
    """The same, and the statistics of the run."""
    sol = dvi.integrate(
        problem, num_steps=steps, method=dvi.WisdomHolman("democratic", **switches),
        save=dvi.Save(every=every), observe={"energy": problem.observables["energy"]},
    )  # fmt: skip
    energy = np.asarray(sol.observed["energy"])
    errors = np.abs(energy / energy[0] - 1)
    return (errors.max(), float(np.median(errors))), sol.stats


def energy():
    """Largest and median energy errors."""
    for name, function in PROBLEMS.items():
        problem, steps = function()
        switches = {"encounters": 3.0} | ({"pericentres": 1.0} if name == "comet" else {})
        ours, stats = error_of_ours(problem, steps, **switches)
        theirs = {x: error_of_rebound(problem, steps, x) for x in ("trace", "mercurius", "whfast")}
        names = {"encounter_steps", "pericentre_steps"} & set(stats)
        switched = {x: int(stats[x]) for x in sorted(names)}
        texts = [f"{x} {worst:.1e}, {middle:.1e}" for x, (worst, middle) in theirs.items()]
        text = f"{name}: {ours[0]:.1e}, {ours[1]:.1e} {switched}; {'; '.join(texts)}"
        is_good = all(x < 3 * y for x, y in zip(ours, theirs["trace"], strict=True))
        # The control: of the other two one loses the energy.
        control = max(theirs["mercurius"][0], theirs["whfast"][0])
        yield text, is_good and control > 1000 * ours[0]


def megno():
    """MEGNO after 1000 revolutions of the inner planet."""
    masses, steps = np.array([1.0, 1e-3, 1e-3]), 25_000
    for ratio in (1.35, 1.4, 1.45, 1.5, 1.55, 1.6, 1.8, 2.0):
        for e in (0.05, 0.1):
            a, zero = np.array([1.0, ratio]), np.zeros(2)
            angles = (np.array([0.0, 1.0]), np.array([0.0, 2.0]), np.array([1.0, 4.0]))
            orbits = elements.Keplerian(a, e + zero, np.array([0.0, 0.01]), *angles)
            problem = problem_of(masses, orbits, YEAR / 25)
            sol = dvi.integrate(
                problem, num_steps=steps, method=dvi.WisdomHolman(), observe=dvi.MEGNO(), save=FINAL
            )
            sim = simulation(problem, problem.q0, problem.p0, "whfast")
            sim.init_megno(seed=1)
            sim.integrate(steps * problem.h)
            ours, theirs = float(sol.observed), sim.megno()
            same = (ours > 10) == (theirs > 10) and (ours > 10 or abs(ours - theirs) < 0.2)
            yield f"a = {ratio}, e = {e}: {ours:.2f}, REBOUND {theirs:.2f}", same


MASSES = np.array([1.0, 1e-2, 1e-2, 1e-2])


def draw(count, seed):
    """Initial states of systems of three planets, which are unstable."""
    random = np.random.default_rng(seed)
    a = np.array([1.0, 1.35, 1.82]) * np.ones((count, 1))
    e, inc = random.uniform(0, 0.05, (count, 3)), random.uniform(0, 0.03, (count, 3))
    orbits = elements.Keplerian(a, e, inc, *random.uniform(0, YEAR, (3, count, 3)))
    return jax.vmap(lambda orbits: elements.to_bodies(orbits, MASSES))(orbits)


def beyond(q, p):
    return jnp.max(jnp.sum((q[1:] - q[:1]) ** 2, axis=1)) - 400.0


def times_of_ours(count, seed, steps):
    """Times at which a planet leaves, the end of the run for systems that none leaves; statuses."""
    q, p = draw(count, seed)
    problem = systems.n_body(MASSES, q[0], p[0], h=YEAR / 20)
    method = dvi.WisdomHolman("democratic", encounters=3.0, pericentres=1.0)
    run = {"method": method, "num_steps": steps, "save": FINAL, "stop": dvi.Stop(beyond)}
    sol = jax.jit(jax.vmap(lambda q, p: dvi.integrate(problem, q, p, throw=False, **run)))(q, p)
    return np.nan_to_num(np.asarray(sol.stop.t), nan=steps * YEAR / 20), sol.status


def times_of_rebound(count, seed, steps, integrator="trace"):
    q, p = draw(count, seed)
    problem, end, times = systems.n_body(MASSES, q[0], p[0], h=YEAR / 20), steps * YEAR / 20, []
    for x, y in zip(q, p, strict=True):
        sim = simulation(problem, x, y, integrator)
        is_inside = True
        while is_inside and sim.t < end:
            sim.integrate(min(sim.t + 2.0, end), exact_finish_time=0)
            places = np.array([[b.x, b.y, b.z] for b in sim.particles])
            is_inside = beyond(places, None) < 0
        times.append(end if is_inside else sim.t)
    return np.array(times)


def escapes(count=128, steps=10_000):
    """Times of escape within 500 revolutions."""
    ours, status = times_of_ours(count, 1, steps)
    theirs = times_of_rebound(count, 2, steps)
    end = steps * YEAR / 20
    kinds, numbers = np.unique(status, return_counts=True)
    statuses = dict(zip(map(str, kinds), map(int, numbers), strict=True))
    test = ks_2samp(ours, theirs)
    text = f"escaped: {np.mean(ours < end):.2f}, TRACE {np.mean(theirs < end):.2f}; median time"
    text += f" / 2π: {np.median(ours) / YEAR:.0f}, {np.median(theirs) / YEAR:.0f}; {statuses}; "
    is_good = set(statuses) <= {"successful", "stopped"}
    yield f"{text}Kolmogorov–Smirnov p = {test.pvalue:.2f}", is_good and test.pvalue > 0.01


ROWS = {f.__name__: f for f in (energy, megno, escapes)}


def picture(path):
    """Distance and energy error of two planets that meet, and the steps with a close pair."""
    import matplotlib.pyplot as plt

    masses, steps = np.array([1.0, 1e-3, 1e-3]), 90
    q = np.array([[-0.0016, 0.0003, 0.0], [0.2176, -0.8012, -0.0028], [1.3448, 0.4861, 0.0091]])
    v = np.array([[-0.0007, -0.0012, 0.0], [1.0603, 0.4562, -0.0042], [-0.406, 0.732, 0.0041]])
    problem = systems.n_body(masses, q, masses[:, None] * v, h=0.1)
    methods = [dvi.WisdomHolman("democratic", encounters=x) for x in (None, 3.0)]
    run = {"observe": {"energy": problem.observables["energy"]}}
    sols = [dvi.integrate(problem, num_steps=steps, method=m, **run) for m in methods]

    def pairs_in_step(q, p):
        one = dvi.integrate(problem, q, p, num_steps=1, method=methods[1], save=FINAL)
        return one.stats["encounter_steps"]

    close = np.asarray(jax.jit(jax.vmap(pairs_in_step))(sols[1].qs[:-1], sols[1].ps[:-1])) > 0
    # A pair that is close at the end of a step only: it was repeated.
    repeated = close & ~np.append(False, close[:-1])
    figure, axes = plt.subplots(2, 1, sharex=True, figsize=(7, 4.4), layout="constrained")
    ts, qs = np.asarray(sols[1].ts), np.asarray(sols[1].qs)
    sun = np.linalg.norm(qs[:, 1:] - qs[:, :1], axis=2).max(axis=1)
    axes[0].semilogy(ts, np.linalg.norm(qs[:, 1] - qs[:, 2], axis=1), label="distance")
    axes[0].semilogy(ts, 3 * np.cbrt(1e-3 / 3) * sun, "--", color="0.5", label="3 Hill radii")
    for sol, label in zip(sols, ("encounters=None", "encounters=3.0"), strict=True):
        energy = np.asarray(sol.observed["energy"])
        axes[1].semilogy(ts[1:], np.abs(energy / energy[0] - 1)[1:], label=label)
    for k in np.flatnonzero(close):
        for ax in axes:
            ax.axvspan(ts[k], ts[k + 1], color="C2" if repeated[k] else "C1", alpha=0.25, lw=0)
    axes[0].set_ylabel("between the planets [au]")
    axes[1].set(ylabel="|ΔE/E|", xlabel="t [year/2π]")
    for ax, place in zip(axes, ("lower right", "center right"), strict=True):
        ax.legend(loc=place, fontsize="small")
    figure.savefig(path, dpi=110)
    print(f"{close.sum()} steps with a close pair, {repeated.sum()} of them repeated")


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=[*ROWS])
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--picture")
    options = parser.parse_args(arguments)
    if options.picture:
        picture(options.picture)
        return 0
    results = []
    for name in options.rows:
        print(f"{name}: {ROWS[name].__doc__}")
        for text, is_good in ROWS[name]():
            print(f"  {'ok    ' if is_good else 'MISSED'} {text}", flush=True)
            results.append(is_good)
    return int(options.check and not all(results))


if __name__ == "__main__":
    sys.exit(main())
