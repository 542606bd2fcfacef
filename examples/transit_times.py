"""Masses and orbits of two planets from the times of their transits, by a fit and by NUTS.

Two planets near the 2:1 resonance of their periods perturb one another. Their transits in front of
the star come some minutes early or late, by amounts from which masses and eccentricities follow.
The data are 40 transit times with a noise of one minute, computed with another integrator than the
model: `KahanLi(8)` with short steps, and each transit by `Section`. The model uses
`WisdomHolman` with 20 steps per inner period.

The observable is the time from a state to the next or last conjunction, δ = −x/ẋ to first order,
with its correction of third order; it is observed to be zero at the observed times. This needs no
search for transits, and derivatives are those of the map.

Run: python examples/transit_times.py [--quick] [DIRECTORY for the picture]
"""

import argparse
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np

import dvi_jax as dvi
from dvi_jax import elements, plot, systems

jax.config.update("jax_enable_x64", True)
mpl.use("Agg")

EARTHS = 332946  # Earth masses of the star
GM = 2.959122082855911e-4  # of the star [au³/day²]
TRUTH = {
    "mass": np.array([5e-5, 1e-4]),  # over that of the star
    "period": np.array([10.0, 20.8]),  # [day]
    "transit": np.array([1.7, 4.1]),  # a time of transit of the unperturbed orbit [day]
    "ecos": np.array([0.02, -0.03]),  # e cos ω
    "esin": np.array([0.03, 0.01]),  # e sin ω
}
SIGMA, COUNT, H = 1 / 1440, 40, 1.0  # [day], transits, [day]
NAMES = "mass", "period", "transit", "ecos", "esin"


def state(params):
    """q0, p0 and args of the star and the planets at t = 0, from the elements.

    Transits are at the true longitude 90°, the observer in the direction of +y.
    """
    ex, ey = params["ecos"], params["esin"]
    masses = GM * jnp.concatenate([jnp.ones(1), params["mass"]])
    mu = jnp.cumsum(masses)[1:]
    n = 2 * jnp.pi / params["period"]
    a = (mu / n**2) ** (1 / 3)
    at_transit = elements.ModifiedEquinoctial(a * (1 - ex**2 - ey**2), ex, ey, 0, 0, jnp.pi / 2)
    longitude = elements.Equinoctial.from_state(*at_transit.state(mu), mu).longitude
    start = elements.Equinoctial(a, ex, ey, 0, 0, longitude - n * params["transit"])
    # The outer planet moves around the centre of mass of the star and the inner one (Jacobi).
    return *elements.to_bodies(start, masses, dim=2), {"masses": masses}


SYSTEM = systems.n_body().system


def model(params):
    q0, p0, args = state(params)
    return {
        "system": SYSTEM, "q0": q0, "p0": p0, "args": args, "h": H,
        "method": dvi.WisdomHolman(scheme=(8, 2)),
    }  # fmt: skip


def delay(t, q, p, args):
    """The time since the conjunction of each planet with the star, negative before it."""
    masses = args["masses"]
    x = q[1:] - q[:1]
    v = p[1:] / masses[1:, None] - p[:1] / masses[0]
    early = x[:, 0] / v[:, 0]
    # x(t) ≈ x + ẋ δ − GM x δ²/(2 r³): δ = −(x/ẋ) (1 + …).
    curve = masses[0] / jnp.sum(x * x, axis=1) ** 1.5
    return early * (1 + curve * early**2 / 3)


