"""Laws of a drift over ε: a power with different corrections at larger ε, and their fits."""

import functools
import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

# Relative error of a drift that is always assumed: no law is more accurate than this.
_LEAST_SCATTER = 1e-3
_DIP = 1e-3  # Smallest factor by which a difference of two powers is reduced where they are equal


def _knee(u: np.ndarray, k: np.ndarray, p: np.ndarray) -> np.ndarray:
    """The factor (1 + e^{pu})^{k/p}, logarithm: 0 for u → −∞, k u for u → ∞."""
    return k / p * np.log1p(_exp(p * u))


def _exp(v: np.ndarray) -> np.ndarray:
    return np.exp(np.minimum(v, 300.0))


class _Law(NamedTuple):
    """A family of shapes g(u, size, sharpness), and its prior. `sizes`: (value, probability) of
    single sizes; `ranges`: (from, to, probability) of sizes with constant density; `sharpnesses`:
    (value, probability)."""

    name: str
    shape: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
    prior: float
    sizes: tuple[tuple[float, float], ...] = ()
    ranges: tuple[tuple[float, float, float], ...] = ()
    sharpnesses: tuple[tuple[float, float], ...] = ((1.0, 1.0),)
    points: int = 0  # How many it needs
    is_open: bool = True  # Whether its centre may lie above the largest ε


_LAWS = (
    _Law("power", lambda u, k, p: np.zeros_like(u), 0.43),
    _Law(
        "sum of two powers",
        lambda u, k, p: _knee(u, k, k * p),  # two powers, k apart
        0.29,
        sizes=((1, 0.35), (2, 0.2), (3, 0.1)),
        ranges=((0.4, 2, 0.23), (2, 4, 0.12)),
        sharpnesses=((1, 0.7), (2, 0.3)),
    ),
    _Law(
        "saturation",
        lambda u, k, p: -_knee(u, k, p),
        0.17,
        sizes=((1, 0.2), (2, 0.15), (3, 0.1), (4, 0.1)),
        ranges=((0.3, 1.5, 0.25), (1.5, 4, 0.2)),
        sharpnesses=((1, 0.4), (2, 0.4), (4, 0.2)),
    ),
    _Law(
        "difference of two powers",
        lambda u, k, p: np.log(np.abs(1 - _exp(k * u)) + _DIP),
        0.06,
        sizes=((1, 0.7), (2, 0.3)),
    ),
    _Law(
        "resonance",
        lambda u, k, p: k / (1 + (p * u) ** 2),
        0.05,
        ranges=((-4, -0.5, 0.4), (0.5, 2.5, 0.4), (2.5, 6, 0.2)),
        sharpnesses=((1, 0.3), (2, 0.4), (5, 0.3)),
        points=6,
        is_open=False,
    ),
)


def names() -> list[str]:
    """Names of the laws, in the order of their numbers."""
    return [law.name for law in _LAWS]


# --- the probability of each law -------------------------------------

_MARGIN = np.log(3.0)
_FAR = np.log(1e4)
# Cells of the centre x_c in three regions of ε, where ε_max is the largest one measured: up to 3
# ε_max; from there to 10⁴ ε_max, where the correction is 10⁻⁴ for k = 1; up to ε_max.
_COUNTS = np.array([40, 20, 40])
_NEAR = 0.6  # Probability that the centre is below 3 ε_max, for laws where it may be above ε_max
_LEVELS = 7
_DIVISIONS = 100  # At each level this many cells, the most probable ones, are divided by four
# A cell is left out if the logarithm of its probability is this much below the largest one.
_NEGLIGIBLE = 12.0


class _Cells(NamedTuple):
    """Cells of the parameters of the shapes, each field of shape (G,). `centres`, `sizes`: the
    middle of a cell; `widths`, `size_widths`: its lengths; `density`: of the prior."""

    laws: np.ndarray
    centres: np.ndarray
    widths: np.ndarray
    sizes: np.ndarray
    size_widths: np.ndarray
    sharpnesses: np.ndarray
    density: np.ndarray

    def take(self, index: np.ndarray) -> "_Cells":
        return _Cells(*(field[index] for field in self))

    def divide(self, by_size: bool, parts: int = 4) -> "_Cells":
        """Each cell cut along its centre or, where it has one, its range of sizes."""
        cut = np.repeat(by_size & (self.size_widths > 0), parts)
        cells = _Cells(*(np.repeat(field, parts) for field in self))
        offsets = np.tile((np.arange(parts) - (parts - 1) / 2) / parts, len(self.laws))
        return cells._replace(
            centres=cells.centres + np.where(cut, 0, offsets * cells.widths),
            sizes=cells.sizes + np.where(cut, offsets * cells.size_widths, 0),
            widths=cells.widths / np.where(cut, 1, parts),
            size_widths=cells.size_widths / np.where(cut, parts, 1),
            density=cells.density / parts,
        )


class Fits(NamedTuple):
    """The straight lines through y − g, each field of shape (G,); the weights have sum 1."""

    laws: np.ndarray
    centres: np.ndarray
    slopes: np.ndarray
    stderrs: np.ndarray
    weights: np.ndarray


