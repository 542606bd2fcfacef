"""A gallery: every kind of picture in `dvi_jax.plot`, drawn from real runs.

Run: python examples/gallery.py [DIRECTORY for the pictures] [NAME of a picture ...]
"""

import sys
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
        return dvi.integrate(problem.system, q, p[None], h=0.05, num_steps=400, method=dvi.Strang())

    sol = jax.vmap(run)(jnp.asarray(p0))
    axis = plot.phase_portrait(
        sol,
        period=2 * np.pi,
        hamiltonian=lambda q, p: jnp.sum(p**2) / 2 - jnp.sum(jnp.cos(q)),
        labels=[f"p$_0$ = {p:g}".replace("-", "−") for p in p0],
        units={"q": "rad"},
        title="The pendulum",
    )
    return plot.save(axis, out / "phase_portrait.png")


def henon_heiles_orbits(count, num_steps, energy, h=0.1, **more):
    """Orbits of one energy that start on x = 0, at rest in y, and their solutions."""
    problem = systems.henon_heiles()
    y = jnp.linspace(-0.3, 0.6, count)
    px = jnp.sqrt(2 * energy - y**2 + 2 * y**3 / 3)

    def run(y, px):
        q, p = jnp.stack([0 * y, y]), jnp.stack([px, 0 * y])
        return dvi.integrate(
            problem.system, q, p, h=h, num_steps=num_steps, method=dvi.Yoshida(4), **more
        )

    return y, run, jax.vmap(run)(y, px), px


def two_degrees(out):
    """One regular orbit in the two planes (q, p) and in the plane of positions."""
    problem = systems.henon_heiles()
    sol = dvi.integrate(
        problem.system, problem.q0, problem.p0, h=0.05, num_steps=2400, method=dvi.Yoshida(4)
    )
    with plot.style():
        figure, axes = plt.subplots(1, 3, figsize=(11.5, 4.0))
        plot.phase_portrait(sol, ax=axes[:2])
        plot.orbit(sol, ax=axes[2])
        axes[0].set_title("A regular orbit of Hénon and Heiles")
        return plot.save(figure, out / "phase_planes.png")


def eight():
    """The figure eight, three turns."""
    problem = systems.figure_eight()
    return dvi.integrate(
        problem.system, problem.q0, problem.p0, h=0.02, num_steps=950, args=problem.args,
        method=dvi.Yoshida(4), observe=dict(problem.observables),
    )  # fmt: skip


def orbits(out):
    """Bodies in the plane, and a disturbed Kepler orbit about its centre."""
    problem = systems.kepler()

    def run(epsilon):
        return dvi.integrate(
            problem.system, problem.q0, problem.p0, h=0.02, num_steps=2500, args=problem.args,
            epsilon=epsilon, method=dvi.Strang(),
        )  # fmt: skip

    epsilons = jnp.array([0.0, 0.02, 0.05])
    with plot.style():
        figure, axes = plt.subplots(1, 2, figsize=(10.4, 4.6))
        plot.orbit(
            jax.vmap(run)(epsilons), centre=[0.0, 0.0],
            labels=[f"ε = {e:g}" for e in epsilons], title="Kepler, disturbed", ax=axes[0],
        )  # fmt: skip
        plot.orbit(eight(), names=["A", "B", "C"], title="The figure eight", ax=axes[1])
        return plot.save(figure, out / "orbits.png")


def mirror_run(num_steps=6000, h=0.1):
    """A particle that bounces in a magnetic mirror."""
    problem = systems.magnetic_mirror()
    return problem, dvi.integrate(
        problem.system, problem.q0, problem.p0, h=h, num_steps=num_steps, args=problem.args,
        method=dvi.GaussLegendre(2), observe=dict(problem.observables),
    )  # fmt: skip


def mirror(out):
    """An orbit in space."""
    _, sol = mirror_run(2500)
    axis = plot.orbit(sol, title="In a magnetic mirror")
    return plot.save(axis, out / "orbit_in_space.png")


