"""A gallery: pictures of states, invariants, chaos, frequencies, cost and sweeps, from real runs.

Pictures of fits, and of the planets with an ephemeris, are in other examples.

Run: python examples/gallery.py [DIRECTORY for the pictures] [NAME of a picture ...]
"""

import argparse
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np

import dvi_jax as dvi
from dvi_jax import plot, systems

jax.config.update("jax_enable_x64", True)
mpl.use("Agg")


# --- states -------------------------------------------------------------------------------------


def pendulum(out):
    """Librations, the neighbourhood of the separatrix and rotations, on the levels of H."""
    problem = systems.perturbed_pendulum()
    p0 = np.array([0.5, 1.0, 1.5, 1.9, 2.2, 2.6, -2.2])

    def run(p):
        q = jnp.zeros(1)
        return dvi.integrate(problem, q, p[None], h=0.05, num_steps=400, method=dvi.Strang())

    sol = jax.vmap(run)(jnp.asarray(p0))
    axis = plot.phase_portrait(
        sol,
        period=2 * np.pi,
        hamiltonian=lambda q, p: jnp.sum(p**2) / 2 - jnp.sum(jnp.cos(q)),
        labels=[f"p$_0$ = {p:g}".replace("-", "−") for p in p0],
        units={"q": "rad"},
        title="Orbits of a pendulum",
    )
    return plot.save(axis, out / "phase_portrait.png")


def two_degrees(out):
    """One regular orbit in the two planes (q, p) and in the plane of positions."""
    problem = systems.henon_heiles()
    sol = dvi.integrate(problem, h=0.05, num_steps=2400, method=dvi.Yoshida(4))
    with plot.style():
        figure, axes = plt.subplots(1, 3, figsize=(11.5, 4.0))
        plot.phase_portrait(sol, ax=axes[:2])
        plot.orbit(sol, ax=axes[2])
        axes[0].set_title("A regular orbit of Hénon and Heiles")
        return plot.save(figure, out / "phase_planes.png")


def eight(num_steps=950):
    """The figure eight, three turns unless `num_steps` differs."""
    problem = systems.figure_eight()
    return dvi.integrate(
        problem,
        h=0.02,
        num_steps=num_steps,
        method=dvi.Yoshida(4),
        observe=dict(problem.observables),
    )


def orbits(out):
    """Bodies in the plane, and a perturbed Kepler orbit about its centre."""
    problem = systems.kepler()

    def run(epsilon):
        return dvi.integrate(problem, h=0.02, num_steps=2500, epsilon=epsilon, method=dvi.Strang())

    epsilons = jnp.array([0.0, 0.02, 0.05])
    with plot.style():
        figure, axes = plt.subplots(1, 2, figsize=(10.4, 4.6))
        plot.orbit(
            jax.vmap(run)(epsilons),
            centre=[0.0, 0.0],
            labels=[f"ε = {e:g}" for e in epsilons],
            title="Perturbed Kepler orbits",
            ax=axes[0],
        )
        # All three bodies go round on one curve: after a third of a turn the next would cover it.
        title = "The figure eight, a third of a turn"
        plot.orbit(eight(105), names=["A", "B", "C"], title=title, ax=axes[1])
        return plot.save(figure, out / "orbits.png")


def mirror_run(num_steps=6000, h=0.1):
    """A particle that bounces in a magnetic mirror."""
    problem = systems.magnetic_mirror()
    return problem, dvi.integrate(
        problem,
        h=h,
        num_steps=num_steps,
        method=dvi.GaussLegendre(2),
        observe=dict(problem.observables),
    )


def mirror(out):
    """An orbit in space."""
    _, sol = mirror_run(2500)
    axis = plot.orbit(sol, title="In a magnetic mirror")
    return plot.save(axis, out / "orbit_in_space.png")


# --- along time ---------------------------------------------------------------------------------


def conserved_along_time(out):
    """The relative error of the energy by four methods."""
    problem = systems.kepler()
    methods = {
        "TypeII": dvi.TypeII(),
        "Strang": dvi.Strang(),
        "Yoshida(4)": dvi.Yoshida(4),
        "RungeKutta4": dvi.RungeKutta4(),
    }
    sols = [
        dvi.integrate(
            problem,
            h=0.02,
            num_steps=20_000,
            method=method,
        )
        for method in methods.values()
    ]

    def energy(q, p):
        return p @ p / 2 - 1 / jnp.linalg.norm(q)

    axis = plot.invariants(
        sols, {"energy": energy}, log=True, labels=list(methods), title="Energy of a Kepler orbit"
    )
    return plot.save(axis, out / "invariants.png")


