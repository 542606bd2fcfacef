"""Measured orders in ε of a drift, as data and as reports."""

from typing import Any, NamedTuple

import numpy as np

from ...base.printing import printable
from .exponents import LEAST_POINTS, Exponent, line, line_interval, resolving_range

# A point counts when its drift is this many times the one that does not come from ε.
ABOVE_FLOOR = 10
_MEANINGS = {
    "failed": "too many of the initial conditions failed",
    "no floor": "the unperturbed run failed, so that the drift at ε = 0 is unknown",
    "round-off": "within ten times of round-off",
    "mesh": "within ten times of the drift at ε = 0",
    "flat": "within ten times of a plateau at the smallest ε",
}
_CAUSES = {"mesh": "discretisation"}
"""Cause in the data → in a report."""


def _of_fit(name: str, doc: str) -> Any:
    return property(lambda self: getattr(self.fit, name), doc=doc)


@printable
class DriftOrder(NamedTuple):
    """The measured order in ε of a drift; print it for a report.

    - `epsilons`, `drifts`: shape (E,); a drift is the largest over the initial conditions that
      count, NaN where they failed.
    - `floor`: the drift at ε = 0; `floor_cause`: "round-off", "mesh" (the unperturbed map does not
      conserve the observable), or "failed" (then it is NaN).
    - `used`: which points the fit uses, shape (E,). `excluded`: why the others are excluded:
      "failed", "no floor", "round-off", "mesh", "flat"; "" where used.
    - `slope`: the order s of drift ∝ ε^s for ε → 0 if it is `resolved`, else the slope of the
      straight line by least squares; NaN with fewer than three points. `stderr`: half of the
      95 % interval, divided by Student's t.
    - `kept`: the initial conditions that count, shape (S,). `start_drifts`, `statuses`: of every
      trajectory, shape (E + 1, S), the last row at ε = 0. A status is one of `RESULTS` by name,
      or "observable_not_finite".
    - `fit`: the comparison of models, an `Exponent`: probabilities, crossover, straight line.
    """

    epsilons: np.ndarray
    drifts: np.ndarray
    floor: float
    floor_cause: str
    used: np.ndarray
    excluded: np.ndarray
    slope: float
    stderr: float
    kept: np.ndarray
    start_drifts: np.ndarray
    statuses: np.ndarray
    fit: Exponent

    interval = _of_fit(
        "interval",
        "95 % interval of the order for ε → 0, from the scatter and from the choice of the law; if "
        "the order is not `resolved`, it also contains `slope`, that of the straight line.",
    )
    resolved = _of_fit("resolved", "Whether that interval is at most 0.6 long.")
    model = _of_fit("model", 'The most probable law: "power", "saturation", …; see `Exponent`.')
    curvature = _of_fit(
        "curvature",
        "d² log(drift) / d log(ε)² of a parabola through the points used, 0 for a power law; NaN "
        "with fewer than four points.",
    )

    @property
    def limit(self) -> float:
        """The order for ε → 0 if it is `resolved`, else NaN."""
        return self.slope if self.resolved else np.nan

    @property
    def resolving_range(self) -> tuple[float, float]:
        """The smallest and the largest ε of a sweep that would resolve the order.

        NaN if smaller ε are required and the drift at ε = 0 hides them, or with fewer than three
        points used. See `small_epsilon_exponent`.
        """
        points = self.epsilons[self.used], self.drifts[self.used]
        return resolving_range(self.fit, *points, ABOVE_FLOOR * self.floor)

    @property
    def successful(self) -> np.ndarray:
        """Whether all trajectories succeeded, for each ε, shape (E,)."""
        return (self.statuses[:-1] == "successful").all(axis=1)

    @property
    def slope_of_all(self) -> float:
        """The slope through all points, plateaus included: near 0 where ε has no effect."""
        good = self.drifts > 0
        return line(np.log(self.epsilons[good]), np.log(self.drifts[good]))[0]

    def __str__(self) -> str:
        points, num_used = len(self.epsilons), int(self.used.sum())
        if (self.excluded == "round-off").all():
            lines = ["no order: conserved to round-off at every ε"]
        elif num_used >= LEAST_POINTS:
            lines = self.fit.report(points, self.resolving_range)
        else:
            lines = [
                f"no order: {num_used} of {points} points can be used, {LEAST_POINTS} are needed "
                f"(through all of them the slope is {self.slope_of_all:.2g})"
            ]
        cause = _CAUSES.get(self.floor_cause, self.floor_cause)
        lines.append(f"  drift at ε = 0: {self.floor:.2g} ({cause})")
        for reason, meaning in _MEANINGS.items():
            where = self.epsilons[self.excluded == reason]
            if len(where):
                ends = dict.fromkeys(f"{x:.3g}" for x in (where.min(), where.max()))
                lines.append(f"  excluded: {len(where)} at ε = {' … '.join(ends)}, {meaning}")
        return "\n".join(lines + _starts_left_out(self.kept, self.statuses))


