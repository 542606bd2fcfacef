"""The lines of one signal: maxima of its windowed transform, and least squares of all of them."""

import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from .results import CODE

EPS = float(np.finfo(np.float64).eps)

# Newton steps to the maximum of an amplitude; Gauss–Newton steps after each line, and rounds of
# them after the last. Both converge quadratically below some hundredths of the resolution.
_ASCENT, _FIT_STEPS, _FINAL_ROUNDS = 4, 3, 4
_FLOOR = 256 * EPS  # A line below this fraction of the largest value of the signal is round-off
_ECHO = 1e-9  # A line weaker by this factor than another within the resolution is its round-off
_RIDGE = 1e-13  # Added to a diagonal of ones: lines that coincide do not give a negative pivot
_GROUP = 6.0  # Lines within so many resolutions may be the width of one that decays
_EXPLAINED = 0.3  # Share of what a constant amplitude leaves that a decaying one may leave
_SEVERAL, _AS_GOOD = 5, 30.0  # Than so many lines it may be so many times worse
_CONVERGENCE = 1e-2  # Last correction to a converged frequency, over the resolution, at most


class LineSettings(NamedTuple):
    """The static arguments of an analysis."""

    lines: int
    window: int
    refine: bool


class SpectralLines(NamedTuple):
    """The lines of one signal in the variable s = ω T/2, amplitudes at the centre."""

    s: Array
    amplitudes: Array
    sure: Array
    constant: Array
    residual: Array
    code: Array


class _Grid(NamedTuple):
    """The samples in blocks, so that e^{isy} = e^{is·rows} e^{is·columns} takes 2√N exponentials.

    y = `rows` + `columns` goes from −1 to 1 over the window; `weights` are χ/N, 0 beyond the end.
    """

    rows: np.ndarray
    columns: np.ndarray
    weights: np.ndarray
    window: int
    N: int


