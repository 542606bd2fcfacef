"""The exponent of a power law for ε → 0, with its uncertainty, from measured points."""

from typing import Any, NamedTuple

import numpy as np

from .laws import Fits, fits_of_laws, lines, names

LEAST_POINTS = 3  # Points that a slope needs: two points always lie on a line
_RESOLUTION = 0.3  # An order is resolved when half of its 95 % interval is at most this
_UNLIKELY = 0.05  # A straight line is rejected when its probability is below this


class Exponent(NamedTuple):
    """The order s of drift ∝ ε^s for ε → 0, and how well the points determine it.

    - `slope`: s if `resolved`, else the slope of the straight line; NaN with fewer than three
      points.
    - `interval`: 95 % interval of s; if not `resolved`, extended so that it contains `slope`.
      `stderr`: half of its length, divided by Student's t of n − 2 degrees of freedom.
    - `resolved`: whether the 95 % interval of s is at most 0.6 long.
    - `model`: the most probable shape, a key of `probabilities`: "power", "sum of two powers",
      "saturation", "difference of two powers", "resonance"; "" with fewer than three points.
    - `crossover`: ε at which the two powers are equal, the saturation begins, or the resonance
      is; NaN for a power.
    - `line_slope`, `line_stderr`: of the straight line through all points, by least squares.
    - `curvature`: d² log(drift) / d log(ε)² of the parabola through all points by least squares;
      NaN with fewer than four points.
    - `points`: number of points n. `range`: smallest and largest ε; NaN with fewer than three.
    """

    slope: float
    interval: tuple[float, float]
    stderr: float
    resolved: bool
    model: str
    probabilities: dict[str, float]
    crossover: float
    line_slope: float
    line_stderr: float
    curvature: float
    points: int
    range: tuple[float, float]

    @property
    def curved(self) -> bool:
        """Whether a straight line is rejected: its probability is below 5 %."""
        return self.points >= LEAST_POINTS and self.probabilities["power"] < _UNLIKELY

    def report(self, points: int, target: tuple[float, float]) -> list[str]:
        """Lines of text: the order and its interval, or that none is resolved. `points`: the number
        before points were excluded; `target`: see `resolving_range`."""
        low, high = self.interval
        law = f"not one power: {self.model} near ε = {self.crossover:.2g}"
        if self.crossover > self.range[1]:
            law = "the slope changes toward larger ε"
        count = f"by {self.points} of {points} points"
        straight = f"the slope of the straight line is {self.line_slope:.3g}"
        if self.resolved:
            power = f"ε^{self.slope:.4g}, 95 % interval {low:.4g} … {high:.4g}, {count}"
            if self.model == "power":
                return [f"drift ∝ {power}"]
            return [f"for ε → 0 the drift tends to {power}", f"  {law}; {straight}"]
        lines = [
            f"no order resolved in this range: for ε → 0 it may be {low:.2g} … {high:.2g} (95 %), "
            f"{count} ({straight})"
        ]
        if self.curved:
            lines.append(f"  {law}")
        remedy = "reduce the drift at ε = 0 first: it hides the smaller ε that are required"
        if np.isfinite(target).all():
            ends = " … ".join(f"{x:.2g}" for x in target)
            remedy = f"take more points (eight or more) at ε = {ends}"
        return [*lines, f"  to resolve it, {remedy}"]


def small_epsilon_exponent(epsilons: Any, drifts: Any, floor: float = 0.0) -> Exponent:
    r"""The exponent s of drift ∝ ε^s for ε → 0, with a 95 % interval over several models.

    With x = log ε, y = log drift, each model has the form

        y_i = a + s x_i + g(x_i) + σ e_i ,    g → 0 for x → −∞ ,    e_i ∼ N(0, 1) independent,

    and differs in the shape g:

    - power: g = 0
    - sum of two powers, ε^s + (…) ε^{s+k}: g = log(1 + e^{pu}) k/p, u = x − x_c, p = k, or
      p = 2k for the root of the sum of their squares
    - saturation: g = −log(1 + e^{pu}) k/p with p = 1, 2, 4
    - difference of two powers: g = log |1 − e^{ku}|
    - resonance: g = A / (1 + (pu)²), A of both signs; with six points or more.

    Where the drift at ε = 0 is not negligible, each is also fitted to drift − floor and to
    drift + floor. For a given g, with constant prior densities of a, s and log σ, the probability
    of g is proportional to its prior times RSS_g^{−(n−2)/2}, RSS_g the sum of the squares of the
    residuals of a straight line through y − g, and s follows Student's t distribution about the
    slope of that line. The interval contains 95 % of the sum of these distributions over all g.
    So it contains the scatter and the uncertainty about the model.

    The crossover ε_c = e^{x_c} lies above the smallest ε by assumption: no measurement excludes
    that another power takes over below it.

    **Arguments** `epsilons`, `drifts`: shape (n,), positive and finite, all ε distinct, in any
    order; all of them are used. `floor`: the drift at ε = 0, smaller than every drift.

    **Returns** an `Exponent`; NaN with fewer than three points.

    **Source** our own; the average over models is that of Hoeting, Madigan, Raftery & Volinsky,
    Stat. Sci. 14 (1999) 382.
    """
    epsilons, drifts = np.asarray(epsilons, float), np.asarray(drifts, float)
    if len(epsilons) < LEAST_POINTS:
        nan, pair = np.nan, (np.nan, np.nan)
        return Exponent(nan, pair, nan, False, "", {}, nan, nan, nan, nan, len(epsilons), pair)
    x, y = np.log(epsilons), np.log(drifts)
    freedom = len(x) - 2
    fits = fits_of_laws(x, drifts, floor)
    by_law = [float(fits.weights[fits.laws == i].sum()) for i in range(len(names()))]
    probabilities = dict(zip(names(), by_law, strict=True))
    model = max(probabilities, key=lambda name: probabilities[name])
    of_model = fits.laws == list(probabilities).index(model)
    crossover = np.nan
    if model != "power":
        crossover = np.exp(np.average(fits.centres[of_model], weights=fits.weights[of_model]))
    low, middle, high = _quantiles(fits, freedom, np.array([0.025, 0.5, 0.975]))
    is_resolved = bool((high - low) / 2 <= _RESOLUTION)
    line_slope, line_stderr = line(x, y)
    slope = middle if is_resolved and model != "power" else line_slope
    low, high = min(low, slope), max(high, slope)
    interval, stderr = (float(low), float(high)), float((high - low) / 2 / student_t(freedom))
    curvature = 2 * float(np.polyfit(x - x.mean(), y, 2)[0]) if len(x) > LEAST_POINTS else np.nan
    order = float(slope), interval, stderr, is_resolved, model, probabilities, float(crossover)
    ends = float(epsilons.min()), float(epsilons.max())
    return Exponent(*order, line_slope, line_stderr, curvature, len(x), ends)


