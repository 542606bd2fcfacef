"""Frequency analysis: the lines of a quasi-periodic signal, after Laskar."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Complex, Float

from .._compat import is_traced, x64_enabled
from .._precision import refuse_double_without_x64
from .._solution import Solution
from .results import FREQUENCY_RESULTS, NAMES, WITHOUT_NUMBERS, name_of, raise_on_failure, with_code

_FEWEST = 32
"""Samples below which there is no window to speak of."""

_ASCENT, _EACH, _LAST = 4, 2, 8
"""Newton steps to the maximum of an amplitude, Gauss–Newton steps after each line and at the end:
they double the digits from a start that is good to some hundredths of the resolution."""

_EPS = float(np.finfo(np.float64).eps)

_FLOOR = 256 * _EPS
"""A line below this share of the largest value of the signal is round-off of its samples."""

_ECHO = 1e-9
"""A line within the resolution of one stronger by this ratio is what round-off left of that."""

_SETTLED = 1e-2
"""Last correction to a frequency, over the resolution, up to which it is taken as found."""

_CODE = {name: i for i, name in enumerate(NAMES)}


class Frequencies(eqx.Module):
    r"""Lines of a signal, strongest first.

        z(t) ≈ c + Σ_k A_k e^{iω_k t}          (complex)
        x(t) ≈ c + Re Σ_k A_k e^{iω_k t}       (real, ω_k > 0)

    - `frequencies`: ω_k [rad per unit of time], shape (count,); `amplitudes`: A_k, complex, units
      of the signal, shape (count,). NaN for lines that are not there, or not to be told.
    - `constant`: c, complex.
    - `residual`: root mean square, in the window, of what these lines leave over that of z − c.
    - `resolution`: 2π/T [rad per unit of time].
    - `result`: the status, one of `FREQUENCY_RESULTS`.

    Axes of a batch, and those of the degrees of freedom of a `Solution`, stand in front.
    """

    frequencies: Float[Array, "*batch count"]
    amplitudes: Complex[Array, "*batch count"]
    constant: Complex[Array, "*batch"]
    residual: Float[Array, "*batch"]
    resolution: Float[Array, "*batch"]
    result: FREQUENCY_RESULTS
    is_real: bool = eqx.field(static=True, default=False)

    @property
    def status(self) -> Any:
        """The name of `result`, such as "successful"; an array of names for a batch."""
        return name_of(self.result)

    def evaluate(self, ts: Any) -> Array:
        """The sum of the lines at times `ts`, shape (N,): shape (*batch, N)."""
        ts = jnp.asarray(ts)
        there = jnp.isfinite(self.frequencies)
        omega, A = jnp.where(there, self.frequencies, 0.0), jnp.where(there, self.amplitudes, 0.0)
        phases = omega[..., :, None] * jnp.expand_dims(ts, tuple(range(omega.ndim)))
        z = self.constant[..., None] + jnp.sum(A[..., :, None] * jnp.exp(1j * phases), axis=-2)
        return z.real if self.is_real else z


class FrequencyDiffusion(eqx.Module):
    """Change of the leading frequency between the two halves of a signal.

    - `first`, `second`: the frequency in each half [rad per unit of time].
    - `rate`: log10 |Δω/ω|; not below log10 of the spacing of floating point numbers, −15.7.
    - `result`: the status, one of `FREQUENCY_RESULTS`; NaN above where it is not `successful`.

    Axes of a batch and of degrees of freedom stand in front.
    """

    first: Float[Array, "*batch"]
    second: Float[Array, "*batch"]
    rate: Float[Array, "*batch"]
    result: FREQUENCY_RESULTS

    @property
    def status(self) -> Any:
        """The name of `result`; an array of names for a batch."""
        return name_of(self.result)


def frequencies(
    ts: Any,
    signal: Any = None,
    *,
    count: int = 8,
    window: int = 2,
    refine: bool = True,
    throw: bool = True,
) -> Frequencies:
    r"""The lines of a signal that is sampled at uniform times.

    One line after the other is found as the maximum over σ of

        |⟨r, e^{iσt}⟩|,   ⟨f, g⟩ = Σ_n χ(t_n) f(t_n) ḡ(t_n) / N,   χ ∝ (1 + cos πu)^window

    with r what the lines before have left over and u from −1 to 1 over the window. A fast Fourier
    transform gives the start, Newton's method the maximum; then *all* amplitudes, and with
    ``refine=True`` all frequencies, are those of least squares in ⟨·,·⟩, by Gauss–Newton: near
    lines do not bias one another. A constant is always among what is fitted.

    **Arguments**

    - `ts`: times, shape (N,), uniform, N ≥ 32; or (*batch, N). Or a `Solution`: then the signal
      of each degree of freedom is q_j − i p_j, for which H = (q² + p²)/2 turns at +1, shape
      (*batch, *state, N).
    - `signal`: shape (*batch, N), complex or real. A real one has lines at ω > 0 alone.
    - `count`: lines to look for, 3·count < N (6·count < N if real); static.
    - `window`: power of Hann's window, 0 to 5; static. A line that is not among the `count` biases
      the others by a share T^−(2·window+2) of it.
    - `refine`: fit all frequencies together at the end, as said; False is Laskar's procedure.
    - `throw`: raise if a signal has another status than `successful`.

    It may be compiled by `jit`, batched by `vmap`, and differentiated.

    **Returns** a `Frequencies`.

    **Raises** `ValueError` for times that are not uniform, and shapes, counts and windows that
    cannot be meant; `TypeError` where only single precision is at hand; `FrequencyError` when a
    signal has no `successful` status and `throw` is True (inside jit an equinox runtime error).

    **Accuracy** round-off, about 1e-15·N of ω, for a signal of no more than `count` lines that
    are further apart than the resolution; see docs/frequencies.md. float32 is computed in float64.

    **Source** Laskar 1990, *Icarus* 88, 266; 1993, *Physica D* 67, 257; 2003, arXiv:math/0305364.
    Joint refinement by least squares: our own, in the place of the corrections of Šidlichovský &
    Nesvorný 1996, *Celest. Mech. Dyn. Astron.* 65, 137.
    """
    settings = settings_of(count, window, refine)
    ts, signal = signals_of(ts, signal)
    check_count(settings, signal)
    found, _ = analyse(ts, signal, settings)
    return raise_on_failure(found) if throw else found


def frequency_diffusion(
    ts: Any,
    signal: Any = None,
    *,
    count: int = 4,
    window: int = 2,
    throw: bool = True,
) -> FrequencyDiffusion:
    r"""How far the leading frequency moves from the first half of a signal to the second.

        log10 |ω(second half) − ω(first half)| / |ω(first half)|

    Near the level of the method, T^−(2·window+2) or that of the integrator, on a torus; orders of
    magnitude above it where the motion is chaotic. In the second half the line is taken that is
    nearest to the leading one of the first half, among those of at least half its amplitude.

    **Arguments** `ts`, `signal`, `window`, `throw` as for `frequencies`; `count` lines are fitted
    in each half, so that the others do not bias the leading one.

    **Returns** a `FrequencyDiffusion`. A chaotic signal whose weaker lines are not to be told
    apart still has a leading frequency in each half: its status is `successful`.

    **Raises** as `frequencies`.

    **Source** Laskar 1993, *Physica D* 67, 257; Dumas & Laskar 1993, *Phys. Rev. Lett.* 70, 2975.
    """
    settings = settings_of(count, window, True)
    ts, signal = signals_of(ts, signal)
    half = signal.shape[-1] // 2
    halves = jnp.stack([signal[..., :half], signal[..., half : 2 * half]])
    if half < _FEWEST:
        raise ValueError(f"two halves need at least {2 * _FEWEST} samples, got {signal.shape[-1]}.")
    times = jnp.stack([ts[..., :half], ts[..., half : 2 * half]])
    times = times.reshape(2, *(1,) * (halves.ndim - times.ndim), *times.shape[1:])
    check_count(settings, halves)
    found, raw = analyse(times, halves, settings)
    first = raw.frequencies[0, ..., 0]
    size = jnp.abs(raw.amplitudes)
    strong = size[1] >= 0.5 * size[0, ..., :1]
    away = jnp.where(strong, jnp.abs(raw.frequencies[1] - first[..., None]), jnp.inf)
    best = jnp.argmin(away, axis=-1)[..., None]
    best = jnp.where(jnp.any(strong, axis=-1)[..., None], best, 0)
    second = jnp.take_along_axis(raw.frequencies[1], best, axis=-1)[..., 0]
    rate = jnp.log10(jnp.maximum(jnp.abs((second - first) / first), _EPS))
    code = jnp.where(raw.code < len(WITHOUT_NUMBERS) + 1, raw.code, 0)
    code = jnp.where(code[0] != 0, code[0], code[1])
    first, second, rate = (jnp.where(code == 0, x, jnp.nan) for x in (first, second, rate))
    of = FrequencyDiffusion(first, second, rate, with_code(code))
    return raise_on_failure(of) if throw else of


class Settings(NamedTuple):
    """What is static of an analysis."""

    count: int
    window: int
    refine: bool


class Raw(NamedTuple):
    """Lines with those that are in doubt, and the codes of the statuses."""

    frequencies: Array
    amplitudes: Array
    code: Array


def settings_of(count: Any, window: Any, refine: Any) -> Settings:
    if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < 1:
        raise ValueError(f"count, the number of lines, must be a positive integer, got {count!r}.")
    if isinstance(window, bool) or not isinstance(window, int | np.integer) or not 0 <= window <= 5:
        raise ValueError(
            f"window, the power of Hann's window, must be an integer from 0 to 5, got {window!r}."
        )
    return Settings(int(count), int(window), bool(refine))


def check_count(settings: Settings, signal: Array) -> None:
    unknowns = 3 * settings.count * (1 if jnp.iscomplexobj(signal) else 2)
    if unknowns >= signal.shape[-1]:
        raise ValueError(
            f"count = {settings.count} lines have {unknowns} unknowns, which {signal.shape[-1]} "
            "samples do not determine: take a smaller count or more samples."
        )


def signals_of(ts: Any, signal: Any) -> tuple[Array, Array]:
    """Times (…, N) and signals (*batch, N), checked; of a `Solution` q − i p."""
    if isinstance(ts, Solution):
        if signal is not None:
            raise ValueError("a Solution brings its own signal, q − i p: leave the other one out.")
        solution, lead = ts, ts.ts.ndim - 1
        z = _double("the trajectory", solution.qs) - 1j * _double("the trajectory", solution.ps)
        signal, ts = jnp.moveaxis(z, lead, -1), solution.ts
        ts = ts.reshape(*ts.shape[:-1], *(1,) * (signal.ndim - ts.ndim), ts.shape[-1])
    elif signal is None:
        raise ValueError("frequencies(ts, signal) needs a signal, or a Solution in place of both.")
    ts, signal = _double("ts", ts), _double("signal", signal)
    if jnp.iscomplexobj(ts):
        raise TypeError("the times must be real: frequencies(ts, signal) takes the times first.")
    if signal.ndim == 0 or ts.ndim == 0 or ts.shape[-1] != signal.shape[-1]:
        raise ValueError(
            f"ts and signal must have one length along their last axis, got shapes {ts.shape} and "
            f"{signal.shape}. Of trajectories saved as (N, n), give signal.T."
        )
    if ts.ndim > 1:
        try:
            fits = np.broadcast_shapes(ts.shape, signal.shape) == signal.shape
        except ValueError:
            fits = False
        if not fits or ts.ndim > signal.ndim:
            raise ValueError(
                f"times of shape {ts.shape} do not go with signals of shape {signal.shape}: give "
                "one row of times, or one for each signal."
            )
    if signal.shape[-1] < _FEWEST:
        raise ValueError(
            f"a frequency needs at least {_FEWEST} samples, got {signal.shape[-1]}: save more "
            "often, or run longer."
        )
    if not is_traced(ts):
        rows = np.asarray(ts).reshape(-1, ts.shape[-1])
        rows = rows[np.isfinite(rows).all(axis=1)]  # times that failed are a matter of statuses
        uneven = np.asarray(_unevenness(jnp.asarray(rows))) if len(rows) else np.zeros(1)
        if not (uneven <= 1).all():
            raise ValueError(
                "the times are not uniform: of their steps the shortest is "
                f"{np.diff(rows[uneven.argmax()]).min():.17g} and the longest "
                f"{np.diff(rows[uneven.argmax()]).max():.17g}. Save with dvi.Save(every=m) on the "
                "lattice dvi.Uniform(), without final=True."
            )
    return ts, signal


def _double(name: str, value: Any) -> Array:
    """An array in double precision, real or complex."""
    value = value if isinstance(value, jax.Array) else np.asarray(value)
    refuse_double_without_x64(name, value.dtype)
    if value.dtype.kind not in "fciu":
        raise TypeError(f"{name} must be an array of numbers, got dtype {value.dtype}.")
    if not x64_enabled():
        raise TypeError(
            "frequency analysis needs double precision, and this process computes in float32: put"
            '\n    jax.config.update("jax_enable_x64", True)\nbefore the first array is made.'
        )
    return jnp.asarray(value, jnp.complex128 if value.dtype.kind == "c" else jnp.float64)


def _unevenness(ts: Array) -> Array:
    """Largest deviation from a uniform lattice over what is allowed; NaN for no lattice at all."""
    N = ts.shape[-1]
    h = (ts[..., -1:] - ts[..., :1]) / (N - 1)
    off = jnp.max(
        jnp.abs(ts - ts[..., :1] - h * np.arange(N).reshape((1,) * (ts.ndim - 1) + (N,))), -1
    )
    size = jnp.max(jnp.abs(ts), axis=-1)
    allowed = 1e-9 * jnp.abs(h[..., 0]) + 4 * N * _EPS * size  # times may be a running sum
    return jnp.where(h[..., 0] != 0, off / allowed, jnp.nan)


@eqx.filter_jit
def analyse(ts: Array, signal: Array, settings: Settings) -> tuple[Frequencies, Raw]:
    """The lines of every signal: those that are sure, and all."""
    lead, N = signal.shape[:-1], signal.shape[-1]
    ts = jnp.broadcast_to(ts, signal.shape)
    h = (ts[..., -1] - ts[..., 0]) / (N - 1)
    flat = signal.reshape(-1, N)
    lines = jax.vmap(lambda z: _lines(z, settings))(flat)
    lines = jax.tree.map(lambda x: x.reshape(*lead, *x.shape[1:]), lines)
    irregular = ~(_unevenness(ts) <= 1)
    code = jnp.where(
        (lines.code != _CODE["not_finite"]) & irregular, _CODE["irregular_times"], lines.code
    )

    scale = 2 / (N * h)
    omega = lines.s * scale[..., None]
    centre = (ts[..., 0] + ts[..., -1]) / 2
    A = lines.amplitudes * jnp.exp(-1j * omega * centre[..., None])
    A = A * (1 if jnp.iscomplexobj(signal) else 2)
    raw = Raw(omega, A, code)
    hard = (code > 0) & (code <= len(WITHOUT_NUMBERS))
    sure = lines.sure & ~hard[..., None]
    found = Frequencies(
        frequencies=jnp.where(sure, omega, jnp.nan),
        amplitudes=jnp.where(sure, A, jnp.nan),
        constant=jnp.where(hard & (code != _CODE["no_signal"]), jnp.nan, lines.constant),
        residual=jnp.where(hard, jnp.nan, lines.residual),
        resolution=2 * jnp.pi / jnp.abs(N * h),
        result=with_code(code),
        is_real=not jnp.iscomplexobj(signal),
    )
    return found, raw


class _Lines(NamedTuple):
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
    padded = np.concatenate([weights / N, np.zeros(A * B - N)]).reshape(A, B)
    rows = (2 * B * np.arange(A) + B - N) / N
    columns = (2 * np.arange(B) + 1 - B) / N
    return _Grid(rows, columns, padded, window, N)


def _hann(window: int) -> np.ndarray:
    """Fourier coefficients of (1 + cos πu)^window over their mean, from −window to window."""
    coefficients = np.array([1.0])
    for _ in range(2 * window):
        coefficients = np.convolve(coefficients, [1.0, 1.0])
    return coefficients / coefficients[window]


def _moments(grid: _Grid, weighted: Array, s: Array) -> Array:
    """Σ χ z y^m e^{−isy} / N for m = 0, 1, 2: s (K,) to (3, K); `weighted` is χz/N."""
    a, b = grid.rows, grid.columns
    inner = jnp.exp(-1j * b[:, None] * s[None, :])
    powers = jnp.concatenate([inner, b[:, None] * inner, b[:, None] ** 2 * inner], axis=1)
    sums = (weighted @ powers).reshape(a.shape[0], 3, s.shape[0])
    outer = jnp.exp(-1j * a[:, None] * s[None, :])[:, None, :]
    x = a[:, None]
    m0, m1, m2 = (sums * outer).transpose(1, 0, 2)
    return jnp.stack([
        jnp.sum(m0, axis=0),
        jnp.sum(x * m0 + m1, axis=0),
        jnp.sum(x**2 * m0 + 2 * x * m1 + m2, axis=0),
    ])  # fmt: skip


def _synthesis(grid: _Grid, s: Array, amplitudes: Array) -> Array:
    """Σ_k A_k e^{is_k y} on the grid."""
    outer = jnp.exp(1j * grid.rows[:, None] * s[None, :]) * amplitudes[None, :]
    return outer @ jnp.exp(1j * s[:, None] * grid.columns[None, :])


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
    S, S1, S2 = _sinc(x)
    R, R1, R2 = _sinc(x / N)
    E, E1 = 1 / R, -R1 / R**2 / N
    E2 = (2 * R1**2 / R**3 - R2 / R**2) / N**2
    D = jnp.stack([S * E, S1 * E + S * E1, S2 * E + 2 * S1 * E1 + S * E2])
    W = jnp.sum((sign * _hann(grid.window).reshape(shape))[None] * D, axis=1)
    return W[0], W[1], W[2]


def _sinc(x: Array) -> tuple[Array, Array, Array]:
    """Of sin x / x the value and two derivatives, by their series where they cancel."""
    near = jnp.abs(x) < 1.0
    far = jnp.where(near, 1.0, x)
    S = jnp.sin(far) / far
    S1 = (jnp.cos(far) - S) / far
    S2 = -S - 2 * S1 / far
    z = jnp.where(near, x, 0.0) ** 2
    terms = [1.0]
    for j in range(1, 10):
        terms.append(-terms[-1] / ((2 * j) * (2 * j + 1)))
    series = jnp.polyval(jnp.array(terms[::-1]), z)
    first = jnp.polyval(jnp.array([2 * j * c for j, c in enumerate(terms)][:0:-1]), z)
    second = jnp.polyval(
        jnp.array([2 * j * (2 * j - 1) * c for j, c in enumerate(terms)][:0:-1]), z
    )
    return (
        jnp.where(near, series, S),
        jnp.where(near, first * jnp.where(near, x, 0.0), S1),
        jnp.where(near, second, S2),
    )


def _lines(z: Array, settings: Settings) -> _Lines:
    """The lines of one signal.

    Slot 0 is the constant; a line of a real signal has a second slot, of −ω.
    """
    is_real, count, N = not jnp.iscomplexobj(z), settings.count, z.shape[-1]
    grid, mirrored = _grid(N, settings.window), 2 if is_real else 1
    finite = jnp.all(jnp.isfinite(z))
    z = jnp.where(finite, z, 0.0).astype(complex)
    largest = jnp.max(jnp.abs(z))
    z = z / jnp.where(largest > 0, largest, 1.0)  # so that squares neither over- nor underflow
    pad = grid.weights.size - N
    blocks = jnp.pad(z, (0, pad)).reshape(grid.weights.shape)

    slots = 1 + count * mirrored
    s, A = jnp.zeros(slots), jnp.zeros(slots, complex).at[0].set(jnp.sum(grid.weights * blocks))
    there = jnp.zeros(slots, bool).at[0].set(True)
    spread = jnp.sum(grid.weights * jnp.abs(blocks - A[0]) ** 2)
    steps = _EACH if settings.refine else 1

    def add(i, state):
        s, A, there = state
        r = blocks - _synthesis(grid, s, A)
        new, size = _strongest(grid, r, is_real)
        fresh = 1 + mirrored * i
        real = _is_line(grid, r, new, size, s, A, there)
        new, size = jnp.where(real, new, 0.0), jnp.where(real, size, 0.0)
        put = (
            lambda x, one, other: lax.dynamic_update_slice(  # noqa: E731
                x, jnp.stack([one, other][:mirrored]), (fresh,)
            )
        )
        s, A = put(s, new, -new), put(A, size, jnp.conj(size))
        there = put(there, real, real)
        s, A, _ = _fit(grid, blocks, s, A, there, settings.refine, steps)
        return s, A, there

    s, A, there = lax.fori_loop(0, count, add, (s, A, there))
    moved = jnp.zeros(slots)
    if settings.refine:
        s, A, moved = _fit(grid, blocks, s, A, there, True, _LAST)

    rest = blocks - _synthesis(grid, s, A)
    residual = jnp.sqrt(
        jnp.sum(grid.weights * jnp.abs(rest) ** 2) / jnp.where(spread > 0, spread, 1.0)
    )
    constant = A[0] * largest
    s, A, there, moved = (x[1::mirrored] for x in (s, A, there, moved))
    order = jnp.argsort(jnp.where(there, -jnp.abs(A), jnp.inf))
    s, A, there, moved = s[order], A[order] * largest, there[order], moved[order]
    unsettled = there & ~(jnp.abs(moved) <= _SETTLED * np.pi)
    both = there[:, None] & there[None, :] & ~np.eye(count, dtype=bool)
    near = both & (jnp.abs(s[:, None] - s[None, :]) < np.pi)
    if is_real:
        s = jnp.where(there, s, 1.0)
    unresolved = jnp.any(near, axis=1) | (there & (jnp.abs(s) < (np.pi / 2 if is_real else np.pi)))
    code = jnp.asarray(0)
    for name, applies in (
        ("not_converged", jnp.any(unsettled)),
        ("unresolved", jnp.any(unresolved)),
        ("aliased", jnp.abs(s[0]) > 0.9 * N * np.pi / 2),
        ("window_too_short", ~(jnp.abs(s[0]) > (settings.window + 1) * np.pi)),
        ("no_signal", ~there[0] | ~(spread > (64 * _EPS) ** 2)),
        ("not_finite", ~finite),
    ):
        code = jnp.where(applies, _CODE[name], code)
    sure = there & ~unsettled & ~unresolved
    return _Lines(s, A, sure, constant, residual, code)


def _strongest(grid: _Grid, r: Array, is_real: bool) -> tuple[Array, Array]:
    """Place and amplitude of the largest maximum of |⟨r, e^{isy}⟩|."""
    N, p = grid.N, grid.window
    weighted = grid.weights * r
    size = jnp.abs(jnp.fft.fft(weighted.reshape(-1)[:N]))
    if is_real:
        size = jnp.where(np.arange(N) <= N // 2, size, 0.0)
    m = jnp.argmax(size)
    before, at, after = size[m - 1], size[m], size[(m + 1) % N]
    ratio = jnp.maximum(before, after) / jnp.where(at > 0, at, 1.0)
    offset = ((p + 1) * ratio - p) / (1 + ratio)  # exact for one line and many samples
    offset = jnp.where(after > before, offset, -offset)
    m = jnp.where(m >= (N + 1) // 2, m - N, m)
    s = np.pi * (m + jnp.clip(offset, -0.6, 0.6))

    def climb(_, s):
        m0, m1, m2 = _moments(grid, weighted, s[None])[:, 0]
        slope = 2 * jnp.imag(jnp.conj(m0) * m1)
        bend = 2 * (jnp.abs(m1) ** 2 - jnp.real(jnp.conj(m0) * m2))
        step = jnp.where(bend < 0, -slope / jnp.where(bend < 0, bend, 1.0), 0.0)
        return s + jnp.clip(step, -np.pi / 2, np.pi / 2)

    s = lax.fori_loop(0, _ASCENT, climb, s)
    return s, _moments(grid, weighted, s[None])[0, 0]


def _is_line(grid: _Grid, r: Array, new: Array, size: Array, s: Array, A: Array, there: Array):
    """Whether a maximum stands above white noise and above round-off.

    Of N values of noise the largest |⟨r, e^{isy}⟩|² is about ln N times its mean, which is the
    variance of r times mean(χ²)/N.
    """
    variance = jnp.sum(grid.weights * jnp.abs(r) ** 2)
    noise = 2 * np.log(grid.N) * np.sum(grid.weights**2) * variance
    beside = there & (jnp.abs(s - new) < np.pi)
    echo = jnp.max(jnp.where(beside, jnp.abs(A), 0.0)) * _ECHO
    return (jnp.abs(size) ** 2 > noise) & (jnp.abs(size) > jnp.maximum(echo, _FLOOR))


class _Fit(NamedTuple):
    """Where the least squares stand."""

    s: Array
    A: Array
    rest: Array
    cost: Array
    damping: Array


def _fit(grid, blocks, s, A, there, with_frequencies: bool, steps: int):
    r"""Gauss–Newton steps on Σ χ |z − Σ_k A_k e^{is_k y}|² in all A_k and s_k, damped.

    With e_k = e^{is_k y} A_k/|A_k| the model changes by e_k a + i e_k b + i y e_k g, real a, b, g;
    then A_k changes by (a + ib) A_k/|A_k| and s_k by g/|A_k|. Scalar products of these columns
    are the window's transform and its derivatives: no sum over samples. The damping is of g alone:
    without frequencies the problem is linear. Returns also the undamped step that would be next.
    """
    free = there.at[0].set(False) & with_frequencies
    mask = jnp.concatenate([there, there, free])
    both = mask[:, None] & mask[None, :]

    def correction(s, A, rest, damping):
        length = jnp.abs(A)
        unit = jnp.where(length > 0, A / jnp.where(length > 0, length, 1.0), 1.0)
        m = jnp.conj(unit)[None, :] * _moments(grid, grid.weights * rest, s)
        W, W1, W2 = _kernel(grid, s[None, :] - s[:, None])
        turn = jnp.conj(unit)[:, None] * unit[None, :]
        G0, G1, G2 = turn * W, turn * (-1j * W1), turn * (-W2)
        M = jnp.block([
            [G0.real, -G0.imag, -G1.imag],
            [G0.imag, G0.real, G1.real],
            [G1.imag, G1.real, G2.real],
        ])  # fmt: skip
        added = jnp.concatenate(
            [jnp.full(2 * s.shape[0], 1e-14), jnp.full(s.shape[0], damping + 1e-14)]
        )
        M = jnp.where(both, M, 0.0) + jnp.diag(jnp.where(mask, added, 1.0))
        rhs = jnp.where(mask, jnp.concatenate([m[0].real, m[0].imag, m[1].imag]), 0.0)
        a, b, g = jnp.linalg.solve(M, rhs).reshape(3, -1)
        return unit * (a + 1j * b), g / jnp.where(length > 0, length, 1.0)

    def of(s, A):
        rest = blocks - _synthesis(grid, s, A)
        return rest, jnp.sum(grid.weights * jnp.abs(rest) ** 2)

    def step(_, now):
        change, moved = correction(now.s, now.A, now.rest, now.damping)
        s, A = now.s + jnp.clip(moved, -np.pi / 4, np.pi / 4), now.A + change
        rest, cost = of(s, A)
        better = cost <= now.cost * (1 + 1e-9) + _EPS**2
        new = _Fit(s, A, rest, cost, jnp.where(now.damping < 1e-4, 0.0, now.damping / 10))
        old = now._replace(damping=jnp.maximum(10 * now.damping, 1e-2))
        return _Fit(*(jnp.where(better, x, y) for x, y in zip(new, old, strict=True)))

    end = lax.fori_loop(0, steps, step, _Fit(s, A, *of(s, A), jnp.zeros(())))
    moved = correction(end.s, end.A, end.rest, 0.0)[1] if with_frequencies else jnp.zeros_like(s)
    return end.s, end.A, moved
