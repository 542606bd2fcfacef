"""Runs of one trajectory with many coordinates as loops in numba, as users write them."""

import numba
import numpy as np


@numba.njit(fastmath=True)
def fput(q, p, steps, h, alpha, beta):
    n = q.size
    for _ in range(steps):
        for i in range(n):
            left = q[i] - (q[i - 1] if i > 0 else 0.0)
            right = (q[i + 1] if i < n - 1 else 0.0) - q[i]
            force = right - left + alpha * (right**2 - left**2) + beta * (right**3 - left**3)
            p[i] += h * force
        for i in range(n):
            q[i] += h * p[i]


@numba.njit(fastmath=True)
def phi4_2d(q, p, steps, h, c):
    n = q.shape[0]
    for _ in range(steps):
        for i in range(n):
            for j in range(n):
                x = q[i, j]
                neighbours = q[i - 1, j] + q[(i + 1) % n, j] + q[i, j - 1] + q[i, (j + 1) % n]
                p[i, j] += h * (neighbours - 5 * x - c * x**3)
        q += h * p


@numba.njit(fastmath=True)
def n_body(q, p, steps, h, softening, m):
    n = q.shape[0]
    a = np.zeros((n, 3))
    for _ in range(steps):
        for i in range(n):
            ax = ay = az = 0.0
            for j in range(n):
                dx, dy, dz = q[j, 0] - q[i, 0], q[j, 1] - q[i, 1], q[j, 2] - q[i, 2]
                r2 = dx * dx + dy * dy + dz * dz + softening
                w = 1 / (r2 * np.sqrt(r2))
                ax += w * dx
                ay += w * dy
                az += w * dz
            a[i, 0], a[i, 1], a[i, 2] = ax, ay, az
        p += h * m * m * a
        q += h * p / m


LOOPS = {"fput": fput, "phi4_2d": phi4_2d, "n_body": n_body}
