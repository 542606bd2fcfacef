# %% [markdown]
# # Fit ε to data
#
# In this notebook you determine the strength $\varepsilon$ of a perturbation and its error from
# noisy observations. You also test whether the data require a perturbation at all, and identify an
# unknown force law. `dvi.fit` minimises $\chi^2$, the sum of the squared residuals divided by their
# variances, with the derivatives of the discrete trajectory.
#
# The example is an oscillator with weak friction, whose exact solution is known,
#
# $$H = \tfrac12 p^2 + \tfrac12 k q^2, \qquad \dot p = -kq - \varepsilon p, \qquad
# k = 1.3,\ \varepsilon = 0.02 .$$
#
# The units of length and time are arbitrary. The position is observed at 60 times between 0.5 and
# 30, with a standard deviation of 0.01. The data are generated from the exact solution, not from
# the model.

# %%
import jax
import matplotlib.pyplot as plt
import numpy as np

import dvi_jax as dvi
from dvi_jax import plot

jax.config.update("jax_enable_x64", True)

K, EPSILON, SIGMA = 1.3, 0.02, 0.01
ts = np.linspace(0.5, 30, 60)


def observed(seed, epsilon=EPSILON):
    """Positions of the oscillator released at q = 1, with noise."""
    rate = np.sqrt(K - epsilon**2 / 4)
    wave = np.cos(rate * ts) + epsilon / (2 * rate) * np.sin(rate * ts)
    noise = SIGMA * np.random.default_rng(seed).normal(size=len(ts))
    values = np.exp(-epsilon * ts / 2) * wave + noise
    return dvi.Observations(ts, values[:, None], sigma=SIGMA, t0=0.0)


# %% [markdown]
# ## The fit
#
# `Model` contains the known quantities. The third argument of `fit` contains the initial guesses of
# the unknown quantities. The guess $\varepsilon = 0$ means no perturbation. It replaces the
# `epsilon` of the model. The `epsilon` of the model is used in fits without $\varepsilon$ among the
# unknown quantities (below).


# %%
def H_D(t0, t1, q0, p1, args):
    return p1 @ p1 / 2 + args["k"] * (q0 @ q0) / 2


def friction(t0, t1, q0, p1, args):
    return -p1


system = dvi.System(H_D, force=friction)
model = dvi.Model(system, h=0.05, p0=[0.0], epsilon=0.0, method=dvi.Yoshida(4))
guess = {"epsilon": 0.0, "q0": np.array([0.9]), "args": {"k": 1.2}}
found = dvi.fit(model, observed(0), guess, progress=False)
for name, x, sigma in zip(found.names, found.x, found.sigma, strict=True):
    print(f"{name:8} = {x:.4f} ± {sigma:.4f}")
print(f"{found.status}, reduced chi² = {found.reduced_chi2:.2f}")

# %% [markdown]
# The plot shows the observations with their errors, and the trajectory with the fitted parameters
# at all steps (`curve`).

# %%
fitted = dvi.integrate(system, p0=[0.0], h=0.05, t1=ts[-1], method=dvi.Yoshida(4), **found.params)
axis = plot.fit_against_data(found, curve=(fitted.ts, fitted.qs))
plt.show()

# %% [markdown]
# ## Are the errors correct?
#
# The fit is repeated for thirty noise realisations. If the errors are correct, the standard
# deviation of the estimates of $\varepsilon$ agrees with the error that the fit reports. With
# thirty realisations the standard deviation is itself known only to about 13 %.

# %%
epsilon_at = found.names.index("epsilon")
fits = [dvi.fit(model, observed(seed), guess, progress=False) for seed in range(30)]
estimates = np.array([fit.x[epsilon_at] for fit in fits])
sigmas = np.array([fit.sigma[epsilon_at] for fit in fits])
pulls = (estimates - EPSILON) / sigmas
print(
    f"ε: mean {estimates.mean():.5f}, standard deviation {estimates.std(ddof=1):.5f}, "
    f"reported {sigmas.mean():.5f}"
)
print(f"(estimate − true value)/sigma: mean {pulls.mean():.2f}, std {pulls.std(ddof=1):.2f}")