def fits_of_laws(x: np.ndarray, drifts: np.ndarray, floor: float) -> Fits:
    """Straight lines for every shape that is not negligible, refined where it is probable.

    `x` = log ε and `drifts`: shape (n,); `floor`: the drift at ε = 0.
    """
    # Which part of the floor is in the drifts, with its probability.
    is_small = floor / drifts.min() < _LEAST_SCATTER
    parts = [(0.0, 1.0)] if is_small else [(0.0, 0.4), (1.0, 0.5), (-1.0, 0.1)]
    fits = [_refined_fits(x, np.log(drifts - part * floor), np.log(p)) for part, p in parts]
    cells = _Cells(*map(np.concatenate, zip(*(f[0] for f in fits), strict=True)))
    slopes, squares, logs = (np.concatenate([f[i] for f in fits]) for i in (1, 2, 3))
    weights = np.exp(logs - logs.max())
    keep = weights > 1e-4 * weights.max()
    dx = x - x.mean()
    stderrs = np.sqrt(squares / (len(x) - 2) / (dx @ dx))
    weights = weights[keep] / weights[keep].sum()
    return Fits(cells.laws[keep], cells.centres[keep], slopes[keep], stderrs[keep], weights)


def _refined_fits(x: np.ndarray, y: np.ndarray, log_prior: float):
    """Cells, slopes, sums of squares and logarithms of the probabilities of all shapes."""
    freedom, cells, out = len(x) - 2, _first_cells(x), []
    for level in range(_LEVELS):
        slopes, squares = lines(x, y - _shapes(x, cells))
        squares = squares + freedom * _LEAST_SCATTER**2
        logs = log_prior + np.log(cells.density) - freedom / 2 * np.log(squares)
        divide = np.zeros(len(logs), bool)
        if level < _LEVELS - 1:
            divide[np.argsort(-logs)[:_DIVISIONS]] = True
            divide &= cells.widths > 0
        keep = ~divide & (logs > logs.max() - _NEGLIGIBLE)
        out.append((cells.take(keep), slopes[keep], squares[keep], logs[keep]))
        if not divide.any():
            break
        cells = cells.take(divide).divide(by_size=level % 2 == 1)
    all_cells = _Cells(*map(np.concatenate, zip(*(o[0] for o in out), strict=True)))
    return all_cells, *(np.concatenate([o[i] for o in out]) for i in (1, 2, 3))


def lines(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Slopes of the lines through rows of y, shape (G, n), and the sums of squared residuals."""
    dx = x - x.mean()
    y = y - y.mean(axis=1, keepdims=True)
    slopes = y @ dx / (dx @ dx)
    residuals = y - slopes[:, None] * dx
    return slopes, np.einsum("ij,ij->i", residuals, residuals)


def _shapes(x: np.ndarray, cells: _Cells) -> np.ndarray:
    """g at each point, shape (G, n)."""
    g = np.empty((len(cells.laws), len(x)))
    for i, law in enumerate(_LAWS):
        rows = cells.laws == i
        u = x - cells.centres[rows, None]
        g[rows] = law.shape(u, cells.sizes[rows, None], cells.sharpnesses[rows, None])
    return g


def _first_cells(x: np.ndarray) -> _Cells:
    """The coarse cells; the density of each is its prior probability."""
    regions, numbers, laws, sizes, size_widths, sharpnesses, density = _table(len(x))
    low, high = x.min(), x.max()
    starts = np.array([low, high + _MARGIN, low])
    widths = (np.array([high + _MARGIN, high + _FAR, high]) - starts) / _COUNTS
    regions = regions.astype(int)
    centres = starts[regions] + (numbers + 0.5) * widths[regions]
    widths = np.where(laws > 0, widths[regions], 0.0)
    return _Cells(laws.astype(int), centres, widths, sizes, size_widths, sharpnesses, density)


@functools.cache
def _table(points: int) -> np.ndarray:
    """Region of the centre, number of its cell there, law, size, its range, sharpness, prior."""
    rows = [(0, 0, 0, 0.0, 0.0, 0.0, _LAWS[0].prior)]
    for i, law in enumerate(_LAWS[1:], 1):
        if points < law.points:
            continue
        regions = [(0, _NEAR), (1, 1 - _NEAR)] if law.is_open else [(2, 1.0)]
        sizes = [(size, 0.0, prior) for size, prior in law.sizes]
        for first, last, prior in law.ranges:
            edges = np.linspace(first, last, 5)
            sizes += [((a + b) / 2, b - a, prior / 4) for a, b in itertools.pairwise(edges)]
        cells = itertools.product(regions, sizes, law.sharpnesses)
        for (region, r), (size, range_, p), (sharpness, q) in cells:
            count = _COUNTS[region]
            shape = size, range_, sharpness, law.prior * r * p * q / count
            rows += [(region, number, i, *shape) for number in range(count)]
    return np.array(rows).T