def watched(out):
    """Observables of the run in the mirror: conserved and adiabatic quantities."""
    problem, sol = mirror_run()
    axes = plot.invariants(sol, units=problem.units, title="Observables in a magnetic mirror")
    return plot.save(axes, out / "watched.png")


def balance(out):
    """Why the angular momentum of a perturbed Kepler orbit with a clock drifts."""
    problem = systems.kepler()
    clocked = dvi.Generator(
        lambda t, q, p, args: 1.0,
        lambda t, q, p, args: jnp.array([-q[1], q[0]]),
        lambda t, q, p, args: jnp.array([-p[1], p[0]]),
    )
    sol = dvi.integrate(problem, h=0.05, num_steps=400, epsilon=0.05)
    found = dvi.noether_balance(
        problem.system, [clocked], [None], sol, epsilon=0.05, args=problem.args
    )
    axes = plot.balance(found, title="Causes of the drift of the angular momentum")
    return plot.save(axes, out / "balance.png")


def drift_orders(out):
    """Drift against ε with the expected slopes."""
    rng = np.random.default_rng(0)
    system = dvi.System(
        lambda t0, t1, q0, p1, args: (p1 @ p1 + q0 @ q0) / 2,
        force=lambda t0, t1, q0, p1, args: -(q0**3),
    )
    samples = tuple(rng.uniform(-1, 1, (2, 200, 1)))
    orders = {}
    for z in range(2):
        found = dvi.discover_invariants(system, dvi.Polynomials(6), z, h=0.1, samples=samples)
        orders[f"order {z}"] = dvi.drift_order(
            system,
            found.invariants[0],
            [0.4],
            [0.3],
            epsilons=np.geomspace(1e-3, 0.2, 8),
            h=0.1,
            num_steps=5000,
        )
    return plot.save(plot.drift_orders(orders, expected=[1, 2]), out / "drift_orders.png")


def drift_surface(out):
    """The drift over ε and h: the order in ε at each h, and steps that are too long."""
    oscillator = systems.oscillator()
    cubic = dvi.System(oscillator.system.H_D, force=lambda t0, t1, q, p, args: -(q**3))
    found = dvi.drift_surface(
        cubic,
        oscillator.observables["map_invariant"],
        [0.4],
        [0.3],
        epsilons=np.geomspace(1e-3, 0.3, 9),
        hs=np.array([0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.5]),
        duration=200.0,
    )
    return plot.save(plot.drift_surface(found, expected=1), out / "drift_surface.png")


# --- chaos --------------------------------------------------------------------------------------


def chaos(out):
    """A section coloured by the MEGNO of each orbit, and indicators along time."""
    problem, energy, count = systems.henon_heiles(), 1 / 8, 48
    y = np.linspace(-0.3, 0.6, count)
    q = np.stack([0 * y, y], 1)
    p = np.stack([np.sqrt(2 * energy - y**2 + 2 * y**3 / 3), 0 * y], 1)
    settings = {"h": 0.1, "method": dvi.Yoshida(4)}
    crossed = dvi.poincare_section(
        problem.system,
        q,
        p,
        lambda t, q, p, args: q[0],
        num_steps=30_000,
        crossings=400,
        **settings,
    )
    watched = {
        "lyapunov": dvi.Running(dvi.LyapunovSpectrum(1)),
        "megno": dvi.Running(dvi.MEGNO()),
        "gali": dvi.Running(dvi.GALI(3)),
    }

    def run(q, p):
        return dvi.integrate(
            problem, q, p, num_steps=20_000, save=dvi.Save(every=20), observe=watched, **settings
        )

    sol = jax.vmap(run)(jnp.asarray(q), jnp.asarray(p))
    found = {name: np.asarray(x) for name, x in sol.observed.items()}
    axis = plot.section(
        crossed,
        colour=np.log10(found["megno"][:, -1]),
        colour_label="log$_{10}$ MEGNO",
        title="Section x = 0 of Hénon and Heiles, energy 1/8",
    )
    yield plot.save(axis, out / "section.png")
    few, t = [4, 20, 32, 44], np.asarray(sol.ts)[0, 1:]
    with plot.style():
        figure, axes = plt.subplots(1, 3, figsize=(14.0, 4.2))
        names = [f"y$_0$ = {v:.2f}".replace("-", "−") for v in y[few]]
        plot.indicator(t, found["lyapunov"][few, :, 0], "lyapunov", labels=names, ax=axes[0])
        plot.indicator(t, found["megno"][few], "megno", labels=names, ax=axes[1])
        axes[1].set_ylim(0, 12)
        plot.indicator(t, found["gali"][few, :, 1], "gali", labels=names, ax=axes[2])
        yield plot.save(figure, out / "indicators.png")