# --- along time ---------------------------------------------------------------------------------


def conserved_along_time(out):
    """One energy by four methods, and all that one run watched."""
    problem = systems.kepler()
    methods = {
        "TypeII": dvi.TypeII(), "Strang": dvi.Strang(), "Yoshida(4)": dvi.Yoshida(4),
        "RungeKutta4": dvi.RungeKutta4(),
    }  # fmt: skip
    sols = [
        dvi.integrate(
            problem.system, problem.q0, problem.p0, h=0.02, num_steps=20_000, args=problem.args,
            method=method,
        )
        for method in methods.values()
    ]  # fmt: skip

    def energy(q, p):
        return p @ p / 2 - 1 / jnp.linalg.norm(q)

    axis = plot.invariants(
        sols, {"energy": energy}, log=True, labels=list(methods), title="Kepler's energy"
    )
    return plot.save(axis, out / "invariants.png")


def watched(out):
    """What the run in the mirror watched: kept, and adiabatic."""
    problem, sol = mirror_run()
    axes = plot.invariants(sol, units=problem.units, title="In a magnetic mirror")
    return plot.save(axes, out / "watched.png")


def balance(out):
    """Why the angular momentum of a disturbed Kepler orbit with a clock drifts."""
    problem = systems.kepler()
    clocked = dvi.Generator(
        lambda t, q, p, args: 1.0,
        lambda t, q, p, args: jnp.array([-q[1], q[0]]),
        lambda t, q, p, args: jnp.array([-p[1], p[0]]),
    )
    sol = dvi.integrate(
        problem.system, problem.q0, problem.p0, h=0.05, num_steps=400, args=problem.args,
        epsilon=0.05,
    )  # fmt: skip
    found = dvi.noether_balance(
        problem.system, [clocked], [None], sol, epsilon=0.05, args=problem.args
    )
    axes = plot.balance(found, title="What turns an invariant into a drift")
    return plot.save(axes, out / "balance.png")


def drift_orders(out):
    """Drift against ε with the promised slopes."""
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
            system, found.invariants[0], [0.4], [0.3], epsilons=np.geomspace(1e-3, 0.2, 8), h=0.1,
            num_steps=5000,
        )  # fmt: skip
    return plot.save(plot.drift_orders(orders, promised=[1, 2]), out / "drift_orders.png")


# --- chaos --------------------------------------------------------------------------------------


def growth(run, y, px):
    """Times and the size of a tangent vector along every orbit, from the derivative of the run."""

    def states(q, p):
        sol = run(q, p)
        return sol.qs, sol.ps, sol.ts

    def one(y, px):
        # Along y at rest: p_x keeps the energy, to first order.
        (_, _, ts), (dq, dp, _) = jax.jvp(states, (y, px), (1.0, -(y - y**2) / px))
        return ts, jnp.sqrt(jnp.sum(dq**2, -1) + jnp.sum(dp**2, -1))

    return jax.vmap(one)(y, px)


def chaos(out):
    """A section coloured by the exponent of each orbit, and the indicators along time."""
    crossing = dvi.Section(lambda t, q, p, args: q[0], direction=1, max_crossings=400)
    y, run, sol, px = henon_heiles_orbits(
        48, 20_000, 1 / 8, save=dvi.Save(every=20), observe={"section": crossing},
        adjoint=dvi.Direct(),
    )  # fmt: skip
    ts, size = growth(run, y, px)
    t, size = np.asarray(ts)[:, 1:], np.asarray(size)
    exponents = np.log(size[:, 1:] / size[:, :1]) / t
    rates = np.diff(np.log(size), axis=1)
    megno = 2 * np.cumsum(rates * t, 1) / t
    megno = np.cumsum(megno, 1) / np.arange(1, megno.shape[1] + 1)
    axis = plot.section(
        sol, colour=np.log10(exponents[:, -1]), colour_label="log$_{10}$ Lyapunov exponent",
        title="Hénon and Heiles, energy 1/8",
    )  # fmt: skip
    yield plot.save(axis, out / "section.png")
    few = [4, 20, 32, 44]
    with plot.style():
        figure, axes = plt.subplots(1, 2, figsize=(10.6, 4.2))
        names = [f"y$_0$ = {v:.2f}".replace("-", "−") for v in np.asarray(y)[few]]
        plot.indicator(t[few], exponents[few], "lyapunov", labels=names, ax=axes[0])
        plot.indicator(t[few], megno[few], "megno", labels=names, ax=axes[1])
        axes[1].set_ylim(0, 12)
        yield plot.save(figure, out / "indicators.png")