assert all(fit.status == "converged" for fit in fits)
assert abs(pulls.mean()) < 3 / np.sqrt(30)
assert 0.7 < pulls.std(ddof=1) < 1.3

# %% [markdown]
# ## Do the data require the friction?
#
# Two control fits answer this question. If the data require friction, a model without friction has
# a reduced $\chi^2$ far above 1 for the same data. The second control uses data without friction:
# the fitted $\varepsilon$ must then be compatible with zero.

# %%
unperturbed = {"q0": np.array([0.9]), "args": {"k": 1.2}}
without = dvi.fit(model, observed(0), unperturbed, progress=False, check_curvature=False)
print(f"without friction: reduced chi² = {without.reduced_chi2:.1f}")

none = dvi.fit(model, observed(0, epsilon=0.0), guess, progress=False)
print(f"data without friction: ε = {none.x[epsilon_at]:.4f} ± {none.sigma[epsilon_at]:.4f}")

assert found.reduced_chi2 < 1.5
assert without.reduced_chi2 > 10
assert abs(none.x[epsilon_at]) < 3 * none.sigma[epsilon_at]

# %% [markdown]
# ## Which force is it?
#
# Suppose that the force law is unknown, and that positions and momenta are observed. `identify`
# fits the coefficients of many candidate terms to the trajectory, and removes a term if the fit is
# nearly as good without it. The candidates are the nine monomials $q^i p^j$ of degree 1 to 3. The
# true force is $-\varepsilon p$, so that only the term `p` should remain, with the coefficient
# $-0.02$. The printed criterion is $\chi^2$ plus a penalty for each term; smaller values are
# better.

# %%
times = np.linspace(0.25, 30, 120)
run = dvi.integrate(
    system, [1.0], [0.0], h=0.01, num_steps=3000, epsilon=EPSILON, args={"k": K},
    method=dvi.Yoshida(4), save=dvi.Save(every=25),
)  # fmt: skip
states = np.concatenate([run.qs, run.ps], axis=1)[1:]
states += SIGMA * np.random.default_rng(1).normal(size=states.shape)
data = dvi.Observations(times, states, observe="state", sigma=SIGMA, t0=0.0)
spring = dvi.Model(dvi.System(H_D), h=0.05, args={"k": K}, method=dvi.Strang())
library = dvi.ForceLibrary.monomials(3, 1)
start = {"q0": np.array([1.0]), "p0": np.array([0.0])}
named = dvi.identify(spring, data, library, start, progress=False, check_curvature=False)
print(named)
assert named.terms == ("p",)
assert abs(named.coefficients[0] + EPSILON) < 3 * named.sigma[0]

# %%
with plot.style():
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4))
    left.hist(pulls, bins=np.arange(-3.5, 3.6, 0.5), color=plot.COLOURS[0], alpha=0.8)
    left.set(
        xlabel="(estimate of ε − true value)/sigma",
        ylabel="number of fits",
        title="30 noise realisations",
    )
    for name, fit in {"with friction": found, "without": without}.items():
        right.plot(ts, fit.whitened[0], ".-", lw=0.7, label=f"{name}: {fit.reduced_chi2:.2f}")
    right.set(xlabel="time t", ylabel="residual/sigma", title="Residuals and reduced χ²")
    right.legend()
plt.show()

# %% [markdown]
# ## Next steps
#
# - Fit data with systematic errors: [general relativity](general_relativity.ipynb) from an
#   ephemeris, and the [Chandler wobble](polar_motion.ipynb) from measured positions of the pole.
# - Use the arguments `bounds`, `priors`, `loss` (for data with outliers) and `shooting`
#   (`MultipleShooting`, for chaotic trajectories) of `dvi.fit`, or fit several data sets together.
# - Fit an unknown force: in `dvi.NetworkForce` neural networks represent its potential and its
#   damping.
# - Sample the posterior distribution of the parameters: `dvi.sample`.
