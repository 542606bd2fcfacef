"""Paths of bodies from an ephemeris, for the forces of bodies that are not integrated."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from numpy.polynomial import chebyshev

from ..base.checks import finite, in_order, in_range, known, one_of, positive
from ..base.files import user_file
from ..base.types import Args, Scalar
from .extras import require

_TERMS = 16


class EphemerisPath(eqx.Module):
    """Path of a body, a function ``(t, args)`` → position, shape (3,): series of Chebyshev.

    - `t0`: the first time. `width`: of each interval. `coefficients`: (intervals, terms, 3).
    - `error`: largest distance from the ephemeris at other times than those of the series.

    NaN before the first time and after the last. It can be differentiated by t.
    """

    t0: Any
    width: Any
    coefficients: Any
    error: float = eqx.field(static=True)

    def __call__(self, t: Scalar, args: Args = None) -> Array:
        place = (jnp.asarray(t) - self.t0) / self.width
        count = len(self.coefficients)
        index = jnp.clip(jnp.floor(place), 0, count - 1)
        x, terms = 2 * (place - index) - 1, jnp.asarray(self.coefficients)[index.astype(int)]
        b, later = jnp.zeros_like(terms[0]), jnp.zeros_like(terms[0])
        for term in terms[:0:-1]:
            b, later = term + 2 * x * b - later, b
        return jnp.where((place < 0) | (place > count), jnp.nan, terms[0] + x * b - later)


def ephemeris_path(
    kernel: Any, target: int, centre: int, dates: Any, *, epoch: float, km: float = 1.0,
    day: float = 86400.0,
) -> EphemerisPath:  # fmt: skip
    """The path of a body relative to another, such as for `dvi.forces.ThirdBody`.

    - `kernel`: an SPK file (.bsp) of JPL, or a kernel that `jplephem` has opened. `target`,
      `centre`: numbers of bodies by NAIF, such as 10 (Sun), 301 (Moon), 399 (Earth).
    - `dates`: the first and the last Julian date (TDB). `epoch`: the date of t = 0.
    - `km`, `day`: a kilometre and a day in the units of the run; by default these are km and s.

    **Returns** an `EphemerisPath`, whose `error` is at most 1e-9 of the distance, with the files of
    JPL 1e-12.

    **Raises** `ImportError` without jplephem; `FileNotFoundError`; `ValueError` for a body or a
    date that the file does not have.

    **Example**

    ```python
    class Circle:                                # in place of an open kernel: Moon around Earth
        centre, target = 399, 301
        def compute(self, date, days):
            angle = 2 * np.pi * (date - 2460000.5 + days) / 27.32
            return 384400 * np.array([np.cos(angle), np.sin(angle), 0 * angle])

    class Kernel:
        pairs = {(399, 301): Circle()}

    moon = interop.ephemeris_path(Kernel(), 301, 399, (2460000.5, 2460030.5), epoch=2460000.5)
    force = dvi.forces.ThirdBody(moon, mu=4902.8)
    print(np.round(moon(86400.0), 1), moon.error < 1e-6)
    # [374281.9  87634.6      0. ] True
    ```
    """
    if not hasattr(kernel, "pairs"):
        file = user_file("kernel", kernel)
        with require("jplephem.spk", "interop.ephemeris_path", "ephemeris").SPK.open(file) as spk:
            return ephemeris_path(spk, target, centre, dates, epoch=epoch, km=km, day=day)
    day, km = positive("day", day), positive("km", km)
    in_order("dates", dates, strictly=True)
    first, last = known("dates", dates, float)
    parents = {body: (parent, segment) for (parent, body), segment in kernel.pairs.items()}
    chains, roots = {}, {}
    for name, body in {"target": target, "centre": centre}.items():
        one_of(name, body, {*parents, *(parent for parent, _ in parents.values())})
        chains[name] = []
        while body in parents:
            body, segment = parents[body]
            chains[name].append(segment)
        roots[name] = body
    one_of("the origin of target in the file", roots["target"], [roots["centre"]])
    common = [x for x in chains["target"] if any(x is y for y in chains["centre"])]

    def position(days: np.ndarray) -> np.ndarray:
        # Julian dates in two parts: one number has only 40 µs.
        sums = [
            sum((x.compute(first, days) for x in chain if not any(x is y for y in common)), 0.0)
            for chain in chains.values()
        ]
        return km * np.broadcast_to(sums[0] - sums[1], (3, len(days)))

    nodes, others = chebyshev.chebpts1(_TERMS), np.linspace(-0.99, 0.99, 23)
    inverse = np.linalg.inv(chebyshev.chebvander(nodes, _TERMS - 1))
    basis = chebyshev.chebvander(others, _TERMS - 1)

    def series(count: int) -> tuple[np.ndarray, float, float]:
        """The coefficients, their error, and the largest distance."""

        def sample(x: np.ndarray) -> np.ndarray:
            days = (last - first) / count * (np.arange(count)[:, None] + (x + 1) / 2)
            return np.moveaxis(position(days.ravel()).reshape(3, count, len(x)), 0, -1)

        terms, exact = inverse @ sample(nodes), sample(others)
        return terms, float(np.abs(basis @ terms - exact).max()), float(np.abs(exact).max())

    count = max(1, round((last - first) / 32))  # intervals of a month, or up to 128 in each
    terms, error, size = series(count)
    for _ in range(7):
        if error > 1e-12 * size:
            count *= 2
            terms, error, size = series(count)
    in_range("the relative error of the series", error / size, 0.0, 1e-9)
    t0 = (first - finite("epoch", epoch)) * day
    return EphemerisPath(t0, (last - first) / count * day, terms, error)
