# %% [markdown]
# # GPU: devices, batches, precision
#
# How does one put a batch of trajectories on a GPU, and what does single precision cost, at which a
# GPU is fastest? This notebook runs on whatever device JAX finds. The outputs that are kept here
# are those of a CPU.
#
# **What is known and what is not.** On a GPU a batch is compiled by XLA as any JAX program: a scan
# over the steps under `vmap`. The package has not been run on a GPU, and no speed on one has been
# measured; see `docs/gpu.md`.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import dvi_jax as dvi
from dvi_jax import plot

jax.config.update("jax_enable_x64", True)  # on a GPU, too

device = jax.devices()[0]
print("platform:", device.platform)

# %% [markdown]
# `JAX_PLATFORMS=cpu` or `cuda` in the environment chooses before Python starts; for an NVIDIA GPU
# install `dvi-jax[cuda12]`. Within a program `jax.default_device` chooses for a block, and an array
# that was put somewhere with `jax.device_put` is computed with there.
#
# ## A batch
#
# One trajectory alone is a chain of small operations that waits for itself; a GPU wants many. So
# the function of one trajectory is mapped over starts: `vmap`, then `jit`. `Save(final=True)` and
# observables that are reduced on the way keep memory from growing with the number of steps.


# %%
def H_D(t0, t1, q0, p1, args):
    return p1 @ p1 / 2 - 1 / jnp.linalg.norm(q0)


def L(t0, t1, q0, p0, q1, p1, args):
    return q1[0] * p1[1] - q1[1] * p1[0]


system = dvi.System(H_D, force=lambda t0, t1, q0, p1, args: -q0)


def one(q0, p0, layout=dvi.Layout(), num_steps=1000):
    sol = dvi.integrate(
        system, q0, p0, h=jnp.asarray(0.05, q0.dtype), num_steps=num_steps,
        epsilon=jnp.asarray(0.01, q0.dtype), save=dvi.Save(final=True),
        observe=dvi.MaxDrift(L), layout=layout, throw=False,
    )  # fmt: skip
    return sol.qs[-1], sol.observed, sol.stats["failed_step"]


rng = np.random.default_rng(0)
q0 = np.array([0.0, 1.2]) + 0.05 * rng.normal(size=(1024, 2))
p0 = np.array([-1.0, -0.6]) + 0.05 * rng.normal(size=(1024, 2))
batch = jax.jit(jax.vmap(one))
with jax.default_device(device):
    q, drift, failed = batch(q0, p0)
print(q.shape, q.dtype, "on", {d.platform for d in q.devices()})
print(
    "failed:",
    int(np.sum(np.asarray(failed) >= 0)),
    f" largest drift of L: {float(drift.max()):.0e}",
)
assert float(drift.max()) < 1e-12

# %% [markdown]
# Several devices: `dvi.over_devices(jax.vmap(one))` divides the lanes between them, `dvi.sweep`
# hands its tasks to all of them and loses nothing when one is lost. With one device the result is
# the same, bit by bit.

# %%
divided = jax.jit(dvi.over_devices(jax.vmap(one)))
assert np.array_equal(divided(q0, p0)[0], q)
print(len(jax.devices()), "device")

# %% [markdown]
# ## Two forms of the arithmetic
#
# `Layout()` chooses by itself: arrays as they were written on a GPU, and on a CPU components (every
# array element a number of its own) for batches of 100 000 trajectories × steps or more. The
# numbers are the same to round-off. Eight trajectories, twenty steps:

# %%
few = q0[:8], p0[:8]
numbers = {}
for form in ("components", "arrays"):
    layout = dvi.Layout(form=form, width=4)
    run = jax.jit(jax.vmap(lambda q, p, layout=layout: one(q, p, layout, num_steps=20)))
    numbers[form] = np.asarray(run(*few)[0])
worst = np.abs(numbers["components"] - numbers["arrays"]).max()
print(f"components and arrays agree to {worst:.0e}")
assert worst < 1e-14

# %% [markdown]
# ## What single precision costs
#
# GPUs for graphics compute in float32 many times faster than in float64. A float64 array with x64
# off is refused; float32 is taken when it is asked for, by the type of the start. The angular
# momentum is exact for this map, so that all of its drift is round-off: how does it grow?

# %%
marks = np.unique(np.geomspace(10, 200_000, 40).astype(int))


def drift_of_L(dtype, arithmetic):
    """Root mean square over 64 orbits of the change of L, at steps that are marked."""

    def run(q0, p0):
        sol = dvi.integrate(
            system, q0, p0, h=jnp.asarray(0.0625, dtype), num_steps=200_000,
            epsilon=jnp.asarray(0.0, dtype), save=dvi.Save(every=10), arithmetic=arithmetic,
            layout=dvi.Layout(form="components"),
        )  # fmt: skip
        return sol.qs, sol.ps

    q, p = jax.jit(jax.vmap(run))(q0[:64].astype(dtype), p0[:64].astype(dtype))
    q, p = (np.asarray(x, np.float64)[:, marks // 10] for x in (q, p))
    values = q[..., 0] * p[..., 1] - q[..., 1] * p[..., 0]
    first = q0[:64].astype(dtype).astype(float), p0[:64].astype(dtype).astype(float)
    start = first[0][:, 0] * first[1][:, 1] - first[0][:, 1] * first[1][:, 0]
    return np.sqrt(np.mean((values / start[:, None] - 1) ** 2, axis=0))


growth = {
    "float32": drift_of_L(jnp.float32, dvi.FloatingPoint()),
    "float32, compensated": drift_of_L(jnp.float32, dvi.Compensated()),
    "float64": drift_of_L(jnp.float64, dvi.FloatingPoint()),
}
for name, values in growth.items():
    print(f"{name:21} after {marks[-1]} steps: {values[-1]:.0e}")

ratio = growth["float32"][-1] / growth["float64"][-1]
assert 1e7 < ratio < 1e10  # of the units in the last place: 5e8
assert growth["float32, compensated"][-1] < 0.1 * growth["float32"][-1]

# %%
with plot.style():
    figure, axis = plt.subplots(figsize=(6.4, 3.6))
    for (name, values), mark in zip(growth.items(), "os^", strict=True):
        axis.loglog(marks, values, mark + "-", ms=3, lw=1, label=name)
    axis.set(
        xlabel="steps", ylabel="rms relative change of L", title="Round-off in an exact invariant"
    )
    figure.legend(loc="outside lower center", ncols=3)
plt.show()

# %% [markdown]
# In float32 the drift is that of float64 times the ratio of the units in the last place, some
# $5 \times 10^8$. `Compensated()` carries what a sum loses, for a few operations more. After
# 200 000 steps plain float32 has lost $2 \times 10^{-5}$ of an invariant that is exact: an
# adiabatic one that drifts by less cannot be measured with it, which is why the package asks for
# float64 unless told otherwise.
#
# ## What next
#
# - On a device: run this notebook there, and compare the printed numbers with those kept here.