def _grid(N: int, window: int) -> _Grid:
    B = 1 << (max(N - 1, 1).bit_length() + 1) // 2
    A = -(-N // B)
    y = (2 * np.arange(N) + 1 - N) / N
    k = np.arange(-window, window + 1)
    weights = np.cos(np.pi * np.outer(y, k)) @ _hann(window)
    blocks = np.concatenate([weights / N, np.zeros(A * B - N)]).reshape(A, B)
    rows = (2 * B * np.arange(A) + B - N) / N
    columns = (2 * np.arange(B) + 1 - B) / N
    return _Grid(rows, columns, blocks, window, N)


def _hann(window: int) -> np.ndarray:
    """Fourier coefficients of (1 + cos πu)^window over their mean, from −window to window."""
    binomials = np.array([math.comb(2 * window, k) for k in range(2 * window + 1)], float)
    return binomials / binomials[window]


def _moments(grid: _Grid, samples: Array, s: Array) -> Array:
    """Σ χ z y^m e^{−isy} / N for m = 0, 1, 2: s (K,) to (3, K); `samples` are χz/N."""
    a, b = grid.rows, grid.columns
    inner = jnp.exp(-1j * b[:, None] * s[None, :])
    powers = jnp.concatenate([inner, b[:, None] * inner, b[:, None] ** 2 * inner], axis=1)
    sums = (samples @ powers).reshape(a.shape[0], 3, s.shape[0])
    outer = jnp.exp(-1j * a[:, None] * s[None, :])[:, None, :]
    x = a[:, None]
    m0, m1, m2 = (sums * outer).transpose(1, 0, 2)
    moments = (m0, x * m0 + m1, x**2 * m0 + 2 * x * m1 + m2)
    return jnp.stack([jnp.sum(m, axis=0) for m in moments])


def _kernel(grid: _Grid, d: Array) -> tuple[Array, Array, Array]:
    r"""The window's transform W(d) = Σ χ e^{idy} / N with its first and second derivatives.

    W(d) = Σ_k a_k D(d + kπ), D(x) = sin x / (N sin(x/N)) = S(x) / S(x/N), S(x) = sin x / x.
    """
    N, k = grid.N, np.arange(-grid.window, grid.window + 1) * np.pi
    shape = (k.shape[0],) + (1,) * d.ndim
    x = d[None] + k.reshape(shape)
    turns = jnp.round(x / (N * np.pi))  # D(x + Nπ) = ±D(x), and S(x/N) has its zero there
    sign = jnp.where((N % 2 == 0) & (turns % 2 != 0), -1.0, 1.0)
    x = x - N * np.pi * turns
    (S, R), (S1, R1), (S2, R2) = _sinc(jnp.stack([x, x / N]))
    E, E1 = 1 / R, -R1 / R**2 / N
    E2 = (2 * R1**2 / R**3 - R2 / R**2) / N**2
    D = jnp.stack([S * E, S1 * E + S * E1, S2 * E + 2 * S1 * E1 + S * E2])
    W = jnp.sum((sign * _hann(grid.window).reshape(shape))[None] * D, axis=1)
    return W[0], W[1], W[2]


def _sinc(x: Array) -> tuple[Array, Array, Array]:
    """sin x / x and its first two derivatives, by a series where the closed forms cancel."""
    is_small = jnp.abs(x) < 1.0
    large = jnp.where(is_small, 1.0, x)
    S = jnp.sin(large) / large
    S1 = (jnp.cos(large) - S) / large
    S2 = -S - 2 * S1 / large
    z = jnp.where(is_small, x, 0.0) ** 2
    terms = [1.0]
    for j in range(1, 10):
        terms.append(-terms[-1] / ((2 * j) * (2 * j + 1)))
    c, k = np.array(terms), 2 * np.arange(10)
    derivatives = c, (k * c)[1:], (k * (k - 1) * c)[1:]
    series, first, second = (jnp.polyval(jnp.array(a[::-1]), z) for a in derivatives)
    first = first * jnp.where(is_small, x, 0.0)
    pairs = (series, S), (first, S1), (second, S2)
    return tuple(jnp.where(is_small, a, b) for a, b in pairs)  # pyright: ignore[reportReturnType]


def lines_of(z: Array, settings: LineSettings) -> SpectralLines:
    """The lines of one signal. Slot 0 is the constant; a real signal has slots of ω and −ω."""
    is_real, count, N = not jnp.iscomplexobj(z), settings.lines, z.shape[-1]
    grid, per_line = _grid(N, settings.window), 2 if is_real else 1
    finite = jnp.all(jnp.isfinite(z))
    z = jnp.where(finite, z, 0.0).astype(complex)
    largest = jnp.max(jnp.abs(z))
    z = z / jnp.where(largest > 0, largest, 1.0)  # so that squares neither over- nor underflow
    blocks = jnp.pad(z, (0, grid.weights.size - N)).reshape(grid.weights.shape)

    slots = 1 + count * per_line
    s, A = jnp.zeros(slots), jnp.zeros(slots, complex).at[0].set(jnp.sum(grid.weights * blocks))
    is_line = jnp.zeros(slots, bool).at[0].set(True)
    spread = jnp.sum(grid.weights * jnp.abs(blocks - A[0]) ** 2)

    def advance(i, state):
        s, A, is_line, r, _ = state
        position, size = _strongest(grid, r, is_real)
        is_new = (i < count) & _exceeds_noise(grid, r, position, size, s, A, is_line)
        position, size = jnp.where(is_new, position, 0.0), jnp.where(is_new, size, 0.0)
        indices = 1 + per_line * i + np.arange(per_line)  # after the last line beyond the end
        s = s.at[indices].set(jnp.stack([position, -position])[:per_line], mode="drop")
        A = A.at[indices].set(jnp.stack([size, jnp.conj(size)])[:per_line], mode="drop")
        is_line = is_line.at[indices].set(is_new, mode="drop")
        s, A, r, change = _fit(grid, blocks, s, A, is_line, settings.refine)
        keep = ~is_line | (jnp.abs(A) > _least_amplitude(s, s, A, is_line))
        keep = jnp.repeat(keep[1::per_line], per_line)  # a pair goes together
        keep = jnp.concatenate([np.ones(1, bool), keep])
        return jnp.where(keep, s, 0.0), jnp.where(keep, A, 0.0), is_line & keep, r, change

    rounds = count + (_FINAL_ROUNDS if settings.refine else 0)
    begin = (s, A, is_line, blocks - A[0], jnp.zeros(slots))
    s, A, is_line, remainder, change = lax.fori_loop(0, rounds, advance, begin)
    power = jnp.sum(grid.weights * jnp.abs(remainder) ** 2)
    residual = jnp.sqrt(power / jnp.where(spread > 0, spread, 1.0))
    constant = A[0] * largest
    s, A, is_line, change = (x[1::per_line] for x in (s, A, is_line, change))
    order = jnp.argsort(jnp.where(is_line, -jnp.abs(A), jnp.inf))
    s, A, is_line, change = s[order], A[order] * largest, is_line[order], change[order]
    sure, code = _reliability(grid, s, is_line, change)
    s, A, sure = _with_decaying_line(grid, remainder, is_real, largest, s, A, is_line, sure)
    code = jnp.where(is_line[0] & (spread > (64 * EPS) ** 2), code, CODE["no_signal"])
    code = jnp.where(finite, code, CODE["not_finite"])
    return SpectralLines(s, A, sure, constant, residual, code)


def _reliability(grid: _Grid, s: Array, is_line: Array, change: Array) -> tuple[Array, Array]:
    """Which lines have converged and are resolved, and the code of the status of the signal."""
    is_inaccurate = is_line & ~(jnp.abs(change) <= _CONVERGENCE * np.pi)
    is_pair = is_line[:, None] & is_line[None, :] & ~np.eye(len(s), dtype=bool)
    is_close = is_pair & (jnp.abs(s[:, None] - s[None, :]) < np.pi)
    is_ambiguous = jnp.any(is_close, axis=1) | (is_line & (jnp.abs(s) < np.pi))  # from the constant
    code = jnp.asarray(0)
    for name, applies in (
        ("not_converged", jnp.any(is_inaccurate)),
        ("unresolved", jnp.any(is_ambiguous)),
        ("aliased", jnp.abs(s[0]) > 0.9 * grid.N * np.pi / 2),
        ("window_too_short", ~(jnp.abs(s[0]) > (grid.window + 1) * np.pi)),
    ):
        code = jnp.where(applies, CODE[name], code)
    return is_line & ~is_inaccurate & ~is_ambiguous, code


def _with_decaying_line(grid: _Grid, remainder, is_real: bool, largest, s, A, is_line, sure):
    """The lines with the strongest one replaced by A e^{(is − g)y}, where it and lines next to it,
    which cannot be resolved, are one line whose amplitude decays or grows."""
    y = grid.rows[:, None] + grid.columns[None, :]
    group = is_line & (jnp.abs(s - s[0]) < _GROUP * np.pi)
    # A is in units of the signal, the remainder in those of its largest value.
    sizes = jnp.where(group, A / jnp.where(largest > 0, largest, 1.0), 0.0)
    outer = jnp.exp(1j * grid.rows[:, None] * s[None, :]) * sizes[None, :]
    sums = outer @ jnp.exp(1j * s[:, None] * grid.columns[None, :])
    signal = remainder + (2 * jnp.real(sums) if is_real else sums)
    position, mean = _strongest(grid, signal, is_real)
    wave = jnp.exp(1j * position * y)
    centre = jnp.real(jnp.sum(grid.weights * y * signal / wave) / jnp.where(mean == 0, 1.0, mean))

    def improve(_, rate):
        """Newton's step to the rate at which ⟨y⟩ over the decaying amplitude is `centre`."""
        w = grid.weights * jnp.exp(-rate * y)
        w = w / jnp.sum(w)
        first = jnp.sum(w * y)
        return rate + jnp.clip((first - centre) / jnp.sum(w * (y - first) ** 2), -1.0, 1.0)

    rate = lax.fori_loop(0, 20, improve, jnp.zeros(()))
    decay = jnp.exp(-rate * y)
    size = jnp.sum(grid.weights * decay * signal / wave) / jnp.sum(grid.weights * decay**2)

    def power(line):
        line = 2 * jnp.real(line) if is_real else line
        return jnp.sum(grid.weights * jnp.abs(signal - line) ** 2)

    # Few lines that are not resolved leave less than one that decays.
    share = jnp.where(jnp.sum(group) < _SEVERAL, 1.0, _AS_GOOD)
    left = power(size * decay * wave)
    explains = (left < _EXPLAINED**2 * power(mean * wave)) & (left < share**2 * power(sums))
    replaces = is_line[0] & ~sure[0] & explains & (jnp.abs(position - s[0]) < np.pi)
    return (
        s.at[0].set(jnp.where(replaces, position, s[0])),
        A.at[0].set(jnp.where(replaces, size * largest, A[0])),
        sure.at[0].set(sure[0] | replaces),
    )


def _strongest(grid: _Grid, r: Array, is_real: bool) -> tuple[Array, Array]:
    """Position and amplitude of the largest maximum of |⟨r, e^{isy}⟩|."""
    N, p = grid.N, grid.window
    samples = jnp.asarray(grid.weights * r)
    size = jnp.abs(jnp.fft.fft(samples.reshape(-1)[:N]))
    if is_real:
        size = jnp.where(np.arange(N) <= N // 2, size, 0.0)
    m = jnp.argmax(size)
    lower, peak, upper = size[m - 1], size[m], size[(m + 1) % N]
    ratio = jnp.maximum(lower, upper) / jnp.where(peak > 0, peak, 1.0)
    offset = ((p + 1) * ratio - p) / (1 + ratio)  # exact for one line and many samples
    offset = jnp.where(upper > lower, offset, -offset)
    m = jnp.where(m >= (N + 1) // 2, m - N, m)
    s = np.pi * (m + jnp.clip(offset, -0.6, 0.6))

    def climb(_, state):
        s = state[0]
        m0, m1, m2 = _moments(grid, samples, s[None])[:, 0]
        slope = 2 * jnp.imag(jnp.conj(m0) * m1)
        bend = 2 * (jnp.abs(m1) ** 2 - jnp.real(jnp.conj(m0) * m2))
        step = jnp.where(bend < 0, -slope / jnp.where(bend < 0, bend, 1.0), 0.0)
        return s + jnp.clip(step, -np.pi / 2, np.pi / 2), s, m0

    _, s, amplitude = lax.fori_loop(0, _ASCENT + 1, climb, (s, s, jnp.zeros((), complex)))
    return s, amplitude


def _exceeds_noise(grid: _Grid, r, position, size, s, A, is_line) -> Array:
    """Whether a maximum exceeds white noise and round-off.

    The largest |⟨r, e^{isy}⟩|² of N values of noise is about ln N times its mean, which is the
    variance of r times mean(χ²)/N.
    """
    variance = jnp.sum(grid.weights * jnp.abs(r) ** 2)
    noise = 2 * np.log(grid.N) * np.sum(grid.weights**2) * variance
    floor = _least_amplitude(position[None], s, A, is_line)[0]
    return (jnp.abs(size) ** 2 > noise) & (jnp.abs(size) > floor)


def _least_amplitude(position: Array, s: Array, A: Array, is_line: Array) -> Array:
    """The least amplitude at a position that is not round-off of near lines.

    A line that was fitted before a near one had converged ends below this, and is removed.
    """
    is_near = is_line[None, :] & (jnp.abs(s[None, :] - position[:, None]) < np.pi)
    stronger = jnp.where(is_near, jnp.abs(A)[None, :], 0.0)
    return jnp.maximum(_ECHO * jnp.max(stronger, axis=1), _FLOOR)


def _correction(grid, s, A, remainder, is_line, with_frequencies: bool, damping):
    r"""The Gauss–Newton step on Σ χ |z − Σ_k A_k e^{is_k y}|² in all A_k and s_k.

    With e_k = e^{is_k y} A_k/|A_k| the model changes by c_k e_k + i g_k y e_k, complex c, real g;
    then A_k changes by c_k A_k/|A_k| and s_k by g_k/|A_k|. With G_m = ⟨e_k, y^m e_j⟩, which are the
    window's transform and its derivatives, and r_m = ⟨remainder, y^m e_j⟩, the normal equations

        G_0 c + i G_1 g = r_0,      Im(G_1 c) + Re(G_2) g = Im r_1

    are solved for g first. Only g is damped: for fixed frequencies the problem is linear.
    """
    length, K = jnp.abs(A), s.shape[0]
    unit = jnp.where(length > 0, A / jnp.where(length > 0, length, 1.0), 1.0)
    is_pair = is_line[:, None] & is_line[None, :]
    r = jnp.conj(unit)[None, :] * _moments(grid, grid.weights * remainder, s)
    r = jnp.where(is_line[None, :], r, 0.0)
    W, W1, W2 = _kernel(grid, s[None, :] - s[:, None])
    turn = jnp.where(is_pair, jnp.conj(unit)[:, None] * unit[None, :], 0.0)
    G0 = turn * W + jnp.diag(jnp.where(is_line, _RIDGE, 1.0))
    if not with_frequencies:
        return unit * _solve(G0, r[0][:, None])[:, 0], jnp.zeros(K)
    G1, G2 = turn * (-1j * W1), turn * (-W2)
    solution = _solve(G0, jnp.concatenate([G1, r[0][:, None]], axis=1))
    product = G1 @ solution
    free = is_line.at[0].set(False)  # the constant stays one
    S = jnp.where(free[:, None] & free[None, :], jnp.real(G2 - product[:, :K]), 0.0)
    S = S + jnp.diag(jnp.where(free, _RIDGE + damping, 1.0))
    right = jnp.where(free, jnp.imag(r[1] - product[:, K]), 0.0)
    g = _solve(S, right[:, None])[:, 0]
    c = solution[:, K] - 1j * (solution[:, :K] @ g.astype(complex))
    return unit * c, g / jnp.where(length > 0, length, 1.0)


def _solve(M: Array, B: Array) -> Array:
    """M⁻¹ B of a positive definite M, by elimination without pivots.

    A batch of small systems is solved together. LAPACK solves them one by one with several threads
    each, which is a hundred times slower where the threads wait for each other.
    """
    K = M.shape[0]

    def eliminate(i, T):
        row = T[i] / T[i, i]
        return (T - T[:, i][:, None] * row[None, :]).at[i].set(row)

    return lax.fori_loop(0, K, eliminate, jnp.concatenate([M, B], axis=1))[:, K:]


def _fit(grid, blocks, s, A, is_line, with_frequencies: bool):
    """A few steps of least squares, with more damping if a step does not reduce the residual: s, A,
    the residual, and the last undamped step in s."""

    def remainder_of(s, A):
        outer = jnp.exp(1j * grid.rows[:, None] * s[None, :]) * A[None, :]
        remainder = blocks - outer @ jnp.exp(1j * s[:, None] * grid.columns[None, :])
        return remainder, jnp.sum(grid.weights * jnp.abs(remainder) ** 2)

    def step(_, state):
        *place, damping, last = state
        s, A, remainder, cost = place
        A_step, s_step = _correction(grid, s, A, remainder, is_line, with_frequencies, damping)
        s, A = s + jnp.clip(s_step, -np.pi / 4, np.pi / 4), A + A_step
        new = (s, A, *remainder_of(s, A), jnp.zeros(()))
        better = new[3] <= cost * (1 + 1e-9) + EPS**2
        old = (*place, jnp.maximum(10 * damping, 1e-2))
        last = jnp.where(damping == 0, s_step, last)
        return *(jnp.where(better, x, y) for x, y in zip(new, old, strict=True)), last

    begin = (s, A, *remainder_of(s, A), jnp.zeros(()), jnp.zeros_like(s))
    s, A, remainder, _, _, last = lax.fori_loop(0, _FIT_STEPS, step, begin)
    return s, A, remainder, last
