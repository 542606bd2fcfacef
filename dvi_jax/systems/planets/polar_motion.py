r"""The motion of the Earth's pole: the Chandler wobble, damped and driven once a year.

The pole of rotation has coordinates x [towards Greenwich] and y [towards 90° **west**]. With
p = x − i y, as y points west, Liouville's equation of an elastic and dissipative Earth is

    p + (i/σ_c) dp/dt = χ(t),    σ_c = σ (1 + i/(2Q)),    σ = 2π / period

(Munk & MacDonald 1960, *The Rotation of the Earth*; Gross 2015), so that dp/dt = iσ_c (p − χ). The
excitation χ = X − i Y is the drifting mean pole and an annual part. With γ = σ/(2Q) the real and
imaginary parts are

    dx/dt = σ (y − Y) − γ (x − X),    dy/dt = −σ (x − X) − γ (y − Y).

For γ = 0 this is canonical with q = x, p = y and H = σ ((q − X)² + (p − Y)²)/2. A `System` has
forces on p only. The damping of x is therefore a term −γ (q − X)(p − Y) of H, which also amplifies
y at the rate γ, and the force −2γ (p − Y) turns this into a damping of y. Both components then
decay at the rate γ, exactly, to all orders in γ; the force −2γ p alone would give this rate only on
average over a period. The excitation is linear in q and p and part of H.
"""

from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from ...base.checks import finite
from ...base.files import user_file
from .._problem import Parameter, Problem, Start, System, library_problem, over_times, vector
from .solar_system import installed_file

REFERENCE = 51544.0
"""Modified Julian date (UTC) of t = 0: 2000-01-01 at 0h [day]."""

YEAR = 365.25
"""Period of the annual terms, and the year of `drift` [day]."""

_FLAG = 16
"""Column of the flag, I for measured and P for predicted: column 17 of the format."""

_COLUMNS = [slice(7, 15), slice(18, 27), slice(37, 46), slice(27, 36), slice(46, 55)]
"""Columns of the fields of `PolarMotion`."""


class PolarMotion(NamedTuple):
    """Measured positions of the pole, all of shape (days,).

    - `mjd`: modified Julian date, UTC [day]; ``mjd - REFERENCE`` is the t of this system.
    - `x`, `y`: towards Greenwich and towards 90° west [arcsec]; q and p of this system.
    - `x_error`, `y_error`: standard errors as published [arcsec].
    """

    mjd: np.ndarray
    x: np.ndarray
    y: np.ndarray
    x_error: np.ndarray
    y_error: np.ndarray


def read_polar_motion(path: str | Path | None = None) -> PolarMotion:
    """The measured pole of each day since 1973-01-02, without predictions.

    - `path`: a file in the format of finals2000A; by default finals2000A.all of the package
      skyfield-data. Nothing is downloaded.

    Returns a `PolarMotion` of Bulletin A. Errors are about 15 mas in 1973, 1 mas in 1984 and below
    0.1 mas from about 2000: far below the effect of atmosphere and ocean, which are not modelled
    (about 20 mas in some years).

    **Raises** `EphemerisMissing` without the extra `ephemeris`; `ValueError` for a file without a
    measured line, or with a line that cannot be read.

    **Source** IERS Rapid Service/Prediction Centre at the U.S. Naval Observatory: public data, free
    to use with acknowledgement. Format: readme.finals2000A of the same centre. Method of Bulletin
    A: McCarthy & Luzum 1991, *Bull. Géod.* 65, 22.
    """
    path = user_file("path", path or installed_file("finals2000A.all", "the measured polar motion"))
    with path.open(encoding="ascii", errors="replace") as file:
        lines = [(i, line) for i, line in enumerate(file, 1) if line[_FLAG : _FLAG + 1] == "I"]
    if not lines:
        raise ValueError(
            f"{path.name} has no measured pole positions: no line with I in column 17, as in the "
            "format finals2000A."
        )
    table = np.empty((len(lines), 5))
    for row, (number, line) in zip(table, lines, strict=True):
        try:
            row[:] = [float(line[column]) for column in _COLUMNS]
        except ValueError:
            raise ValueError(
                f"line {number} of {path.name} is not in the format finals2000A: "
                f"{line[:55].rstrip()!r}."
            ) from None
    return PolarMotion(*table.T)


