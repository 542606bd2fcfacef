# %% [markdown]
# # The Chandler wobble from measured poles
#
# In this notebook you fit the period and the damping of the Chandler wobble to measured positions
# of the Earth's pole, and estimate errors that take the correlation of the residuals into account.
#
# The Earth's pole of rotation moves around a mean position in about 433 days (Chandler wobble). The
# motion is damped, and driven with a period of one year. The model is a damped and driven
# oscillator with the coordinates of the pole as $q = x$, $p = y$. The damping and the driving are
# the perturbation; its strength is $\varepsilon = 1$. The data are four arcs of eight years. The
# period, the damping and the driving are the same for all arcs; each arc has its own initial state.
#
# The notebook needs the extra `ephemeris`, which installs a package with the measured poles:
# `pip install ".[ephemeris]"` in a clone. `python examples/polar_motion.py` computes the same fit.

# %%
import jax
import matplotlib.pyplot as plt
import numpy as np

import dvi_jax as dvi
from dvi_jax import plot
from dvi_jax.systems import polar_motion
from dvi_jax.systems.planets.polar_motion import REFERENCE, YEAR, read_polar_motion

jax.config.update("jax_enable_x64", True)

YEARS = 8  # length of an arc

# %% [markdown]
# ## The data
#
# The published errors of the poles are not used. They do not include the effects that the model
# neglects (atmosphere, ocean), and from 1984 on they are much smaller than these effects: about
# one milliarcsecond (mas) or less, compared with about 20 mas in some years. All values have the
# same weight, and the fit estimates their standard deviation from the residuals. There is one
# position every ten days.

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
# With $\varepsilon = 1$ the damping and the driving have their full strength. The parameters in
# `args` are common to all arcs; `q0` and `p0` have one row per arc.

# %%
problem = polar_motion()
model = dvi.Model(problem.system, h=5.0, epsilon=1.0, method=dvi.Yoshida(4))


def fitted(arcs, args):
    first = np.stack([arc.values[0] for arc in arcs])
    params = {"args": args, "q0": first[:, :1], "p0": first[:, 1:]}
    return dvi.fit(model, arcs, params, check_curvature=False, progress=False)


fit = fitted(arcs, problem.args)
lag = fit.statistics()["lag_one"]
print(f"{fit.status}; {1e3 * fit.rms:.2f} mas rms; correlation of neighbouring residuals", end=" ")
print(f"{np.mean(lag):.2f}")
assert fit.rms < 0.05  # arcsec

# %% [markdown]
# ## Errors
#
# The formal errors assume white noise. But atmosphere and ocean excite the wobble itself, so the
# residuals are correlated over months. Therefore we repeat the fit four times, each time without
# one arc (jackknife). The scatter of these fits gives more realistic errors. With only four arcs
# the jackknife errors are themselves rough estimates. The damping is described by $1/Q$, where $Q$
# is the quality factor.

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
assert abs(inverse_Q) < 2 * error[1]  # 1/Q is compatible with 0

# %% [markdown]
# The period agrees with the literature, 433.0 ± 1.1 days (Wilson & Vicente 1990). $1/Q$ differs
# from zero by less than its jackknife error: this fit does not determine $Q$.

# %%
with plot.style():
    figure, axes = plt.subplots(3, 1, figsize=(7, 5), sharex=True, dpi=85)
    for t, seen, found in zip(fit.ts, fit.observed, fit.predicted, strict=True):
        for i, name in enumerate("xy"):
            axes[i].plot(2000 + t / YEAR, seen[:, i], ".", ms=1.5, color="0.6", label="measured")
            axes[i].plot(2000 + t / YEAR, found[:, i], lw=1, color=plot.COLOURS[0], label="fit")
            axes[i].set_ylabel(f"{name} [arcsec]")
            off = 1e3 * (seen - found)[:, i]
            axes[2].plot(2000 + t / YEAR, off, lw=0.8, color=plot.COLOURS[i], label=name)
    axes[0].set_title("Position of the pole")
    axes[2].set(xlabel="year", ylabel="measured − fit [mas]", title="Residuals")
    for axis in axes[[0, 2]]:  # the first arc is enough for a legend
        look = {"loc": "lower right", "bbox_to_anchor": (1, 0.97), "ncols": 2, "markerscale": 4}
        axis.legend(handles=axis.lines[:2], **look)
plt.show()

# %% [markdown]
# ## Next steps
#
# - Use shorter arcs, `YEARS = 4`, and compare the residuals and the jackknife errors.
# - Repeat the fit with `h=10.0`. If the results change by less than their errors, the
#   discretisation error is small enough.
