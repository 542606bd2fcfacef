"""Rotation matrices and momenta of rigid bodies, for systems with the constraint `orthonormal`.

The state of a body is its rotation matrix R from body axes to fixed axes with the momentum P, both
(3, 3); a free body has its position and momentum in a fourth row, (4, 3). D = diag(d) has the
second moments d_k = ∫ x_k² dm = (I1 + I2 + I3)/2 − I_k along the principal axes. A flat body has
one d_k = 0 and a rod two, for which D has no inverse: such a body is given a thickness, d_k = 1e-8
(I1 + I2 + I3), which changes its moments by as little.

**Source** Hairer, Lubich & Wanner 2006, *Geometric Numerical Integration*, VII.5; Leimkuhler &
Reich 2004, *Simulating Hamiltonian Dynamics*, 8.
"""

from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from lanewise.jaxprs.jaxapi import is_traced

from ..base.checks import array

_BODY = (3, 3), (4, 3)


def _checked(name: str, value: Any, *shapes: tuple[int, ...]) -> Array:
    hint = "For many bodies use jax.vmap."
    return array(name, jnp.asarray(value), *shapes, integers=True, hint=hint)


def orthonormal(q: Array, args: Any = None) -> Array:
    """The constraint RᵀR = 1 of the first three rows of q: its six different components."""
    return (q[:3].T @ q[:3] - jnp.eye(3, dtype=q.dtype))[np.triu_indices(3)]


def second_moments(I: Any) -> Array:  # noqa: E741
    """d_k = (I1 + I2 + I3)/2 − I_k of principal moments of inertia I, shape (3,); at least 1e-8 of
    their sum (8e-7 in float32).

    **Raises** `ValueError` for a moment that is larger than the sum of the two others, which no
    body has; if it is traced, the result is NaN.
    """
    I = _checked("I", I, (3,))  # noqa: E741
    d = jnp.sum(I) / 2 - I
    smallest = max(1e-8, 8 * float(jnp.finfo(d.dtype).eps)) * jnp.sum(I)
    is_impossible = ~(d >= -smallest)
    if not is_traced(d) and is_impossible.any():
        raise ValueError(
            "each of the principal moments I must be at most the sum of the two others, got "
            f"{np.asarray(I).tolist()}. A flat body has I3 = I1 + I2, a rod I1 = 0 and I2 = I3."
        )
    # The derivative is that of d, also for a flat body.
    d = d + lax.stop_gradient(jnp.maximum(d, smallest) - d)
    return jnp.where(is_impossible, jnp.nan, d)


def rotational_energy(P: Array, I: Any) -> Array:  # noqa: E741
    """tr(P D⁻¹ Pᵀ)/2, the energy of rotation with P = (dR/dt) D."""
    return jnp.sum(_checked("P", P, *_BODY)[:3] ** 2 / second_moments(I)[None]) / 2


def body_momentum(R: Array, P: Array) -> Array:
    """Angular momentum π on the body's axes, shape (3,): π̂ = RᵀP − PᵀR; on fixed axes it is R π."""
    turning = _checked("R", R, *_BODY)[:3].T @ _checked("P", P, *_BODY)[:3]
    return jnp.stack([turning[k - 1, k - 2] - turning[k - 2, k - 1] for k in range(3)])


def momentum(R: Array, pi: Any, I: Any) -> Array:  # noqa: E741
    """P = R Ω̂ D of a body with angular momentum π = I Ω on its axes."""
    d, I = second_moments(I), jnp.asarray(I)  # noqa: E741
    thickness = d - (jnp.sum(I) / 2 - I)  # zero unless the body is flat
    x, y, z = _checked("pi", pi, (3,)) / (I + jnp.sum(thickness) - thickness)
    spin = jnp.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return _checked("R", R, (3, 3)) @ spin * d[None]


def rotation(phi: Any, theta: Any, psi: Any) -> Array:
    """R = R_z(φ) R_x(θ) R_z(ψ) of Euler's angles [rad]."""

    phi, theta, psi = (
        _checked(f"{name} of a rotation", angle, ())
        for name, angle in (("phi", phi), ("theta", theta), ("psi", psi))
    )

    def about_z(angle):
        c, s = jnp.cos(angle), jnp.sin(angle)
        return jnp.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])

    about_x = jnp.roll(about_z(theta), (1, 1), (0, 1))
    return about_z(phi) @ about_x @ about_z(psi)


def euler_angles(R: Array) -> Array:
    """Euler's angles (φ, θ, ψ) [rad] of a rotation matrix; φ and ψ jump where θ is 0 or π."""
    R = _checked("R", R, *_BODY)
    sine = jnp.sqrt(R[2, 0] ** 2 + R[2, 1] ** 2)
    phi, psi = jnp.arctan2(R[0, 2], -R[1, 2]), jnp.arctan2(R[2, 0], R[2, 1])
    return jnp.stack([phi, jnp.arctan2(sine, R[2, 2]), psi])


def quaternion(R: Array) -> Array:
    """The unit quaternion (w, x, y, z), w ≥ 0, of rotation matrices of shape (…, 3, 3)."""
    if jnp.shape(R)[-2:] != (3, 3):
        raise ValueError(f"R must have the shape (…, 3, 3), got {jnp.shape(R)}.")
    return _quaternion(R)


@partial(jnp.vectorize, signature="(n,n)->(m)")
def _quaternion(R: Array) -> Array:
    (a, b, c), (d, e, f), (g, h, i) = R
    K = jnp.array([  # 4 u uᵀ of the quaternion u
        [1 + a + e + i, h - f, c - g, d - b],
        [h - f, 1 + a - e - i, b + d, c + g],
        [c - g, b + d, 1 - a + e - i, f + h],
        [d - b, c + g, f + h, 1 - a - e + i],
    ])  # fmt: skip
    # The row of the largest component, which is at least 1/2: no digits cancel.
    row = K[jnp.argmax(jnp.diagonal(K))]
    return jnp.where(row[0] < 0, -row, row) / jnp.linalg.norm(row)
