# %% [markdown]
# # {{title}}
#
# The system of `system.py`: one trajectory, what it keeps, and how that depends on the disturbance.

# %%
import jax
import numpy as np
from system import angular_momentum, energy, system

import dvi_jax as dvi
from dvi_jax import plot

jax.config.update("jax_enable_x64", True)  # invariants need double precision

args = {"mass": 1.0, "stiffness": 1.0}
q0, p0 = np.array([1.0, 0.0]), np.array([0.0, 0.6])

# %% [markdown]
# ## One trajectory
#
# `observe` takes functions of one step; in a reduction they cost no memory.

# %%
solution = dvi.integrate(
    system,
    q0,
    p0,
    h=0.05,
    num_steps=4000,
    epsilon=0.05,
    args=args,
    method=dvi.Strang(),
    save=dvi.Save(every=4),
    observe={
        "energy": dvi.Range(energy),
        "angular momentum": dvi.MaxDrift(angular_momentum),
    },
)
print(solution.status, solution.observed)
plot.orbit(solution)

# %% [markdown]
# ## The order of the drift
#
# The map of `TypeII` keeps, undisturbed, an energy of its own: the energy − h k q·p / (2 m). The
# disturbance makes it waver, by ε to the first power; `dvi-jax discover` finds what wavers less.


# %%
def kept(t0, t1, q0, p0, q1, p1, args):
    shift = (t1 - t0) * args["stiffness"] / (2 * args["mass"])
    return energy(t0, t1, q0, p0, q1, p1, args) - shift * (q1 @ p1)


order = dvi.drift_order(
    system,
    kept,
    q0,
    p0,
    epsilons=np.geomspace(1e-4, 1e-2, 5),
    h=0.05,
    num_steps=1000,
    args=args,
    method=dvi.TypeII(),
)
print(order)

# %% [markdown]
# ## A derivative through the whole run
#
# Of the last position by the strength of the disturbance.


# %%
def last(epsilon):
    found = dvi.integrate(
        system,
        q0,
        p0,
        h=0.05,
        num_steps=400,
        epsilon=epsilon,
        args=args,
        method=dvi.Strang(),
        save=dvi.Save(final=True),
    )
    return found.qs[-1, 0]


slope = jax.grad(last)(0.05)
print(slope)

# %% [markdown]
# ## Many trajectories, as a picture
#
# Wherever a number stands there may be an axis. `dvi-jax sweep sweep.toml` does the same from a
# file, and `dvi.open_sweep("results/sweep.zarr")` reads what it wrote.

# %%
many = dvi.sweep(
    system,
    [dvi.Axis("x", np.linspace(0.2, 1.2, 24), units="m"), 0.0],
    p0,
    h=0.05,
    num_steps=1000,
    epsilon=np.geomspace(1e-3, 1e-1, 12),
    args=args,
    method=dvi.Strang(),
    observe={"energy_drift": dvi.MaxDrift(energy)},
)
plot.sweep_map(many.to_xarray().energy_drift, x="epsilon", y="x")
