"""General relativity from a century of Mercury: a fit of its strength ε to an ephemeris.

Sun and planets move by Newton's law and a perturbing force, ε times the Sun's relativity. ε and the
initial state of Mercury are fitted to its positions in JPL's DE421: without the perturbation, with
it, and with an oblate Sun. The expected result is ε = 1.

Run: python examples/general_relativity.py [--out DIR] [--conservative] [--years N]
     [--method NAME(ORDER)] [--step DAYS]
"""

import argparse
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np

import dvi_jax as dvi
from dvi_jax import plot
from dvi_jax.systems.planets.relativity import (
    SUN_J2,
    hamiltonian_with_oblateness,
    momenta_from_velocities,
    post_newtonian_force,
    post_newtonian_hamiltonian,
    velocities_from_momenta,
)
from dvi_jax.systems.planets.solar_system import (
    AU_IN_KM,
    GM,
    ephemeris,
    julian_date,
    perihelion_longitude,
    to_ecliptic,
)

START, MERCURY, EVERY = julian_date("1900-01-01"), 1, 10  # an observation every 10 days
METRES, ARCSEC, CENTURY = AU_IN_KM * 1e3, 180 * 3600 / np.pi, 36525.0
EARTH_1_4 = 1 / (1 / 87.969 - 4 / 365.256)  # day: Mercury goes round four times in nearly a year
TEXTBOOK = 42.98  # ″/century, Park et al. 2017, AJ 153, 121

SYSTEMS = {
    False: dvi.System(hamiltonian_with_oblateness, force=post_newtonian_force),
    True: dvi.System(hamiltonian_with_oblateness, perturbation=post_newtonian_hamiltonian),
}
"""Key: whether relativity is a Hamiltonian perturbation. With J2 = 0 the Sun is a point."""


@dataclass
class Stage:
    """A fit with what follows from it.

    - `fit`: the `FitResult`. `epsilon`, `sigma`: ε and its formal error.
    - `off`: DE421 minus fit along track, radially and across the orbit [m], shape (times, 3).
    - `rms`: root mean square of the distance between the two [m].
    - `advance`: of the perihelion, by a line through its longitude [″/century].
    """

    name: str
    fit: dvi.FitResult
    epsilon: float
    sigma: float
    off: np.ndarray
    rms: float
    advance: float


def mercury(t, q, p, args):
    """Heliocentric position of Mercury [au]."""
    return q[MERCURY] - q[0]


def observed(years):
    """Heliocentric positions of Mercury by DE421 [au], every ten days from the start."""
    days = EVERY * np.arange(1, int(years * 365.25 / EVERY) + 1)
    q, _ = ephemeris(START + days)
    # No sigma: what model and ephemeris differ by is found from the residuals.
    return dvi.Observations(days, q[:, MERCURY] - q[:, 0], observe=mercury, t0=0.0)


def century(J2=0.0, conservative=False, method=dvi.GaussLegendre(8), h=10.0):
    """The model: parameters → arguments of `integrate`.

    - parameters: ``"epsilon"``, 0 if left out, and ``"start"``, what is added to Mercury's position
      [au] and velocity [au/day] on the first day, shape (6,).
    """
    q, v = (jnp.asarray(x[0]) for x in ephemeris([START]))
    args = {"masses": GM, "G": 1.0, "J2": J2}

    def model(params):
        epsilon, start = params.get("epsilon", 0.0), params["start"]
        q0, v0 = q.at[MERCURY].add(start[:3]), v.at[MERCURY].add(start[3:])
        p0 = jnp.asarray(GM)[:, None] * v0
        if conservative:  # canonical momenta, linear in 1/c² and so in ε
            p0 = p0 + epsilon * (momenta_from_velocities(q0, v0, args) - p0)
        return {
            "system": SYSTEMS[conservative],
            "q0": q0,
            "p0": p0,
            "h": h,
            "epsilon": epsilon,
            "args": args,
            "method": method,
            "newton": dvi.Picard(),
            "arithmetic": dvi.Compensated(),
        }

    return model


