"""Heat load of lost alpha particles on the first wall of a stellarator.

Run: python examples/alpha_walls.py WOUT [DIRECTORY] [--particles 10000] [--seconds 1e-4]

`WOUT` is a file of VMEC, which is scaled to the size of a reactor (packages booz_xform, netCDF4).
The picture of the documentation is that of wout_li383_1.4m.nc, NCSX, from the tests of booz_xform.
The wall of triangles is at s = 1.15. The particles that reach s = 1.1 are followed for 200 steps
more: to the wall, or back into the plasma.
"""

import argparse
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np

import dvi_jax as dvi
from dvi_jax import plot
from dvi_jax.systems import boozer

jax.config.update("jax_enable_x64", True)
mpl.use("Agg")

POWER, BEFORE, WALL, BEYOND, RADIUS = 100e6, 1.1, 1.15, 1.25, 1.7
"""Power of the alphas [W]; values of s; minor radius [m]."""

CELLS, BLOCK = (48, 192), 4
"""Cells of the wall in θ and ζ, and cells per block of the picture in each direction."""


def reactor(path):
    """Guiding centres and geometry of an equilibrium at the size of a reactor."""
    field, geometry = boozer.read_vmec(path, modes=(24, 16), surfaces=16, box=(4, 4))
    factor = RADIUS / jnp.sqrt(2 * field.psi_edge / field.average)
    lengths = factor * geometry.R, factor * geometry.Z
    geometry = eqx.tree_at(lambda g: (g.R, g.Z), geometry, lengths)
    return boozer.GuidingCentres(field.scaled(minor_radius=RADIUS)), geometry


def lost_paths(alphas, particles, seconds):
    """s, θ and ζ of those that reach s = 1.1, for 200 steps from there."""
    births = boozer.Births(particles, alphas, seed=1)

    @jax.jit
    @jax.vmap
    def run(i):
        q, p, args = births.at(i, 0.0, None)
        return dvi.integrate(
            alphas.system, q, p, h=alphas.h, num_steps=alphas.steps(seconds), args=args,
            method=dvi.GaussLegendre(2), stop=alphas.loss_at(BEYOND), throw=False,
        )  # fmt: skip

    paths, failed = [], 0
    for batch in np.array_split(np.arange(particles), max(1, particles // 1000)):
        sol = run(batch)
        failed += np.sum(~np.isin(sol.status, ["successful", "stopped"]))
        places = np.stack(alphas.coordinates_of(sol.qs, sol.ps)[:3])
        is_beyond = places[0] > BEFORE
        rows = np.flatnonzero(is_beyond.any(1))
        steps = is_beyond[rows].argmax(1)[:, None] + np.arange(-1, 200)
        paths.append(places[:, rows[:, None], np.minimum(steps, is_beyond.shape[1] - 1)])
    print(f"orbits with an error: {failed}")
    return np.concatenate(paths, axis=1)


def draw(wall, hits, power, periods):
    """The mean of all periods of the torus in blocks of cells, and the number of hits in each."""
    watts = wall.heat_load(hits, power) * wall.areas

    def blocks(values):
        shape = (CELLS[0] // BLOCK, BLOCK, periods, CELLS[1] // periods // BLOCK, BLOCK * 2)
        return values.reshape(shape).sum((1, 2, 4))

    load = blocks(watts) / blocks(wall.areas)
    print(f"largest load of a block {load.max() / 1e6:.2f} MW/m², "
          f"{blocks(watts).flat[load.argmax()] / power:.0f} particles")  # fmt: skip
    print(f"mean of the wall {watts.sum() / wall.areas.sum() / 1e3:.1f} kW/m²")
    figure, axis = plt.subplots(figsize=(7.5, 3.6), layout="constrained")
    axis.grid(False)
    image = axis.imshow(load / 1e6, origin="lower", extent=(0, 360 / periods, 0, 360),
                        aspect="auto", cmap="inferno")  # fmt: skip
    axis.set(xlabel="ζ within one period [degrees]", ylabel="θ [degrees]", yticks=range(0, 361, 90))
    figure.colorbar(image, label="heat load [MW/m²]")
    return figure


def main():
    """Follow the particles, print the losses, write the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("wout", type=Path)
    parser.add_argument("directory", nargs="?", default=".", type=Path)
    parser.add_argument("--particles", type=int, default=10000)
    parser.add_argument("--seconds", type=float, default=1e-4)
    options = parser.parse_args()
    options.directory.mkdir(parents=True, exist_ok=True)
    alphas, geometry = reactor(options.wout)
    paths = lost_paths(alphas, options.particles, options.seconds)
    wall = boozer.wall_of_surface(geometry, WALL, CELLS)
    hits = wall.hits(geometry.cartesian(*paths))
    is_hit, power = hits.triangle >= 0, POWER / options.particles
    print(f"step {alphas.h:.2f} m; {paths.shape[1]} of {options.particles} particles "
          f"reach s = {BEFORE} within {options.seconds:g} s")  # fmt: skip
    print(f"{is_hit.sum()} of them, {is_hit.sum() * power / 1e6:.2f} MW, meet the wall")
    angle, error = np.degrees(hits.angle[is_hit]), 1e3 * hits.error[is_hit]
    print(f"angle of incidence: median {np.median(angle):.1f}°, smallest {angle.min():.0f}°")
    print(
        f"error of the point: median {np.nanmedian(error):.1f} mm, largest {np.nanmax(error):.0f}"
    )
    print(f"without an estimate of the error, in the last segment: {np.isnan(error).sum()}")
    with plot.style():
        figure = draw(wall, hits, power, alphas.field.shape.periods)
        print(f"written: {plot.save(figure, options.directory / 'alpha_walls.png')}")


if __name__ == "__main__":
    main()