def rates(args: Any) -> tuple[Any, Any]:
    """Frequency σ = 2π/period and rate of damping γ = σ/(2Q) [1/day]."""
    sigma = 2 * jnp.pi / args["period"]
    return sigma, sigma * args["inverse_Q"] / 2


def mean_pole(t: Any, args: Any) -> tuple[Any, Any]:
    """x and y of the mean pole, mean + drift t/365.25 [arcsec]."""
    mean, drift = jnp.asarray(args["mean"]), jnp.asarray(args["drift"])
    return mean[0] + drift[0] * t / YEAR, mean[1] + drift[1] * t / YEAR


def annual(t: Any, args: Any) -> tuple[Any, Any]:
    """X and Y of the annual excitation, X − i Y = a exp(iωt) + b exp(−iωt) [arcsec].

    a and b are `prograde` and `retrograde`, each as (real part, imaginary part); ω = 2π/365.25 day.
    """
    a, b = jnp.asarray(args["prograde"]), jnp.asarray(args["retrograde"])
    c, s = jnp.cos(2 * jnp.pi / YEAR * t), jnp.sin(2 * jnp.pi / YEAR * t)
    X = (a[0] + b[0]) * c - (a[1] - b[1]) * s
    Y = -(a[1] + b[1]) * c - (a[0] - b[0]) * s
    return X, Y


def hamiltonian(t0, t1, q0, p1, args):
    """H_D = σ (u² + v²)/2, u = q0 − mean x, v = p1 − mean y: the free wobble, undamped."""
    sigma, _ = rates(args)
    x, y = mean_pole(t0, args)
    return sigma * jnp.sum((q0 - x) ** 2 + (p1 - y) ** 2) / 2


def disturbance(t0, t1, q0, p1, args):
    """H1_D = −σ (u X + v Y) − γ (u − X)(v − Y): the excitation, and one half of the damping."""
    sigma, gamma = rates(args)
    x, y = mean_pole(t0, args)
    X, Y = annual(t0, args)
    u, v = q0 - x, p1 - y
    return -jnp.sum(sigma * (u * X + v * Y) + gamma * (u - X) * (v - Y))


def damping(t0, t1, q0, p1, args):
    """W = −2γ (v − Y): the other half of the damping."""
    _, gamma = rates(args)
    return -2 * gamma * (p1 - mean_pole(t0, args)[1] - annual(t0, args)[1])


def forced_pole(t: Any, args: Any) -> tuple[Any, Any]:
    r"""x and y of the pole without a free wobble, exact at ε = 1 [arcsec].

        x − i y = m + m′/(iσ_c) + a exp(iωt) σ_c/(σ_c − ω) + b exp(−iωt) σ_c/(σ_c + ω)

    m = x − i y of the mean pole. With a period of 433 days the prograde term is five times its
    excitation (resonance), the retrograde one less than half.
    """
    sigma, gamma = rates(args)
    sigma_c, omega = sigma + 1j * gamma, 2 * jnp.pi / YEAR
    (x, y), drift = mean_pole(t, args), jnp.asarray(args["drift"]) / YEAR
    a, b = (jnp.asarray(args[name]) for name in ("prograde", "retrograde"))
    turn = jnp.exp(1j * omega * t)
    p = x - 1j * y + (drift[0] - 1j * drift[1]) / (1j * sigma_c)
    p = p + (a[0] + 1j * a[1]) * turn * sigma_c / (sigma_c - omega)
    p = p + (b[0] + 1j * b[1]) / turn * sigma_c / (sigma_c + omega)
    return p.real, -p.imag


