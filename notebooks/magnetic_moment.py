# %% [markdown]
# # The magnetic moment in a magnetic mirror
#
# In this notebook you measure how well a magnetic mirror conserves the magnetic moment of a charged
# particle, and whether the particle is reflected where the magnetic moment predicts it.
#
# The particle gyrates around a field line. If the field increases enough along the line, the
# particle is reflected. The reason is an adiabatic invariant, the magnetic moment. Its
# leading-order term is
#
# $$\mu_0 = \frac{m v_\perp^2}{2 B},$$
#
# where $m$ is the mass, $v_\perp$ the component of the velocity perpendicular to the field and $B$
# the field strength. The small parameter is the gyroradius divided by the length over which the
# field changes.
#
# The system is `systems.magnetic_mirror`, $H = |p - eA(q)|^2/2m$ with the charge $e$ and the vector
# potential $A$. On the axis $B = B_0 (1 + z^2/\ell^2)$. At the initial state the gyroradius and the
# gyrofrequency are 1. Therefore the small parameter is $1/\ell$. $H$ is not separable, so each step
# is implicit.

# %%
import jax
import matplotlib.pyplot as plt
import numpy as np

import dvi_jax as dvi
from dvi_jax import plot, systems

jax.config.update("jax_enable_x64", True)


# %% [markdown]
# ## The motion
#
# The guiding centre (the centre of the gyration) is initially at a distance $\ell/2$ from the axis.
# A bounce is the motion from one mirror point to the other and back. The run covers about two
# bounces. The method is Gauss' method of order 4, with a step of 0.1. The left plot shows one
# bounce, the right plot the magnetic moment without and with its first correction $\mu_1$.


# %%
def bounces(length):
    mirror = systems.magnetic_mirror(length, distance=length / 2)
    return dvi.integrate(
        mirror.system, mirror.q0, mirror.p0, h=mirror.h, num_steps=int(120 * length),
        args=mirror.args, method=dvi.GaussLegendre(2), observe=mirror.observables,
        save=dvi.Save(every=5),
    )  # fmt: skip


def relative_range(values):
    """Range over mean."""
    return np.ptp(values) / abs(np.mean(values))


lengths = np.array([20.0, 40.0, 80.0])
runs = [bounces(length) for length in lengths]
sol = runs[1]
with plot.style():
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.4, 3.4), dpi=90)
    x, _, z = np.asarray(sol.qs[:510]).T
    left.plot(z, x, lw=0.9)
    left.set(xlabel="z, along the axis", ylabel="x", title="One bounce, ℓ = 40")
    for name, key in {"μ₀": "magnetic_moment", "μ₀ + μ₁": "corrected_moment"}.items():
        values = np.asarray(sol.observed[key])
        right.plot(sol.ts, values / values[0], lw=0.8, label=name)
    right.set(
        xlabel="time [gyrofrequency⁻¹]", ylabel="value / initial value", title="Magnetic moment"
    )
    right.set_ylim(None, 1.009)
    right.legend(loc="upper right", ncols=2)
plt.show()

# %% [markdown]
# ## Conservation
#
# Two quantities check the integration. The field is symmetric about the axis. Therefore the method
# conserves the canonical angular momentum to round-off. The energy has the error of the method.
#
# $\mu_0$ oscillates at the gyrofrequency, with an amplitude that scales as $1/\ell$. The amplitude
# of $\mu_0 + \mu_1$ scales as $1/\ell^2$. (The formula for $\mu_1$ requires a field with
# $b \cdot (\nabla \times b) = 0$, where $b$ is the unit vector along the field.) The second
# adiabatic invariant is the *bounce action* $J = \oint p_\parallel\, ds$ along the field line. The
# amplitude of its oscillation also scales as $1/\ell^2$. The table shows the measured powers.

# %%
keys = ["magnetic_moment", "corrected_moment", "bounce_action"]
table = np.array([[relative_range(run.observed[key]) for run in runs] for key in keys])
slopes = [-np.polyfit(np.log(lengths), np.log(row), 1)[0] for row in table]
print(f"{'range / mean, ℓ =':22}", *(f"{length:9.0f}" for length in lengths), "   power of 1/ℓ")
for key, row, slope in zip(keys, table, slopes, strict=True):
    print(f"{key:22}", *(f"{x:9.2e}" for x in row), f"{slope:12.2f}")
