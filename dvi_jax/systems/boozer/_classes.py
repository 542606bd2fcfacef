"""Classes of orbits: passing, trapped, or both in turn."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...observe import Reduction
from ._bounce import centre_of
from ._field import Field
from ._motion import Angles, Regular

_SURFACES, _DEGREE = 33, 12
_ANGLES = 64


def largest_strength(field: Field) -> Float[Array, " degree"]:
    r"""Chebyshev coefficients in 2√s − 1 of B_max(s), the largest |B| on a surface [T].

    On 33 surfaces, the maximum of a parabola through the largest value on 64 × 64 angles of a
    period and its neighbours; then least squares of degree 12. The error is about 1e-6 of |B| for
    `precise_qa`, and 5e-5 for `w7x`, where the position of the maximum jumps.
    """
    N = field.shape.periods
    r = (1 - np.cos(np.pi * np.arange(_SURFACES) / (_SURFACES - 1))) / 2
    angles = 2 * np.pi * np.arange(_ANGLES) / _ANGLES
    theta, zeta = (x.ravel() for x in np.meshgrid(angles, angles / N, indexing="ij"))
    s, theta, zeta = (x.copy() for x in np.broadcast_arrays(r[:, None] ** 2, theta, zeta))
    B = field.strength(s, theta, zeta).reshape(_SURFACES, _ANGLES, _ANGLES)
    largest = jnp.stack([_parabola_maximum(values) for values in B])
    pseudo_inverse = np.linalg.pinv(np.polynomial.chebyshev.chebvander(2 * r - 1, _DEGREE))
    return jnp.asarray(pseudo_inverse) @ largest


def _parabola_maximum(B: Array) -> Array:
    """The maximum of the parabola through the largest value on a periodic grid and its eight
    neighbours; the largest value itself where that parabola has no maximum."""
    i, j = jnp.unravel_index(jnp.argmax(B), B.shape)
    patch = jnp.roll(jnp.roll(B, 1 - i, 0), 1 - j, 1)[:3, :3]
    gx, gy = (patch[2, 1] - patch[0, 1]) / 2, (patch[1, 2] - patch[1, 0]) / 2
    xx = patch[2, 1] - 2 * patch[1, 1] + patch[0, 1]
    yy = patch[1, 2] - 2 * patch[1, 1] + patch[1, 0]
    xy = (patch[2, 2] - patch[2, 0] - patch[0, 2] + patch[0, 0]) / 4
    # A direction in which |B| does not change has no curvature.
    flat = 1e-12 * jnp.abs(patch[1, 1])
    xx, yy = jnp.minimum(xx, -flat), jnp.minimum(yy, -flat)
    determinant = xx * yy - xy**2
    gain = -(yy * gx**2 - 2 * xy * gx * gy + xx * gy**2) / (2 * determinant)
    return patch[1, 1] + jnp.where((determinant > 0) & (gain > 0), gain, 0.0)


class Trapping(eqx.Module):
    """The margin 1 − μ B_max(s)/E of a state, an observable."""

    chart: Regular | Angles
    largest: Float[Array, " degree"]

    def __call__(self, t, q, p, args):
        centre = centre_of(self.chart, q, p, args, None)
        x = 2 * jnp.sqrt(centre.s) - 1
        return 1 - args["mu"] * chebyshev(self.largest, x) / centre.energy


def chebyshev(c: Any, x: Any) -> Array:
    """Σ c_k T_k(x), by Clenshaw's recursion."""
    b1 = b2 = jnp.zeros_like(x)
    for k in range(c.shape[0] - 1, 0, -1):
        b1, b2 = 2 * x * b1 - b2 + c[k], b1
    return x * b1 - b2 + c[0]


class Extremes(Reduction):
    """Smallest and largest value of an observable along a run: shape (2, …).

    Steps at which the value is NaN are left out, so that the values before a failure or a loss
    count. NaN if there is no other step.

    - `function`: an observable, see `integrate`.
    """

    function: Any

    def start(self, value):
        nan, index = jnp.full_like(value, jnp.nan), jnp.zeros(value.shape, jnp.int32)
        return nan, nan, index, index

    def update(self, memory, k, t, value):
        low, high, at_low, at_high = memory
        # A comparison with NaN is false: the first number replaces it, and NaN replaces no number.
        lower, higher = (value < low) | jnp.isnan(low), (value > high) | jnp.isnan(high)
        low, high = jnp.where(lower, value, low), jnp.where(higher, value, high)
        return low, high, jnp.where(lower, k, at_low), jnp.where(higher, k, at_high)

    def finish(self, memory):
        return jnp.stack(memory[:2])

    def combine(self, memory, k, t, value):
        low, high, *indices = memory
        low = low + self.change(value, k == indices[0])
        return low, high + self.change(value, k == indices[1]), *indices


def classify(extremes: Any) -> np.ndarray:
    """The class of each orbit, from the smallest and largest margin along it.

    "passing" if the margin 1 − μ B_max/E is positive along all of the orbit (it never bounces),
    "trapped" if it is negative along all of it, "transitional" if it has both signs, "unknown"
    without a value. A margin is computed with the largest |B| on the surface: an orbit with a
    small negative margin may need many toroidal turns to a bounce point.

    - `extremes`: of ``boozer.Extremes(centres.trapping)``, shape (…, 2), with the orbits first.

    **Returns** an array of text, shape (…). **Raises** `ValueError` for another shape.

    **Example**

    ```python
    field = boozer.precise_qa()
    alphas = boozer.GuidingCentres(field)
    q, p, args = alphas.start(s=0.3, theta=0.0, zeta=0.0, pitch=np.array([0.1, 0.9]))
    run = lambda q, p, mu: dvi.integrate(
        alphas.system, q, p, args=alphas.args(mu), h=alphas.h, num_steps=300,
        method=dvi.GaussLegendre(2), stop=alphas.loss, save=dvi.Save(final=True),
        observe=boozer.Extremes(alphas.trapping)).observed
    print(boozer.classify(jax.vmap(run)(q, p, args["mu"])))
    # ['trapped' 'passing']
    ```
    """
    margins = np.asarray(extremes, float)
    if margins.ndim == 0 or margins.shape[-1] != 2:
        raise ValueError(
            "extremes must be those of boozer.Extremes(centres.trapping), of shape (…, 2), got "
            f"shape {margins.shape}."
        )
    low, high = margins[..., 0], margins[..., 1]
    labels = np.full(low.shape, "transitional")
    labels[low > 0] = "passing"
    labels[high < 0] = "trapped"
    labels[np.isnan(low)] = "unknown"
    return labels
