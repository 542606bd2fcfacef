"""Fields of degrees of freedom that a map couples weakly or not, tested in the motion of these.

The residual of a field along slow degrees of freedom is small against what fast ones move by, and
no larger step can be tried for all together: see `invariants.blocks`.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ..algebra.nullspace import SeriesSpace, orthonormal_range, singular_vectors
from ..functions.sampling import Displacements, SamplePoints, spreads
from ..invariants.blocks import INSIDE, largest, relative_to, weak_groups, with_others_held
from ..invariants.expansions import Larger, larger_of_block
from .conditions import Conditions
from .search import SymmetrySearch

# (samples, h) → the conditions of order 0
ConditionsFunction = Callable[[SamplePoints, float], Conditions]


class FieldBlock(NamedTuple):
    """Some degrees of freedom, fields along them, and functions that depend on no others.

    - `search`: of all fields. `places`: numbers of the degrees of freedom. `functions`: numbers of
      the functions.
    """

    search: SymmetrySearch
    places: np.ndarray
    functions: np.ndarray

    @property
    def coordinates(self) -> np.ndarray:
        """Those of the block in (q, p)."""
        return np.concatenate([self.places, self.search.n + self.places])

    @property
    def text(self) -> str:
        return ", ".join(f"{x}{i + 1}" for i in self.places for x in "qp")

    def restrict(self, raw: Conditions) -> Conditions:
        """The conditions on its fields by its own equations."""
        rows, functions = self.coordinates, self.functions
        columns = np.append(0, 1 + rows)
        return Conditions(
            determining=raw.determining[..., rows, :, :][..., columns, :][..., functions],
            identity=raw.identity[..., columns, :, :][..., columns, :][..., functions],
            gauge=raw.gauge[..., columns, :1],  # none is sought
            clock=raw.clock[..., rows],
            later=raw.later[..., rows],
            values=raw.values[..., functions],
            slopes=raw.slopes[..., functions, :][..., columns],
            jacobian=raw.jacobian[..., rows, :, :][..., columns],
            points=raw.points[..., columns],
            good=raw.good,
        )

    def samples(self, whole: SamplePoints) -> SamplePoints:
        """States of the block alone."""
        q, p = (x.reshape(len(x), -1)[:, self.places] for x in whole[:2])
        return SamplePoints(q, p, whole.t)

    def search_alone(self, raw: Conditions, samples: SamplePoints, h: float) -> SymmetrySearch:
        bases = self.search.basis.select(self.functions), self.search.gauge_basis
        return SymmetrySearch(self.restrict(raw), samples, h, False, bases, None)

    def number_inside(self, space: SeriesSpace) -> int:
        """How many combinations of null vectors are fields of this block."""
        R = self.search.conditions.R
        own = orthonormal_range(R[:, self.functions] / np.linalg.norm(R, 2), 1e-12)
        fields = space.leading[: self.search.size].reshape(-1, len(R), space.leading.shape[1])
        components = fields[self.coordinates - 2 * self.search.n]  # without ξ0
        inside = np.einsum("fk,cfi->cki", own, components).reshape(-1, fields.shape[2])
        return int(np.sum(singular_vectors(inside)[0] > 1 - INSIDE**2))


def field_blocks(search: SymmetrySearch, raw: Conditions, samples: SamplePoints, h: float):
    """The `FieldBlock`s that weak couplings or none connect; none where all are coupled."""
    n = search.n
    steps, units = raw.displacements(samples), spreads(samples)
    # Of the equations, by the coordinates of both points.
    slopes = np.max(np.abs(raw.jacobian[:, 0, ..., 1:]), axis=2) * abs(h) * units
    by_columns = [largest(slopes[..., j], samples) for j in range(2 * n)]
    strengths = np.max(np.reshape(by_columns, (2, n, n)), axis=0).T
    np.fill_diagonal(strengths, 0.0)
    depends = np.any(raw.slopes[:, 0, :, 1:] != 0, axis=0)
    blocks = []
    for places in weak_groups(relative_to(strengths, steps)):
        block = FieldBlock(search, places, np.zeros(0, int))
        others = np.delete(depends, block.coordinates, axis=1)
        functions = np.flatnonzero(~others.any(axis=1))
        if len(others[0]) and len(functions):
            blocks.append(block._replace(functions=functions))
    return blocks


def larger_of_blocks(
    search: SymmetrySearch,
    raw: Conditions,
    samples: SamplePoints,
    h: float,
    conditions: ConditionsFunction,
) -> tuple[Larger, ...]:
    """How many fields of each block satisfy its own equations at a larger step, and in a larger
    box, with all others held."""
    larger: tuple[Larger, ...] = ()
    steps, space = raw.displacements(samples), search.spaces()[0]
    for block in field_blocks(search, raw, samples, h):
        if not (number := block.number_inside(space)):
            continue

        def held(points: SamplePoints, step: float, block=block) -> Conditions:
            return conditions(with_others_held(points, block.places, steps), step)

        def displacements(points: SamplePoints, step: float, block=block) -> Displacements:
            return block.restrict(held(points, step)).displacements(points)

        def count(points: SamplePoints, step: float, block=block) -> int | None:
            other = held(points, step)
            return block.search_alone(other, points, step).count if other.all_good else None

        points = block.samples(samples)
        larger += larger_of_block(number, points, h, displacements, count, block.text)
    return larger
