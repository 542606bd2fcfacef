"""Plain loops in NumPy and mpmath, with slopes by hand, that the random runs are compared with."""

from typing import Any

import mpmath
import numpy as np
from scipy.optimize import brentq


class Precise:
    """Elementary functions of arrays of mpmath numbers, in place of those of NumPy."""

    sin, cos, sqrt, exp = (np.vectorize(getattr(mpmath, name), otypes=[object])
                           for name in ("sin", "cos", "sqrt", "exp"))  # fmt: skip
    sum = staticmethod(np.sum)


POTENTIALS = {
    "quartic": (
        lambda xp, q, k: xp.sum(k[0] * q**2 / 2 + k[1] * q**4 / 4),
        lambda xp, q, k: k[0] * q + k[1] * q**3,
    ),
    "pendulum": (
        lambda xp, q, k: -xp.sum(k[0] * xp.cos(k[1] * q)),
        lambda xp, q, k: k[0] * k[1] * xp.sin(k[1] * q),
    ),
    "soft": (
        lambda xp, q, k: -k[0] / xp.sqrt(q @ q + k[1] ** 2),
        lambda xp, q, k: k[0] * q / xp.sqrt(q @ q + k[1] ** 2) ** 3,
    ),
    "well": (
        lambda xp, q, k: k[0] * q @ q / 2 - k[1] * xp.exp(-q @ q),
        lambda xp, q, k: k[0] * q + 2 * k[1] * q * xp.exp(-q @ q),
    ),
}
"""Name → V(xp, q, k) and ∂V/∂q; `xp` has the elementary functions."""

JUMP = 1 / (2 - 2 ** (1 / 3))
FIFTH = 1 / (4 - 4 ** (1 / 3))


def strang(*lengths: float) -> list[tuple[str, float]]:
    """Kicks and drifts of Strang's step over each of these parts of a step."""
    return [x for c in lengths for x in (("kick", c / 2), ("drift", c), ("kick", c / 2))]


SEQUENCES = {
    "TypeII()": [("kick", 1.0), ("drift", 1.0)],
    "Adjoint(dvi.TypeII())": [("drift", 1.0), ("kick", 1.0)],
    "Strang()": strang(1.0),
    "Yoshida(4)": strang(JUMP, 1 - 2 * JUMP, JUMP),
    "Suzuki(4)": strang(FIFTH, FIFTH, 1 - 4 * FIFTH, FIFTH, FIFTH),
}
"""Method → the kicks and drifts of its step for a separable Hamiltonian."""


def step(sequence, slope, h, q, p, m):
    for kind, c in sequence:
        if kind == "kick":
            p = p - c * h * slope(q)
        else:
            q = q + c * h * p / m
    return q, p


def palindrome(flows: list, lengths: list[float], h: Any, q: Any, p: Any):
    """A(h/2) B(h/2) C(h) B(h/2) A(h/2) over each of these parts of a step."""
    for c in lengths:
        for flow in flows[:-1]:
            q, p = flow(c * h / 2, q, p)
        q, p = flows[-1](c * h, q, p)
        for flow in flows[-2::-1]:
            q, p = flow(c * h / 2, q, p)
    return q, p


def trajectory(advance, t0, h, q, p, num_steps: int) -> list[tuple]:
    """(t, q, p) of all steps of ``advance(h, q, p)``."""
    states = [(t0, q, p)]
    for k in range(num_steps):
        q, p = advance(h, q, p)
        states.append((t0 + (k + 1) * h, q, p))
    return states


def until(g, advance, t0, h, q, p, num_steps: int):
    """The states before g ≥ 0 at the end of a step, and the point with g = 0 in that step."""
    states = [(t0, q, p)]
    if g(t0, q, p) >= 0:
        return states, states[0]
    for k in range(num_steps):
        t = t0 + k * h

        def point(part, t=t, q=q, p=p):
            return t + part * h, *advance(part * h, q, p)

        if g(*point(1.0)) >= 0:
            return states, point(brentq(lambda part: g(*point(part)), 0, 1, xtol=1e-15))
        states.append(point(1.0))
        _, q, p = states[-1]
    return states, None


