"""Fields on grids, by cubic splines of the package interpax."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from ...base.checks import array, in_order, one_of, positive
from ...base.printing import printable
from ...fit.checks import package


@printable
class Spline(eqx.Module):
    r"""A field on a grid, as a function of the position: A, B, E or a potential.

    It is a product of cubic splines, twice continuously differentiable.

    **Arguments**

    - `axes`: x, y and z of the grid [length], or R, φ [rad] and Z of a `cylindrical` one, in
      ascending order.
    - `values`: of shape (len(x), len(y), len(z)) or, of a vector, with a last axis (3,); its
      components are along x, y, z, or R, φ, Z.
    - `period`: of φ [rad] in a cylindrical grid, 2π over the number of field periods. The grid then
      has the angles from 0 to the period, which itself is left out.

    ``spline(q)`` is a vector along x, y, z of shape (3,), or a scalar. Outside of the grid it is
    NaN, with its derivatives, so that a run there ends with the status ``not_finite``.

    **Raises** `ImportError` without interpax, which the extra ``fields`` installs; `ValueError` for
    other shapes.

    **Accuracy** O(spacing⁴), and O(spacing³) of first derivatives. The curl of a spline of A has no
    divergence. That of a spline of B is O(spacing³): `Boris` preserves the volume in either, but
    `MagneticSplitting` is for a spline of A, and symplectic up to the quadrature over cells.

    **Source** Conlin et al., *interpax*, https://github.com/f0uriest/interpax.
    """

    arrays: Any
    settings: Any = eqx.field(static=True)
    cylindrical: bool = eqx.field(static=True)

    def __init__(
        self, axes: Sequence[Any], values: Any, *, cylindrical: bool = False, period: Any = None
    ):
        values, axes = jnp.asarray(values), [jnp.asarray(axis) for axis in axes]
        one_of("number of axes", len(axes), (3,))
        for name, axis in zip("xyz", axes, strict=True):
            in_order(f"axis {name}", axis, strictly=True)
        shape = tuple(axis.size for axis in axes)
        array("values", values, shape, (*shape, 3))
        periods = None
        if period is not None:
            periods = (None, positive("period", period), None)
        interpax = package("interpax", "fields.Spline", '"dvi-jax[fields]"')
        with jax.numpy_rank_promotion("allow"):
            interpolator = interpax.Interpolator3D(
                *axes, values, method="cubic2", extrap=False, period=periods
            )
        # Its settings are no arrays of JAX, and must not be traced.
        self.arrays, self.settings = eqx.partition(interpolator, eqx.is_array)
        self.cylindrical = cylindrical

    def __call__(self, q: Any) -> Array:
        """The field at a position of shape (3,)."""
        x, y, z = q = jnp.asarray(q)
        place = (jnp.sqrt(x * x + y * y), jnp.arctan2(y, x), z) if self.cylindrical else (x, y, z)
        with jax.numpy_rank_promotion("allow"):
            field = eqx.combine(self.arrays, self.settings)(*place)
        # The derivative of the NaN outside would be zero: a method that uses only derivatives of A
        # would continue without a field.
        field = field + jnp.where(jnp.isfinite(field), 0.0, jnp.nan) * jnp.sum(q)
        if not self.cylindrical or not field.ndim:
            return field
        R, _, _ = place
        along_R, along_phi, along_Z = field
        return jnp.stack(
            [(x * along_R - y * along_phi) / R, (y * along_R + x * along_phi) / R, along_Z]
        )
