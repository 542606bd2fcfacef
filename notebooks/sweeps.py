# %% [markdown]
# # Sweeps: many trajectories at once
#
# In this notebook you compute many trajectories with one call of `dvi.sweep`, for example to find
# how the drift of an invariant depends on the perturbation and on the initial condition.
# `dvi.sweep` runs a grid of parameters, labels the results and gives each trajectory a status. With
# `store=` it stores finished results on disk.
#
# The system is the Kepler problem in the plane, perturbed by the central force $-\varepsilon q$.
# You measure with which power of $\varepsilon$ the drift of the energy $H$ scales, whether the
# angular momentum $L$ drifts, and for which orbits the run fails.

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
folder = tempfile.TemporaryDirectory()  # for results that you need later, use a permanent folder

# %% [markdown]
# ## A grid
#
# Any number in `epsilon`, `h`, `t0`, `q0`, `p0` and `args` can be an axis of the grid. Here the
# axes are 20 strengths `epsilon` and 32 initial momenta `p_x`, which gives 640 trajectories. The
# method is Gauss' method of order 6. Each trajectory has 800 steps, but only two numbers per
# trajectory are stored: the largest drifts of $H$ and $L$, which are computed during the run.

# %%
asked = {
    "q0": kepler.q0,
    "p0": [dvi.Axis("p_x", np.linspace(-0.85, -0.25, 32)), kepler.p0[1]],
    "epsilon": np.geomspace(1e-4, 0.5, 20),
    "h": 0.05,
    "num_steps": 800,
    "args": kepler.args,
    "method": dvi.GaussLegendre(3),
    "progress": False,  # True shows a progress bar
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
# A failed trajectory affects only its own entry. Orbits with initial momenta close to $-0.25$ come
# so close to the centre that the solver does not converge with the step 0.05. The failed
# trajectories are counted, hatched in the first two plots, and excluded from the statistics below.

# %%
data.p_x.attrs["long_name"] = "initial momentum p$_x$"
data.energy_drift.attrs["long_name"] = "largest drift of the energy"
with plot.style():
    plot.sweep_map(data.energy_drift, x="epsilon", limits=(1e-5, 1)).set_title(
        "Drift of the energy"
    )
    plt.show()
    order_of = plot.slope_map(data.energy_drift, "epsilon", x="epsilon", limits=(0, 2))
    order_of.set_title("Order of the drift in ε")
    plt.show()
    plot.failure_map(data).set_title("Status of the runs")
    plt.show()

# %% [markdown]
# ## Numbers
#
# The drift of the energy is proportional to $\varepsilon$ for small $\varepsilon$. For very
# eccentric orbits, which come close to the centre, the error of the discretisation is larger than
# the effect of $\varepsilon$. The local exponent of $\varepsilon$ (second plot) then changes
# irregularly from pixel to pixel, and the exponent of the median drift is close to 0.
#
# The angular momentum must not drift, except for round-off and the tolerance of the solver: the
# force has no torque, and Gauss' methods conserve quadratic invariants.

# %%
good = data.where(data.status == 0)


def order(drift, epsilons):
    """Power of ε in the median over initial momenta."""
    return np.polyfit(np.log(epsilons), np.log(drift.median("p_x")), 1)[0]


weak = good.sel(epsilon=slice(1e-4, 3e-3))
round_orbits = order(weak.energy_drift.sel(p_x=slice(-0.85, -0.52)), weak.epsilon)
eccentric_orbits = order(weak.energy_drift.sel(p_x=slice(-0.37, -0.33)), weak.epsilon)
largest = float(good.momentum_drift.max())
print(f"drift of H: ε^{round_orbits:.2f}; on very eccentric orbits ε^{eccentric_orbits:.2f}")
print(f"drift of L: at most {largest:.0e}")
share = float((data.status != 0).mean())
print(f"{100 * share:.1f} % of the trajectories failed")

assert abs(round_orbits - 1) < 0.1
assert abs(eccentric_orbits) < 0.3
assert largest < 1e-11
assert 0 < share < 0.2

# %% [markdown]
# ## Repeat and resume
#
# The store contains a description of this sweep and its results. If you repeat the call, it reads
# all results and computes no trajectory. If you repeat the call after an interruption, it computes
# only the missing tasks. On the same machine, with the same versions, the results are then
# identical bit for bit to those of a sweep without interruption.
#
# `integrate` computes a single trajectory with another compiled program. Its result agrees with
# that of the sweep at least to round-off.

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
# As a control, the step h is changed from 0.05 to 0.051. `sweep` must then reject the store,
# because the store contains the results of another sweep. The line below is a part of the error
# message.

# %%
try:
    dvi.sweep(kepler.system, **asked | {"h": 0.051}, store=store)
except dvi.StoreMismatch as refusal:
    print(*str(refusal).splitlines()[1:2])
else:
    raise AssertionError("a sweep with another step was accepted")

# %%
folder.cleanup()

# %% [markdown]
# ## Next steps
#
# - Generate initial conditions on the device: `start=dvi.starts.Halton(count, low, high)`. They are
#   computed when they are needed, so that even $10^{12}$ of them need no memory.
# - Run a sweep from a file: `dvi-jax sweep examples/sweep.toml`.
# - Estimate the time and the size of a large sweep: `dvi.sweep_cost(...)` computes one task for
#   each method and number of steps.
# - Use many machines: pass a Dask client as `client=`.
