"""Losses of fusion-born alpha particles from a stellarator, with error bars and maps.

Run: python examples/alpha_losses.py [DIRECTORY] [--field precise_qa] [--particles 1000]
     [--seconds 0.01]

`--field` is precise_qa, w7x, or a file of booz_xform. The same command again continues an
interrupted run: what is computed is in DIRECTORY/alpha_losses.zarr. As a command of the command
line: alpha_losses.toml next to this file.
"""

import argparse
from pathlib import Path

import jax
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np

import dvi_jax as dvi
from dvi_jax import plot
from dvi_jax.systems import boozer

jax.config.update("jax_enable_x64", True)
mpl.use("Agg")

PROMPT = 1e-3
"""Seconds: a trapped particle whose banana orbit leaves the plasma is lost before this time."""


def field_named(name):
    """A field of the package, or that of a file, scaled to a reactor."""
    if name in ("precise_qa", "w7x"):
        return getattr(boozer, name)()
    return boozer.read_booz_xform(name, box=(6, 4)).scaled()


def swept(alphas, particles, seconds, store=None, seed=1):
    """The sweep over all particles: when each is lost, and how well its energy is conserved."""
    system = alphas.system

    def energy(t0, t1, q0, p0, q1, p1, args):
        """2H, which is 1."""
        return 2 * system.hamiltonian(t1, t1, q1, p1, 0.0, args)

    return dvi.sweep(
        system,
        start=boozer.Births(particles, alphas, seed=seed),
        args=alphas.args(0.0),  # each particle has its own mu
        h=alphas.h,
        num_steps=alphas.steps(seconds),
        method=dvi.GaussLegendre(2),
        stop=alphas.loss,
        observe={"energy_drift": dvi.MaxDrift(energy)},
        store=store,
        progress=True,
    )


def births(alphas, particles, seed=1):
    """s and pitch at birth."""
    starts = boozer.Births(particles, alphas, seed=seed)
    q, p, _ = jax.jit(jax.vmap(lambda i: starts.at(i, 0.0, None)))(np.arange(particles))
    at = alphas.coordinates_of(q, p)
    return np.asarray(at.s), np.asarray(at.v_parallel) / alphas.speed


def tips(alphas, seconds=2e-3):
    """s and ζ of the points where trapped particles turn: a Poincaré section at v∥ = 0."""
    s = np.linspace(0.05, 0.75, 15)
    start = alphas.coordinates_of(*alphas.start(s, 0.0, 0.0, 0.0)[:2])
    # From θ = 0, where |B| is smallest, with a pitch that turns half way to the largest |B|.
    far = np.asarray(alphas.field.strength(s, np.pi / 2, 0.0))
    pitch = np.sqrt(np.maximum(1 - np.asarray(start.B) / far, 0.0))
    q, p, args = alphas.start(s, 0.0, 0.0, pitch)

    def one(q, p, mu):
        return dvi.integrate(
            alphas.system,
            q,
            p,
            h=alphas.h,
            num_steps=alphas.steps(seconds),
            args={**args, "mu": mu},
            method=dvi.GaussLegendre(2),
            observe=alphas.bounces(200),
            stop=alphas.loss,
            save=dvi.Save(final=True),
            throw=False,
        ).observed

    found = jax.jit(jax.vmap(one))(q, p, args["mu"])
    at = alphas.coordinates_of(found.qs, found.ps)
    return np.asarray(at.s), np.asarray(at.zeta)


def draw(alphas, stop_seconds, s, pitch, seconds):
    """The fraction lost against time, the time of the loss over s and pitch at birth, and where
    trapped particles turn."""
    figure, (left, right, last) = plt.subplots(1, 3, figsize=(15, 4.2), layout="constrained")
    times = np.geomspace(1e-5, seconds, 200)
    found = boozer.loss_fraction(stop_seconds, times)
    left.fill_between(times, 100 * found.low, 100 * found.high, alpha=0.3, label="68 % interval")
    left.plot(times, 100 * found.fraction, label=f"{len(s)} particles")
    left.axvline(PROMPT, linestyle=":", color="0.5")
    left.set(xscale="log", xlabel="time [s]", ylabel="lost particles [%]", ylim=(0, None))
    left.set_title("Lost particles against time")
    left.legend(loc="upper left")
    lost = np.isfinite(stop_seconds)
    right.scatter(s[~lost], pitch[~lost], s=5, color="0.8", label="not lost")
    marks = right.scatter(
        s[lost], pitch[lost], s=16, c=stop_seconds[lost], norm=mpl.colors.LogNorm(1e-5, seconds)
    )
    figure.colorbar(marks, ax=right, label="time of the loss [s]")
    right.set(xlim=(0, 1), ylim=(-1, 1), xlabel="s at birth", ylabel="v$_∥$/v at birth")
    right.set_title("Which particles are lost")
    right.legend(loc="lower right")
    for of_orbit, zeta in zip(*tips(alphas), strict=True):
        period = 2 * np.pi / alphas.field.shape.periods
        last.plot(zeta % period, of_orbit, ".", markersize=2)
    last.set(ylim=(0, 1), xlabel="ζ, modulo a period", ylabel="s")
    last.set_title("Where trapped particles turn, v$_∥$ = 0")
    return figure


def main():
    """Sweep, print the losses, write the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("directory", nargs="?", default=".", type=Path)
    parser.add_argument("--field", default="precise_qa")
    parser.add_argument("--particles", type=int, default=1000)
    parser.add_argument("--seconds", type=float, default=0.01)
    options = parser.parse_args()
    options.directory.mkdir(parents=True, exist_ok=True)
    alphas = boozer.GuidingCentres(field_named(options.field))
    print(f"step {alphas.h:.3g} m = {1e6 * alphas.seconds(alphas.h):.3g} µs")
    store = options.directory / "alpha_losses.zarr"
    result = swept(alphas, options.particles, options.seconds, store)
    print(result.status_counts())
    stops = alphas.seconds(np.asarray(result["stop_t"]))
    failed = np.asarray(result["status"]) == "not_converged"
    at_end = boozer.loss_fraction(stops, [PROMPT, options.seconds])
    for time, x, low, high in zip(*at_end, strict=True):
        print(f"lost after {time:g} s: {100 * x:.2f} % ({100 * low:.2f} to {100 * high:.2f} %)")
    drift = np.asarray(result["energy_drift"])
    print(f"energy drift: median {np.nanmedian(drift):.1e}, largest {np.nanmax(drift):.1e}")
    print(f"not solved: {int(failed.sum())}")
    with plot.style():
        figure = draw(alphas, stops, *births(alphas, options.particles), options.seconds)
        print(f"written: {plot.save(figure, options.directory / 'alpha_losses.png')}")


if __name__ == "__main__":
    main()
