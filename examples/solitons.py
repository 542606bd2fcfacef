"""Solitons of the sine-Gordon equation with weak friction and a drive: laws of their parameters.

Above: a kink at rest is accelerated by a constant force against friction; its velocity follows the
law of McLaughlin and Scott, dv/dt = −ε [α v (1 − v²) + (πf/4) (1 − v²)^{3/2}], with the damping α
and the drive f. Below: a breather with friction; its action J = 16 arcsin(E/16) decays as
exp(−εαt), and J exp(εαt) is an adiabatic invariant, while the energy E follows another law.

Run: python examples/solitons.py [DIRECTORY for the picture]
"""

import sys
from pathlib import Path

import jax
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from scipy.integrate import solve_ivp

import dvi_jax as dvi
from dvi_jax import plot, systems
from dvi_jax.systems.sine_gordon import breather_action

jax.config.update("jax_enable_x64", True)
mpl.use("Agg")

DAMPING, DRIVE = 1.0, -1.5


def run(problem, epsilon, duration, q0=None, every=5):
    """A run by the Strang composition, with saved states and observables."""
    steps = round(duration / problem.h / every) * every
    # Friction makes the steps weakly implicit: fixed-point iteration is the shortest program.
    return dvi.integrate(problem, q0=q0, num_steps=steps, epsilon=epsilon, method=dvi.Strang(),
                         root_finder=dvi.Picard(), observe=problem.observables,
                         save=dvi.Save(every=every), layout=dvi.Layout(form="arrays"))  # fmt: skip


def kink(epsilon, duration, n=192, dx=0.2):
    """Solution, times, and velocities of a kink: measured, and by the law."""
    problem = systems.sine_gordon(n, dx, start="kink", velocity=0.0, damping=DAMPING, drive=DRIVE)
    # The vacuum is displaced by the drive. In the old one the whole field would oscillate.
    vacuum = np.arcsin(epsilon * DRIVE)
    sol = run(problem, epsilon, duration, q0=problem.q0 + vacuum)

    def law(t, v):
        drive = np.pi * DRIVE / 4 * (1 - v**2) ** 1.5
        return -epsilon * (DAMPING * v * (1 - v**2) + drive)

    t = np.asarray(sol.ts)
    v = solve_ivp(law, (0, t[-1]), [0.0], t_eval=t, rtol=1e-9, atol=1e-9).y[0]
    return sol, t, np.asarray(sol.observed["kink_velocity"]), v


def breather(epsilon, duration, n=192, dx=0.2):
    """Solution, times, energies and actions of a breather at rest."""
    problem = systems.sine_gordon(n, dx, velocity=0.0, damping=DAMPING)
    sol = run(problem, epsilon, duration)
    energy = np.asarray(sol.observed["energy"])
    return sol, np.asarray(sol.ts), energy, np.asarray(breather_action(energy))


def draw(axis, sol, n=192, dx=0.2, **colours):
    """The field over space and time."""
    x = dx * (np.arange(n) - (n - 1) / 2)
    field = colours.pop("of", lambda u: u)(np.asarray(sol.qs))
    image = axis.pcolormesh(np.asarray(sol.ts), x, field.T, rasterized=True, **colours)
    axis.set(xlabel="t", ylabel="x")
    axis.grid(visible=False)
    return image


def main():
    with plot.style():
        figure, axes = plt.subplots(2, 2, figsize=(10, 6.4), layout="constrained")
        sol, *_ = kink(0.05, 60.0)
        image = draw(axes[0, 0], sol, of=lambda u: 1 - np.cos(u - np.arcsin(0.05 * DRIVE)),
                     cmap="magma")  # fmt: skip
        figure.colorbar(image, ax=axes[0, 0], label="1 − cos(u − u₀), u₀: vacuum")
        axes[0, 0].set_title("Driven kink on a ring, ε = 0.05")
        for i, epsilon in enumerate((0.05, 0.025)):
            _, t, v, law = kink(epsilon, 3 / epsilon)
            axes[0, 1].plot(epsilon * t, v, color=plot.COLOURS[i], label=f"ε = {epsilon}")
            print(f"kink, ε = {epsilon}: v({t[-1]:.0f}) = {v[-1]:.4f}, law {law[-1]:.4f}, "
                  f"largest difference {np.max(np.abs(v - law)):.1e}")  # fmt: skip
        axes[0, 1].plot(epsilon * t, law, "k--", lw=1, label="McLaughlin & Scott")
        limit = -np.pi * DRIVE / (4 * DAMPING)
        limit /= np.hypot(1, limit)
        axes[0, 1].axhline(limit, color="0.6", lw=0.8, label="friction = drive")
        axes[0, 1].set(xlabel="εt", ylabel="velocity v", title="Its velocity")
        axes[0, 1].legend()
        sol, *_ = breather(0.02, 100.0)
        image = draw(axes[1, 0], sol, cmap="RdBu_r", vmin=-5, vmax=5)
        figure.colorbar(image, ax=axes[1, 0], label="u")
        axes[1, 0].set_title("Breather with friction, ε = 0.02")
        for i, epsilon in enumerate((0.02, 0.01)):
            _, t, energy, action = breather(epsilon, 2 / epsilon)
            growth = np.exp(epsilon * DAMPING * t)
            invariant = action * growth / action[0]
            axes[1, 1].plot(epsilon * t, invariant, color=plot.COLOURS[i],
                            label=f"J exp(εt)/J₀, ε = {epsilon}")  # fmt: skip
            print(f"breather, ε = {epsilon}: J exp(εt) varies by {np.ptp(invariant):.1e}, "
                  f"E exp(εt) by {np.ptp(energy * growth / energy[0]):.1e}")  # fmt: skip
        axes[1, 1].plot(epsilon * t, energy * growth / energy[0], "k--", lw=1,
                        label="E exp(εt)/E₀")  # fmt: skip
        axes[1, 1].set(xlabel="εt", ylabel="relative to t = 0", title="Its action and its energy")
        axes[1, 1].legend()
        folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
        print(f"picture: {plot.save(figure, folder / 'solitons.png')}")


if __name__ == "__main__":
    main()
