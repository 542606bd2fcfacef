"""`WisdomHolman` against WHFast of REBOUND: the same states, energy errors and time per step.

    python benchmarks/wisdom_holman.py [--years 1e6] [--check]

The bodies are the Sun with Jupiter to Pluto, and the Sun with Mercury to Saturn, on 2000-01-01.
Both programs start from the same numbers, with the same coordinates, corrector and step; WHFast
runs with safe_mode=0. Times are processor times on one thread; a batch is 1024 copies of the outer
bodies. `--check` exits with 1 if a limit is exceeded. Requires the extras interop and ephemeris.
"""

import argparse
import time

import jax
import jax.numpy as jnp
import numpy as np
import rebound

import dvi_jax as dvi
import lanewise
from dvi_jax import interop, systems
from dvi_jax.systems.n_body import hamiltonian
from dvi_jax.systems.planets.solar_system import BODIES

jax.config.update("jax_enable_x64", True)

OUTER = "Sun", "Jupiter", "Saturn", "Uranus", "Neptune", "Pluto"
INNER = "Sun", "Mercury", "Venus", "Earth–Moon", "Mars", "Jupiter", "Saturn"
THEIRS = {"jacobi": "jacobi", "democratic": "democraticheliocentric"}
SAMPLES = 200


def simulation(names, h, coordinates="jacobi", corrector=0):
    """REBOUND's simulation of the bodies at the centre of mass."""
    planets = systems.solar_system("2000-01-01")
    sim = rebound.Simulation()
    for i in map(BODIES.index, names):
        m = planets.args["masses"][i]
        position, velocity = planets.q0[i], planets.p0[i] / m
        kinds = ("x", "y", "z", "vx", "vy", "vz")
        sim.add(m=m, **dict(zip(kinds, map(float, (*position, *velocity)), strict=True)))
    sim.move_to_com()
    sim.integrator, sim.dt = "whfast", h
    sim.integrator.coordinates = THEIRS[coordinates]
    sim.integrator.safe_mode, sim.integrator.corrector = 0, corrector
    return sim


def problem_of(sim):
    copy = sim.copy()
    copy.integrator = "ias15"
    return interop.from_rebound(copy)


def positions(sim):
    return np.array([[b.x, b.y, b.z] for b in sim.particles])


def same_states(coordinates, corrector, steps=4400):
    """The largest relative difference of a position after 100 revolutions of Jupiter."""
    sim = simulation(OUTER, 100.0, coordinates, corrector)
    problem = problem_of(sim)
    sim.steps(steps)
    sim.synchronize()
    sol = dvi.integrate(
        problem, num_steps=steps, h=100.0, method=dvi.WisdomHolman(coordinates, corrector),
        save=dvi.Save(final=True),
    )  # fmt: skip
    theirs = positions(sim)
    apart = np.linalg.norm(sol.q_final - theirs, axis=1) / np.linalg.norm(theirs, axis=1)
    return apart[1:].max()


def energy_errors(names, h, years, corrector):
    """Standard deviations of the relative energy error, ours and theirs, and its trends."""
    sim = simulation(names, h, "jacobi", corrector)
    problem = problem_of(sim)
    every = max(1, round(years * 365.25 / h / SAMPLES))
    sol = dvi.integrate(
        problem, num_steps=every * SAMPLES, h=h, method=dvi.WisdomHolman(corrector=corrector),
        save=dvi.Save(every=every),
    )  # fmt: skip
    states = zip(sol.qs, sol.ps, strict=True)
    ours = [float(hamiltonian(0.0, 0.0, q, p, problem.args)) for q, p in states]
    theirs = [sim.energy()]
    for _ in range(SAMPLES):
        sim.steps(every)
        sim.synchronize()
        theirs.append(sim.energy())
    relative = [np.array(e) / e[0] - 1 for e in (ours, theirs)]
    t = np.linspace(0, 1, SAMPLES + 1)
    return [e.std() for e in relative], [np.polyfit(t, e, 1)[0] for e in relative]


def times(coordinates, steps=200_000, batch=1024, batch_steps=500):
    """ns per step and system: ours alone, ours in a batch, WHFast."""
    sim = simulation(OUTER, 100.0, coordinates)
    problem = problem_of(sim)
    method = dvi.WisdomHolman(coordinates)

    def final(q, p, num_steps):
        return dvi.integrate(
            problem.system, q, p, args=problem.args, h=100.0, num_steps=num_steps, method=method,
            save=dvi.Save(final=True), throw=False,
        ).q_final  # fmt: skip

    one = jax.jit(lambda q, p: final(q, p, steps))
    many = jax.jit(jax.vmap(lambda q, p: final(q, p, batch_steps)))
    q, p = jnp.asarray(problem.q0), jnp.asarray(problem.p0)
    qs, ps = (jnp.broadcast_to(x, (batch, *x.shape)) for x in (q, p))
    alone = least(lambda: jax.block_until_ready(one(q, p))) / steps
    together = least(lambda: jax.block_until_ready(many(qs, ps))) / batch_steps / batch
    theirs = least(lambda: sim.steps(steps)) / steps
    return 1e9 * alone, 1e9 * together, 1e9 * theirs


def least(run, repeats=4):
    """The least processor time of a run, the first call left out [s]."""
    run()
    found = []
    for _ in range(repeats):
        began = time.process_time()
        run()
        found.append(time.process_time() - began)
    return min(found)


def main(years, check):
    lanewise.set_threads(1)
    failed = []

    def row(text, value, limit):
        print(f"{text:75} {value:10.3g} {limit:10.3g}", flush=True)
        if not value <= limit:
            failed.append(text)

    print(f"{'':75} {'measured':>10} {'limit':>10}")
    for coordinates, corrector in (("jacobi", 0), ("jacobi", 11), ("democratic", 0)):
        name = f"{coordinates}, corrector {corrector}"
        apart = same_states(coordinates, corrector)
        row(f"{name}: relative difference after 100 revolutions", apart, 1e-11)
    for coordinates in THEIRS:
        alone, together, theirs = times(coordinates)
        row(f"{coordinates}: time of one system over WHFast ({theirs:.0f} ns)", alone / theirs, 1.3)
        row(f"{coordinates}: time per system of 1024 over WHFast", together / theirs, 0.5)
    for names, h in ((OUTER, 100.0), (INNER, 4.0)):
        for corrector in (0, 11):
            (ours, theirs), trends = energy_errors(names, h, years, corrector)
            text = f"{names[1]}–{names[-1]}, {years:.0e} years, corrector {corrector}: "
            text += f"energy error {ours:.2e} over {theirs:.2e}"
            # An error of some 1e-13 after 10⁷ steps is a random walk of round-off.
            row(text, ours / theirs, 1.2 if theirs > 1e-12 else 2.0)
            print(f"    trend over the run: {trends[0]:.1e}, WHFast {trends[1]:.1e}")
    if check and failed:
        raise SystemExit("above the limit: " + "; ".join(failed))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--years", type=float, default=1e6)
    parser.add_argument("--check", action="store_true")
    options = parser.parse_args()
    main(options.years, options.check)
