"""Maps of a sweep: energy drift of the perturbed Kepler problem over ε and initial momentum.

Run: python examples/sweep_map.py [DIRECTORY for the picture]
"""

import sys
from pathlib import Path

import jax
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np

import dvi_jax as dvi
from dvi_jax import plot, systems

jax.config.update("jax_enable_x64", True)
mpl.use("Agg")


def measured():
    """The largest drift of the energy for 36 perturbation strengths × 44 initial momenta.

    Gauss' method of order 4 has an equation to solve in each step. The smaller the momentum, the
    nearer the body comes to the centre, and there it finds no solution with a step of this size.
    """
    kepler = systems.kepler()
    return dvi.sweep(
        kepler.system,
        kepler.q0,
        [dvi.Axis("p_x", np.linspace(-1.3, -0.3, 44)), kepler.p0[1]],
        epsilon=np.geomspace(1e-4, 1.0, 36),
        h=kepler.h,
        num_steps=300,
        args=kepler.args,
        method=dvi.GaussLegendre(2),
        observe={"energy_drift": dvi.MaxDrift(kepler.observables["energy"])},
    )


def draw(data):
    """Drift, local order in ε and statuses, side by side."""
    figure, axes = plt.subplots(1, 3, figsize=(12.6, 4.3), layout="constrained")
    data.p_x.attrs["long_name"] = "initial momentum p$_x$"
    data.energy_drift.attrs["long_name"] = "largest drift of the energy"
    plot.sweep_map(data.energy_drift, limits=(1e-4, 10), ax=axes[0])
    plot.slope_map(data.energy_drift, "epsilon", x="epsilon", limits=(0, 2), ax=axes[1])
    plot.failure_map(data, ax=axes[2])
    titles = "Largest drift of the energy", "Order of the drift in ε", "Status of the runs"
    for axis, title in zip(axes, titles, strict=True):
        axis.set(title=title, xlabel="strength ε of the perturbing force")
    figure.get_layout_engine().set(w_pad=0.12)
    return figure


def main():
    """Sweep, print what happened, write the picture."""
    out = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
    out.mkdir(parents=True, exist_ok=True)
    result = measured()
    print(result, result.status_counts())
    with plot.style():
        print(f"written: {plot.save(draw(result.to_xarray()), out / 'sweep_maps.png')}")


if __name__ == "__main__":
    main()
