"""Conserved quantities, their order in ε, and why others drift: six systems and two pictures.

Run: python examples/what_is_conserved.py [DIRECTORY for the pictures]
"""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np

import dvi_jax as dvi
from dvi_jax import plot

jax.config.update("jax_enable_x64", True)
mpl.use("Agg")

RNG = np.random.default_rng(0)
H = 0.1
EVERY, PIECE = 7, 150
"""Slow oscillator: steps between saved states; states of which the largest change is drawn."""


def box(n, count):
    """Samples (qs, ps) of the domain of interest."""
    return tuple(RNG.uniform(-1, 1, (2, count, n)))


def oscillator(t0, t1, q0, p1, args):
    """H_D of the harmonic oscillator in any number of dimensions."""
    return (p1 @ p1 + q0 @ q0) / 2


def cubic(out):
    """A cubic spring: an invariant for every order, and the drift that it promises."""
    system = dvi.System(oscillator, force=lambda t0, t1, q0, p1, args: -(q0**3))
    orders = {}
    for z in range(4):
        found = dvi.discover_invariants(system, dvi.Polynomials(8), z, h=H, samples=box(1, 400))
        series = found.invariants[0]
        orders[f"order {z}"] = dvi.drift_order(
            system,
            series,
            [0.4],
            [0.3],
            epsilons=np.geomspace(1e-3, 0.2, 8),
            h=H,
            num_steps=20_000,
        )
        print(f"order {z}: {series.formula(6)}\n  {orders[f'order {z}']}")
    with plot.style():
        figure = plot.drift_orders(orders, expected=[1, 2, 3, 4])
        print(f"written: {plot.save(figure, out / 'drift_orders.png')}")


def van_der_pol():
    """Friction and its opposite: the amplitude is lost at order 1, by the averaged law."""
    system = dvi.System(oscillator, force=lambda t0, t1, q0, p1, args: (1 - q0**2) * p1)
    print(dvi.discover_invariants(system, dvi.Polynomials(6), 1, h=H, samples=box(1, 400)))


def henon_heiles():
    """Two of four quadratic invariants of the isotropic oscillator exist to the second order."""

    def H1(t0, t1, q0, p1, args):
        return q0[0] ** 2 * q0[1] - q0[1] ** 3 / 3

    system = dvi.System(oscillator, perturbation=H1)
    print(dvi.discover_invariants(system, dvi.Polynomials(4), 2, h=H, samples=box(2, 400)))


def kepler():
    """Angular momentum exactly; energy and the Laplace–Runge–Lenz vector up to O(h^r)."""
    system = dvi.System(
        lambda t0, t1, q0, p1, args: p1 @ p1 / 2 - 1 / jnp.sqrt(q0 @ q0),
        force=lambda t0, t1, q0, p1, args: -q0,
    )
    basis = dvi.Polynomials(3) + (
        dvi.Polynomials(1, variables=["q1", "q2"], constant=True) * dvi.Radial()
    )
    angle, r = RNG.uniform(0, 2 * np.pi, 500), RNG.uniform(0.8, 1.25, 500)
    outward = np.stack([np.cos(angle), np.sin(angle)], 1)
    across = np.stack([-outward[:, 1], outward[:, 0]], 1) * RNG.choice([-1, 1], (500, 1))
    speeds = RNG.uniform(-0.3, 0.3, (500, 1)), RNG.uniform(0.85, 1.15, (500, 1))
    samples = r[:, None] * outward, speeds[0] * outward + speeds[1] * across
    print(dvi.discover_invariants(system, basis, 1, h=H, samples=samples))
    for method in (dvi.TypeII(), dvi.Strang()):
        for h in (0.04, 0.02):
            found = dvi.discover_invariants(
                system, basis, h=h, samples=samples, method=method, tolerance=1e-2
            )
            small = ", ".join(f"{x:.1e}" for x in found.singular_values[-4:])
            print(f"{type(method).__name__}, h = {h}: {found.survivors[0]} kept, to {small}")
    every = (*found.invariants, *found.dependent_invariants)
    x, y = (
        next(series for series in every if name in series.formula(3, 0.03))
        for name in ("q1 1/r", "q2 1/r")
    )
    units = [
        float(series.coefficients[0, found.basis.names.index(name)])
        for series, name in ((x, "q1 1/r"), (y, "q2 1/r"))
    ]

    def perihelion(t0, t1, q0, p0, q1, p1, args):
        A = [-series.evaluate(q1, p1, 0.0) / c for series, c in zip((x, y), units, strict=True)]
        return jnp.arctan2(A[1], A[0])

    e, turn = 0.3, {}
    for epsilon in (0.0, 1e-4):
        run = dvi.integrate(
            system,
            [1 - e, 0.0],
            [0.0, np.sqrt((1 + e) / (1 - e))],
            h=0.02,
            num_steps=60_000,
            epsilon=epsilon,
            method=dvi.Strang(),
            observe=dvi.Trend(perihelion),
        )
        turn[epsilon] = float(run.observed)
    measured, theory = (turn[1e-4] - turn[0.0]) / 1e-4, -1.5 * np.sqrt(1 - e**2)
    print(f"perihelion turns by {measured:.4f} ε per unit of time; first order says {theory:.4f}")


