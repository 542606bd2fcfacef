# %% [markdown]
# # Alpha particles in a stellarator
#
# In this notebook you follow fusion-born alpha particles in a quasi-axisymmetric stellarator, see
# which orbits exist, check what is conserved, and compute which fraction is lost. The page
# `docs/alpha-particles.md` explains the equations and the units.

# %%
import jax
import matplotlib.pyplot as plt
import numpy as np

import dvi_jax as dvi
from dvi_jax import plot
from dvi_jax.systems import boozer

jax.config.update("jax_enable_x64", True)
field = boozer.precise_qa()  # at reactor size
alphas = boozer.GuidingCentres(field)  # 3.5 MeV alpha particles
print(f"speed {alphas.speed:.3g} m/s, m v/(Ze) = {alphas.rho:.3f} T m")
print(f"a step of {alphas.h:.2f} m takes {1e6 * alphas.seconds(alphas.h):.2f} µs")

# %% [markdown]
# ## The field
#
# |B| on two flux surfaces. In a quasi-axisymmetric field it is nearly independent of ζ.

# %%
theta, zeta = np.meshgrid(np.linspace(0, 2 * np.pi, 80), np.linspace(0, 2 * np.pi, 80))
with plot.style():
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), sharey=True, layout="constrained")
    for axis, s in zip(axes, (0.25, 1.0), strict=True):
        lines = axis.contour(zeta, theta, field.strength(s, theta, zeta), levels=10)
        axis.set(xlabel="ζ", title=f"|B| [T] at s = {s}")
    axes[0].set_ylabel("θ")
    figure.colorbar(lines, ax=axes)
    plt.show()
print(f"symmetry-breaking modes at the edge: {float(field.ripple()):.1e} of |B|")

# %% [markdown]
# ## Orbits
#
# Two particles start at the same point with different pitch $v_\parallel/v$. The passing particle
# follows the field lines around the torus. The trapped particle is reflected where |B| is large;
# the projection of its orbit onto the poloidal plane has the form of a banana.

# %%
pitch = np.array([0.8, 0.2])
q0, p0, args = alphas.start(0.4, 0.2, 0.4, pitch)
system = alphas.system


def energy(t0, t1, q0, p0, q1, p1, args):
    """2H, which is 1 at the start."""
    return 2 * system.hamiltonian(t1, t1, q1, p1, 0.0, args)


def orbit(q0, p0, mu):
    return dvi.integrate(
        system,
        q0,
        p0,
        h=alphas.h / 2,
        num_steps=2 * alphas.steps(2e-4),
        args={**args, "mu": mu},
        method=dvi.GaussLegendre(2),
        observe=dvi.MaxDrift(energy),
    )


sols = jax.jit(jax.vmap(orbit))(q0, p0, args["mu"])
at = alphas.coordinates_of(sols.qs, sols.ps)
with plot.style():
    figure, axes = plt.subplots(1, 2, figsize=(9, 4), layout="constrained")
    for i, name in enumerate(("passing", "trapped")):
        r = np.sqrt(at.s[i])
        axes[0].plot(r * np.cos(at.theta[i]), r * np.sin(at.theta[i]), linewidth=0.8, label=name)
        seconds = alphas.seconds(sols.ts[i])
        axes[1].plot(1e6 * seconds, at.v_parallel[i] / alphas.speed, linewidth=0.8)
    axes[0].set(aspect="equal", xlabel="√s cos θ", ylabel="√s sin θ", title="Poloidal projection")
    axes[0].legend(loc="upper right")
    axes[1].set(xlabel="time [µs]", ylabel="v$_∥$/v", title="Parallel velocity")
    plt.show()

# %% [markdown]
# ## What is conserved
#
# The energy oscillates by an amount that decreases as h⁴, and has no drift. The momentum $p_\zeta$
# would be conserved exactly in an exactly axisymmetric field; here it changes by the small
# symmetry-breaking modes.

# %%
at_edge = float(field.poloidal_flux(1.0)) / alphas.rho  # the scale of p_zeta
change = np.ptp(np.asarray(sols.ps)[:, :, 1], axis=1) / at_edge
for i, name in enumerate(("passing", "trapped")):
    print(f"{name}: energy drift {float(sols.observed[i]):.1e}, change of p_zeta {change[i]:.1e}")
assert float(sols.observed.max()) < 1e-5
assert change.max() < 1e-2

# %% [markdown]
# ## Losses
#
# `boozer.Births` draws initial conditions from the rate of the fusion reactions. A run ends where
# the particle reaches the edge, s = 1.

# %%
births = boozer.Births(1000, alphas, seed=1)
result = dvi.sweep(
    system,
    start=births,
    args=alphas.args(0.0),
    h=alphas.h,
    num_steps=alphas.steps(1e-3),
    method=dvi.GaussLegendre(2),
    stop=alphas.loss,
    observe={"energy_drift": dvi.MaxDrift(energy)},
)
print(result.status_counts())
times = np.geomspace(1e-5, 1e-3, 100)
lost = boozer.loss_fraction(alphas.seconds(result["stop_t"]), times)
assert 0.005 < lost.fraction[-1] < 0.03
with plot.style():
    figure, axis = plt.subplots(figsize=(6, 3.4), layout="constrained")
    axis.fill_between(times, 100 * lost.low, 100 * lost.high, alpha=0.3, label="68 % interval")
    axis.plot(times, 100 * lost.fraction)
    axis.set(xscale="log", xlabel="time [s]", ylabel="lost particles [%]", ylim=(0, None))
    axis.legend(loc="upper left")
    plt.show()

# %% [markdown]
# The first losses are *prompt*: trapped particles near the edge whose banana orbit crosses it, on
# the first bounce. `python examples/alpha_losses.py` continues to 10 ms and stores the results, so
# that an interrupted run can be resumed.
