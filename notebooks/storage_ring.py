# %% [markdown]
# # A storage ring
#
# In this notebook you match a cell of a storage ring, track particles through the cell of a light
# source, look at its tunes, and find an approximate invariant of the one-turn map. The page
# `docs/storage-rings.md` explains coordinates, signs and units.

# %%
from importlib.resources import files

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optimistix

import dvi_jax as dvi
from dvi_jax import plot, rings

jax.config.update("jax_enable_x64", True)
bend = rings.bend("B", 1.5, angle=np.pi / 16, edge_in=np.pi / 32, edge_out=np.pi / 32)
cell = [
    rings.quadrupole("QF", 0.4, k1=1.3),
    rings.drift("D", 0.2),
    rings.sextupole("SF", 0.2, b2=2.0),
    rings.drift("D", 0.2),
    bend,
    rings.drift("D", 0.2),
    rings.quadrupole("QD", 0.4, k1=-1.3),
    rings.drift("D", 0.2),
    rings.sextupole("SD", 0.2, b2=-3.0),
    rings.drift("D", 0.2),
    bend,
    rings.drift("D", 0.2),
]
ring = rings.Ring(cell, energy=1e9, periods=16)  # one turn is a passage of the cell

# %% [markdown]
# ## Optics
#
# Tunes are differentiable, so that a least-squares solver finds the strengths for given tunes.


# %%
def missed(k, args):
    changed = ring.set("QF", b1=k[0]).set("QD", b1=k[1])
    return rings.optics(changed, chromatic=False).tune - jnp.array([0.265, 0.211])


solver = optimistix.LevenbergMarquardt(rtol=1e-10, atol=1e-10)
k = optimistix.least_squares(missed, solver, jnp.array([1.3, -1.3])).value
ring = ring.set("QF", b1=k[0]).set("QD", b1=k[1])
optics = rings.optics(ring, chromatic=False)
print(f"strengths {np.round(k, 4)} 1/m², tunes {np.round(optics.tune, 6)}")
assert np.allclose(optics.tune, [0.265, 0.211], atol=1e-9)
plot.twiss(ring, optics)
plt.show()

# %% [markdown]
# ## Tracking
#
# The cell of the ESRF-EBS is one of the lattices that pyAT contains. The points are the states
# after each turn. Far from the closed orbit the sextupoles deform the ellipses, and the last
# particle is lost.

# %%
esrf = rings.load(files("machine_data") / "hmba.mat")
x = jnp.array([1.0, 2.5, 4.0, 5.5, 7.0, 8.5, 10.5, 13.0]) * 1e-3
z = jnp.zeros((8, 6)).at[:, 0].set(x)
out = rings.track(esrf, z, 600, every=1)
print("lost in turn", np.asarray(out.turn), "(−1: not lost)")
assert out.lost[-1]
kept = np.flatnonzero(~out.lost)
turns = np.broadcast_to(np.arange(1.0, 601.0), (len(kept), 600))
axis = plot.phase_portrait((turns, out.z[kept][..., :1], out.z[kept][..., 1:2]), dots=True)
axis.set(xlabel="x [m]", ylabel="p$_x$")
plt.show()

# %% [markdown]
# ## Tunes of a light source
#
# The diffusion, the change of the tunes from the first half of the turns to the second half, is
# large where the motion is chaotic.

# %%
x, y = np.meshgrid(np.linspace(1e-3, 10e-3, 25), np.linspace(0.1e-3, 4e-3, 16))
tunes = rings.frequency_map(esrf, x, y, turns=256)
plot.tune_map(x, y, tunes, order=5)
plt.show()

# %% [markdown]
# ## An invariant of the map
#
# At ε = 0 the sextupoles of our cell are off, and the Courant–Snyder invariant is conserved
# exactly. The discovery finds it, and its correction of order ε. The drift of the sum is then
# O(ε²).

# %%
turn = rings.problem(ring.perturbed("S*", "b2"), planes="x")
size = np.array([5e-3, 5e-3 / float(optics.beta[0, 0])])[:, None, None]
samples = size * np.random.default_rng(0).uniform(-1, 1, (2, 300, 1))
found = dvi.discover_invariants(
    turn.system, dvi.Polynomials(3), order=1, h=1.0, samples=samples, args=turn.args
)
corrected = found.invariants[0]
courant_snyder = eqx.tree_at(lambda i: i.coefficients, corrected, corrected.coefficients[:1])
how = {"h": 1.0, "num_steps": 1000, "epsilons": [0.1, 0.2, 0.4, 0.8], "args": turn.args}
orders = {
    name: dvi.drift_order(turn.system, invariant, [3e-3], [0.0], **how)
    for name, invariant in (("Courant–Snyder", courant_snyder), ("with correction", corrected))
}
beta, alpha = float(optics.beta[0, 0]), float(optics.alpha[0, 0])
print(corrected)
print(f"β/γ = {beta**2 / (1 + alpha**2):.4f}")
print("drift ∝ " + ", ".join(f"ε^{order.slope:.2f}" for order in orders.values()))
assert abs(orders["Courant–Snyder"].slope - 1) < 0.1
assert abs(orders["with correction"].slope - 2) < 0.1
plot.drift_orders(orders, expected=[1, 2])
plt.show()