def duffing(out):
    """Positions of a damped oscillator, once per period, against the amplitude of its force."""
    problem = systems.duffing()
    gamma, period = np.linspace(0.2, 0.65, 450), 2 * np.pi / problem.args["omega"]
    found = dvi.bifurcation(
        problem.system,
        problem.q0,
        problem.p0,
        dvi.stroboscope(period),
        h=period / 60,
        num_steps=60 * 152,
        epsilon=1.0,
        args={**problem.args, "gamma": dvi.Axis("gamma", gamma)},
        skip=90,
        crossings=60,
        method=dvi.Strang(),
    )
    axis = plot.bifurcation(
        gamma, found, name="amplitude γ of the driving force", title="Duffing's oscillator"
    )
    return plot.save(axis, out / "bifurcation.png")


# --- frequencies --------------------------------------------------------------------------------


def frequencies(out):
    """Lines of a regular orbit, and the diffusion of the frequencies of many."""
    problem, energy = systems.henon_heiles(), 1 / 8
    settings = {"h": 0.1, "method": dvi.Yoshida(4)}
    sol = dvi.integrate(problem, num_steps=16_384, save=dvi.Save(every=4), **settings)
    found = dvi.frequencies(sol, count=7)
    with plot.style():
        figure, axes = plt.subplots(1, 2, figsize=(10.8, 4.2), width_ratios=(5, 4))
        plot.spectrum(
            found, labels=["x", "y"], title="Lines of an orbit of Hénon and Heiles", ax=axes[0]
        )
        y = jnp.linspace(-0.3, 0.6, 120)
        px = jnp.sqrt(2 * energy - y**2 + 2 * y**3 / 3)

        def run(y, px):
            q, p = jnp.stack([0 * y, y]), jnp.stack([px, 0 * y])
            return dvi.integrate(
                problem, q, p, num_steps=16_384, save=dvi.Save(every=8), **settings
            )

        many = dvi.frequency_diffusion(jax.vmap(run)(y, px), throw=False)
        w = np.abs(np.asarray(many.first))
        moved = np.max(np.asarray(many.rate), axis=-1)
        plot.frequency_map(
            w[:, 0], w[:, 1], moved, resonances=[(1, -1)], title="Energy 1/8", ax=axes[1]
        )
        return plot.save(figure, out / "frequencies.png")


def diffusion(out):
    """Diffusion of frequencies over initial conditions (y, p_y) on the section x = 0."""
    problem, energy = systems.henon_heiles(), 1 / 8
    y, py = np.linspace(-0.35, 0.6, 48), np.linspace(-0.45, 0.45, 47)
    Y, P = (jnp.asarray(v) for v in np.meshgrid(y, py, indexing="ij"))
    # NaN where no momentum has this energy.
    px = jnp.sqrt(2 * energy - Y**2 + 2 * Y**3 / 3 - P**2)

    def run(y, px, py):
        return dvi.integrate(
            problem,
            jnp.stack([0 * y, y]),
            jnp.stack([px, py]),
            h=0.1,
            num_steps=8192,
            method=dvi.Yoshida(4),
            save=dvi.Save(every=8),
            throw=False,
        )

    inside = np.isfinite(np.asarray(px))
    sol = jax.vmap(run)(Y[inside], px[inside], P[inside])
    found = dvi.frequency_diffusion(sol, throw=False)
    moved = np.full(inside.shape, np.nan)
    moved[inside] = np.max(np.asarray(found.rate), axis=-1)
    axis = plot.frequency_map(
        y, py, moved, names=("y", "p$_y$"), title="Hénon and Heiles, energy 1/8"
    )
    return plot.save(axis, out / "diffusion.png")


# --- sweeps -------------------------------------------------------------------------------------


