# %% [markdown]
# # How long is an adiabatic invariant conserved?
#
# In this notebook you prove an upper bound on the change of an adiabatic invariant in one step of
# the map. The bound holds for all states of a domain. You then compare it with measured changes. If
# $b$ is an upper bound on the change in one step, then $N$ steps change the invariant by at most $N
# b$, as long as the trajectory stays in the domain.
#
# There are three systems: an oscillator with a cubic force, the system of Hénon and Heiles, and a
# pendulum in a field that varies slowly. The proofs require python-flint: `pip install ".[proof]"`
# in a clone of the repository.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import dvi_jax as dvi
from dvi_jax import plot

jax.config.update("jax_enable_x64", True)  # invariants need double precision


# %% [markdown]
# ## An oscillator with a cubic force
#
# The system is $H = (p^2 + q^2)/2$ with the force $-\varepsilon q^3$, and the step is $h = 0.1$.
# For each order $z$ from 1 to 4, `discover_invariants` finds an invariant $I_0 + \dots +
# \varepsilon^z I_z$. `bound_drift` then proves a bound for all states with $|q|, |p| \le 0.5$ and
# for all $\varepsilon$ from 0 to $\varepsilon_0$.


# %%
def quadratic(t0, t1, q0, p1, args):
    return (p1 @ p1 + q0 @ q0) / 2


cubic = dvi.System(quadratic, force=lambda t0, t1, q0, p1, args: -(q0**3))
samples = np.random.default_rng(0).uniform(-0.5, 0.5, (2, 1000, 1))
found = {
    z: dvi.discover_invariants(cubic, dvi.Polynomials(4 + 2 * z), order=z, h=0.1, samples=samples)
    for z in (1, 2, 3, 4)
}
bound = dvi.bound_drift(found[2], cubic, h=0.1, epsilon=0.01, domain=0.5)
print(bound)

# %% [markdown]
# In the report, the column `change ≤` is the upper bound on the change in one step in exact
# arithmetic, `seen` is the largest change found at sample points, and `rounding ≤` is the upper
# bound on the change by rounding in float64. In the report `I_0` is the name of invariant number 0,
# the whole series, and not its leading term $I_0$. The report also contains a value $L$ of the
# invariant and a number of steps $N$. If the initial state is in the domain and the initial value
# of the invariant is at most $L$, the trajectory stays in the domain for $N$ steps. Therefore the
# bounds hold in all of these steps, without an assumption about the trajectory.
#
# The next cell computes twenty trajectories with $10^4$ steps. The measured changes must be below
# the proved bound.

# %%
r = bound.start * 0.5
q, p = np.random.default_rng(1).uniform(-r, r, (2, 20, 1))
runs = jax.vmap(
    lambda q, p: dvi.integrate(cubic, q, p, h=0.1, num_steps=10_000, epsilon=0.01)
)(q, p)  # fmt: skip
invariant = found[2].invariants[0]
values = jax.vmap(jax.vmap(lambda q, p: invariant.evaluate(q, p, 0.01)))(runs.qs, runs.ps)
plot.drift_bound(bound, np.arange(values.shape[1]), values)
plt.show()

largest = np.max(np.abs(values - values[:, :1]))
proved = 10_000 * (bound.per_step[0] + bound.rounding[0])
print(f"largest measured change {largest:.1e}, proved for 10000 steps {proved:.1e}")
assert largest < proved

# %% [markdown]
# After about 25 steps the largest change does not grow any more (figure), because the changes in
# single steps cancel along an orbit. The proof cannot show this, because it adds the largest
# possible changes. It proves a number of steps in which the change of the invariant is less than a
# given value.
#
# ## Smaller perturbations
#
# The bound of order $z$ is proportional to $\varepsilon_0^{z+1}$ as long as it is larger than the
# rounding of float64. Let $N$ be the number of steps within which the invariant is proved to change
# by less than $10^{-3}$. Then $N$ scales as $\varepsilon_0^{-(z+1)}$.

# %%
strengths = np.array([2.0, 1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01])
steps = {}
for z, one in found.items():
    bounds = [
        dvi.bound_drift(one, cubic, h=0.1, epsilon=e, domain=0.5, ratio=4.0, max_boxes=200)
        for e in strengths
    ]
    steps[z] = np.array([b.num_steps(1e-3) for b in bounds], float)
    slope = np.polyfit(np.log(strengths[2:6]), np.log(steps[z][2:6]), 1)[0]
    print(f"order {z}: N = {steps[z][-1]:.1e} at 0.01, N ∝ ε^{slope:.2f}")

with plot.style():
    figure, axis = plt.subplots(figsize=(6.4, 4.4))
    for (z, n), marker in zip(steps.items(), "osD^", strict=True):
        axis.loglog(1 / strengths, np.where(n > 0, n, np.nan), marker=marker, label=f"order {z}")
    axis.set(xlabel="1/ε$_0$", ylabel="steps N for a change of 0.001, proved")
    axis.legend()
    plt.show()

