"""Rotation matrices and momenta of rigid bodies, for systems with the constraint `orthonormal`.

The state of a body is its rotation matrix R from body axes to fixed axes with the momentum P, both
(3, 3); a free body has its position and momentum in a fourth row, (4, 3). D = diag(d) has the
second moments d_k = ∫ x_k² dm = (I1 + I2 + I3)/2 − I_k along the principal axes.

**Source** Hairer, Lubich & Wanner 2006, *Geometric Numerical Integration*, VII.5; Leimkuhler &
Reich 2004, *Simulating Hamiltonian Dynamics*, 8.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array


def orthonormal(q: Array, args: Any = None) -> Array:
    """The constraint RᵀR = 1 of the first three rows of q: its six different components."""
    R = q[:3]
    excess = R.T @ R - jnp.eye(3, dtype=q.dtype)
    return excess[np.triu_indices(3)]


def second_moments(I: Any) -> Array:  # noqa: E741
    """d_k = (I1 + I2 + I3)/2 − I_k of principal moments of inertia I, shape (3,)."""
    return jnp.sum(jnp.asarray(I)) / 2 - jnp.asarray(I)


def rotational_energy(P: Array, I: Any) -> Array:  # noqa: E741
    """tr(P D⁻¹ Pᵀ)/2, the energy of rotation with P = (dR/dt) D."""
    return jnp.sum(P[:3] ** 2 / second_moments(I)[None]) / 2


def body_momentum(R: Array, P: Array) -> Array:
    """Angular momentum π on the body's axes, shape (3,): π̂ = RᵀP − PᵀR; on fixed axes it is R π."""
    turning = R[:3].T @ P[:3]
    return jnp.stack([turning[k - 1, k - 2] - turning[k - 2, k - 1] for k in range(3)])


def momentum(R: Array, pi: Any, I: Any) -> Array:  # noqa: E741
    """P = R Ω̂ D of a body with angular momentum π = I Ω on its axes."""
    x, y, z = jnp.asarray(pi) / jnp.asarray(I)
    spin = jnp.stack([0 * x, -z, y, z, 0 * x, -x, -y, x, 0 * x]).reshape(3, 3)
    return R @ spin * second_moments(I)[None]


def rotation(phi: Any, theta: Any, psi: Any) -> Array:
    """R = R_z(φ) R_x(θ) R_z(ψ) of Euler's angles [rad]."""

    def about_z(angle):
        c, s = jnp.cos(angle), jnp.sin(angle)
        zero, one = jnp.zeros_like(c), jnp.ones_like(c)
        return jnp.stack([c, -s, zero, s, c, zero, zero, zero, one]).reshape(3, 3)

    about_x = jnp.roll(about_z(theta), (1, 1), (0, 1))
    return about_z(phi) @ about_x @ about_z(psi)


def euler_angles(R: Array) -> Array:
    """Euler's angles (φ, θ, ψ) [rad] of a rotation matrix; φ and ψ jump where θ is 0 or π."""
    across = jnp.sqrt(R[2, 0] ** 2 + R[2, 1] ** 2)
    phi, psi = jnp.arctan2(R[0, 2], -R[1, 2]), jnp.arctan2(R[2, 0], R[2, 1])
    return jnp.stack([phi, jnp.arctan2(across, R[2, 2]), psi])


def quaternion(R: Array) -> Array:
    """The unit quaternion (w, x, y, z), w ≥ 0, of rotation matrices of shape (…, 3, 3)."""
    R = jnp.moveaxis(jnp.asarray(R), (-2, -1), (0, 1))
    K: list[list[Any]] = [[None] * 4 for _ in range(4)]  # 4 a aᵀ of the quaternion a
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        K[0][i + 1] = K[i + 1][0] = R[k, j] - R[j, k]
        K[j + 1][k + 1] = K[k + 1][j + 1] = R[j, k] + R[k, j]
        K[i + 1][i + 1] = 1 + R[i, i] - R[j, j] - R[k, k]
    K[0][0] = 1 + R[0, 0] + R[1, 1] + R[2, 2]
    rows = jnp.stack([jnp.stack(row, -1) for row in K], -2)
    # The row of the largest component, which is at least 1/2: no digits cancel.
    largest = jnp.argmax(jnp.diagonal(rows, axis1=-2, axis2=-1), axis=-1)
    row = jnp.take_along_axis(rows, largest[..., None, None], axis=-2)[..., 0, :]
    a = row / jnp.linalg.norm(row, axis=-1, keepdims=True)
    return jnp.where(a[..., :1] < 0, -a, a)
