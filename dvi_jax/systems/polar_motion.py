r"""The motion of the Earth's pole: the Chandler wobble, damped and driven once a year.

The pole of rotation moves about the crust as x [towards Greenwich] and y [towards 90° **west**].
With p = x − i y, as y points west, Liouville's equation of an Earth that yields and loses energy is

    p + (i/σ_c) dp/dt = χ(t),    σ_c = σ (1 + i/(2Q)),    σ = 2π / period

(Munk & MacDonald 1960, *The Rotation of the Earth*; Gross 2015), so that dp/dt = iσ_c (p − χ). Here
χ = X − i Y is the mean pole, which drifts, and an annual part. With γ = σ/(2Q) the two real parts
are

    dx/dt = σ (y − Y) − γ (x − X),    dy/dt = −σ (x − X) − γ (y − Y).

Where γ = 0 this is canonical as it stands: q = x, p = y, H = σ ((q − X)² + (p − Y)²)/2. A system
here takes a force on p alone. The loss in x is therefore put in as −γ (q − X)(p − Y) in H, which
would feed y as it drains x, and the force −2γ (p − Y) takes from y what was fed and as much again.
Both components lose at the rate γ, exactly, to all orders in γ; −2γ p alone would do so only on the
average over a period. What drives the wobble is linear in q and p and part of H.
"""

from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from .._system import System
from ._problem import Problem, named, over_times
from ._start import Start, finite, positive, vector
from .solar_system import installed_file

REFERENCE = 51544.0
"""Modified Julian date (UTC) of t = 0: 2000-01-01 at 0h [day]."""

YEAR = 365.25
"""Period of the annual terms, and the year of `drift` [day]."""

