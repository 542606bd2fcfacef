# %% [markdown]
# # GPU: devices, batches, precision
#
# After this notebook you can start a batch of trajectories on a device that JAX finds, and you can
# measure how much accuracy is lost in single precision. The stored outputs are those of a CPU.
#
# **The package has not been tested on a GPU**, and its speed there has not been measured
# (`docs/gpu.md`). On a GPU a batch is an ordinary JAX program, `jax.lax.scan` over the
# steps under `jax.vmap`. XLA compiles this program.

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
# For an NVIDIA GPU install the extra `cuda12`. To select the device, set `JAX_PLATFORMS=cpu` or
# `JAX_PLATFORMS=cuda` in the environment before Python starts. In a program,
# `jax.default_device(device)` selects the device for a `with` block. If `jax.device_put` has moved
# the input arrays to a device, the computation runs on this device.
#
# ## A batch
#
# The steps of one trajectory cannot run in parallel, because each step needs the result of the step
# before it. To use a whole GPU, compute many trajectories at once: `jax.vmap` maps the function of
# one trajectory over the initial conditions, and `jax.jit` compiles the result. With
# `Save(final=True)` and reductions such as `MaxDrift`, the memory of a run without derivatives does
# not grow with the number of steps.


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
# With several devices, `dvi.over_devices(jax.vmap(one))` divides the batch between them; the size
# of the batch must be a multiple of the number of devices. `dvi.sweep` distributes its tasks to all
# devices. With one device, the result must be identical bit for bit to that without `over_devices`.
# The next cell checks this.

# %%
divided = jax.jit(dvi.over_devices(jax.vmap(one)))
assert np.array_equal(divided(q0, p0)[0], q)
print(len(jax.devices()), "device")

# %% [markdown]
# ## Two ways to compile on a CPU
#
# With `Layout()`, the default, this package compiles a run to machine code on a CPU, and XLA
# compiles it on a GPU. With `Layout(form="arrays")`, XLA compiles it on every device. The results
# of the two must agree to round-off. The next cell checks this for eight trajectories of twenty
# steps.

# %%
few = q0[:8], p0[:8]
numbers = {}
for form in ("auto", "arrays"):
    layout = dvi.Layout(form=form, width=4)
    run = jax.jit(jax.vmap(lambda q, p, layout=layout: one(q, p, layout, num_steps=20)))
    numbers[form] = np.asarray(run(*few)[0])
worst = np.abs(numbers["auto"] - numbers["arrays"]).max()
print(f"machine code and XLA agree to {worst:.0e}")
assert worst < 1e-14

# %% [markdown]
# ## Single precision
#
# Many GPUs compute much faster in float32 than in float64. A run uses float32 only if the initial
# state has this type. If `jax_enable_x64` is false, a float64 initial state raises an error. The
# next cell computes the same orbits in both precisions. Without round-off the map would conserve
# the angular momentum $L$. Therefore the computed drift of $L$ is caused by round-off only. The
# plot shows how this drift grows with the number of steps.

# %%
marks = np.unique(np.geomspace(10, 200_000, 40).astype(int))


def drift_of_L(dtype, arithmetic):
    """Root mean square over 64 orbits of the relative change of L, at the steps in `marks`."""

    def run(q0, p0):
        sol = dvi.integrate(
            system, q0, p0, h=jnp.asarray(0.0625, dtype), num_steps=200_000,
            epsilon=jnp.asarray(0.0, dtype), save=dvi.Save(every=10), arithmetic=arithmetic,
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
assert 1e7 < ratio < 1e10  # the ratio of the rounding units is 5e8
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
# In float32 the drift is larger by a factor of the order of $5 \times 10^8$, the ratio of the
# rounding units of float32 and float64. After 200 000 steps with $h = 0.0625$ in float32 the
# relative change of $L$, an exact invariant, is $2 \times 10^{-5}$ (rms over 64 orbits). In such a
# run, relative drifts of an adiabatic invariant below this value cannot be measured. Therefore the
# package raises an error where JAX would round float64 input to float32. `Compensated()` stores the
# rounding error of each step and adds it in the next step. In this example it reduces the change to
# $2 \times 10^{-7}$.
#
# ## Next step
#
# - Run this notebook on a GPU, and compare the printed numbers with those stored here.
