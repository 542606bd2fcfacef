"""Degrees of freedom that a map couples weakly or not: each block is searched in its own motion.

The change in a step of a function of slow degrees of freedom is small against what fast ones move
by, so that the whole search takes every expansion of their motion for conserved. Functions of
blocks that are not coupled are therefore searched alone. Where a weak coupling remains, what is
conserved is found together, and functions of one block are tested in its motion with all others
held: a function of the block that is conserved wherever the others are is conserved there too.
"""

from typing import Any, NamedTuple

import numpy as np

from ..algebra.nullspace import orthonormal_range, singular_vectors
from ..functions.sampling import Displacements, SamplePoints, spreads
from .changes import Changes
from .search import NullSpaces, null_spaces

_ROUNDING = 64 * np.finfo(float).eps  # Displacements that differ by less are the same
_WEAK = 1e-2  # A coupling by which a step changes by less than this share of itself is weak
INSIDE = 1e-4  # Functions whose slopes are below this share of their size do not depend on a block


def _columns(x: np.ndarray) -> np.ndarray:
    return x.reshape(len(x), -1)


class Block(NamedTuple):
    """Some degrees of freedom of a map with n, and the functions that depend on no others.

    - `whole`: the changes of all functions. `places`: numbers of the degrees of freedom.
    - `functions`: numbers of the functions.
    """

    whole: Changes
    places: np.ndarray
    functions: np.ndarray

    @property
    def coordinates(self) -> np.ndarray:
        """Those of the block in z = (q, p, t)."""
        n = self.whole.shifts.shape[1] // 2
        return np.concatenate([self.places, n + self.places, [2 * n]])

    @property
    def text(self) -> str:
        """Its coordinates, for a report."""
        return ", ".join(f"{x}{i + 1}" for i in self.places for x in "qp")

    @property
    def samples(self) -> SamplePoints:
        """States of the block alone."""
        q, p, t = self.whole.samples
        return SamplePoints(_columns(q)[:, self.places], _columns(p)[:, self.places], t)

    def restrict(self, whole: Changes) -> Changes:
        """The changes of its functions by its own motion."""
        z, functions = self.coordinates, self.functions
        motion = whole.motion._replace(
            changes=whole.motion.changes[:, z][..., functions],
            rounding=whole.motion.rounding[:, functions],
        )
        basis, (q, p, t) = whole.step_map.basis.select(functions), whole.samples
        return whole._replace(
            step_map=whole.step_map._replace(basis=basis),
            samples=SamplePoints(_columns(q)[:, self.places], _columns(p)[:, self.places], t),
            values=whole.values[:, functions],
            terms=whole.terms[:, :1, functions],
            volume=whole.volume[:, :1],
            motion=motion,
            slopes=whole.slopes[:, functions][..., z],
            shifts=whole.shifts[:, z],
        )

    def recompute(self, samples: SamplePoints, h: Any) -> Changes:
        """Of order 0 at other states of the block, or with another step, where all others are
        held."""
        points = with_others_held(samples, self.places, self.whole.displacements)
        return self.restrict(self.whole.recompute(points, h))

    def number_inside(self, leading: np.ndarray, conditions: Any) -> int:
        """How many combinations of orthonormal columns, shares of the orthonormal functions of the
        whole search, are functions of this block."""
        R = conditions.R / np.linalg.norm(conditions.R, 2)
        own = orthonormal_range(R[:, self.functions], 1e-12)
        cosines = singular_vectors(own.T @ leading[: len(R)])[0]
        return int(np.sum(cosines > 1 - INSIDE**2))


def with_others_held(
    samples: SamplePoints, places: np.ndarray, steps: Displacements
) -> SamplePoints:
    """States of some degrees of freedom, with all others where they move least: they may be too
    fast for a step that is larger for these."""
    n = steps.samples.q[0].size
    relative = np.abs(steps.values) / spreads(steps.samples)
    others = np.delete(relative, np.concatenate([places, n + places]), axis=1)
    calm = int(np.argmin(np.max(others, axis=1)))
    q, p = (np.repeat(_columns(x)[[calm]], len(samples.t), 0) for x in steps.samples[:2])
    q[:, places], p[:, places] = samples.q, samples.p
    shape = -1, *steps.samples.q.shape[1:]
    return SamplePoints(q.reshape(shape), p.reshape(shape), samples.t)


def blocks_of(changes: Changes) -> tuple[list[Block], list[Block]]:
    """The blocks that a map does not couple, and others that it couples weakly; none where all
    degrees of freedom are coupled, or samples lie on the manifold of a constraint."""
    if changes.step_map.is_constrained or changes.samples.q[0].size < 2:
        return [], []
    couples, strengths = _couplings(changes)
    apart, nearly_apart = groups(couples), weak_groups(strengths)
    weak = [x for x in nearly_apart if not any(np.array_equal(x, y) for y in apart)]
    return _blocks(changes, apart), _blocks(changes, weak)


