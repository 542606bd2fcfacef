"""Degrees of freedom that a map does not couple: each block is searched alone, in its own motion.

The change in a step of a function of slow degrees of freedom is small against what fast ones move
by, so that the whole search takes every expansion of their motion for conserved.
"""

from typing import Any, NamedTuple

import numpy as np

from ..algebra.nullspace import orthonormal_range, singular_vectors
from ..functions.sampling import SamplePoints, spreads
from .changes import Changes
from .search import NullSpaces, null_spaces

_ROUNDING = 64 * np.finfo(float).eps  # Displacements that differ by less are the same
_INSIDE = 1e-4  # Functions whose slopes are below this share of their size do not depend on a block


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
        """Of order 0 at other states of the block, or with another step. All others are where they
        move least: they may be too fast for a step that is larger for this block."""
        whole, calm = self.whole, self._calmest()
        q, p = (np.repeat(_columns(x)[[calm]], len(samples.t), 0) for x in whole.samples[:2])
        q[:, self.places], p[:, self.places] = samples.q, samples.p
        shape = -1, *whole.samples.q.shape[1:]
        points = SamplePoints(q.reshape(shape), p.reshape(shape), samples.t)
        return self.restrict(whole.recompute(points, h))

    def _calmest(self) -> int:
        """The sample at which the other degrees of freedom move least."""
        relative = np.abs(self.whole.shifts[:, :-1]) / spreads(self.whole.samples)
        return int(np.argmin(np.max(np.delete(relative, self.coordinates[:-1], axis=1), axis=1)))


def blocks_of(changes: Changes) -> list[Block]:
    """The blocks that a map does not couple; none where it couples all degrees of freedom, or
    samples lie on the manifold of a constraint."""
    if changes.step_map.is_constrained or changes.samples.q[0].size < 2:
        return []
    groups, depends = _groups(_couplings(changes)), np.any(changes.slopes != 0, axis=0)
    if len(groups) == 1:
        return []
    blocks = []
    for group in groups:
        block = Block(changes, group, np.zeros(0, int))
        others = np.delete(depends, block.coordinates, axis=1)
        functions = np.flatnonzero(~others.any(axis=1))
        if depends[functions].any():
            blocks.append(block._replace(functions=functions))
    return blocks


def _couplings(changes: Changes) -> np.ndarray:
    """Whether the step of degree of freedom i depends on j, shape (n, n): it differs where those of
    j are exchanged between samples."""
    (q, p, t), n = changes.samples, changes.samples.q[0].size
    z = np.concatenate([_columns(q), _columns(p)], axis=1)
    limits = _ROUNDING * np.max(np.abs(z) + np.abs(z + changes.shifts[:, :-1]), axis=0)
    couples = np.zeros((n, n), bool)
    for j in range(n):
        other = z.copy()
        other[:, [j, n + j]] = np.roll(z[:, [j, n + j]], 1, axis=0)
        points = SamplePoints(other[:, :n].reshape(q.shape), other[:, n:].reshape(q.shape), t)
        moved = changes.recompute(points).shifts[:, :-1]
        # Where the step is not defined elsewhere, nothing shows that it couples nothing.
        differs = np.any(~(np.abs(moved - changes.shifts[:, :-1]) <= limits), axis=0)
        couples[:, j] = differs[:n] | differs[n:]
    return couples | np.eye(n, dtype=bool)


def _groups(couples: np.ndarray) -> list[np.ndarray]:
    """The connected components of a graph."""
    reach = (couples | couples.T).astype(float)
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
        R = conditions.R / np.linalg.norm(conditions.R, 2)
        own = orthonormal_range(R[:, self.block.functions], 1e-12)
        cosines = singular_vectors(own.T @ leading[:size])[0]
        if np.sum(cosines > 1 - _INSIDE**2) <= self.null.count:
            return leading
        slopes, V = singular_vectors(self.foreign_slopes(conditions) @ leading[:size])
        return leading @ V[slopes <= _INSIDE].T


def search_blocks(changes: Changes) -> list[BlockSearch]:
    """What is conserved in the functions of each block alone."""
    blocks = [b for b in blocks_of(changes) if len(b.functions) * 2 <= len(changes.good)]
    return [BlockSearch(block, null_spaces(block.restrict(changes))) for block in blocks]
