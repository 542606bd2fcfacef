# %% [markdown]
# # A ring that radiates
#
# In this notebook you compute the loss of energy of electrons in a storage ring, its damping times,
# and the beam in the equilibrium of damping and quantum excitation. You compare this beam with
# particles that are tracked with noise, differentiate its emittance, and compute how long it lives.
# The page `docs/storage-rings.md` explains the model.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from dvi_jax import rings

jax.config.update("jax_enable_x64", True)
bend = rings.bend("B", 1.5, angle=np.pi / 16, edge_in=np.pi / 32, edge_out=np.pi / 32)
drift = rings.drift("D", 0.4)
cell = [
    rings.quadrupole("QF", 0.4, k1=1.3),
    drift,
    bend,
    drift,
    rings.quadrupole("QD", 0.4, k1=-1.3),
    drift,
    bend,
    drift,
    rings.cavity("RF", 0.0, voltage=1e-4, frequency=5e8),
]
ring = rings.radiating(rings.Ring(cell, energy=1e9, periods=16))
ring = rings.in_phase(ring)  # the cavity gives the energy that a particle loses

# %% [markdown]
# ## The equilibrium
#
# `rings.equilibrium` finds the closed orbit in 6D, on which the cavity replaces the lost energy,
# and the covariances that one turn with damping and quantum excitation does not change.

# %%
beam = rings.equilibrium(ring)
print(f"loss of a turn {beam.loss:.1f} eV, damping times {1e3 * beam.damping_time.round(6)} ms")
print(f"partition numbers {beam.partition.round(4)}, emittance {1e9 * beam.emittance[0]:.2f} nm")
print(f"energy spread {beam.energy_spread:.2e}, bunch length {1e3 * beam.bunch_length:.2f} mm")

# %% [markdown]
# The radiation integrals give nearly the same numbers. They are the limit of small losses and of
# slow synchrotron motion.

# %%
i1, i2, i3, i4, i5 = rings.radiation_integrals(ring)
c_q, gamma = 3.83194e-13, 1e9 / 510998.95
print(f"partition numbers {1 - i4 / i2:.4f}, 1, {2 + i4 / i2:.4f}")
print(f"emittance {1e9 * c_q * gamma**2 * i5 / (i2 - i4):.2f} nm")
assert abs(beam.partition[0] / (1 - i4 / i2) - 1) < 0.01

# %% [markdown]
# ## The beam along the ring
#
# The line is the width of the beam. It consists of betatron oscillations, √(βε), and of the spread
# of the energy, Dσ.

# %%
optics = rings.optics(ring, chromatic=False)
s, width = np.asarray(ring.places), 1e3 * np.sqrt(beam.sigma[:, 0, 0])
betatron = 1e3 * np.sqrt(optics.beta[:, 0] * beam.emittance[0])
energy = 1e3 * np.abs(optics.dispersion[:, 0]) * beam.energy_spread
_, axis = plt.subplots(figsize=(7, 3.5), layout="constrained")
axis.plot(s, width, "k", lw=2, label="σ$_x$")
axis.plot(s, betatron, "--", label="√(β$_x$ε$_x$)")
axis.plot(s, energy, ":", label="|D$_x$|σ$_δ$")
axis.set(xlabel="s [m]", ylabel="width [mm]", ylim=(0, None))
axis.legend(loc="upper left", bbox_to_anchor=(1, 1), frameon=False)
plt.show()
assert np.allclose(width, np.hypot(betatron, energy), rtol=0.03)

# %% [markdown]
# ## Particles with noise
#
# In this ring damping takes hundreds of thousands of turns. A loss that is 10⁴ times as large, with
# a diffusion that is larger by the same factor, has the same equilibrium after some hundreds of
# turns. 1000 particles start on the closed orbit; each has its own random numbers.

# %%
loss, excitation = (ring.get("[BQ]*", name) for name in ("loss", "excitation"))
fast = ring.set("[BQ]*", loss=1e4 * loss, excitation=1e2 * excitation)
fast = rings.in_phase(fast.set("RF", voltage=0.02))
expected = rings.equilibrium(fast)
start = jnp.broadcast_to(expected.orbit[0], (1000, 6))
turns = 10 * np.arange(1, 101)
z = np.asarray(rings.track(fast, start, 1000, every=10, key=0).z)
axes = plt.subplots(1, 2, figsize=(9, 3.5), layout="constrained")[1]
for axis, i, name, unit in ((axes[0], 0, "σ$_x$", 1e3), (axes[1], 5, "σ$_δ$", 1e3)):
    axis.plot(turns, unit * z[..., i].std(0), lw=1, label="1000 particles")
    axis.axhline(unit * np.sqrt(expected.sigma[0, i, i]), color="k", ls="--", label="envelope")
    axis.set(xlabel="turn", ylabel=name + (" [mm]" if i == 0 else " [10$^{-3}$]"), ylim=(0, None))
axes[0].legend(loc="lower right")
plt.show()
# The mean over the second half: the standard error of a variance of 1000 particles is 4.5 %.
ratio = z[:, 50:, 0].var(0).mean() / expected.sigma[0, 0, 0]
print(f"variance of x over that of the envelope: {ratio:.3f}")
assert abs(ratio - 1) < 0.15

# %% [markdown]
# ## A smaller emittance
#
# The emittance is differentiable by every parameter of the ring.


# %%
def emittance(k):
    return rings.equilibrium(ring.set("QF", b1=k)).emittance[0]


_, slope = jax.jvp(emittance, (1.3,), (1.0,))
step = 1e-3
difference = (emittance(1.3 + step) - emittance(1.3 - step)) / (2 * step)
print(f"dε/dk = {1e9 * slope:.4f} nm m², by differences {1e9 * difference:.4f} nm m²")
assert abs(slope / difference - 1) < 1e-3
ks = np.linspace(1.0, 1.6, 7)
values = 1e9 * np.array([emittance(k) for k in ks])
_, axis = plt.subplots(figsize=(6, 3.5), layout="constrained")
axis.plot(ks, values, "o-", ms=3)
axis.axline((1.3, 1e9 * float(beam.emittance[0])), slope=1e9 * float(slope), color="C1", ls="--")
axis.set(xlabel="k$_{QF}$ [1/m²]", ylabel="emittance [nm]", ylim=(0.9 * values.min(), None))
plt.show()

# %% [markdown]
# ## The lifetime
#
# Particles of a bunch scatter on each other and exchange energy. Those that leave the momentum
# aperture are lost. More vertical emittance makes the bunch less dense, so that it lives longer.

# %%
aperture = rings.momentum_aperture(ring, turns=200, where="[BQ]*", largest=0.05, steps=8)
print(f"momentum aperture from {aperture[:, 0].max():.4f} to {aperture[:, 1].min():.4f}")
couplings = np.array([0.001, 0.003, 0.01, 0.03, 0.1])
hours = [
    rings.touschek_lifetime(
        ring,
        aperture,
        1e10,
        emittance=beam.emittance[0] * jnp.array([1.0, coupling]),
        energy_spread=beam.energy_spread,
        bunch_length=beam.bunch_length,
        where="[BQ]*",
    )
    / 3600
    for coupling in couplings
]
_, axis = plt.subplots(figsize=(6, 3.5), layout="constrained")
axis.loglog(100 * couplings, hours, "o-")
axis.set(xlabel="vertical emittance [% of the horizontal one]", ylabel="lifetime [h]")
plt.show()
assert np.all(np.diff(hours) > 0)