def _of_each_order(name: str, doc: str, axis: int = 0) -> Any:
    """A field of every order, stacked along an axis."""

    def stack(self):
        return np.stack([getattr(order, name) for order in self.orders], axis)

    return property(stack, doc=doc)


@printable
class DriftSurface(NamedTuple):
    """Drifts over ε and h, with their orders; print it for a table.

    - `epsilons`: shape (E,); `hs`: step sizes, shape (H,); `num_steps`: steps at each, (H,).
    - `orders`: a `DriftOrder` for each h, over the same initial conditions.
    - `mesh_used`: at which h the drift at ε = 0 is above round-off, shape (H,); `mesh_slope`,
      `mesh_stderr`: its order in h there, d log(drift) / d log(h); NaN with fewer than three.
    """

    epsilons: np.ndarray
    hs: np.ndarray
    num_steps: np.ndarray
    orders: tuple[DriftOrder, ...]
    mesh_used: np.ndarray
    mesh_slope: float
    mesh_stderr: float

    drifts = _of_each_order("drifts", "Shape (E, H); NaN where the trajectories failed.", 1)
    floors = _of_each_order("floor", "The drifts at ε = 0, shape (H,).")
    used = _of_each_order("used", "Which points the fits in ε use, shape (E, H).", 1)
    excluded = _of_each_order("excluded", 'Why not the others, shape (E, H); "" where used.', 1)
    statuses = _of_each_order(
        "statuses", "Of every trajectory, shape (E + 1, H, S), the last row at ε = 0.", 1
    )
    slopes = _of_each_order(
        "slope", "The order in ε at each h, (H,); of the straight line where it is not resolved."
    )
    intervals = _of_each_order("interval", "Their 95 % intervals, shape (H, 2).")

    @property
    def mesh_interval(self) -> tuple[float, float]:
        """95 % confidence interval of the order in h of the drift at ε = 0."""
        return line_interval(self.mesh_slope, self.mesh_stderr, int(self.mesh_used.sum()))

    def __str__(self) -> str:
        def row(name, cells):
            return f"{name:>10}" + "".join(f"{cell:>11}" for cell in cells)

        marks = np.where(self.used, " ", "*")
        lines = [row("ε \\ h", [f"{h:.3g} " for h in self.hs])]
        for epsilon, drifts, mark in zip(self.epsilons, self.drifts, marks, strict=True):
            cells = [f"{d:.2e}{m}" for d, m in zip(drifts, mark, strict=True)]
            lines.append(row(f"{epsilon:.3g}", cells))
        lines.append(row("0", [f"{floor:.2e} " for floor in self.floors]))
        unclear = [np.isfinite(o.slope) and not o.resolved for o in self.orders]
        slopes = zip(self.slopes, unclear, strict=True)
        lines.append(row("slope", [f"{slope:.3f}{'?' if u else ' '}" for slope, u in slopes]))
        lines.append(row("±", [f"{x:.3f} " for x in np.ptp(self.intervals, axis=1) / 2]))
        if any(unclear):
            lines.append("? no order resolved in this range of ε: slope of the straight line")
        for reason, meaning in _MEANINGS.items():
            count = int(np.sum(self.excluded == reason))
            if count:
                lines.append(f"* {count} excluded: {meaning}")
        count = int(self.mesh_used.sum())
        if count >= LEAST_POINTS:
            low, high = self.mesh_interval
            lines.append(
                f"drift at ε = 0 ∝ h^{self.mesh_slope:.4g}, 95 % interval {low:.4g} … {high:.4g}, "
                f"by {count} of {len(self.hs)} step sizes"
            )
        else:
            lines.append(f"drift at ε = 0: above round-off at {count} of {len(self.hs)} step sizes")
        valid = self.orders[0].kept
        return "\n".join(lines + _starts_left_out(valid, self.statuses.reshape(-1, len(valid))))


def _starts_left_out(valid: np.ndarray, statuses: np.ndarray) -> list[str]:
    """Lines about the initial conditions that do not count; `statuses`: shape (points, S)."""
    failures = np.flatnonzero(~valid)
    if not len(failures):
        return []
    causes = statuses[:, failures]
    names = ", ".join(np.unique(causes[causes != "successful"]))
    numbers = ", ".join(map(str, failures[:8])) + (", …" if len(failures) > 8 else "")
    count = f"{len(failures)} of {len(valid)} initial conditions"
    return [f"  left out: {count} ({names}): number {numbers}"]