exact = max(relative_range(run.observed["canonical_angular_momentum"]) for run in runs)
energy = max(relative_range(run.observed["energy"]) for run in runs)
print(f"angular momentum: {exact:.0e}, energy: {energy:.0e}")

assert abs(slopes[0] - 1) < 0.1
assert abs(slopes[1] - 2) < 0.1
assert abs(slopes[2] - 2) < 0.1
assert exact < 1e-13
assert energy < 2e-6

# %% [markdown]
# ## The mirror point
#
# At the mirror point the velocity along the field line is zero, and nearly the whole energy $E$ is
# in the gyration: $E \approx \mu B$ with $\mu = \mu_0 + \mu_1$. The field strength at the mirror
# point must therefore agree with $E/\mu$ to a relative accuracy of about $1/\ell$.


# %%
def field_at_turn(run, length):
    """|B| at the guiding centre where |z| is largest: the mean of |B| over one gyration."""
    z = np.asarray(run.qs)[:, 2]
    peak = np.argmax(np.abs(z))
    about = np.asarray(run.qs)[max(peak - 12, 0) : peak + 13]  # about one gyration
    x, y, z = about.T
    B = np.stack([-x * z, -y * z, length**2 + z**2]) / length**2
    return np.linalg.norm(B, axis=0).mean()


for run, length in zip(runs, lengths, strict=True):
    predicted = np.mean(run.observed["energy"]) / np.mean(run.observed["corrected_moment"])
    seen = field_at_turn(run, length)
    print(f"ℓ = {length:3.0f}: reflected at B = {seen:.3f}, predicted E/μ = {predicted:.3f}")
    assert abs(seen / predicted - 1) < 1 / length

# %% [markdown]
# ## Controls
#
# There are two controls, in which the range must not be small. The energy of the gyration,
# $m v_\perp^2/2 = \mu_0 B$, changes by about the same factor as the field, for each of the three
# $\ell$. If the field changes within a few gyroradii ($\ell = 2$), $\mu_0$ is not conserved.

# %%
gyration = []
for run, length in zip(runs, lengths, strict=True):
    x, y, z = np.asarray(run.qs).T
    B = np.linalg.norm(np.stack([-x * z, -y * z, length**2 + z**2]) / length**2, axis=0)
    gyration.append(relative_range(np.asarray(run.observed["magnetic_moment"]) * B))
slope = -np.polyfit(np.log(lengths), np.log(gyration), 1)[0]
short = bounces(2.0)
print(f"energy of the gyration: range / mean {np.round(gyration, 2)}, (1/ℓ)^{slope:.2f}")
control = relative_range(short.observed["magnetic_moment"])
print(f"ℓ = 2: range / mean of the moment is {control:.2f}")
assert abs(slope) < 0.1
assert control > 0.5

# %%
with plot.style():
    figure, axis = plt.subplots(figsize=(6.4, 3.8))
    names = ["μ₀", "μ₀ + μ₁", "bounce action"]
    for i, (name, row, slope) in enumerate(zip(names, table, slopes, strict=True)):
        axis.loglog(1 / lengths, row, "os^"[i] + "-", label=f"{name}: slope {slope:.2f}")
    axis.loglog(1 / lengths, gyration, "x--", color="0.5", label="m v⊥²/2: not an invariant")
    axis.set(xlabel="gyroradius / ℓ", ylabel="range / mean")
    axis.set_title("Oscillation of each quantity along one orbit")
    figure.legend(loc="outside lower center", ncols=2)
plt.show()

# %% [markdown]
# ## Next steps
#
# - Use the Earth's field (Störmer's problem): `systems.dipole_field`.
# - `magnetic_moment()` in `examples/what_is_conserved.py` finds $\mu$ in a field with a weak
#   gradient, with `dvi.discover_invariants`.
# - At small $\ell$, find the initial conditions for which $\mu$ is not conserved, with `dvi.sweep`.
