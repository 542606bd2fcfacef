# %% [markdown]
# # {{title}}
#
# The system of `system.py`: one trajectory, what it conserves, and how that depends on ε, the
# strength of the perturbation.

# %%
import jax
import numpy as np
from system import angular_momentum, energy, system

import dvi_jax as dvi
from dvi_jax import plot

jax.config.update("jax_enable_x64", True)  # invariants need double precision

q0, p0 = np.array([1.0, 0.0]), np.array([0.0, 0.6])
settings = {"h": 0.05, "args": {"mass": 1.0, "stiffness": 1.0}, "method": dvi.Strang()}

# %% [markdown]
# ## One trajectory
#
# `observe` takes functions of the state; in a reduction they cost no memory.

# %%
observe = {"energy": dvi.Range(energy), "angular momentum": dvi.MaxDrift(angular_momentum)}
run = settings | {"num_steps": 4000, "epsilon": 0.05, "save": dvi.Save(every=4)}
solution = dvi.integrate(system, q0, p0, observe=observe, **run)
print(solution.status, solution.observed)
plot.orbit(solution)

# %% [markdown]
# ## The order of the drift
#
# Without perturbation the map of `TypeII` conserves the energy − h k q·p / (2 m). With it that
# quantity drifts by an amount of first order in ε; `dvi-jax discover` finds corrections that drift
# less.


# %%
def modified_energy(t, q, p, args):
    shift = settings["h"] * args["stiffness"] / (2 * args["mass"])
    return energy(t, q, p, args) - shift * (q @ p)


epsilons = np.geomspace(1e-4, 1e-2, 5)
run = settings | {"method": dvi.TypeII(), "num_steps": 1000}
order = dvi.drift_order(system, modified_energy, q0, p0, epsilons=epsilons, **run)
print(order)

# %% [markdown]
# ## A derivative through the whole run
#
# The derivative of the last position with respect to ε.


# %%
def last(epsilon):
    run = settings | {"num_steps": 400, "save": dvi.Save(final=True)}
    return dvi.integrate(system, q0, p0, epsilon=epsilon, **run).qs[-1, 0]


slope = jax.grad(last)(0.05)
print(slope)

# %% [markdown]
# ## Many trajectories, as a picture
#
# An axis can take the place of any number. `dvi-jax sweep sweep.toml` does the same from a file,
# and `dvi.open_sweep("results/sweep.zarr")` reads what it wrote.

# %%
x = dvi.Axis("x", np.linspace(0.2, 1.2, 24), units="m")
run = settings | {"num_steps": 1000, "epsilon": np.geomspace(1e-3, 1e-1, 12)}
result = dvi.sweep(system, [x, 0.0], p0, observe={"energy_drift": dvi.MaxDrift(energy)}, **run)
plot.sweep_map(result.to_xarray().energy_drift, x="epsilon", y="x")