def sweeps(out):
    """Drift of a perturbed oscillator over ε and the step, its local order, and failures."""
    oscillator = systems.oscillator()
    system = dvi.System(oscillator.system.H_D, force=lambda t0, t1, q0, p1, args: -(q0**3))
    data = dvi.sweep(
        system,
        [0.4],
        [0.3],
        h=np.linspace(0.05, 2.4, 48),
        num_steps=2000,
        epsilon=np.geomspace(1e-4, 1, 40),
        observe={"drift": dvi.MaxDrift(oscillator.observables["map_invariant"])},
    ).to_xarray()
    with plot.style():
        figure, axes = plt.subplots(1, 3, figsize=(14.0, 4.0))
        plot.sweep_map(data["drift"], status=data["status"], limits=(1e-6, 0.1), ax=axes[0])
        slopes = data["drift"].where(data["drift"] < 0.1)
        plot.slope_map(slopes, x="epsilon", y="h", limits=(0, 2), ax=axes[1])
        plot.failure_map(data, ax=axes[2])
        return plot.save(figure, out / "sweeps.png")


# --- cost ---------------------------------------------------------------------------------------


def cost(out):
    """Error of the position after ten periods of a Kepler orbit, against evaluations of the force.

    RungeKutta4, of order 4, falls by 5: its energy drifts as h⁵, and that outweighs the rest here.
    KahanLi(8) meets round-off before its slope has settled at −8.
    """
    problem = systems.kepler()
    energy = 0.5 * 1.36 - 1 / 1.2
    turn = 2 * np.pi * (-2 * energy) ** -1.5
    methods = {
        "Strang": (dvi.Strang(), 1),
        "Yoshida(4)": (dvi.Yoshida(4), 3),
        "BlanesMoan(4)": (dvi.BlanesMoan(4), 6),
        "KahanLi(8)": (dvi.KahanLi(8), 17),
        "RungeKutta4": (dvi.RungeKutta4(), 4),
    }
    results = {}
    for name, (method, stages) in methods.items():
        costs, errors = [], []
        for k in range(5, 13):
            steps = 10 * 2**k // (4 if stages > 10 else 1)
            sol = dvi.integrate(
                problem,
                h=10 * turn / steps,
                num_steps=steps,
                method=method,
                save=dvi.Save(final=True),
                throw=False,
            )
            costs.append(stages * steps)
            errors.append(float(jnp.linalg.norm(sol.qs[-1] - jnp.asarray(problem.q0))))
        results[name] = (costs, errors)
    axis = plot.work_precision(
        results,
        "evaluations of the force",
        "error of the position after ten periods",
        title="Kepler's ellipse",
    )
    return plot.save(axis, out / "work_precision.png")


# --- films --------------------------------------------------------------------------------------


def films(out):
    """The figure eight; a Kepler orbit with its invariants; the mirror in space."""
    yield plot.animate(
        eight(),
        out / "figure_eight.gif",
        names=["A", "B", "C"],
        seconds=5,
        fps=20,
        tail=0.12,
        title="The figure eight",
        dpi=80,
    )
    problem = systems.kepler()
    sol = dvi.integrate(
        problem,
        h=0.05,
        num_steps=600,
        epsilon=0.02,
        method=dvi.Strang(),
        observe=dict(problem.observables),
    )
    yield plot.animate(
        sol,
        out / "kepler.gif",
        centre=[0.0, 0.0],
        beside="invariants",
        values={name: sol.observed[name] for name in ("energy", "angular_momentum")},
        seconds=5,
        fps=12,
        dpi=80,
        title="Kepler, ε = 0.02",
    )
    _, sol = mirror_run(1500)
    yield plot.animate(sol, out / "mirror.gif", seconds=4, fps=10, tail=0.1, dpi=80)


PICTURES = [
    pendulum, two_degrees, orbits, mirror, conserved_along_time, watched, balance, drift_orders,
    drift_surface, chaos, duffing, frequencies, diffusion, sweeps, cost, films,
]  # fmt: skip


def main():
    """Draw all pictures, or those that are named."""
    names = {f.__name__: f for f in PICTURES}
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("directory", type=Path, nargs="?", default="gallery")
    parser.add_argument("pictures", nargs="*", help=f"of {', '.join(names)}; all if left out")
    given = parser.parse_args()
    out, chosen = given.directory, given.pictures
    if unknown := [name for name in chosen if name not in names]:
        parser.error(f"no picture is called {', '.join(unknown)}: there are {', '.join(names)}.")
    out.mkdir(parents=True, exist_ok=True)
    for name in chosen or names:
        start = time.perf_counter()
        files = names[name](out)
        for file in [files] if isinstance(files, Path) else files:
            print(f"written: {file} ({time.perf_counter() - start:.1f} s)")


if __name__ == "__main__":
    main()