def duffing(out):
    """What a damped spring does once a period of the force that drives it, over its size."""
    system = dvi.System(
        lambda t0, t1, q0, p1, args: jnp.sum(p1**2) / 2 - jnp.sum(q0**2) / 2 + jnp.sum(q0**4) / 4,
        force=lambda t0, t1, q0, p1, args: -0.3 * p1 + args * jnp.cos(1.2 * t0),
    )
    gamma = jnp.linspace(0.2, 0.65, 450)

    def run(size):
        return dvi.integrate(
            system, [1.0], [0.0], h=2 * np.pi / 1.2 / 60, num_steps=60 * 150, epsilon=1.0,
            args=size, save=dvi.Save(final=True), method=dvi.Strang(),
            observe=dvi.Section(lambda t, q, p, args: jnp.sin(1.2 * (t + 0.01)), 1, 150),
        )  # fmt: skip

    sol = jax.vmap(run)(gamma)
    axis = plot.bifurcation(
        gamma, sol.observed, skip=90, name="size of the driving force", title="Duffing's oscillator"
    )
    return plot.save(axis, out / "bifurcation.png")


# --- frequencies --------------------------------------------------------------------------------


def lines(signal, step, count):
    """The strongest lines of a signal: peaks of its spectrum within a Hann window, refined."""
    n = signal.shape[-1]
    window = np.hanning(n) * 2
    found = []
    k = np.arange(n)
    for _ in range(count):
        power = np.abs(np.fft.fft(signal * window)) / n
        at = int(np.argmax(power))
        left, mid, right = np.log(power[[at - 1, at, (at + 1) % n]])
        w = 2 * np.pi * (at + (left - right) / (2 * (left - 2 * mid + right))) / n
        wave = np.exp(1j * (w if w < np.pi else w - 2 * np.pi) * k)
        a = np.vdot(wave, signal * window) / n
        signal = signal - a * wave
        found.append(((w if w < np.pi else w - 2 * np.pi) / step, a))
    return np.array([f for f, _ in found]), np.array([a for _, a in found])


def frequencies(out):
    """Lines of a regular orbit, and the frequencies of many as they change."""
    problem = systems.henon_heiles()
    sol = dvi.integrate(
        problem.system, problem.q0, problem.p0, h=0.1, num_steps=16_384, method=dvi.Yoshida(4),
        save=dvi.Save(every=4),
    )  # fmt: skip
    z = np.asarray(sol.qs - 1j * sol.ps)
    pairs = [lines(z[:, i], 0.4, 7) for i in range(2)]
    with plot.style():
        figure, axes = plt.subplots(1, 2, figsize=(10.8, 4.2), width_ratios=(5, 4))
        plot.spectrum(
            np.stack([w for w, _ in pairs]), np.stack([a for _, a in pairs]), labels=["x", "y"],
            title="Lines of an orbit of Hénon and Heiles", ax=axes[0],
        )  # fmt: skip
        _, _, many, _ = henon_heiles_orbits(120, 16_384, 1 / 8, save=dvi.Save(every=8))
        z = np.asarray(many.qs - 1j * many.ps)
        half = z.shape[1] // 2
        w = np.array(
            [[[lines(z[b, s, i], 0.8, 1)[0][0] for i in range(2)]
              for s in (slice(0, half), slice(half, 2 * half))] for b in range(len(z))]
        )  # fmt: skip
        moved = np.log10(np.abs(w[:, 1] / w[:, 0] - 1).max(-1) + 1e-16)
        plot.frequency_map(
            np.abs(w[:, 0, 0]), np.abs(w[:, 0, 1]), moved, resonances=[(1, -1)],
            title="Energy 1/8", ax=axes[1],
        )  # fmt: skip
        return plot.save(figure, out / "frequencies.png")