def magnetic_moment():
    """A charge in B = 1 + εx: v²/2 is kept, and the guiding centre drifts across grad B."""

    def H_D(t0, t1, q0, p1, args):
        return jnp.sum((p1 - jnp.stack([-q0[1], q0[0]]) / 2) ** 2) / 2

    def H1(t0, t1, q0, p1, args):
        v = p1 - jnp.stack([-q0[1], q0[0]]) / 2
        return -jnp.sum(v * jnp.stack([-q0[0] * q0[1], q0[0] ** 2]) / 3)

    system = dvi.System(H_D, perturbation=H1)
    print(dvi.discover_invariants(system, dvi.Polynomials(4), 2, h=H, samples=box(2, 400)))


def slow_oscillator(out):
    """ω = 1 + 0.3 sin τ, τ = εt: the map keeps the discrete action, not energy over frequency."""

    def omega(tau):
        return 1 + 0.3 * jnp.sin(tau)

    def H_D(t0, t1, q0, p1, args):
        return (p1 @ p1 + omega(t0) ** 2 * (q0 @ q0)) / 2

    system = dvi.System(H_D, slow_time=True)
    quadratics = dvi.Basis(
        {
            "q²": lambda q, p: q[0] ** 2,
            "q p": lambda q, p: q[0] * p[0],
            "p²": lambda q, p: p[0] ** 2,
        }
    )
    found = dvi.discover_invariants(
        system,
        quadratics * dvi.Chebyshev(24, "τ", domain=(0, 2 * np.pi)),
        2,
        h=H,
        samples=(*box(1, 800), RNG.uniform(0, 2 * np.pi, 800)),
        tolerance=1e-5,
    )
    print(str(found).split("  lost", maxsplit=1)[0])
    q, p, tau = (x.ravel() for x in (*box(1, 500), RNG.uniform(0, 2 * np.pi, 500)))
    leading = np.asarray(
        jax.vmap(found.basis)(q[:, None], p[:, None], tau) @ found.coefficients[0, 0]
    )
    w = np.asarray(omega(tau))
    energy = (p**2 + w**2 * q**2 - H * w**2 * q * p) / 2
    for name, J in (
        ("discrete action", energy / w / np.sqrt(1 - (H * w) ** 2 / 4)),
        ("discrete energy / ω", energy / w),
    ):
        off = leading * (leading @ J) / (leading @ leading) - J
        print(
            f"  leading-order term and {name} differ by "
            f"{np.linalg.norm(off) / np.linalg.norm(J):.1e}"
        )
    epsilon = 2e-4
    run = dvi.integrate(
        system,
        [0.4],
        [0.3],
        h=H,
        num_steps=int(2 * np.pi / epsilon / H),
        epsilon=epsilon,
        save=dvi.Save(every=EVERY),
        observe=found.invariants[0],
    )
    q, p, tau = np.asarray(run.qs)[1:, 0], np.asarray(run.ps)[1:, 0], epsilon * run.ts[1:]
    w = np.asarray(omega(tau))
    discrete_energy = (p**2 + w**2 * q**2 - H * w**2 * q * p) / 2
    curves = {
        "energy / ω": (p**2 + w**2 * q**2) / 2 / w,
        "discrete energy / ω": discrete_energy / w,
        "discrete action": discrete_energy / w / np.sqrt(1 - (H * w) ** 2 / 4),
        "discovered, order 2": np.asarray(run.observed),
    }
    with plot.style():
        figure, axes = plt.subplots(figsize=(7.5, 4.5))
        # The changes oscillate: the largest of each piece of about 16 periods is a readable line.
        count = len(tau) // PIECE
        middle = np.reshape(tau[: count * PIECE], (count, PIECE)).mean(axis=1)
        for (name, values), dash in zip(curves.items(), plot.DASHES, strict=False):
            change = np.abs(values / values[0] - 1)
            largest = change[: count * PIECE].reshape(count, PIECE).max(axis=1)
            label = f"{name}: up to {change.max():.0e}"
            axes.semilogy(middle, largest, ls=dash, label=label)
        axes.set(xlabel="slow time τ = εt")
        axes.set_ylabel("relative change |ΔI/I$_0$|, largest in 16 periods")
        axes.set_title(f"Oscillator with a slowly varying frequency, ε = {epsilon:g}, h = {H:g}")
        axes.set_ylim(1e-7, 1)
        figure.legend(loc="outside lower center", ncols=2)
        print(f"written: {plot.save(figure, out / 'slow_oscillator.png')}")


if __name__ == "__main__":
    directory = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
    directory.mkdir(parents=True, exist_ok=True)
    cubic(directory)
    van_der_pol()
    henon_heiles()
    kepler()
    magnetic_moment()
    slow_oscillator(directory)