def exact(t: Any, t0: Any, q0: Any, p0: Any, args: Any) -> tuple[Any, Any]:
    """x and y at times t of the pole that is at (q0, p0) at t0, exact at ε = 1 [arcsec].

    The distance from the `forced_pole`, d = p − forced pole, is a spiral,
    d(t) = d(t0) exp(iσ_c (t − t0)). All arguments broadcast.
    """
    sigma, gamma = rates(args)
    x0, y0 = forced_pole(t0, args)
    d = (q0 - x0 - 1j * (p0 - y0)) * jnp.exp((1j * sigma - gamma) * (t - t0))
    x, y = forced_pole(t, args)
    return x + d.real, y - d.imag


def amplitude(t0, t1, q0, p0, q1, p1, args):
    """√(u² + v²) at t1, distance from the mean pole [arcsec]: constant at ε = 0 without drift."""
    return _distance(q1, p1, mean_pole(t1, args))


def free_amplitude(t0, t1, q0, p0, q1, p1, args):
    """Distance from the `forced_pole` at t1 [arcsec], which decays as exp(−γt) at ε = 1."""
    return _distance(q1, p1, forced_pole(t1, args))


def _distance(q, p, pole):
    return jnp.sqrt(jnp.sum((q - pole[0]) ** 2 + (p - pole[1]) ** 2))


@over_times((1,))
def _exact_from_zero(t, q0, p0, args):
    """`exact` from t0 = 0, with the arguments of `Problem.exact`."""
    return exact(t, 0.0, q0, p0, args)


def _pair(first, second, meaning):
    return Parameter(np.array([first, second]), meaning, vector(2))


def polar_motion() -> Problem:
    r"""Polar motion of the Earth from 2000-01-01 (t = 0); at ε = 0 free and undamped.

        H_D + ε H1_D  and  ε W    of  hamiltonian, excitation, damping

    q = x and p = y [arcsec], t = MJD − 51544 [day]; `parameters` describes args. ε between 0 and 1
    scales excitation and damping; the closed forms `forced_pole` and `exact` hold at ε = 1. The
    step suits `Strang`: at h = 1 day the period is too short by 0.004 day, an error that scales as
    h².

    Limits of a fit: random excitation by atmosphere and ocean is not in the model. It moves the
    pole by tens of mas over years, so that residuals are correlated for months and formal errors
    are many times too small. Three decades give the period to about 3 days and 1/Q to about 0.01
    (our own, by jackknife and on synthetic poles), which does not distinguish Q from infinity.
    Yamaguchi & Furuya 2025, doi 10.1186/s40623-025-02240-7, argue that the pole alone determines
    neither.

    **Source** period: Wilson & Vicente 1990, *Geophys. Monogr.* 59, 151, 433.0 ± 1.1 days; Q:
    Nastula & Gross 2015, *J. Geophys. Res. Solid Earth* 120, 4474, 127 (56 to 255); mean pole: IERS
    Conventions (2010), 7.1.4, (21) as updated in 2018; start: finals2000A; annual terms: our own
    fit to 1976–2008. Review: Gross 2015, *Treatise on Geophysics*, 2nd ed., 3.09.
    """
    return library_problem(
        System(hamiltonian, damping, disturbance),
        Start("the pole has one x, in q0, and one y, in p0", (1,)),
        name="polar_motion",
        q0_p0_h=([0.043301], [0.377867], 1.0),
        parameters={
            "period": Parameter(433.0, "of the free wobble [day]"),
            "inverse_Q": Parameter(1 / 127, "1/Q, of either sign [1]", finite),
            "prograde": _pair(0.0065, -0.0138, "drive of the annual wobble (real, imag.) [arcsec]"),
            "retrograde": _pair(-0.0042, -0.0069, "the same, turning the other way [arcsec]"),
            "mean": _pair(0.0550, 0.3205, "mean pole (x, y) at t = 0 [arcsec]"),
            "drift": _pair(0.001677, 0.003460, "of the mean pole (x, y) [arcsec/365.25 day]"),
        },
        observables=[amplitude, free_amplitude],
        autonomous=False,
        units={"q": "arcsec", "p": "arcsec", "t": "day", "energy": "arcsec²/day"},
        source="Wilson & Vicente 1990; Nastula & Gross 2015; IERS Conventions 2010; finals2000A",
        exact=_exact_from_zero,
        exact_epsilon=1.0,
    )
