# %% [markdown]
# # A ring that radiates
#
# In this notebook you compute the loss of energy of electrons in a storage ring, its damping times,
# and the beam in the equilibrium of damping and quantum excitation. You compare this beam with
# particles that are tracked with noise, differentiate its emittance by the gradient of a
# quadrupole, and compute its Touschek lifetime. The page `docs/storage-rings.md` explains the
# model, and compares it with other programs.
#
# The ring has 16 cells. One *turn* of tracking is one passage of a cell, which has its own cavity.
# `rings.radiating` lets bends and quadrupoles radiate, and `rings.in_phase` sets the phase of the
# cavity so that it gives the energy that a particle on the closed orbit loses.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from dvi_jax import rings

jax.config.update("jax_enable_x64", True)
bend = rings.bend("B", 1.5, angle=np.pi / 16, edge_in=np.pi / 32, edge_out=np.pi / 32)
drift = rings.drift("D", 0.4)
arc = [
    rings.quadrupole("QF", 0.4, k1=1.3), drift, bend, drift,
    rings.quadrupole("QD", 0.4, k1=-1.3), drift, bend, drift,
    rings.aperture("A", ellipse=(0.02, 0.01)),
]  # fmt: skip
cavity = rings.cavity("RF", 0.0, voltage=2e-4, frequency=1e8)
ring = rings.radiating(rings.Ring([*arc, cavity], energy=1e9, periods=16))
ring = rings.in_phase(ring)

# %% [markdown]
# ## The equilibrium
#
# `rings.equilibrium` computes the closed orbit in six dimensions, and on it the covariances that a
# turn with damping and quantum excitation does not change (Ohmi's envelope).

# %%
beam = rings.equilibrium(ring)
print(f"loss in a cell {beam.loss:.1f} eV, damping times {(1e3 * beam.damping_time).round(2)} ms")
print(f"partition numbers {beam.partition.round(4)}, emittance {1e9 * beam.emittance[0]:.2f} nm")
print(f"energy spread {beam.energy_spread:.2e}, bunch length {1e3 * beam.bunch_length:.2f} mm")

# %% [markdown]
# The radiation integrals of the bends give nearly the same numbers. Their formulas are the limit of
# small losses and of slow synchrotron motion.

# %%
_, i2, i3, i4, i5 = rings.radiation_integrals(ring)
c_q, gamma = 3.83194e-13, 1e9 / 510998.95
integrals = {
    "loss [eV]": (beam.loss, 8.84627e-5 * i2 / (2 * np.pi) * 1e9),
    "partition number in x": (beam.partition[0], 1 - i4 / i2),
    "emittance [nm]": (1e9 * beam.emittance[0], 1e9 * c_q * gamma**2 * i5 / (i2 - i4)),
    "energy spread [1e-4]": (
        1e4 * beam.energy_spread, 1e4 * gamma * np.sqrt(c_q * i3 / (2 * i2 + i4))
    ),
}  # fmt: skip
for name, (envelope, formula) in integrals.items():
    print(f"{name:22} envelope {envelope:8.3f}, integrals {formula:8.3f}")
    assert abs(envelope / formula - 1) < 2e-3

# %% [markdown]
# ## The closed orbit and tapered magnets
#
# Here the whole ring has a single cavity, and an energy of 5 GeV. Between two passages of the
# cavity the energy of a particle decreases, and the closed orbit deviates by $D\delta$ from the
# design orbit, $D$ the dispersion. `rings.tapered` scales the fields of the magnets with the local
# momentum. The energy still decreases, but the orbit is restored.

# %%
single = rings.cavity("RF", 0.0, voltage=5e-3, frequency=1e8)
whole = rings.radiating(rings.Ring([*(16 * arc), single], energy=5e9))
whole = rings.in_phase(whole)
tapered = rings.tapered(whole)
figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
largest = {}
for label, other, style in (("equal magnets", whole, "-"), ("tapered magnets", tapered, "--")):
    orbit = np.asarray(rings.optics(other, chromatic=False).orbit)
    largest[label] = np.abs(orbit[:, 0]).max()
    axes[0].plot(other.places, 1e3 * orbit[:, 5], style, label=label)
    axes[1].plot(other.places, 1e3 * orbit[:, 0], style)
    print(f"{label}: |x| up to {1e3 * largest[label]:.4f} mm")
axes[0].set(xlabel="s [m]", ylabel="δ [10$^{-3}$]")
axes[1].set(xlabel="s [m]", ylabel="x [mm]")
figure.legend(loc="outside upper center", ncols=2, frameon=False)
plt.show()
assert largest["tapered magnets"] < 0.1 * largest["equal magnets"]

# %% [markdown]
# ## Particles with noise
#
# At 1 GeV damping takes tens of thousands of turns. With `loss` $10^4$ times as large, and
# `excitation`, whose square is the diffusion, $10^2$ times as large, damping and diffusion are both
# $10^4$ times as fast, and their equilibrium is nearly the same. 400 particles start with a large
# vertical emittance and with no other; each has its own random numbers.
#
# The emittances of particles with covariances $\Sigma$ are the moduli of the eigenvalues of
# $\Sigma S$, with the matrix $S$ of the symplectic form. Those of the envelope approach the
# equilibrium as $e^{-2t/\tau}$, with the damping time $\tau$ of the mode.

