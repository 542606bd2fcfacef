# %% [markdown]
# # Discovering invariants
#
# In this notebook you search for the quantities that a system conserves, exactly or up to an order
# in $\varepsilon$. You do this for four systems, without symmetries as input.
#
# The search is a problem of linear algebra. Let $\varphi(q, p)$ be a vector of basis functions and
# $\Phi_\varepsilon$ the map of one step. The matrix $A_m$ contains the Taylor coefficients of order
# $\varepsilon^m$ of the change $\varphi \circ \Phi_\varepsilon - \varphi$, with one row for each
# random sample. The series $I = \sum_m \varepsilon^m c_m \cdot \varphi$ with constant vectors $c_m$
# is an invariant of order $z$ if
#
# $$\sum_{m \le k} A_{k-m}\, c_m = 0, \qquad k = 0 \dots z.$$
#
# The coefficients $c_0, \dots, c_z$ together are therefore a vector in the null space of a matrix
# that consists of the $A_m$. A quarter of the samples is held out for validation. A long run is the
# final test.

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
# The system is the cubic spring of the [quick start](quick_start.ipynb). The drift of an invariant
# of order $z$, its largest change in 10 000 steps, must scale as $\varepsilon^{z+1}$.

# %%
cubic = dvi.System(oscillator, force=lambda t0, t1, q0, p1, args: -(q0**3))
orders = {}
for z in range(3):
    found = dvi.discover_invariants(cubic, dvi.Polynomials(6), z, h=0.1, samples=box(1, 400))
    orders[f"order {z}"] = dvi.drift_order(
        cubic, found.invariants[0], [0.4], [0.3],
        epsilons=np.geomspace(2e-3, 0.2, 6), h=0.1, num_steps=10_000,
    )  # fmt: skip
    print(f"z = {z}: slope {orders[f'order {z}'].slope:.2f}, expected {z + 1}")
    assert abs(orders[f"order {z}"].limit - (z + 1)) < 0.1

# %%
axis = plot.drift_orders(orders, expected=[1, 2, 3], title="A cubic spring, 10 000 steps")
plt.show()

# %% [markdown]
# The bars at the left are the drift at $\varepsilon = 0$, which is round-off.
#
# ## No invariant
#
# Van der Pol's force $(1 - q^2)\,p$ amplifies small oscillations and damps large ones. Therefore an
# invariant of first order does not exist, and the list `invariants` must be empty. A quantity $I$
# is conserved for $\varepsilon = 0$ only. The report must give the mean change of $I$ in one step,
# as a function of $I$.

# %%
van_der_pol = dvi.System(oscillator, force=lambda t0, t1, q0, p1, args: (1 - q0**2) * p1)
none = dvi.discover_invariants(van_der_pol, dvi.Polynomials(6), 1, h=0.1, samples=box(1, 400))
law = none.obstructions[0]
print("linearly independent functions conserved to order 0, to order 1:", none.survivors)
print(law)
assert len(none.invariants) == 0

# %% [markdown]
# The mean change is zero at one positive value of $I$, the fixed point. This is the value of $I$ on
# the limit cycle. A run from a state inside the limit cycle and a run from a state outside must
# both end at this value.

# %%
runs = [
    dvi.integrate(van_der_pol, [q], [0.0], h=0.1, num_steps=3000, epsilon=0.05) for q in (0.5, 3.5)
]


def I_0(q, p):
    return (p**2 - 0.1 * q * p + q**2) / 2


at_end = [float(np.mean(I_0(sol.qs[-628:, 0], sol.ps[-628:, 0]))) for sol in runs]
at_rest = float(law.rest[0])
print(f"fixed point I = {at_rest:.3f} (order 1); the runs end at {at_end[0]:.3f}, {at_end[1]:.3f}")
assert np.allclose(at_end, at_rest, rtol=0.01)

# %%
with plot.style():
    figure, (left, right) = plt.subplots(1, 2, figsize=(8, 3.2), dpi=90)
    for sol, name in zip(runs, ["from inside", "from outside"], strict=True):
        left.plot(sol.qs[:, 0], sol.ps[:, 0], lw=0.4, label=name)
        right.plot(sol.ts, I_0(sol.qs[:, 0], sol.ps[:, 0]), lw=1, label=name)
    right.axhline(at_rest, color="0.3", ls="--", lw=1, label="fixed point of the law")
    left.set(xlabel="q", ylabel="p", aspect="equal", title="van der Pol, ε = 0.05")
    right.set(xlabel="time t", ylabel="leading-order term I", title="Approach to the limit cycle")
    right.legend()
plt.show()

# %% [markdown]
# ## Number of invariants per order
#
# The isotropic oscillator in the plane conserves four quadratic forms, of which three are
# functionally independent. The perturbation of Hénon and Heiles, $\varepsilon (q_1^2 q_2 -
# q_2^3/3)$, destroys some of these conservation laws. The next cell counts the linearly independent
# leading-order terms $c_0 \cdot \varphi$ of the invariants of order 0, 1 and 2.

# %%
henon_heiles = dvi.System(
    oscillator,
    perturbation=lambda t0, t1, q0, p1, args: q0[0] ** 2 * q0[1] - q0[1] ** 3 / 3,
)
found = dvi.discover_invariants(
    henon_heiles, dvi.Polynomials(4), 2, h=0.1, samples=box(2, 400), representative="simplest"
)
print("number of leading-order terms at order 0, 1, 2:", found.survivors)
for series in found.invariants:
    print(series.formula(4).split(" + … (")[0].split(" + ε ")[0], "+ …")
assert found.survivors == (13, 4, 2)

# %% [markdown]
# Thirteen terms exist at order 0: the four quadratic forms and nine products of them, of degree
# four. The corrections of the products would have degree five, but the basis ends at degree four.
# Therefore only the four quadratic forms remain at order 1. Two of them, the angular momentum and
# the energy, also have corrections of second order. For large $\varepsilon$ most trajectories are
# chaotic. Then only the energy is conserved approximately, and the angular momentum is not.

# %% [markdown]
# ## A basis that is too small
#
# If the basis cannot represent an invariant, the search does not find the invariant, but it must
# not report a wrong one. For Kepler's problem and a basis of polynomials, only the angular momentum
# is found. With $1/r$ in the basis, three approximate invariants are found, too: the energy and the
# two components of the Laplace–Runge–Lenz vector. The map conserves these three only approximately.
# Therefore their singular values are small but not round-off. A singular value counts as zero if it
# is below `tolerance` times the largest one.

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
    print(f"{name}: {kept[name].survivors[0]} conserved; smallest singular values {values}")
print(kept["polynomials"].invariants[0].formula(3))
assert kept["polynomials"].survivors[0] == 1
assert kept["with 1/r"].survivors[0] == 4

# %% [markdown]
# ## Next steps
#
# - Search for invariants that depend on a slow time $\tau = \varepsilon t$:
#   `dvi.System(..., slow_time=True)`, with samples (qs, ps, taus). For the oscillator with a slowly
#   varying frequency in `examples/what_is_conserved.py` the search finds the discrete action.
# - Find generators of symmetries with `dvi.find_symmetries`, and measure the causes of a drift with
#   `dvi.noether_balance`.
# - Study systems in which adiabatic invariance fails: [limits](limits.ipynb).