def simulated(rng):
    """Transit times of each planet with noise, from another integrator."""
    q0, p0, args = state(TRUTH)

    def of(i):
        # At longitude 90° x decreases; behind the star, at 270°, it increases.
        return dvi.Section(lambda t, q, p, args: q[i, 0] - q[0, 0], direction=-1, max_crossings=60)

    sol = dvi.integrate(
        SYSTEM, q0, p0, args=args, h=0.05, num_steps=5600, method=dvi.KahanLi(8),
        observe=[of(1), of(2)], save=dvi.Save(final=True),
    )  # fmt: skip
    times = [np.asarray(c.ts)[: int(c.count)] for c in sol.observed]
    inner, outer = times[0][: COUNT - COUNT // 3], times[1][: COUNT // 3]
    return [t + SIGMA * rng.normal(size=t.size) for t in (inner, outer)]


def observations(times):
    """All times in order, with NaN for the planet that does not transit."""
    ts = np.concatenate(times)
    which = np.repeat([0, 1], [len(t) for t in times])
    order = np.argsort(ts)
    values = np.full((ts.size, 2), np.nan)
    values[np.arange(ts.size), which[order]] = 0.0
    return dvi.Observations(ts[order], values, observe=delay, sigma=SIGMA, t0=0.0)


def starting(times):
    """Linear ephemerides, circular orbits and masses of the size of the Earth's."""
    lines = [np.polyfit(np.arange(t.size), t, 1) for t in times]
    return {
        "mass": np.full(2, 3e-5),
        "period": np.array([line[0] for line in lines]),
        "transit": np.array([line[1] for line in lines]),
        "ecos": np.array([0.01, -0.01]),
        "esin": np.array([0.01, 0.01]),
    }


def main(quick, directory):
    if directory:  # before minutes of work
        Path(directory).mkdir(parents=True, exist_ok=True)
    times = simulated(np.random.default_rng(1))
    data, priors = observations(times), {"ecos": dvi.Prior(0.0, 0.05), "esin": dvi.Prior(0.0, 0.05)}
    bounds = {"mass": dvi.Bounds(0.0, 1e-3)}
    began = time.perf_counter()
    found = dvi.fit(model, data, starting(times), priors=priors, bounds=bounds, progress=False)
    print(f"fit: {found.status} in {time.perf_counter() - began:.1f} s, chi² = {found.chi2:.1f}")
    began = time.perf_counter()
    draws = 200 if quick else 1000
    chains = dvi.sample(
        model, data, found.params, priors=priors, bounds=bounds, start=found, num_samples=draws,
        num_warmup=150 if quick else 500, chains=2, target_accept=0.98, progress=False,
    )  # fmt: skip
    print(f"NUTS: {chains.status} in {time.perf_counter() - began:.1f} s")
    print(f"{'':12}{'truth':>12}{'fit':>12}{'±':>10}{'NUTS':>12}{'±':>10}")
    rows = zip(found.names, found.x, found.sigma, chains.mean, chains.x.std((0, 1)), strict=True)
    exact = np.concatenate([TRUTH[key] for key in sorted(TRUTH)])
    for (name, *numbers), true in zip(rows, exact, strict=True):
        print(f"{name:12}{true:12.6g}{numbers[0]:12.6g}{numbers[1]:10.2g}", end="")
        print(f"{numbers[2]:12.6g}{numbers[3]:10.2g}")
    if directory:
        picture(times, found, chains, Path(directory) / "transit_times.png")
    return found, chains


def picture(times, found, chains, path):
    """Delays of the transits from a linear ephemeris, and the posterior of the masses."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
    for t, name in zip(times, ("inner planet", "outer planet"), strict=True):
        k = np.arange(t.size)
        late = 1440 * (t - np.polyval(np.polyfit(k, t, 1), k))
        axes[0].errorbar(t, late, 1440 * SIGMA, fmt="o", ms=3, label=name)
    axes[0].set(xlabel="time [day]", ylabel="delay [min]", title="Transits and a constant period")
    axes[0].legend()
    axes[1].plot(*(EARTHS * chains.params["mass"].reshape(-1, 2).T), ".", ms=2, alpha=0.4)
    axes[1].plot(*(EARTHS * TRUTH["mass"]), "k+", ms=12, label="true value")
    axes[1].set(xlabel="inner planet", ylabel="outer planet", title="Masses [Earth masses]")
    axes[1].legend()
    plot.save(figure, path)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("directory", nargs="?")
    parser.add_argument("--quick", action="store_true", help="fewer draws")
    options = parser.parse_args()
    main(options.quick, options.directory)
