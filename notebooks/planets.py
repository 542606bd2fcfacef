# %% [markdown]
# # Planets and satellites
#
# In this notebook you follow orbital elements along a run, compute the 42.98″ of Mercury, let the
# atmosphere pull down a satellite of an oblate Earth, and fit the drag to noisy distances. The page
# [planets and satellites](../docs/planets.md) has the tables of forces and elements.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import dvi_jax as dvi
from dvi_jax import elements, forces, plot, systems

jax.config.update("jax_enable_x64", True)

# %% [markdown]
# ## Mercury
#
# `elements.to_bodies` makes the initial state from orbital elements. `add_to` adds the relativity
# of the Sun to Newton's law of gravitation. The perihelion advances at the angle
# $3 n\,\mu/(c^2 a (1 - e^2))$ per unit of time.

# %%
GM, c = 2.959122082855911e-4, 173.1446326846693  # of the Sun [au³/day²], of light [au/day]
a, e = 0.38709893, 0.20563069
masses = np.array([1.0, 1.66e-7]) * GM
mercury = elements.Keplerian([a], [e], [0.1], [0.8], [0.5], [0.0])
sun = systems.n_body(masses, *elements.to_bodies(mercury, masses), h=1.0)
problem = forces.Relativity(c).add_to(sun)
method = dvi.WisdomHolman(scheme=(8, 4))
sol = dvi.integrate(problem, num_steps=36525, method=method, save=dvi.Save(every=25))
orbit = sol.elements(masses)
angle = np.degrees(np.unwrap(np.asarray(orbit.Omega + orbit.omega)[:, 0])) * 3600
formula = np.degrees(3 * np.sqrt(GM / a**3) * GM / (c**2 * a * (1 - e**2))) * 3600 * 36525
advance = np.polyfit(sol.ts / 36525, angle, 1)[0]
print(f"{advance:.2f}″ per century, formula {formula:.2f}″")
assert abs(advance - formula) < 0.01

# %% [markdown]
# `PostNewtonian` has the relativity of all bodies. For one planet the difference is of the order of
# its mass.

# %%
all_bodies = forces.PostNewtonian(c).add_to(sun)
end = dvi.integrate(all_bodies, num_steps=3650, method=method, save=dvi.Save(final=True))
difference = np.linalg.norm(end.qs[-1, 1] - sol.qs[3650 // 25, 1]) * 149597870.7
print(f"{difference:.2g} km after ten years")
assert 0 < difference < 1

# %% [markdown]
# ## A satellite with drag
#
# For one satellite q has the shape (3,), p is the velocity, and `args["mu"]` is G times the mass of
# the planet. `f + g` is the sum of two forces. The strength of the drag is a parameter in `args`.
# $J_2$ turns the node; the drag changes the semi-major axis.

# %%
mu, radius, J2 = 398600.44, 6378.14, 1.0826e-3  # [km³/s²], [km]


def kepler(t0, t1, q0, p1, args):
    return p1 @ p1 / 2 - args["mu"] / jnp.sqrt(q0 @ q0)


def density(r, args):
    height = jnp.sqrt(r @ r) - radius
    return 3e-3 * jnp.exp(-(height - 400.0) / 60.0)  # [kg/km³]


drag = forces.Drag(density, ballistic=1.8e-8, rate=7.292e-5)  # 2.2 · 4 m²/500 kg [km²/kg]
both = forces.Harmonics(radius, {2: J2}) + (lambda args: args["drag"]) * drag
satellite = dvi.System(kepler, force=both, epsilon=1.0)
q0, v0 = elements.Keplerian(radius + 400, 0.002, 0.9, 0.4, 0.2, 0.1).state(mu)
sol = dvi.integrate(
    satellite, q0, v0, args={"mu": mu, "drag": 1.0}, h=60.0, num_steps=4320,
    method=dvi.GaussLegendre(2), save=dvi.Save(every=2),
)  # fmt: skip
days = sol.ts / 86400
plot.elements(
    days, sol.elements(mu=mu), ("a", "e", "Omega"), units={"t": "day", "a": "km"},
    title="A satellite at 400 km: $J_2$ and drag",
)  # fmt: skip
plt.show()

# %% [markdown]
# The semi-major axis oscillates twice in each revolution, because the equatorial bulge attracts the
# satellite, and decreases because of the drag. The mean rate of the node is
# $-\frac32 n J_2 (R/p)^2 \cos i$.

# %%
orbit = sol.elements(mu=mu)
a, e, inc = (float(np.mean(x)) for x in (orbit.a, orbit.e, orbit.inc))
node = np.polyfit(days, np.degrees(np.unwrap(np.asarray(orbit.Omega))), 1)[0]
rate = -1.5 * np.sqrt(mu / a**3) * J2 * (radius / (a * (1 - e * e))) ** 2 * np.cos(inc)
print(f"node {node:.3f}° per day, formula {np.degrees(rate) * 86400:.3f}°")
print(f"semi-major axis {np.polyfit(days, orbit.a, 1)[0] * 1000:.0f} m per day")
assert abs(node / np.degrees(rate) / 86400 - 1) < 5e-3

# %% [markdown]
# ## A fit of the drag
#
# The data are distances to a point on the equator at rest, every four minutes of half a day, with
# an error of 5 m. The initial state and the drag are unknown.

# %%
station = radius * np.array([1.0, 0.0, 0.0])


def distance(t, q, p, args):
    return jnp.sqrt(jnp.sum((q - station) ** 2))[None]


model = dvi.Model(satellite, h=60.0, args={"mu": mu}, method=dvi.GaussLegendre(2))
exact = model({"q0": q0, "p0": v0, "args": {"drag": 1.0}})
seen = dvi.integrate(**exact, num_steps=720, observe=distance, save=dvi.Save(every=4))
noise = 5e-3 * np.random.default_rng(0).normal(size=(180, 1))
data = dvi.Observations(
    np.asarray(seen.ts)[1:], np.asarray(seen.observed)[1:] + noise, distance, sigma=5e-3, t0=0.0
)
guess = {"q0": np.asarray(q0) + 0.1, "p0": np.asarray(v0) - 1e-4, "args": {"drag": 0.3}}
result = dvi.fit(model, data, guess)
value, error = float(result.params["args"]["drag"]), result.sigma[result.names.index("args.drag")]
print(f"drag {value:.4f} ± {error:.4f}, reduced chi² {result.reduced_chi2:.2f}")
assert abs(value - 1) < 3 * error

# %% [markdown]
# ## Next
#
# - Other forces: tides, radiation, migration, a third body on the path of an ephemeris file
#   (`interop.ephemeris_path`): [planets and satellites](../docs/planets.md).
# - Fits to other data: [fitting](fitting.ipynb).
