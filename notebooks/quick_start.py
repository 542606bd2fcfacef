# %% [markdown]
# # Quick start: find an adiabatic invariant and verify it
#
# In this notebook you find an adiabatic invariant of a perturbed oscillator. You verify it in runs
# of 5000 steps. As a control you apply the same test to two quantities that are not adiabatic
# invariants. A weak nonlinear force perturbs a mass on a spring,
#
# $$H = \tfrac12\,(p^2 + q^2), \qquad \dot p = -q - \varepsilon q^3 .$$
#
# The energy $H$ is not conserved: it changes by $O(\varepsilon)$. A quantity $I = I_0 + \varepsilon
# I_1$ whose rate of change is $O(\varepsilon^2)$ is an *adiabatic invariant of first order*. In
# this example its total change also stays $O(\varepsilon^2)$ in 5000 steps.
#
# `dvi_jax` does not solve the differential equation exactly. It iterates a map: one step of a
# variational integrator with the step size $h$. You therefore search for an invariant of the *map*,
# here at $h = 0.1$.

# %%
import jax
import matplotlib.pyplot as plt
import numpy as np

import dvi_jax as dvi
from dvi_jax import plot

jax.config.update("jax_enable_x64", True)  # invariants need double precision


# %% [markdown]
# ## Define, discover, verify
#
# The discrete Hamiltonian `H_D`, which defines the map, and the force `W` are functions of one step
# from the time `t0` to the time `t1`: `q0` is the position at the beginning of the step, `p1` the
# momentum at its end. `args` contains parameters, which are not used here.
#
# `discover_invariants` searches for invariants among the polynomials up to degree 8, at 400 random
# states. The invariant is not unique: with `representative="simplest"` the function returns the one
# with the simplest terms. The drift of the invariant is its largest change in 5000 steps.
# `drift_order` measures how the drift scales with $\varepsilon$.


# %%
def H_D(t0, t1, q0, p1, args):
    return (p1 @ p1 + q0 @ q0) / 2


def W(t0, t1, q0, p1, args):
    return -(q0**3)


system = dvi.System(H_D, force=W)
samples = np.random.default_rng(0).uniform(-1, 1, (2, 400, 1))
found = dvi.discover_invariants(
    system, dvi.Polynomials(8), order=1, h=0.1, samples=samples, representative="simplest"
)
invariant = found.invariants[0]
run = {"q0": [0.4], "p0": [0.3], "h": 0.1, "num_steps": 5000}
order = dvi.drift_order(system, invariant, **run, epsilons=np.geomspace(0.005, 0.1, 6))
print("I =", invariant.formula(4))
print(order)

# %% [markdown]
# The leading-order term $I_0 = (q^2 - h\,qp + p^2)/2$ is the quantity that the map conserves for
# $\varepsilon = 0$ in place of the energy. The correction $I_1$ is a polynomial of degree four. The
# drift scales as $\varepsilon^2$.

# %%
assert abs(order.slope - 2) < 0.02


# %% [markdown]
# ## Controls
#
# A test is meaningful only if it can fail. We therefore test two quantities that are not adiabatic
# invariants of first order. The energy must fail for two reasons: the force changes it at first
# order in $\varepsilon$, and the map does not conserve it even at $\varepsilon = 0$. $I_0$ without
# its correction must fail for the first reason only. The drift of $I_0$ must scale as
# $\varepsilon$: its slope in the output must be 1.


# %%
def energy(q, p):  # an observable is a function of the state
    return (p @ p + q @ q) / 2


def I_0(q, p):
    return (p @ p - 0.1 * (q @ p) + q @ q) / 2


epsilons = np.geomspace(0.005, 0.1, 6)
orders = {
    "energy": dvi.drift_order(system, energy, **run, epsilons=epsilons),
    "I₀ alone": dvi.drift_order(system, I_0, **run, epsilons=epsilons),
    "I₀ + ε I₁": order,
}
for name, measured in orders.items():
    print(f"{name}: at ε = 0 it changes by {measured.floor:.1e}, slope {measured.slope:.3f}")

assert np.isnan(orders["energy"].slope)  # hidden by the energy error of the map
assert abs(orders["I₀ alone"].slope - 1) < 0.05

# %%
axis = plot.drift_orders(orders, expected=[None, 1, 2], title="Largest change in 5000 steps")
plt.show()

# %% [markdown]
# Open symbols mark drifts that are less than ten times the drift at $\varepsilon = 0$. They are not
# used for the slope. All symbols of the energy are open. Therefore its slope is not measured
# (`nan`).
#
# The next cell plots the same quantities against time, for $\varepsilon = 0.1$.

# %%
sol = dvi.integrate(
    system, [0.4], [0.3], h=0.1, num_steps=600, epsilon=0.1,
    observe={"energy": energy, "I₀ alone": I_0, "I₀ + ε I₁": invariant},
)  # fmt: skip
with plot.style():
    figure, axis = plt.subplots(figsize=(6.4, 3.2))
    for name in orders:
        values = sol.observed[name]
        # The invariant is a function of a step and has no value at the start.
        axis.plot(sol.ts[-len(values) :], values / values[0] - 1, lw=1.1, label=name)
    axis.set(xlabel="time t", ylabel="relative change", title="ε = 0.1")
    figure.legend(loc="outside lower center", ncols=3)
plt.show()

# %% [markdown]
# ## Next steps
#
# - Use `order=2` or `order=3` in `discover_invariants`: the slope becomes 3 or 4
#   ([discovering invariants](discovering_invariants.ipynb)).
# - Use your own $H$ and force ([your own system](your_own_system.ipynb)).
# - Use friction, `-p1`, as the force: no adiabatic invariant of first order exists, and the report
#   gives the reason ([limits](limits.ipynb)).