def _blocks(changes: Changes, places: list[np.ndarray]) -> list[Block]:
    """The blocks that have functions, without one of all degrees of freedom."""
    depends, blocks = np.any(changes.slopes != 0, axis=0), []
    for group in places:
        block = Block(changes, group, np.zeros(0, int))
        others = np.delete(depends, block.coordinates, axis=1)
        functions = np.flatnonzero(~others.any(axis=1))
        if len(others[0]) and depends[functions].any():
            blocks.append(block._replace(functions=functions))
    return [b for b in blocks if len(b.functions) * 2 <= len(changes.good)]


def _couplings(changes: Changes) -> tuple[np.ndarray, np.ndarray]:
    """Whether the step of degree of freedom i depends on j, shape (n, n): it differs where those of
    j are exchanged between samples; and by which share of the larger of the two steps."""
    (q, p, t), n = changes.samples, changes.samples.q[0].size
    z = np.concatenate([_columns(q), _columns(p)], axis=1)
    limits = _ROUNDING * np.max(np.abs(z) + np.abs(z + changes.shifts[:, :-1]), axis=0)
    couples, strengths = np.zeros((n, n), bool), np.zeros((n, n))
    for j in range(n):
        other = z.copy()
        other[:, [j, n + j]] = np.roll(z[:, [j, n + j]], 1, axis=0)
        points = SamplePoints(other[:, :n].reshape(q.shape), other[:, n:].reshape(q.shape), t)
        moved = changes.recompute(points).shifts[:, :-1]
        # Where the step is not defined elsewhere, nothing shows that it couples nothing.
        differences = np.nan_to_num(np.abs(moved - changes.shifts[:, :-1]), nan=np.inf)
        differs = np.any(differences > limits, axis=0)
        couples[:, j] = differs[:n] | differs[n:]
        strengths[:, j] = largest(differences, changes.samples)
    return couples, relative_to(strengths, changes.displacements)


def largest(differences: np.ndarray, samples: SamplePoints) -> np.ndarray:
    """Of differences of (q, p), (S, 2n), the largest of each degree of freedom, (n,), in units of
    the spread of the samples."""
    shares = np.max(differences, axis=0) / spreads(samples)
    return np.max(shares.reshape(2, -1), axis=0)


def relative_to(strengths: np.ndarray, steps: Displacements) -> np.ndarray:
    """What degrees of freedom i change by because of j, (n, n), as a share of the larger of their
    steps."""
    own = largest(np.abs(steps.values), steps.samples)
    return strengths / np.maximum(np.maximum(own, own[:, None]), np.finfo(float).tiny)


def weak_groups(strengths: np.ndarray) -> list[np.ndarray]:
    """Degrees of freedom that only weak couplings connect with others; see `relative_to`."""
    return groups(strengths > _WEAK)


def groups(couples: np.ndarray) -> list[np.ndarray]:
    """The connected components of a graph."""
    reach = (couples | couples.T | np.eye(len(couples), dtype=bool)).astype(float)
    for _ in range(len(reach).bit_length()):
        reach = (reach @ reach > 0).astype(float)
    rows = {tuple(np.flatnonzero(row).tolist()): None for row in reach}
    return [np.array(row) for row in rows]


class BlockSearch(NamedTuple):
    """A block, and what is conserved in its functions."""

    block: Block
    null: NullSpaces

    @property
    def unclear(self) -> int:
        """How many combinations of its functions cannot be decided."""
        count = self.null.count + (self.null.constant is not None)
        return max(self.null.conditions.motion.unclear_count() - count, 0) + self.null.unclear

    def foreign_slopes(self, conditions: Any) -> np.ndarray:
        """For the orthonormal functions of the whole search: slopes along the block outside the
        span of those of its invariants, in units of the spread, as rows of shape (…, size)."""
        whole, z = self.block.whole, self.block.coordinates[:-1]
        units = spreads(whole.samples)[z]
        rows = np.einsum("sbz,bk->szk", whole.slopes[..., z], conditions.orthonormal)
        rows = rows * units[:, None] * conditions.calm[:, None, None] / np.sqrt(len(rows))
        own = self.null.changes.slopes[..., :-1] * units
        invariants = self.null.conditions.orthonormal @ self.null.spaces[0].leading
        for s, slopes in enumerate(np.einsum("sbz,bk->szk", own, invariants)):
            length = np.linalg.norm(slopes, axis=0)
            span = orthonormal_range(slopes / np.where(length > 0, length, 1), 1e-5)
            rows[s] -= span @ (span.T @ rows[s])
        return rows.reshape(-1, rows.shape[2])

    def without_false(self, leading: np.ndarray, conditions: Any) -> np.ndarray:
        """Of candidates of the whole search, columns with orthonormal leading-order terms: those
        that are no function of a quantity that this block does not conserve."""
        size = len(conditions.R)
        if self.block.number_inside(leading, conditions) <= self.null.count:
            return leading
        slopes, V = singular_vectors(self.foreign_slopes(conditions) @ leading[:size])
        return leading @ V[slopes <= INSIDE].T


def search_block(block: Block) -> BlockSearch:
    """What is conserved in the functions of a block that is not coupled."""
    return BlockSearch(block, null_spaces(block.restrict(block.whole)))