_MJD, _FLAG = slice(7, 15), 16  # columns 8-15 and 17 of a line, counted from 1 in the format
_X, _X_ERROR, _Y, _Y_ERROR = slice(18, 27), slice(27, 36), slice(37, 46), slice(46, 55)


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
    """The pole of each day since 1973-01-02 as measured; predictions are left out.

    - `path`: a file in the format of finals2000A; by default finals2000A.all of the package
      skyfield-data. Nothing is fetched.

    Returns a `PolarMotion` of Bulletin A. Errors are about 15 mas in 1973, 1 mas in 1984 and below
    0.1 mas from about 2000: far below what an unmodelled atmosphere and ocean do to the pole
    (about 20 mas in some years).

    **Raises** `EphemerisMissing` without the extra `ephemeris`; `ValueError` for a file without one
    measured line, or with a line that cannot be read.

    **Source** IERS Rapid Service/Prediction Centre at the U.S. Naval Observatory: public data, free
    to use with acknowledgement. The package that carries the file is under the MIT licence. Format:
    readme.finals2000A of the same centre, columns 8–15 (MJD), 17 (I measured, P predicted), 19–27,
    28–36, 38–46, 47–55. How Bulletin A is made: McCarthy & Luzum 1991, *Bull. Géod.* 65, 22.
    """
    path = (
        installed_file("finals2000A.all", "the measured polar motion")
        if path is None
        else Path(path)
    )
    with path.open(encoding="ascii", errors="replace") as file:
        lines = [(i, line) for i, line in enumerate(file, 1) if line[_FLAG : _FLAG + 1] == "I"]
    if not lines:
        raise ValueError(
            f"{path.name} has no measured pole (no line with I in column 17): it must be in the "
            "format of finals2000A."
        )
    table = np.empty((len(lines), 5))
    for row, (number, line) in zip(table, lines, strict=True):
        try:
            row[:] = [float(line[s]) for s in (_MJD, _X, _Y, _X_ERROR, _Y_ERROR)]
        except ValueError:
            raise ValueError(
                f"line {number} of {path.name} is not in the format of finals2000A: "
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
    """X and Y of what drives the wobble, X − i Y = a exp(iωt) + b exp(−iωt) [arcsec].

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
    """H1_D = −σ (u X + v Y) − γ (u − X)(v − Y): the driving, and one half of the damping."""
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
    r"""x and y of the pole that does not wobble freely, exact at ε = 1 [arcsec].

        x − i y = m + m′/(iσ_c) + a exp(iωt) σ_c/(σ_c − ω) + b exp(−iωt) σ_c/(σ_c + ω)

    m: mean pole, x − i y of it. The annual terms are the resonance: with 433 days a prograde one
    is five times what drives it, a retrograde one less than a half.
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

    The `forced_pole`, and about it a spiral: with d = p − forced pole,
    d(t) = d(t0) exp(iσ_c (t − t0)). All arguments broadcast.
    """
    sigma, gamma = rates(args)
    x0, y0 = forced_pole(t0, args)
    d = (q0 - x0 - 1j * (p0 - y0)) * jnp.exp((1j * sigma - gamma) * (t - t0))
    x, y = forced_pole(t, args)
    return x + d.real, y - d.imag


def amplitude(t0, t1, q0, p0, q1, p1, args):
    """√(u² + v²) at t1, the distance from the mean pole [arcsec]: kept at ε = 0 without drift."""
    x, y = mean_pole(t1, args)
    return jnp.sqrt(jnp.sum((q1 - x) ** 2 + (p1 - y) ** 2))


def free_amplitude(t0, t1, q0, p0, q1, p1, args):
    """Distance from the `forced_pole` at t1 [arcsec]: exp(−γt) of itself at ε = 1."""
    x, y = forced_pole(t1, args)
    return jnp.sqrt(jnp.sum((q1 - x) ** 2 + (p1 - y) ** 2))


check_start = Start(
    "the pole is one point, its x and its y",
    (1,),
    {"period": positive, "inverse_Q": finite}
    | dict.fromkeys(("prograde", "retrograde", "mean", "drift"), vector(2)),
)


def polar_motion() -> Problem:
    r"""The pole on 2000-01-01 (t = 0), with ε = 1 the Earth's and with ε = 0 free and undamped.

        H_D + ε H1_D  and  ε W    of  hamiltonian, disturbance, damping

    `args`, each of which a fit may set free:

    - `period`: of the free wobble [day]. `inverse_Q`: 1/Q; of either sign, as an error of it has.
    - `prograde`, `retrograde`: (real, imaginary) of what drives the annual wobble [arcsec].
    - `mean`, `drift`: of the mean pole, (x, y) at t = 0 [arcsec] and a year [arcsec/365.25 day].

    q = x and p = y [arcsec], t = MJD − 51544 [day]. ε between 0 and 1 scales driving and damping;
    the closed forms `forced_pole` and `exact` hold at ε = 1. The step suits `Strang`: at h = 1 day
    the period is too short by 0.004 day, and that goes with h².

    What a fit can tell: what atmosphere and ocean do at random is not in the model. It moves the
    pole by tens of mas over years, so that residuals are correlated for months and formal errors
    many times too small. Three decades give the period to about 3 days and 1/Q to about 0.01 (our
    own, by jackknife and on made-up poles), which does not tell Q from infinity. Yamaguchi & Furuya
    2025, doi 10.1186/s40623-025-02240-7, argue that neither can be had from the pole alone.

    **Source** period: Wilson & Vicente 1990, *Geophys. Monogr.* 59, 151, 433.0 ± 1.1 days; Q:
    Nastula & Gross 2015, *J. Geophys. Res. Solid Earth* 120, 4474, 127 (56 to 255); mean pole: IERS
    Conventions (2010), 7.1.4, (21) as updated in 2018; start: finals2000A; annual terms: our own
    fit to 1976–2008. Review: Gross 2015, *Treatise on Geophysics*, 2nd ed., 3.09.
    """
    return Problem(
        name="polar_motion",
        system=System(hamiltonian, force=damping, perturbation=disturbance),
        q0=[0.043301],
        p0=[0.377867],
        h=1.0,
        args={
            "period": 433.0,
            "inverse_Q": 1 / 127,
            "prograde": np.array([0.0065, -0.0138]),
            "retrograde": np.array([-0.0042, -0.0069]),
            "mean": np.array([0.0550, 0.3205]),
            "drift": np.array([0.001677, 0.003460]),
        },
        observables=named(amplitude, free_amplitude),
        units={"q": "arcsec", "p": "arcsec", "t": "day", "energy": "arcsec²/day"},
        source="Wilson & Vicente 1990; Nastula & Gross 2015; IERS Conventions 2010; finals2000A",
        check=check_start,
        parameters={
            "period": "of the free wobble [day]",
            "inverse_Q": "1/Q, of either sign [1]",
            "prograde": "what drives the annual wobble, (real, imaginary) [arcsec]",
            "retrograde": "the same, turning the other way [arcsec]",
            "mean": "mean pole (x, y) at t = 0 [arcsec]",
            "drift": "of the mean pole (x, y) in a year [arcsec/365.25 day]",
        },
        exact=_exact_from_zero,
        exact_epsilon=1.0,
    )


@over_times((1,))
def _exact_from_zero(t: Any, q0: Any, p0: Any, args: Any) -> tuple[Any, Any]:
    """`exact` as a `Problem` has it: of one start at t0 = 0."""
    return exact(t, 0.0, q0, p0, args)