def resolving_range(fit: Exponent, epsilons: Any, drifts: Any, smallest_drift: float = 0.0):
    """The smallest and the largest ε of a sweep that should resolve the order.

    For a straight line: the same range, extended downward by a factor of 10. For a curve: from
    1/100 to 1/3 of the ε at which the slope changes. The drift, extrapolated by a power through
    the two smallest ε, must stay above `smallest_drift`.

    - `fit`: of `epsilons`, `drifts`, shape (n,).

    **Returns** (lowest, highest); NaN where `smallest_drift` leaves less than a factor of 3, or
    with fewer than three points.
    """
    if fit.points < LEAST_POINTS:
        return np.nan, np.nan
    epsilons, drifts = np.asarray(epsilons, float), np.asarray(drifts, float)
    first, second = np.argsort(epsilons)[:2]
    low, high = epsilons[first] / 10, epsilons.max()
    if fit.model != "power" and fit.crossover < high:
        low, high = fit.crossover / 100, fit.crossover / 3
    if smallest_drift > 0:
        local = np.log(drifts[second] / drifts[first]) / np.log(epsilons[second] / epsilons[first])
        reach = (smallest_drift / drifts[first]) ** (1 / max(local, 0.25))
        low = max(low, epsilons[first] * min(reach, 1.0))
    return (float(low), float(high)) if high >= 3 * low else (np.nan, np.nan)


_FLAT = 0.5  # Below this slope a run of points at the smallest ε is a plateau
_FLAT_SPAN = np.sqrt(10)  # Ratio of largest to smallest ε that such a run must have at least
_FLAT_RISE = 10  # Ratio of largest to smallest drift that such a run has at most


def plateau_level(epsilons: np.ndarray, drifts: np.ndarray) -> float:
    """The constant level of the drifts at the smallest ε; 0 if they rise from the first on."""
    order = np.argsort(epsilons)
    x, y = np.log(epsilons[order]), np.log(drifts[order])
    for count in range(len(x), LEAST_POINTS - 1, -1):
        if x[count - 1] - x[0] < np.log(_FLAT_SPAN):
            break
        rises = line(x[:count], y[:count])[0] >= _FLAT or np.ptp(y[:count]) > np.log(_FLAT_RISE)
        if not rises:
            return float(np.exp(np.median(y[:count])))
    return 0.0


def line(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Least-squares slope and its standard error; NaN for fewer than three points."""
    if len(x) < LEAST_POINTS:
        return np.nan, np.nan
    slopes, squares = lines(x, y[None])
    dx = x - x.mean()
    return float(slopes[0]), float(np.sqrt(squares[0] / (len(x) - 2) / (dx @ dx)))


def line_interval(slope: float, stderr: float, points: int) -> tuple[float, float]:
    """95 % interval of the slope of a straight line, by Student's t; NaN below three points."""
    if points < LEAST_POINTS:
        return np.nan, np.nan
    half = student_t(points - 2) * stderr
    return slope - half, slope + half


def student_t(freedom: int) -> float:
    """The t with P(|T| < t) = 95 %, for T of Student's distribution."""
    from scipy import special  # here, so that importing the package does not import SciPy

    return float(special.stdtrit(freedom, 0.975))


def _quantiles(fits: Fits, freedom: int, levels: np.ndarray) -> np.ndarray:
    """Where the weighted sum of Student's distributions has the values `levels`; by bisection."""
    from scipy import special

    reach = 15 * fits.stderrs
    low = np.full(len(levels), (fits.slopes - reach).min())
    high = np.full(len(levels), (fits.slopes + reach).max())
    for _ in range(36):
        middle = (low + high) / 2
        t = (middle[:, None] - fits.slopes) / fits.stderrs
        is_below = special.stdtr(freedom, t) @ fits.weights < levels
        low, high = np.where(is_below, middle, low), np.where(is_below, high, middle)
    return (low + high) / 2