# --- cost ---------------------------------------------------------------------------------------


def cost(out):
    """Error of the place after ten turns of Kepler's ellipse, against evaluations of the force."""
    problem = systems.kepler()
    energy = 0.5 * 1.36 - 1 / 1.2
    turn = 2 * np.pi * (-2 * energy) ** -1.5
    methods = {
        "Strang": (dvi.Strang(), 1), "Yoshida(4)": (dvi.Yoshida(4), 3),
        "BlanesMoan(4)": (dvi.BlanesMoan(4), 6), "KahanLi(8)": (dvi.KahanLi(8), 17),
        "RungeKutta4": (dvi.RungeKutta4(), 4),
    }  # fmt: skip
    results = {}
    for name, (method, stages) in methods.items():
        costs, errors = [], []
        for k in range(5, 11):
            steps = 10 * 2**k // (4 if stages > 10 else 1)
            sol = dvi.integrate(
                problem.system, problem.q0, problem.p0, h=10 * turn / steps, num_steps=steps,
                args=problem.args, method=method, save=dvi.Save(final=True), throw=False,
            )  # fmt: skip
            costs.append(stages * steps)
            errors.append(float(jnp.linalg.norm(sol.qs[-1] - jnp.asarray(problem.q0))))
        results[name] = (costs, errors)
    axis = plot.work_precision(
        results, "evaluations of the force", "error of the place after ten turns",
        title="Kepler's ellipse",
    )  # fmt: skip
    return plot.save(axis, out / "work_precision.png")


# --- films --------------------------------------------------------------------------------------


def films(out):
    """The figure eight; a Kepler orbit beside what it conserves; the mirror in space."""
    yield plot.animate(
        eight(), out / "figure_eight.gif", names=["A", "B", "C"], seconds=5, fps=20, tail=0.12,
        title="The figure eight", dpi=80,
    )  # fmt: skip
    problem = systems.kepler()
    sol = dvi.integrate(
        problem.system, problem.q0, problem.p0, h=0.05, num_steps=600, args=problem.args,
        epsilon=0.02, method=dvi.Strang(), observe=dict(problem.observables),
    )  # fmt: skip
    yield plot.animate(
        sol, out / "kepler.gif", centre=[0.0, 0.0], beside="invariants",
        values={name: sol.observed[name] for name in ("energy", "angular_momentum")},
        seconds=5, fps=12, dpi=80, title="Kepler, ε = 0.02",
    )  # fmt: skip
    _, sol = mirror_run(1500)
    yield plot.animate(sol, out / "mirror.gif", seconds=4, fps=10, tail=0.1, dpi=80)


PICTURES = [
    pendulum, two_degrees, orbits, mirror, conserved_along_time, watched, balance, drift_orders,
    chaos, duffing, frequencies, cost, films,
]  # fmt: skip


def main():
    """Draw all pictures, or those that are named."""
    out = Path(sys.argv[1] if len(sys.argv) > 1 else "gallery")
    out.mkdir(parents=True, exist_ok=True)
    names = {f.__name__: f for f in PICTURES}
    for name in sys.argv[2:] or names:
        start = time.perf_counter()
        files = names[name](out)
        for file in [files] if isinstance(files, Path) else files:
            print(f"written: {file} ({time.perf_counter() - start:.1f} s)")


if __name__ == "__main__":
    main()
