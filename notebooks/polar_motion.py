# %% [markdown]
# # The Chandler wobble from measured poles
#
# The Earth's pole of rotation goes about the crust in some 433 days, is damped, and driven once a
# year. In $q = x,$ $p = y$ of the pole that is a damped and driven oscillator, whose disturbance
# has the strength $\varepsilon = 1$. Four arcs of eight years share period, damping and driving;
# each has a start of its own. How long is the period, how strong the damping, and how well is
# either known?
#
# Needs the extra `ephemeris`, which brings the measured poles: `pip install "dvi-jax[ephemeris]"`.
# As a command: `python examples/polar_motion.py`.

# %%
import jax
import matplotlib.pyplot as plt
import numpy as np

import dvi_jax as dvi
from dvi_jax import plot
from dvi_jax.systems import polar_motion
from dvi_jax.systems.polar_motion import REFERENCE, YEAR, read_polar_motion

jax.config.update("jax_enable_x64", True)

YEARS = 8  # length of an arc

# %% [markdown]
# ## The data
#
# Published errors are far below what the model leaves out (atmosphere, ocean), so none are given
# and all values weigh alike.

# %%
pole = read_polar_motion()
arcs = []
for start in (42778, 45700, 48622, 51544):  # 1976, 1984, 1992, 2000, each on January 1
    rows = np.searchsorted(pole.mjd, start) + 10 * np.arange(int(YEARS * YEAR / 10) + 1)
    values = np.stack([pole.x, pole.y], axis=1)[rows]
    arcs.append(dvi.Observations(pole.mjd[rows] - REFERENCE, values, observe="state"))
print(len(arcs), "arcs,", sum(arc.values.size for arc in arcs), "values")

# %% [markdown]
# ## The fit
#
# With $\varepsilon = 1$ the disturbance is the Earth's. Parameters under `args` are common; `q0`
# and `p0` have a row for each arc.

# %%
problem = polar_motion()
model = dvi.Model(problem.system, h=5.0, epsilon=1.0, method=dvi.Yoshida(4))


def fitted(arcs, args):
    first = np.stack([arc.values[0] for arc in arcs])
    params = {"args": args, "q0": first[:, :1], "p0": first[:, 1:]}
    return dvi.fit(model, arcs, params, check_curvature=False, progress=False)


fit = fitted(arcs, problem.args)
lag = fit.statistics()["lag_one"]
print(f"{fit.status}; {1e3 * fit.rms:.2f} mas rms; neighbouring residuals correlate by", end=" ")
print(f"{np.mean(lag):.2f}")
assert fit.rms < 0.05  # arcsec

# %% [markdown]
# ## How well is it known?
#
# The formal errors take residuals for white noise. They are not: noise excites the wobble itself,
# and neighbours are alike for months. Leaving out each arc in turn gives honest errors.

# %%
at = [fit.names.index(name) for name in ("args.period", "args.inverse_Q")]
each = np.stack(
    [fitted(arcs[:i] + arcs[i + 1 :], fit.params["args"]).x[at] for i in range(len(arcs))]
)
n = len(arcs)
error = np.sqrt((n - 1) / n * np.sum((each - each.mean(axis=0)) ** 2, axis=0))
for name, k in (("period [day]", 0), ("1/Q", 1)):
    x, formal = fit.x[at[k]], fit.sigma[at[k]]
    print(f"{name}: {x:.4g}, formal ± {formal:.2g}, jackknife ± {error[k]:.2g}")

period, inverse_Q = fit.x[at]
assert abs(period - 433.0) < 2 * error[0]  # Wilson & Vicente 1990: 433.0 ± 1.1
assert np.all(error > 8 * fit.sigma[at])  # formal errors are far too small
assert abs(inverse_Q) < 2 * error[1]  # 1/Q is not told from 0

# %% [markdown]
# Grey: measured; blue, upper panels: fitted; below, x in blue and y in orange. The period agrees
# with the literature, 433.0 ± 1.1 days. 1/Q is less than its error from zero: these data do not
# determine Q.

# %%
with plot.style():
    figure, axes = plt.subplots(3, 1, figsize=(7, 5), sharex=True, dpi=85)
    for t, seen, found in zip(fit.ts, fit.observed, fit.predicted, strict=True):
        for i, name in enumerate("xy"):
            axes[i].plot(2000 + t / YEAR, seen[:, i], ".", ms=1.5, color="0.6")
            axes[i].plot(2000 + t / YEAR, found[:, i], lw=1, color=plot.COLOURS[0])
            axes[i].set_ylabel(f"{name} [arcsec]")
            off = 1e3 * (seen - found)[:, i]
            axes[2].plot(2000 + t / YEAR, off, lw=0.8, color=plot.COLOURS[i])
    axes[0].set_title("The pole, measured and fitted")
    axes[2].set(xlabel="year", ylabel="residuals [mas]", title="What is left of x and y")
plt.show()

# %% [markdown]
# ## What next
#
# - Longer or shorter arcs, `YEARS = 4`: what becomes of the residuals, and of the jackknife's
#   errors?
# - The step does not matter here, the noise does: try `h=10.0`.
