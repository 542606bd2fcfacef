# %% [markdown]
# # Discovering invariants
#
# Given a system, what does it keep, exactly or to some order in $\varepsilon$? No symmetry is told.
# The question is one of linear algebra: with functions $\varphi(q, p)$, the map $\Phi_\varepsilon$
# of one step and the Taylor coefficients $A_m$ of $\varphi \circ \Phi_\varepsilon - \varphi$ in
# $\varepsilon$ at random samples, the series $I = \sum_m \varepsilon^m c_m \cdot \varphi$ is an
# invariant of order $z$ where
#
# $$\sum_{m \le k} A_{k-m}\, c_m = 0, \qquad k = 0 \dots z:$$
#
# a null space. A quarter of the samples is held out and judges. Then a long run decides.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import dvi_jax as dvi
from dvi_jax import plot

jax.config.update("jax_enable_x64", True)
rng = np.random.default_rng(0)


def box(n, count):
    """Samples (qs, ps) of the domain of interest."""
    return tuple(rng.uniform(-1, 1, (2, count, n)))


def oscillator(t0, t1, q0, p1, args):
    return (p1 @ p1 + q0 @ q0) / 2


# %% [markdown]
# ## An invariant for every order
#
# The cubic spring of the [quick start](quick_start.ipynb). An invariant of order $z$ must drift
# with $\varepsilon^{z+1}$, over 10 000 steps.

# %%
cubic = dvi.System(oscillator, force=lambda t0, t1, q0, p1, args: -(q0**3))
orders = {}
for z in range(3):
    found = dvi.discover_invariants(cubic, dvi.Polynomials(6), z, h=0.1, samples=box(1, 400))
    orders[f"order {z}"] = dvi.drift_order(
        cubic, found.invariants[0], [0.4], [0.3],
        epsilons=np.geomspace(2e-3, 0.2, 6), h=0.1, num_steps=10_000,
    )  # fmt: skip
    print(f"z = {z}: slope {orders[f'order {z}'].slope:.2f}, promised {z + 1}")
    assert abs(orders[f"order {z}"].limit - (z + 1)) < 0.1

# %%
axis = plot.drift_orders(orders, promised=[1, 2, 3], title="A cubic spring, 10 000 steps")
plt.show()

# %% [markdown]
# The bars at the left are what is left at $\varepsilon = 0$, round-off.
#
# ## Where there is none
#
# Van der Pol's force $(1 - q^2)\,p$ pumps small swings and damps large ones. There is no invariant
# of first order, and the answer must be "none", with the reason.

# %%
van_der_pol = dvi.System(oscillator, force=lambda t0, t1, q0, p1, args: (1 - q0**2) * p1)
none = dvi.discover_invariants(van_der_pol, dvi.Polynomials(6), 1, h=0.1, samples=box(1, 400))
law = none.obstructions[0]
print("functions of the basis kept to order 0, to order 1:", none.survivors)
print(law)
assert len(none.invariants) == 0

# %% [markdown]
# The law of the loss has a point at rest, the limit cycle. Is it there? Two runs, one from within
# and one from without, must end on it.

# %%
runs = [
    dvi.integrate(van_der_pol, [q], [0.0], h=0.1, num_steps=3000, epsilon=0.05) for q in (0.5, 3.5)
]


def I_0(q, p):
    return (p**2 - 0.1 * q * p + q**2) / 2


at_end = [float(np.mean(I_0(sol.qs[-628:, 0], sol.ps[-628:, 0]))) for sol in runs]
at_rest = float(law.rest[0])
print(f"at rest at I = {at_rest:.3f} (order 1); the runs end at {at_end[0]:.3f}, {at_end[1]:.3f}")
assert np.allclose(at_end, at_rest, rtol=0.01)