# %% [markdown]
# The figure shows the proved $N$ for four orders. Order 4 gives the largest $N$ for every
# $\varepsilon_0$ in the figure. The theorems of Nekhoroshev and Neishtadt apply to certain analytic
# systems. They state that an adiabatic invariant is conserved for a time that grows faster than any
# power of $1/\varepsilon$. With the best order $z^*(\varepsilon)$ for each $\varepsilon$, this time
# is exponentially long. Invariants of an order above 4 may give longer times. Orders 1 to 3 are not
# plotted at $\varepsilon_0 = 2$, and order 1 is not plotted at $\varepsilon_0 = 1$, because their
# bound on the change in one step is larger than $10^{-3}$.
#
# Rounding limits all orders: it changes the invariant by up to $2 \times 10^{-16}$ in a step, so
# that $N$ cannot exceed about $5 \times 10^{12}$.

# %% [markdown]
# ## Two degrees of freedom
#
# Hénon and Heiles' system has the force $-\varepsilon\,(2 q_1 q_2,\; q_1^2 - q_2^2)$. The search at
# order 3 finds two invariants; the last one is the energy with corrections. Its level surfaces
# around the centre of the domain are closed, and its change in one step is bounded. Together these
# prove that a trajectory with an initial state near the centre stays in the domain for the printed
# number of steps.

# %%
henon_heiles = dvi.System(
    quadratic,
    force=lambda t0, t1, q0, p1, args: -jnp.array([2 * q0[0] * q0[1], q0[0] ** 2 - q0[1] ** 2]),
)
samples = np.random.default_rng(0).uniform(-0.3, 0.3, (2, 800, 2))
two = dvi.discover_invariants(henon_heiles, dvi.Polynomials(5), order=3, h=0.1, samples=samples)
energy = dvi.bound_drift(
    two.invariants[-1], henon_heiles, h=0.1, epsilon=0.01, domain=np.full(2, 0.3), ratio=6.0
)
print(f"change in a step at most {energy.per_step[0]:.1e}, by rounding {energy.rounding[0]:.1e}")
print(f"the change is below 0.001 for {energy.num_steps(1e-3):.1e} steps")
scaled = f"the domain scaled by {energy.start}"
print(f"no trajectory that starts in {scaled} leaves the domain in {energy.steps:.1e} steps")
assert energy.num_steps(1e-3) > 9e9

# %% [markdown]
# ## A slowly varying parameter
#
# A pendulum moves in a field whose strength varies slowly: $H = p^2/2 - (1 +
# \varepsilon \sin\tau) \cos q$ with $\tau = \varepsilon t$. We bound the change of the modified
# energy of the map, which depends on $\tau$. The argument `time` is the interval of $\tau$ in which
# steps begin, here one period of the field.


# %%
def field(t0, t1, q0, p1, args):
    return -jnp.sin(t0) * jnp.sin(q0)


pendulum = dvi.System(
    lambda t0, t1, q0, p1, args: p1 @ p1 / 2 - jnp.sum(jnp.cos(q0)), force=field, slow_time=True
)


def energy_of_the_map(q, p, epsilon, tau):
    """H − (h/2) ∂H/∂q·∂H/∂p, with h = 0.05."""
    w = 1 + epsilon * jnp.sin(tau)
    return p @ p / 2 - w * jnp.sum(jnp.cos(q)) - 0.025 * w * jnp.sin(q) @ p


slow = dvi.bound_drift(
    energy_of_the_map, pendulum, h=0.05, epsilon=0.01, domain=np.array([0.8]),
    time=(0.0, 2 * np.pi), ratio=4.0,
)  # fmt: skip
print(slow)
print("steps proved for the initial state (0.3, 0):", slow.steps_inside([0.3], [0.0], 0.01))

# %% [markdown]
# In one step this quantity changes by $O(h^3)$, because it contains only the first correction of
# the energy, and by $O(\varepsilon^2 h)$, because the strength of the field varies. Both parts have
# about the same size here. Therefore the number of steps for a change of 0.001 is small. The last
# line of the output answers another question: for how many steps does a trajectory stay in the
# domain? From (0.3, 0) the quantity may change by much more than 0.001 before the trajectory can
# leave the domain. Therefore all 12 566 steps of one period are proved.
#
# ## Proved and measured statements
#
# | status | statement |
# |---|---|
# | proved | the bound of the change in a step, for *all* states of the domain and all ε |
# | proved | the bound of the change by rounding, under the assumptions of `bound_drift` |
# | proved | from an invariant of at most $L$ a trajectory stays in the domain for $N$ steps |
# | only measured | the changes in single steps cancel: for 10 000 steps their sum is below 1e-11 |
#
# `bound.save("bound.json")` writes the certificate, and `dvi-jax verify bound.json` checks it with
# a separate program.
