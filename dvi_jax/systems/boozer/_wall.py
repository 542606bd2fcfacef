"""First walls: where paths meet a surface of triangles, at which angle, and the heat on it."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ...base.checks import all_finite, array, instance, known, positive, whole
from ...base.files import user_file
from ...base.printing import printable
from ._files import Geometry
from ._vmec import package

_BATCH = 64
"""Segments that are compared with all triangles at once."""

_MARGIN = 1e-9
"""Of barycentric coordinates, so that no segment passes between two neighbours."""


@printable
class Hits(NamedTuple):
    """The first point of each path on a wall, shape (…): `point` (…, 3) [m]; NaN without a hit.

    `step` and `fraction`: it lies on the segment from position `step` to the next one. `triangle`
    is the index of the triangle; both are −1 without a hit. `angle` [rad] is that between the
    segment and the normal: 0 for perpendicular incidence, π/2 for grazing. `error` [m] is an
    estimate of the distance of the path from its segment: a path that turns uniformly is not
    farther away.
    """

    point: np.ndarray
    triangle: np.ndarray
    angle: np.ndarray
    step: np.ndarray
    fraction: np.ndarray
    error: np.ndarray


@printable
class Wall(eqx.Module):
    r"""A first wall of triangles.

    **Arguments** `triangles`: their corners [m], Cartesian, shape (n, 3, 3).

    **Raises** `ValueError` for another shape, or corners that are not finite.

    **Accuracy** of a hit: that of the segments, see `Hits`; the points on them have round-off.
    """

    triangles: Float[Array, "n 3 3"]

    def __init__(self, triangles: Any):
        corners = array("triangles", known("triangles", triangles, float), ("n", 3, 3))
        all_finite("triangles", corners)
        self.triangles = jnp.asarray(corners)

    @property
    def areas(self) -> np.ndarray:
        """The area of each triangle [m²]."""
        a, b, c = np.moveaxis(np.asarray(self.triangles), 1, 0)
        return np.linalg.norm(np.cross(b - a, c - a), axis=-1) / 2

    def hits(self, paths: Any) -> Hits:
        """The first `Hits` of paths through positions [m], shape (…, positions, 3).

        Positions are connected by straight segments, each of which is compared with all triangles;
        those from the first NaN on are left out, as after the stop of a run.
        """
        paths = known("paths", paths, float)
        array("paths", paths, (*paths.shape[:-2], "positions", 3))
        flat = paths.reshape(-1, *paths.shape[-2:])
        is_before = np.cumprod(np.isfinite(flat).all(-1), axis=1) > 0
        flat = np.where(is_before[..., None], flat, np.nan)
        count, last = len(flat), max(flat.shape[1] - 1, 1)
        starts, ends = (x.reshape(-1, 3) for x in (flat[:, :-1], flat[:, 1:]))
        fractions, indices = np.full(len(starts), np.nan), np.zeros(len(starts), int)
        # Most paths of a batch have ended: in sizes of powers of two, for few compilations.
        if (finite := np.flatnonzero(np.isfinite(ends).all(-1))).size:
            rows = np.resize(finite, 1 << (finite.size - 1).bit_length())
            fractions[rows], indices[rows] = _first(self.triangles, starts[rows], ends[rows])
        fractions = fractions.reshape(count, last)
        step = np.argmax(np.isfinite(fractions), axis=1)
        rows = np.arange(count)
        fraction, triangle = fractions[rows, step], indices.reshape(count, last)[rows, step]
        begin = flat[rows, step]
        segment = flat[rows, step + 1] - begin
        a, b, c = np.moveaxis(np.asarray(self.triangles)[triangle], 1, 0)
        normal = np.cross(b - a, c - a)
        sizes = np.linalg.norm(normal, axis=-1) * np.linalg.norm(segment, axis=-1)
        is_hit = np.isfinite(fraction)
        with np.errstate(divide="ignore", invalid="ignore"):
            cosine = np.abs(np.sum(normal * segment, axis=-1)) / sizes
        angle = np.where(is_hit, np.arccos(np.minimum(cosine, 1.0)), np.nan)
        # The sagitta of an arc over one segment is an eighth of the second difference.
        middle = np.clip(step[:, None] + np.arange(-1, 2), 0, flat.shape[1] - 1)
        bend = np.diff(flat[rows[:, None], middle], 2, axis=1)[:, 0]
        error = np.where(is_hit, np.linalg.norm(bend, axis=-1) / 8, np.nan)
        point = begin + np.where(is_hit, fraction, np.nan)[:, None] * segment
        shape = paths.shape[:-2]
        step, triangle = np.where(is_hit, step, -1), np.where(is_hit, triangle, -1)
        values = (x.reshape(shape) for x in (triangle, angle, step, fraction, error))
        return Hits(point.reshape(*shape, 3), *values)

    def heat_load(self, hits: Hits, power: Any) -> np.ndarray:
        """The power per area on each triangle [W/m²], shape (n,).

        - `power`: of the particles of each path [W], a number or an array like ``hits.step``: the
          number of particles per second that it stands for times their energy at the hit.
        """
        power = np.broadcast_to(known("power", power, float), hits.triangle.shape)
        is_hit = hits.triangle >= 0
        areas = self.areas
        total = np.bincount(hits.triangle[is_hit], power[is_hit], minlength=len(areas))
        return total / areas


def wall_of_surface(geometry: Geometry, s: float, shape: tuple[int, int] = (64, 64)) -> Wall:
    """A `Wall` at s = const, which may lie beyond the plasma: s > 1 continues the polynomials.

    - `shape`: numbers of points in θ and along the whole torus; each cell is two triangles.

    **Accuracy** the distance to the surface is about (size of a cell)²/(8 radius of curvature).
    """
    instance("geometry", geometry, Geometry, "a Geometry", "such as boozer.read_geometry(path)")
    s = positive("s", s)
    n, k = (whole(f"entry {i} of shape", x, 3) for i, x in enumerate(shape))
    angles = [2 * np.pi * np.arange(count + 1) / count for count in (n, k)]
    theta, zeta = (x.copy() for x in np.meshgrid(*angles, indexing="ij"))
    x = np.asarray(geometry.cartesian(np.full(theta.shape, s), theta, zeta))
    a, b, c, d = x[:-1, :-1], x[1:, :-1], x[1:, 1:], x[:-1, 1:]
    cells = np.stack([np.stack([a, b, c], -2), np.stack([a, c, d], -2)], -3)
    return Wall(cells.reshape(-1, 3, 3))


def read_wall(path: Any, scale: float = 1.0) -> Wall:
    """A `Wall` from a file that the package ``trimesh`` reads, such as STL, PLY or OBJ.

    - `scale`: metres per unit of the file, 1e-3 for millimetres.

    **Raises** `ImportError` without trimesh.
    """
    path = user_file("path", path)
    mesh = package("trimesh", "boozer.read_wall").load_mesh(str(path))
    return Wall(positive("scale", scale) * np.asarray(mesh.triangles, float))


@jax.jit
def _first(triangles: Array, starts: Array, ends: Array) -> tuple[Array, Array]:
    """The smallest fraction of each segment on a triangle (NaN: none), and the triangle."""
    a = triangles[:, 0]
    edges = triangles[:, 1] - a, triangles[:, 2] - a
    normal = jnp.cross(*edges)

    def first_of(ends):
        # Möller & Trumbore 1997, J. Graph. Tools 2, 21.
        start, end = ends
        direction = jnp.broadcast_to(end - start, a.shape)
        determinant = -jnp.sum(normal * direction, -1)
        offset = start[None] - a
        moment = jnp.cross(offset, direction)
        u, v = jnp.sum(edges[1] * moment, -1), -jnp.sum(edges[0] * moment, -1)
        t = jnp.sum(normal * offset, -1)
        u, v, t = (x / determinant for x in (u, v, t))
        is_inside = (jnp.minimum(u, v) >= -_MARGIN) & (u + v <= 1 + _MARGIN)
        t = jnp.where(is_inside & (t >= 0) & (t <= 1), t, jnp.inf)
        first = jnp.argmin(t)
        return jnp.where(t[first] < jnp.inf, t[first], jnp.nan), first

    return lax.map(first_of, (starts, ends), batch_size=_BATCH)
