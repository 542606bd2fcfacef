"""Noise: the canonical distribution of a double well, and the diffusion of an adiabatic invariant.

Left: positions of 10⁵ paths of Langevin's equation by BAOAB, and their exact density. Right: the
variance of three quantities of an anharmonic oscillator with weak noise: the invariant of first
order in ε that `dvi.discover_invariants` finds, the energy without the perturbation, and the slope
that averaging predicts.

Run: python examples/noise.py [DIRECTORY for the picture]
"""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np

import dvi_jax as dvi
from dvi_jax import systems

jax.config.update("jax_enable_x64", True)
mpl.use("Agg")

T, EPSILON, STRENGTH = 0.5, 0.2, 0.005


def positions(paths=100_000):
    """Final positions of independent paths in the double well."""
    well = systems.double_well(T)

    def last(key):
        sol = dvi.integrate(well, num_steps=2000, method=dvi.BAOAB(), path=dvi.Brownian(key),
                            save=dvi.Save(final=True))  # fmt: skip
        return sol.qs[-1, 0]

    return np.asarray(jax.jit(jax.vmap(last))(jax.random.split(jax.random.key(0), paths)))


def oscillator(noise=None):
    return dvi.System(
        lambda t0, t1, q0, p1, args: (p1 @ p1 + q0 @ q0) / 2,
        perturbation=lambda t0, t1, q0, p1, args: jnp.sum(q0**4) / 4,
        noise=noise,
    )


def variances(paths=2000, num_steps=1200, h=0.1):
    """Times, variances of the invariant and of the energy over the paths, predicted slope."""
    samples = np.random.default_rng(0).uniform(-1, 1, (2, 200, 1))
    found = dvi.discover_invariants(oscillator(), dvi.Polynomials(4), order=1, h=h,
                                    samples=samples, method=dvi.Strang())  # fmt: skip
    print(found)

    def invariant(q, p):
        return found.evaluate(q, p, EPSILON)[0]

    def energy(q, p):
        return (p @ p + q @ q) / 2

    noisy = oscillator(lambda t, q, p, args: STRENGTH * jnp.cos(q))
    run = {"h": h, "num_steps": num_steps, "epsilon": EPSILON, "method": dvi.BAOAB()}

    def one(key):
        sol = dvi.integrate(noisy, [1.0], [0.0], path=dvi.Brownian(key), **run)
        return [jax.vmap(f)(sol.qs, sol.ps) for f in (invariant, energy)]

    values = jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(1), paths))
    moved = dvi.invariant_diffusion(
        noisy, [1.0], [0.0], invariant=invariant, num_paths=paths, **run
    )
    print(f"B = {moved.diffusion:.3e} ± {moved.diffusion_error:.0e} from the paths, "
          f"{moved.predicted_diffusion:.3e} from averaging")  # fmt: skip
    return h * np.arange(num_steps + 1), *(np.var(v, axis=0) for v in values), moved


def main():
    fig, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
    q = positions()
    x = np.linspace(-2, 2, 400)
    density = np.exp(-((x**2 - 1) ** 2) / T)
    left.hist(q, 80, range=(-2, 2), density=True, color="0.8", label="10⁵ paths")
    left.plot(x, density / (density.sum() * (x[1] - x[0])), "C0", label=r"$e^{-V/T}/Z$")
    left.set(xlabel="q", ylabel="density", title="double well, T = 0.5")
    left.legend(frameon=False)
    t, of_invariant, of_energy, moved = variances()
    right.plot(t, of_energy, "0.6", lw=1, label="energy without perturbation")
    right.plot(t, of_invariant, "C0", label="invariant of order 1 in ε")
    right.plot(t, moved.predicted_diffusion * t, "k--", lw=1, label="averaged: B t")
    right.set(xlabel="t", ylabel="variance over the paths", title="anharmonic oscillator, ε = 0.2")
    right.legend(frameon=False)
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
    fig.savefig(folder / "noise.png", dpi=110)
    print(f"picture: {folder / 'noise.png'}")


if __name__ == "__main__":
    main()
