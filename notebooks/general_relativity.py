# %% [markdown]
# # General relativity from the ephemeris
#
# In this notebook you fit the strength $\varepsilon$ of general relativity to positions of Mercury.
# The Sun and the planets move according to Newton's law and a perturbing force, which is
# $\varepsilon$ times the post-Newtonian correction $W_{\rm PN}$ of the Sun's attraction,
#
# $$\dot p = -\frac{\partial H}{\partial q} + \varepsilon\, W_{\rm PN}(q, p),$$
#
# where $H$ is the Hamiltonian of Newton's law of gravitation, with the oblateness $J_2$ of the Sun.
# The positions are those of JPL's ephemeris DE421. DE421 is itself an integration with relativity,
# fitted to observations, so the expected result is $\varepsilon = 1$. The initial guess is 0.
#
# The notebook needs the ephemeris: `pip install ".[ephemeris]"` in a clone of the repository.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import dvi_jax as dvi
from dvi_jax import plot
from dvi_jax.systems.planets.relativity import (
    SUN_J2,
    hamiltonian_with_oblateness,
    post_newtonian_force,
)
from dvi_jax.systems.planets.solar_system import AU_IN_KM, GM, ephemeris, julian_date

jax.config.update("jax_enable_x64", True)

YEARS = 5  # 100 years take minutes; the results are in docs/general-relativity.md

# %% [markdown]
# ## The data
#
# The data are heliocentric positions of Mercury every ten days from 1900 on. No standard deviation
# is given for them; the fit estimates it from the residuals.

# %%
START, MERCURY = julian_date("1900-01-01"), 1
days = 10.0 * np.arange(1, int(YEARS * 36.525) + 1)
seen, _ = ephemeris(START + days)


def mercury(t, q, p, args):
    return q[MERCURY] - q[0]


data = dvi.Observations(days, seen[:, MERCURY] - seen[:, 0], observe=mercury, t0=0.0)
print(len(days), "positions")

# %% [markdown]
# ## The model
#
# `post_newtonian_force` is the perturbing force $W_{\rm PN}$. The initial states are those of the
# ephemeris. Six corrections `start` of Mercury's initial position [au] and velocity [au/day] are
# fitted together with $\varepsilon$.

# %%
system = dvi.System(hamiltonian_with_oblateness, force=post_newtonian_force)
q, v = (jnp.asarray(x[0]) for x in ephemeris([START]))


def model(params):
    start = params["start"]
    return {
        "system": system,
        "q0": q.at[MERCURY].add(start[:3]),
        "p0": jnp.asarray(GM)[:, None] * v.at[MERCURY].add(start[3:]),
        "epsilon": params.get("epsilon", 0.0),
        "args": {"masses": GM, "G": 1.0, "J2": SUN_J2},
        "h": 10.0,
        "method": dvi.GaussLegendre(8),
        "newton": dvi.Picard(),
        "arithmetic": dvi.Compensated(),
    }


def fitted(model, params):
    return dvi.fit(model, data, params, check_curvature=False, progress=False)


# %% [markdown]
# ## Two fits: without and with relativity
#
# Both fits include the oblateness of the Sun, $J_2 = 2 \times 10^{-7}$, because the oblateness also
# rotates Mercury's perihelion. The fit without relativity is the control: its residuals must be
# much larger.

# %%
still = np.zeros(6)
fits = {
    "Newton alone": fitted(model, {"start": still}),
    "with relativity": fitted(model, {"epsilon": 0.0, "start": still}),
}


def rms(fit):
    """Root mean square of the distance from the ephemeris [m]."""
    return np.sqrt(np.mean(np.sum(fit.residuals[0] ** 2, axis=1))) * AU_IN_KM * 1e3


for name, fit in fits.items():
    print(f"{name:16}: {rms(fit):9.3g} m rms")
fit = fits["with relativity"]
epsilon, formal = fit.x[0], fit.sigma[0]
lag = float(np.mean(fit.statistics()["lag_one"]))
print(f"ε = {epsilon:.5f}, formal ± {formal:.0e}; correlation of neighbouring residuals {lag:.2f}")

assert abs(epsilon - 1) < 1e-4
assert rms(fits["Newton alone"]) > 1000 * rms(fit)  # control: the data require relativity
assert lag > 0.5  # so that the formal error is much too small

# %% [markdown]
# The printed error (±) is formal: it assumes independent residuals. But neighbouring residuals are
# correlated, so the formal error is too small. In a model without the oblateness, `"J2": 0.0`, the
# fit attributes the effect of the oblateness to relativity. A fit to 100 years then gives
# $\varepsilon = 1.0006$ (`python examples/general_relativity.py`).

# %%
with plot.style():
    figure, axis = plt.subplots(figsize=(8, 3.8))
    for (name, fit), mark in zip(fits.items(), "os", strict=True):
        off = np.linalg.norm(fit.residuals[0], axis=1) * AU_IN_KM * 1e3
        axis.semilogy(1900 + days / 365.25, off, mark, ms=2, label=f"{name}: {rms(fit):.2g} m")
    axis.set(xlabel="year", ylabel="distance from DE421 [m]", title="Residuals of the fits")
    figure.legend(loc="outside lower center", ncols=2, markerscale=3)
plt.show()

# %% [markdown]
# ## Next steps
#
# - Fit 100 years and analyse the residuals: `python examples/general_relativity.py`;
#   `docs/general-relativity.md` shows the results.
# - Fit another body, or use the Hamiltonian form of relativity in
#   `dvi_jax.systems.planets.relativity`.