def between(advance, states, h, times) -> tuple:
    """States at requested times: a substep from the step before; NaN after the last state."""
    qs, ps = [], []
    for time in times:
        k = int(np.clip(np.floor((time - states[0][0]) / h), 0, len(states) - 1))
        t, q, p = states[k]
        is_after = k == len(states) - 1 and (time - t) / h > 1e-12
        q, p = (q * np.nan, p * np.nan) if is_after else advance(time - t, q, p)
        qs.append(q)
        ps.append(p)
    return np.array(qs), np.array(ps)


# --- noise ----------------------------------------------------------------------------------------


def noisy_step(method: str, slope, h, q, p, z, s):
    """A step with the normal numbers z, one row for each increment."""
    m, gamma, T = s["m"], s["friction"], s["temperature"]

    def relax(h, p, z):
        return np.exp(-gamma * h) * p + np.sqrt(T * m * (1 - np.exp(-2 * gamma * h))) * z

    if method == "BAOAB":
        p = p - h / 2 * slope(q)
        q = q + h / 2 * p / m
        p = relax(h, p, z[0])
        q = q + h / 2 * p / m
        return q, p - h / 2 * slope(q)
    if method == "OBABO":
        q, p = step(strang(1.0), slope, h, q, relax(h / 2, p, z[0]), m)
        return q, relax(h / 2, p, z[1])
    kick = np.sqrt(2 * gamma * T * m * h) * z[0]
    if method == "StochasticEuler":
        p = (p - h * slope(q) + kick) / (1 + h * gamma)
        return q + h * p / m, p
    q1, p1 = q, p
    for _ in range(200):  # the midpoint rule
        middle_q, middle_p = (q + q1) / 2, (p + p1) / 2
        q1, p1 = q + h * middle_p / m, p - h * slope(middle_q) - h * gamma * middle_p + kick
    return q1, p1


# --- constraints ----------------------------------------------------------------------------------


def rattle(g, G, slope, h, q, p, m):
    """The RATTLE step of Andersen for equal masses m; `G` is ∂g/∂q."""
    G0 = G(q)
    half = p - h / 2 * slope(q)
    multipliers = np.zeros(len(G0))
    for _ in range(50):
        q1 = q + h / m * (half - G0.T @ multipliers)
        multipliers = multipliers + np.linalg.solve(h / m * G(q1) @ G0.T, g(q1))
    half = half - G0.T @ multipliers
    q1 = q + h / m * half
    p1, G1 = half - h / 2 * slope(q1), G(q1)
    return q1, p1 - G1.T @ np.linalg.solve(G1 @ G1.T, G1 @ p1)


# --- rings ----------------------------------------------------------------------------------------


def drift(z, length):
    x, px, y, py, zeta, delta = z
    late = length * (px**2 + py**2) / (2 * (1 + delta) ** 2)
    scale = length / (1 + delta)
    return np.array([x + scale * px, px, y + scale * py, py, zeta - late, delta])


def kick(z, length, b, a=(), h=0.0):
    """The kick of Σ (b_n + i a_n)(x + iy)^n, in a bend of curvature h."""
    x, px, y, py, zeta, delta = z
    pairs = zip(b, a or np.zeros(len(b)), strict=True)
    field = sum((b_n + 1j * a_n) * (x + 1j * y) ** n for n, (b_n, a_n) in enumerate(pairs))
    px = px - length * np.real(field) + length * h * (delta - h * x)
    return np.array([x, px, y, py + length * np.imag(field), zeta - length * h * x, delta])


def magnet(z, length, b, slices, h=0.0):
    """Forest and Ruth's composition in each slice."""
    for _ in range(slices):
        for c in (JUMP, 1 - 2 * JUMP, JUMP):
            part = c * length / slices
            z = drift(kick(drift(z, part / 2), part, b, h=h), part / 2)
    return z


def edge(z, h, angle):
    x, px, y, py, zeta, delta = z
    slope = h * np.tan(angle)
    return np.array([x, px + slope * x, y, py - slope * y, zeta, delta])


def cavity(z, voltage, wave_number):
    change = np.array([0, 0, 0, 0, 0, voltage * np.sin(wave_number * z[4])])
    return z + change