def fitted(name, model, data, params):
    """The fit of one stage."""
    fit = dvi.fit(model, data, params, check_curvature=False)
    known = "epsilon" in params
    off = fit.residuals[0] * METRES
    q, v, advance = orbit(model, fit.params, len(data.ts))
    return Stage(
        name,
        fit,
        float(fit.params["epsilon"]) if known else 0.0,
        float(fit.sigma[0]) if known else 0.0,
        components(off, q, v),
        float(np.sqrt(np.mean(np.sum(off**2, axis=1)))),
        advance,
    )


def orbit(model, params, count):
    """Mercury's heliocentric positions [au] and velocities [au/day], advance of the perihelion."""
    spec = model(params)
    sol = dvi.integrate(
        **spec, num_steps=round(count * EVERY / spec["h"]), save=dvi.Save(every=_stride(spec["h"]))
    )
    vs = np.asarray(sol.ps) / GM[:, None]
    if spec["system"].perturbation is not None:
        plain = jax.vmap(velocities_from_momenta, (0, 0, None))(sol.qs, sol.ps, spec["args"])
        vs = vs + float(spec["epsilon"]) * (np.asarray(plain) - vs)
    q, v = (np.asarray(x[1:, MERCURY] - x[1:, 0]) for x in (sol.qs, vs))
    return q, v, perihelion_advance(q, v)


def perihelion_advance(q, v):
    """Slope of the perihelion's longitude on the ecliptic of J2000 [″/century]."""
    turn = perihelion_longitude(to_ecliptic(q), to_ecliptic(v), GM[0] + GM[MERCURY])
    return float(np.polyfit(EVERY * np.arange(len(q)) / CENTURY, turn * ARCSEC, 1)[0])


def components(off, q, v):
    """Vectors along track, radially and across the orbit of q and v."""
    radial, across = q, np.cross(q, v)
    axes = (np.cross(across, radial), radial, across)
    return np.stack([np.sum(off * a, axis=1) / np.linalg.norm(a, axis=1) for a in axes], axis=1)


def spectrum(x):
    """Periods [day] and amplitudes of a series every ten days; its parabola is taken out."""
    t = np.linspace(-1, 1, len(x))
    window = np.hanning(len(x))
    x = (x - np.polyval(np.polyfit(t, x, 2), t)) * window
    amplitude = 2 * np.abs(np.fft.rfft(x, 8 * len(x)))[1:] / window.sum()
    return 1 / np.fft.rfftfreq(8 * len(x), EVERY)[1:], amplitude


def stages(years=100, **options):
    """The three fits: Newton alone, with relativity, with relativity and an oblate Sun."""
    data, still = observed(years), np.zeros(6)
    plain, oblate = century(**options), century(J2=SUN_J2, **options)
    newton = fitted("Newton alone", plain, data, {"start": still})
    # From ε = 0: nothing is assumed. The oblate Sun's fit goes on from there.
    einstein = fitted("+ relativity", plain, data, {"epsilon": 0.0, "start": still})
    both = fitted("+ oblate Sun", oblate, data, einstein.fit.params)
    return [newton, einstein, both]


def table(found, years):
    """The stages as text."""
    q, v = ephemeris(START + EVERY * np.arange(1, int(years * 365.25 / EVERY) + 1))
    tabulated = perihelion_advance(*(x[:, MERCURY] - x[:, 0] for x in (q, v)))
    lines = [f"{'':14} {'ε':>22} {'rms [km]':>10} {'perihelion [″/century]':>23} steps seconds"]
    for s in found:
        epsilon = f"{s.epsilon:.6f} ± {s.sigma:.7f}" if s.sigma else "0 (fixed)"
        lines.append(
            f"{s.name:14} {epsilon:>22} {s.rms / 1e3:10.4g} {s.advance:23.3f} "
            f"{len(s.fit.history['loss']):5d} {s.fit.seconds:7.1f}"
        )
    lines.append(f"{'DE421':14} {'':>22} {'':>10} {tabulated:23.3f}")
    gain = found[1].advance - found[0].advance
    lines.append(
        f"The perturbation turns Mercury's perihelion by {gain:.3f}″ per century; textbook: "
        f"{TEXTBOOK}″."
    )
    r = found[-1].off
    lag = np.sum(r[1:] * r[:-1]) / np.sum(r**2)
    lines.append(
        f"The residuals are systematic (correlation of neighbours {lag:.2f}): ± is formal, for\n"
        "independent errors, and much too small."
    )
    return "\n".join(lines)