# %%
loss, excitation = (ring.get("[BQ]*", name) for name in ("loss", "excitation"))
fast = ring.set("[BQ]*", loss=1e4 * loss, excitation=1e2 * excitation)
fast = rings.in_phase(fast.set("RF", voltage=0.02))
expected = rings.equilibrium(fast)
optics = rings.optics(fast, chromatic=False)
count, every, turns = 400, 10, 1200
vertical = np.random.default_rng(0).normal(size=(count, 2)) * np.sqrt(2 * 5e-8)
start = np.asarray(expected.orbit[0])[None] + np.real(
    (vertical[:, :1] + 1j * vertical[:, 1:]) * np.asarray(optics.modes[0, 1])[None] / np.sqrt(2)
)
z = np.asarray(rings.track(fast, start, turns, every=every, key=0).z)
print(f"lost: {np.isnan(z).any(axis=(1, 2)).sum()} of {count} particles")

S = np.kron(np.eye(3), [[0, 1], [-1, 0]])
z = np.concatenate([start[:, None], z], 1)
z = z - z.mean(0)
covariances = np.einsum("pti,ptj->tij", z, z) / count
# Vertical motion is not coupled; the horizontal emittance is the smaller one of the other two.
planes = [0, 1, 4, 5]
others = np.abs(np.linalg.eigvals((covariances @ S)[:, planes][:, :, planes]))
vertical = np.sqrt(np.linalg.det(covariances[:, 2:4, 2:4]))
tracked = np.stack([others.min(1), vertical, others.max(1)], 1)

time = np.arange(0, turns + 1, every)
decay = np.exp(-2 * np.outer(time * fast.period, 1 / expected.damping_time))
envelope = tracked[0] * decay + np.asarray(expected.emittance) * (1 - decay)
figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
for k, (name, unit) in enumerate((("x", 1e9), ("y", 1e9), ("ζ", 1e6))):
    axis = axes[k // 2]
    axis.plot(time[::4], unit * tracked[::4, k], f"C{k}.", label=f"particles, {name}")
    axis.plot(time, unit * envelope[:, k], f"C{k}-", label=f"envelope, {name}")
    axis.set(xlabel="turn", ylabel="emittance [nm]" if k < 2 else "emittance [µm]")
    axis.legend(frameon=False)
plt.show()
later = time > 600
ratio = tracked[later].mean(0) / np.asarray(expected.emittance)
print(f"emittance x: {1e9 * expected.emittance[0]:.2f} nm, with the usual damping "
      f"{1e9 * beam.emittance[0]:.2f} nm")  # fmt: skip
print(f"of the particles after turn 600, over the envelope: x {ratio[0]:.3f}, ζ {ratio[2]:.3f}")
# One sample of 400 particles has the standard error 5 %.
assert np.all(np.abs(ratio[[0, 2]] - 1) < 0.15)

# %% [markdown]
# ## A smaller emittance
#
# The emittance is differentiable by every parameter of the ring, here by the gradient of the
# focusing quadrupole.


# %%
def emittance(k):
    return rings.equilibrium(ring.set("QF", b1=k)).emittance[0]


value, slope = jax.jvp(emittance, (1.3,), (1.0,))
step = 1e-3
difference = (emittance(1.3 + step) - emittance(1.3 - step)) / (2 * step)
print(f"dε/dk = {1e9 * slope:.3f} nm m², by differences {1e9 * difference:.3f} nm m²")
assert abs(slope / difference - 1) < 1e-4
ks = np.linspace(1.1, 1.6, 6)
_, axis = plt.subplots(figsize=(6, 3.2), layout="constrained")
axis.plot(ks, [1e9 * emittance(k) for k in ks], "o-", ms=4, label="emittance")
near = np.array([1.15, 1.45])
axis.plot(near, 1e9 * (value + slope * (near - 1.3)), "--", label="derivative at 1.3 m$^{-2}$")
axis.set(xlabel="gradient of QF [m$^{-2}$]", ylabel="emittance [nm]")
axis.legend(frameon=False)
plt.show()

# %% [markdown]
# ## The lifetime
#
# Particles of a bunch scatter on each other and exchange momentum. Those that leave the momentum
# aperture are lost. It is computed here by tracking over 300 turns, at the entrance of each magnet,
# and is given by the pipe at the focusing quadrupole. With a larger vertical emittance the bunch is
# less dense and lives longer.

# %%
couplings = np.array([0.001, 0.003, 0.01, 0.03, 0.1])
_, axis = plt.subplots(figsize=(6, 3.2), layout="constrained")
at_one_per_cent = []
for width in (0.02, 0.03, 0.04):
    pipe = ring.set("A", radius_x=width)
    aperture = rings.momentum_aperture(pipe, 300, "[BQ]*", largest=0.04, steps=20)
    hours = [
        rings.touschek_lifetime(
            pipe,
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
    assert np.all(np.diff(hours) > 0)
    at_one_per_cent.append(hours[2])
    axis.loglog(1e2 * couplings, hours, "o-", ms=4, label=f"|x| < {1e3 * width:.0f} mm")
    print(
        f"pipe of ±{1e3 * width:.0f} mm: momentum aperture {1e2 * aperture[:, 1].min():.2f} % to "
        f"{1e2 * aperture[:, 1].max():.2f} %, lifetime {hours[2]:.2f} h with ε_y = 0.01 ε_x"
    )
axis.set(xlabel="vertical emittance [% of the horizontal one]", ylabel="lifetime [h]")
axis.legend(frameon=False)
plt.show()
assert np.all(np.diff(at_one_per_cent) > 0)
