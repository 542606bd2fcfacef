"""The conditions on a symmetry in units in which they have no dimension."""

from dataclasses import dataclass

import numpy as np

from ..algebra.motion import FieldMotion
from ..functions.sampling import SamplePoints, rounding, spread
from .conditions import Conditions


@dataclass(frozen=True)
class Units:
    """Units in which the rows and the unknowns of the conditions have no dimension.

    - `columns`: the components of a field, with or without ξ0. `last_digit`: of the coordinates, as
      a share of how much they vary.
    - `rows`: of the discrete equations, (2n,). `components`: of ξ0, ξ and η, as `columns`.
    - `actions`: of the rows of Noether's identity, (1 + 2n,).
    """

    columns: slice
    rows: np.ndarray
    components: np.ndarray
    actions: np.ndarray
    last_digit: float

    @classmethod
    def from_samples(cls, raw: Conditions, samples: SamplePoints, h: float, time: bool) -> "Units":
        """From the spread of the samples, and the clock's effect on the equations."""
        fit, n = ~samples.held_out, samples.q[0].size
        q, p = spread(samples.q), spread(samples.p)
        rows = h / np.repeat([q, p], n)
        rate = float(np.median(np.sqrt(np.mean((raw.clock[fit, 0] * rows) ** 2, axis=1))))
        t = 1 / rate if rate > 0 else 1.0
        columns = slice(0 if time else 1, None)
        components = np.repeat([t, q, p], [1, n, n])[columns]
        actions = h / (q * p) * np.repeat([1, q, p], [1, n, n])
        return cls(columns, rows, components, actions, rounding(samples))

    def determining(self, raw: Conditions) -> tuple[FieldMotion, np.ndarray]:
        """`FieldMotion` of the user's functions, and the determining equations, (S, z + 1, rows, C,
        B). All samples count alike, also where the derivatives of F are large."""
        jacobian = raw.jacobian[:, 0][..., self.columns] * self.rows[:, None, None]
        jacobian = jacobian * self.components
        motion = _motion(raw, jacobian, self.last_digit)
        size = np.max(motion.second, axis=1)
        size = np.where(size > 0, size, 1.0)
        terms = raw.determining.sum(axis=2)[..., self.columns, :]
        terms = terms * self.rows[:, None, None] * self.components[:, None]
        return motion.divide_by(size), terms / size.reshape(-1, 1, 1, 1, 1)

    def closing(self, raw: Conditions) -> tuple[np.ndarray, np.ndarray]:
        """The terms of Noether's identity, (S, z + 1, 2, rows, C, B), and those of the gauges."""
        identity = raw.identity[..., self.columns, :] * self.actions[:, None, None]
        return identity * self.components[:, None], raw.gauge * self.actions[:, None]


def _motion(raw: Conditions, jacobian: np.ndarray, last_digit: float) -> FieldMotion:
    """Of the user's functions. `jacobian`: ∂F/∂z of both points without units, (S, 2n, 2, C)."""
    values, later = raw.values[:, 0, 0], raw.values[:, 0, 1]
    places = raw.points[:, 0]
    slopes = raw.slopes[:, 0].swapaxes(1, 2)
    changes = slopes * np.diff(places, axis=1)[:, 0, :, None]
    parts = jacobian[:, :, 0], jacobian[:, :, 1], jacobian.sum(axis=2)
    first, second, total = (np.linalg.norm(x, axis=1) for x in parts)
    # φ(z0) and φ(z1), each with the last digit of the point where it is taken
    blur = np.einsum("sdb,sd->sb", np.abs(slopes), np.sum(np.abs(places), axis=1))
    sizes = first[..., None] * np.abs(values)[:, None]
    sizes = sizes + second[..., None] * (np.abs(later) + blur)[:, None]
    predictions = second[..., None] * np.sum(np.abs(changes), axis=1)[:, None]
    predictions = predictions + total[..., None] * np.abs(values)[:, None]
    errors = np.finfo(float).eps * sizes + last_digit * predictions
    return FieldMotion(values, changes, second, total, errors)
