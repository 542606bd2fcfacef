# %% [markdown]
# # Sweeps: many trajectories at once
#
# How does the drift of an invariant depend on the disturbance, and on where the orbit starts? One
# trajectory does not tell. `dvi.sweep` runs a whole grid, labels the results, gives a status to
# each trajectory and keeps in a store what is done.
#
# The system is Kepler's, in the plane, disturbed by the central force $-\varepsilon q$. At which
# power of $\varepsilon$ do energy $H$ and angular momentum $L$ drift, on the mesh, and which orbits
# fail?

# %%
import tempfile
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np

import dvi_jax as dvi
from dvi_jax import plot, systems

jax.config.update("jax_enable_x64", True)

kepler = systems.kepler()
folder = tempfile.TemporaryDirectory()  # give a lasting place to results that matter

# %% [markdown]
# ## A grid
#
# Wherever `integrate` takes a number, `sweep` takes an axis: here 20 strengths and 32 momenta at
# the start, 640 trajectories of Gauss' method of order 6. Of 800 steps each only two numbers are
# kept: the largest drifts, found on the way.

# %%
asked = {
    "q0": kepler.q0,
    "p0": [dvi.Axis("p_x", np.linspace(-0.85, -0.25, 32)), kepler.p0[1]],
    "epsilon": np.geomspace(1e-4, 0.5, 20),
    "h": 0.05,
    "num_steps": 800,
    "args": kepler.args,
    "method": dvi.GaussLegendre(3),
    "progress": False,  # True for a bar
    "observe": {
        "energy_drift": dvi.MaxDrift(kepler.observables["energy"]),
        "momentum_drift": dvi.MaxDrift(kepler.observables["angular_momentum"]),
    },
}
store = Path(folder.name) / "kepler.zarr"
result = dvi.sweep(kepler.system, **asked, store=store)
data = result.to_xarray()
print(dict(data.sizes), result.status_counts())

# %% [markdown]
# A trajectory that fails costs its own result and no other: the momenta near $-0.25$ fall so close
# to the centre that the equations of a step of this size have no solution to be found. They are
# counted, hatched in the picture, and left out where statistics are made.

# %%
data.p_x.attrs["long_name"] = "momentum p$_x$ at the start"
data.energy_drift.attrs["long_name"] = "largest drift of the energy"
with plot.style():
    plot.sweep_map(data.energy_drift, x="epsilon", limits=(1e-5, 1)).set_title("Drift")
    plt.show()
    order_of = plot.slope_map(data.energy_drift, "epsilon", x="epsilon", limits=(0, 2))
    order_of.set_title("Its order in ε")
    plt.show()
    plot.failure_map(data).set_title("How runs end")
    plt.show()

# %% [markdown]
# ## Numbers
#
# The energy drifts with the first power of $\varepsilon$ as long as that is small. Where the orbit
# falls close to the centre the mesh does more than $\varepsilon$: the local slope is noise, the
# checkerboard in the picture, and a line through the median has a slope near 0. The angular
# momentum must not drift at all: the force has no torque, and a symplectic Runge–Kutta method keeps
# quadratic invariants.

# %%
good = data.where(data.status == 0)


def order(drift, epsilons):
    """Power of ε in the median over starts."""
    return np.polyfit(np.log(epsilons), np.log(drift.median("p_x")), 1)[0]


weak = good.sel(epsilon=slice(1e-4, 3e-3))
round_orbits = order(weak.energy_drift.sel(p_x=slice(-0.85, -0.52)), weak.epsilon)
steep_orbits = order(weak.energy_drift.sel(p_x=slice(-0.37, -0.33)), weak.epsilon)
largest = float(good.momentum_drift.max())
print(f"drift of H: ε^{round_orbits:.2f}; on steep orbits ε^{steep_orbits:.2f}")
print(f"drift of L: at most {largest:.0e}")
share = float((data.status != 0).mean())
print(f"{100 * share:.1f} % of the trajectories failed")

assert abs(round_orbits - 1) < 0.1
assert abs(steep_orbits) < 0.3
assert largest < 1e-11
assert 0 < share < 0.2

# %% [markdown]
# ## Done is done
#
# The store belongs to this sweep. The same call finds everything done, and computes nothing; had it
# been killed half-way, it would go on with what is missing. So it gives the same bits. And a single
# trajectory of the sweep is the one that `integrate` gives by itself: another program, which agrees
# to round-off.

# %%
again = dvi.sweep(kepler.system, **asked, store=store)
assert np.array_equal(again["energy_drift"], result["energy_drift"], equal_nan=True)

i, j = 11, 5
alone = dvi.integrate(
    kepler.system, kepler.q0, [float(data.p_x[j]), kepler.p0[1]],
    epsilon=float(data.epsilon[i]), h=0.05, num_steps=800, args=kepler.args,
    method=dvi.GaussLegendre(3), observe=asked["observe"], save=dvi.Save(final=True),
)  # fmt: skip
in_sweep = data.energy_drift.isel(epsilon=i, p_x=j).item()
print(f"in the sweep {in_sweep:.12f}, alone {float(alone.observed['energy_drift']):.12f}")
assert abs(in_sweep / float(alone.observed["energy_drift"]) - 1) < 1e-10

# %% [markdown]
# The control: another sweep must not be taken for it. One number is changed, and the store refuses.

# %%
try:
    dvi.sweep(kepler.system, **asked | {"h": 0.051}, store=store)
except dvi.StoreMismatch as refusal:
    print(*str(refusal).splitlines()[1:2])
else:
    raise AssertionError("a sweep with another step was taken for the same")

# %%
folder.cleanup()

# %% [markdown]
# ## What next
#
# - `start=dvi.starts.Halton(count, low, high)`: starts that are made on the device, $10^{12}$ of
#   them need no memory.
# - `dvi-jax sweep examples/sweep.toml`: the same from a file.
# - `dvi.sweep_cost(...)`: what a large one will take, measured on one task.
# - Many machines: `client=` takes a Dask cluster.