# %%
with plot.style():
    figure, (left, right) = plt.subplots(1, 2, figsize=(8, 3.2), dpi=90)
    for sol, name in zip(runs, ["from within", "from without"], strict=True):
        left.plot(sol.qs[:, 0], sol.ps[:, 0], lw=0.4, label=name)
        right.plot(sol.ts, I_0(sol.qs[:, 0], sol.ps[:, 0]), lw=1, label=name)
    right.axhline(at_rest, color="0.3", ls="--", lw=1, label="at rest, by the law")
    left.set(xlabel="q", ylabel="p", aspect="equal", title="van der Pol, ε = 0.05")
    right.set(xlabel="time t", ylabel="I", title="The leading part is lost")
    right.legend()
plt.show()

# %% [markdown]
# ## How many, out of how many
#
# The isotropic oscillator in the plane keeps four quadratic forms, three of them independent.
# Hénon and Heiles' disturbance $\varepsilon (x^2 y - y^3/3)$ takes some away, at second order only.

# %%
henon_heiles = dvi.System(
    oscillator,
    perturbation=lambda t0, t1, q0, p1, args: q0[0] ** 2 * q0[1] - q0[1] ** 3 / 3,
)
found = dvi.discover_invariants(
    henon_heiles, dvi.Polynomials(4), 2, h=0.1, samples=box(2, 400), representative="simplest"
)
print("leading parts that survive order 0, 1, 2:", found.survivors)
for series in found.invariants:
    print(series.formula(4).split(" + … (")[0].split(" + ε ")[0], "+ …")
assert found.survivors == (13, 4, 2)

# %% [markdown]
# Thirteen, because nine products of the quadratic forms are of degree four and in the basis. These
# would need corrections of degree five, which are not in it: four are left. Two survive the second
# order, the angular momentum and the energy, each with its corrections. Nothing is said of the
# orders beyond: that this motion becomes chaotic says that the former is not kept at all of them.

# %% [markdown]
# ## A trap, and how it is seen
#
# A basis that is too small for the truth gives no invariant, not a wrong one. Kepler's problem in
# polynomials alone has only the angular momentum; with $1/r$ a map of second order keeps energy and
# Laplace–Runge–Lenz vector approximately, and says how well.

# %%
kepler = dvi.System(lambda t0, t1, q0, p1, args: p1 @ p1 / 2 - 1 / jnp.sqrt(q0 @ q0))
angle, r = rng.uniform(0, 2 * np.pi, 500), rng.uniform(0.8, 1.25, 500)
outward = np.stack([np.cos(angle), np.sin(angle)], 1)
across = np.stack([-outward[:, 1], outward[:, 0]], 1) * rng.choice([-1, 1], (500, 1))
speeds = rng.uniform(-0.3, 0.3, (500, 1)), rng.uniform(0.85, 1.15, (500, 1))
samples = r[:, None] * outward, speeds[0] * outward + speeds[1] * across

small = dvi.Polynomials(3)
large = small + dvi.Polynomials(1, variables=["q1", "q2"], constant=True) * dvi.Radial()
kept = {}
for name, basis, tolerance in [("polynomials", small, None), ("with 1/r", large, 1e-2)]:
    kept[name] = dvi.discover_invariants(
        kepler, basis, h=0.02, samples=samples, method=dvi.Strang(), tolerance=tolerance
    )
    values = ", ".join(f"{x:.0e}" for x in kept[name].singular_values[-5:])
    print(f"{name}: {kept[name].survivors[0]} kept; smallest singular values {values}")
print(kept["polynomials"].invariants[0].formula(3))
assert kept["polynomials"].survivors[0] == 1
assert kept["with 1/r"].survivors[0] == 4

# %% [markdown]
# ## What next
#
# - A system with a slow time, `dvi.System(..., slow_time=True)`, takes samples (qs, ps, taus): the
#   slow oscillator in `examples/what_is_conserved.py` gives its discrete action.
# - `dvi.find_symmetries` finds the generators, `dvi.noether_balance` says why something drifts.
# - Where it ends: [limits](limits.ipynb).
