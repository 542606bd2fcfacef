# %% [markdown]
# # Events: a bouncing ball and a billiard
#
# After this notebook you can let a trajectory bounce, differentiate through the bounces, and
# measure the chaos of a billiard. An event is a point where a function $g(t, q, p)$ reaches zero
# from below. `dvi.Jump(g, map)` replaces the state there, and the run goes on.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import dvi_jax as dvi
from dvi_jax import plot, systems

jax.config.update("jax_enable_x64", True)

# %% [markdown]
# ## A ball
#
# The height is $q$, gravity is 1, and each bounce multiplies the speed by $e$. A ball that falls
# from the height $q_0$ bounces at $t_1 = \sqrt{2 q_0}$, and then after flights of $2 e^k t_1$.

# %%
ball = dvi.System(lambda t0, t1, q, p, e: p[0] ** 2 / 2 + q[0])
floor = dvi.Jump(lambda q, p: -q[0], lambda t, q, p, e: (q, -e * p))


def drop(height, e, num_steps=60):
    return dvi.integrate(ball, jnp.stack([height]), jnp.zeros(1), args=e, h=0.1,
                         num_steps=num_steps, method="strang", jump=floor, throw=False)  # fmt: skip


run = jax.jit(drop)(1.0, 0.8)
exact = np.sqrt(2) * (1 + 2 * 0.8 * np.array([0, 1, 1 + 0.8]))
print(f"{int(run.jumps.count)} bounces, at t =", np.round(run.jumps.ts[:3], 4))
assert np.max(np.abs(run.jumps.ts[:3] - exact)) < 1e-13

# %% [markdown]
# With $e < 1$ the bounces accumulate at $t_1 (1 + e)/(1 - e)$. The run ends there with a status of
# its own; it does not go through the floor, and it does not take ever smaller steps.

# %%
ended = jax.jit(lambda e: drop(1.0, e))(0.5)
step = int(ended.stats["failed_step"])
print(f"{ended.status} in the step from t = {0.1 * step:.1f}; the limit is {3 * np.sqrt(2):.3f}")

# %% [markdown]
# ## The derivative
#
# How does the position at $t = 3$ depend on the first height? A higher start delays the bounce,
# and the ball then has less time to rise. `jax.grad` includes this change of the time, which is
# called saltation. We compare it with differences.

# %%


def position(height):
    return drop(height, 0.8, 30).qs[-1, 0]


slope = float(jax.jit(jax.grad(position))(1.0))
difference = float((jax.jit(position)(1 + 1e-5) - jax.jit(position)(1 - 1e-5)) / 2e-5)
assert abs(slope - difference) < 1e-6
print(f"derivative {slope:.6f}, from differences {difference:.6f}")

# %% [markdown]
# ## Sinai's billiard
#
# `systems.sinai_billiard()` is a square with a disc in its centre. Its `jumps` are the disc and
# the walls, and `dvi.integrate` makes them. Two orbits begin $10^{-6}$ apart.

# %%
table = systems.sinai_billiard()
start = np.array([[0.8, 0.1], [0.8, 0.1 + 1e-6]])


@jax.jit
@jax.vmap
def orbit(q):
    return dvi.integrate(table, q, table.p0, h=0.1, num_steps=250, throw=False)


orbits = orbit(jnp.asarray(start))
distance = np.linalg.norm(orbits.qs[0] - orbits.qs[1], axis=1)

# %% [markdown]
# The Lyapunov exponent $\lambda$ is the rate at which they separate. Its deviation vectors pass
# each reflection with the saltation. Sinai's formula gives it from the geometry alone: it is the
# sum of $\ln(1 + \kappa\tau)$ over flights of length $\tau$, divided by the time, where the
# curvature $\kappa$ of a wave front grows by $2/(R\cos\varphi)$ at the disc.

# %%
long = dvi.integrate(systems.sinai_billiard(max_jumps=8000), num_steps=10_000,
                     observe=dvi.LyapunovSpectrum(1), save=dvi.Save(final=True))  # fmt: skip
n, J = int(long.jumps.count), long.jumps
flights = np.diff(np.asarray(J.ts[:n]), prepend=0)
kappa = total = 0.0
rows = (flights, *(np.asarray(x[:n]) for x in (J.index, J.qs_before, J.ps_before)))
for tau, wall, q, p in zip(*rows, strict=True):
    total += np.log(1 + kappa * tau)
    kappa = kappa / (1 + kappa * tau) + (2 / -(q @ p) if wall == 0 else 0)
exponent, formula = float(long.observed[0]), total / float(long.ts[-1])
assert abs(exponent - formula) < 0.005
print(f"λ = {exponent:.1f} from the run, {formula:.1f} from the formula")

# %%
with plot.style():
    figure, axes = plt.subplots(1, 3, figsize=(9.6, 3.2), layout="constrained")
    a, b, c = axes
    a.plot(run.ts, run.qs[:, 0])
    a.plot(run.jumps.ts[:3], [0, 0, 0], "o")
    a.set(title="A ball", xlabel="t", ylabel="height")
    for qs in orbits.qs:
        b.plot(*np.asarray(qs).T, lw=0.8)
    angle = np.linspace(0, 2 * np.pi, 100)
    b.fill(0.5 * np.cos(angle), 0.5 * np.sin(angle), color="0.8")
    b.plot([-1, 1, 1, -1, -1], [-1, -1, 1, 1, -1], "k", lw=1)
    b.set(title="Two orbits", aspect="equal")
    c.semilogy(orbits.ts[0], distance, label="distance")
    c.semilogy(orbits.ts[0], 1e-6 * np.exp(exponent * orbits.ts[0]), "--", label="exp(λt)")
    c.set(title="Their distance", xlabel="t", ylim=(1e-7, 10))
    c.legend()
plt.show()

# %% [markdown]
# ## Next steps
#
# - [The quick start](quick_start.ipynb) shows other observables.
# - `docs/events.md` explains walls, kicks, stages with other parameters, and the limits.
# - Try `systems.stadium()`: all its walls focus, and it is chaotic all the same.
