"""The picture of README: energy errors of three methods, and invariants that were found.

Left: Kepler's problem with eccentricity 0.3, a million steps of 1/100 of a period.
Right: the oscillator H = (p² + q²)/2 with the perturbing force −εq³. Invariants of orders 0,
1 and 2 are discovered on the map; the drift of each scales as a higher power of ε.

Run: python examples/overview.py [FILE]
"""

import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np

import dvi_jax as dvi

jax.config.update("jax_enable_x64", True)
mpl.use("Agg")

STEPS, EVERY = 1_000_000, 20
METHODS = {
    "Runge–Kutta, order 4": dvi.RungeKutta4(),
    "Störmer–Verlet, order 2": dvi.Strang(),
    "Kahan–Li, order 8": dvi.KahanLi(8),
}


def energy_errors(axis):
    """Largest relative energy error up to each time, for three methods."""

    def energy(q, p):
        return p @ p / 2 - 1 / jnp.linalg.norm(q)

    kepler = dvi.System(lambda t0, t1, q0, p1, args: energy(q0, p1))
    e = 0.3
    q0, p0 = np.array([1 - e, 0.0]), np.array([0.0, np.sqrt((1 + e) / (1 - e))])

    for name, method in METHODS.items():
        sol = dvi.integrate(
            kepler,
            q0,
            p0,
            h=2 * np.pi / 100,
            num_steps=STEPS,
            method=method,
            arithmetic=dvi.Compensated(),
            save=dvi.Save(every=EVERY),
        )
        E = np.asarray(jax.vmap(energy)(sol.qs, sol.ps))
        error = np.maximum.accumulate(np.abs(E / E[0] - 1))
        rows = np.unique(np.geomspace(5, len(E) - 1, 300).astype(int))
        axis.loglog(rows * EVERY / 100, error[rows], label=name)
        print(f"{name}: {error[-1]:.1e}")
    axis.set(xlabel="time [periods]", ylabel="largest relative energy error")
    axis.set_title("A Kepler orbit over a million steps")
    axis.legend()


def drifts(axis):
    """Drift of the invariants of orders 0, 1 and 2 against ε."""
    oscillator = dvi.System(
        lambda t0, t1, q0, p1, args: (p1 @ p1 + q0 @ q0) / 2,
        force=lambda t0, t1, q0, p1, args: -(q0**3),
    )
    samples = np.random.default_rng(0).uniform(-1, 1, (2, 400, 1))
    epsilons = np.geomspace(0.004, 0.1, 8)
    found = dvi.discover_invariants(
        oscillator, dvi.Polynomials(8), order=2, h=0.1, samples=samples, representative="simplest"
    ).invariants[0]
    print(found)
    for order in range(3):
        measured = dvi.drift_order(
            oscillator,
            truncated(found, order),
            [0.4],
            [0.3],
            h=0.1,
            num_steps=5000,
            epsilons=epsilons,
        )
        label = f"order {order}: drift ∝ ε$^{{{measured.slope:.2f}}}$"
        (line,) = axis.loglog(measured.epsilons, measured.drifts, "o-", label=label)
        out = ~measured.used
        look = {"mfc": "white", "color": line.get_color()}
        axis.plot(measured.epsilons[out], np.asarray(measured.drifts)[out], "o", **look)
        print(order, measured.slope, measured.stderr)
    axis.set(xlabel="strength ε of the perturbing force", ylabel="largest drift over 5000 steps")
    axis.set_ylim(bottom=1e-17)  # space for the legend
    axis.set_title("Invariants found for a perturbed oscillator")
    axis.plot([], [], "o", mfc="white", color="0.3", label="excluded: round-off")
    axis.legend()


def truncated(found, order):
    """The invariant up to the power `order` of ε."""
    return eqx.tree_at(lambda f: f.coefficients, found, found.coefficients[: order + 1])


if __name__ == "__main__":
    with dvi.plot.style():
        figure, (left, right) = plt.subplots(1, 2, figsize=(10.5, 4.2), layout="constrained")
        energy_errors(left)
        drifts(right)
        dvi.plot.save(figure, sys.argv[1] if len(sys.argv) > 1 else "overview.png")