def draw(found):
    """Residuals of the stages; those of the last by component, and their spectrum."""
    figure, ((a, b), (c, d)) = plt.subplots(2, 2, figsize=(10, 6.4))
    year = 1900 + EVERY * np.arange(1, len(found[0].off) + 1) / 365.25
    last = found[-1].off
    for s, colour in zip(found, plot.COLOURS, strict=False):
        size = np.linalg.norm(s.off, axis=1) / 1e3
        label = f"{s.name}: {float(f'{s.rms / 1e3:.3g}'):g} km"
        a.semilogy(year, size, ".", ms=1.2, color=colour, label=label)
    a.set(title="Mercury, distance of the fits from DE421 (rms)", ylabel="distance [km]")
    a.set_ylim(1e-3, None)
    a.legend(loc="center right", bbox_to_anchor=(1, 0.58), markerscale=8)
    b.plot(year, last[:, 0], lw=0.5, color=plot.COLOURS[2])
    b.set(title="Residuals along track, fit with oblate Sun", ylabel="DE421 − fit [m]")
    for s, colour in zip(found[1:], plot.COLOURS[1:], strict=False):
        c.plot(year, s.off[:, 2], lw=0.5, color=colour, label=s.name)
    c.set(title="Residuals across the orbit", xlabel="year", ylabel="DE421 − fit [m]")
    c.legend(loc="upper center", ncols=2)
    for i, (name, colour) in enumerate([("along", 2), ("radial", 3), ("across", 0)]):
        d.loglog(*spectrum(last[:, i]), lw=0.8, color=plot.COLOURS[colour], label=name)
    d.axvline(EARTH_1_4, color="0.5", lw=0.8, ls=":")
    d.text(EARTH_1_4 * 1.15, 20, "Mercury–Earth 4 : 1", color="0.3", va="center", fontsize=9)
    d.set(title="Spectrum of the residuals, fit with oblate Sun")
    d.set(xlabel="period [day]", ylabel="amplitude [m]")
    d.set(ylim=(1e-2, 1e2), xlim=(20, 4e4))
    d.legend(loc="upper left", ncols=3, handlelength=1.2, columnspacing=1.0)
    return figure


def _stride(h):
    stride = round(EVERY / h)
    if stride < 1 or abs(stride * h - EVERY) > 1e-12:
        raise SystemExit(f"the step must divide {EVERY} days, got {h:g}.")
    return stride


def _method(text):
    name, _, order = text.rstrip(")").partition("(")
    known = {"GaussLegendre", "KahanLi", "Yoshida", "Suzuki", "BlanesMoan", "McLachlan", "Strang"}
    if name not in known:
        raise SystemExit(f"method must be one of {', '.join(sorted(known))}, got {text!r}.")
    return getattr(dvi, name)(*([int(order)] if order else []))


def main():
    """Fit, print, draw."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--out", type=Path, default=Path("."), help="directory for the picture")
    parser.add_argument("--conservative", action="store_true", help="relativity as a Hamiltonian")
    parser.add_argument("--years", type=float, default=100, help="years of data from 1900 on")
    parser.add_argument("--method", default="GaussLegendre(8)", help="and its order or stages")
    parser.add_argument("--step", type=float, default=10.0, help="days, a divisor of 10")
    given = parser.parse_args()
    _stride(given.step)
    given.out.mkdir(parents=True, exist_ok=True)
    found = stages(
        given.years,
        conservative=given.conservative,
        method=_method(given.method),
        h=given.step,
    )
    print(table(found, given.years))
    with plot.style():
        print(f"written: {plot.save(draw(found), given.out / 'general_relativity.png')}")


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    mpl.use("Agg")
    main()
