"""Frequency analysis (NAFF): the lines of a quasi-periodic signal, after Laskar."""

import dataclasses
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from lanewise.jaxprs.jaxapi import is_traced, x64_enabled

from ..base.checks import known, one_of, whole
from ..base.inputs import refuse_unit_or_mask
from ..base.precision import refuse_double_without_x64
from ..observe.solution import Solution
from .lines import EPS, LineSettings, SpectralLines, lines_of
from .results import (
    CODE,
    FREQUENCY_RESULTS,
    WithStatus,
    code_of,
    lacks_numbers,
    require_success,
    with_code,
)

_FEWEST = 32  # Least number of samples of a signal


class Frequencies(WithStatus):
    r"""Lines of a signal, strongest first.

        z(t) ≈ c + Σ_k A_k e^{iω_k t}          (complex)
        x(t) ≈ c + Re Σ_k A_k e^{iω_k t}       (real, ω_k > 0)

    - `frequencies`: ω_k [rad per unit of time], shape (count,); `amplitudes`: A_k, complex, units
      of the signal, shape (count,). NaN for missing or unresolved lines. Where the unresolved ones
      are one line whose amplitude decays or grows exponentially, the first is its frequency and its
      amplitude in the middle of the window; the status is `unresolved` all the same.
    - `constant`: c, complex (its imaginary part is 0 for a real signal).
    - `residual`: root mean square, in the window, of z minus all lines, divided by that of z − c.
      Unresolved lines are included, so that it is not the error of `evaluate`.
    - `resolution`: 2π/T [rad per unit of time].
    - `result`: the status, one of `FREQUENCY_RESULTS`.
    - `is_real`: whether the signal is real; `state_axes`: number of axes of the degrees of freedom
      of one trajectory. Both static.

    The first axes are those of a batch, then of the degrees of freedom: (*batch, *state, count).
    """

    frequencies: Float[Array, "*batch count"]
    amplitudes: Complex[Array, "*batch count"]
    constant: Complex[Array, "*batch"]
    residual: Float[Array, "*batch"]
    resolution: Float[Array, "*batch"]
    result: FREQUENCY_RESULTS
    is_real: bool = eqx.field(static=True, default=False)
    state_axes: int = eqx.field(static=True, default=0)

    def evaluate(self, ts: Any) -> Array:
        """The constant and the sum of the lines at times `ts` of any shape (*times).

        Shape (*batch, *times): every signal at every time; for different times of each signal of a
        batch, ``jax.vmap(lambda f, t: f.evaluate(t))(found, ts)``. NaN where a line is unresolved
        or the status leaves no numbers; the constant alone if there is no line.
        """
        ts = _real_times("ts", ts)
        times, batch = ts.reshape(-1), self.constant.shape
        is_line = jnp.isfinite(self.frequencies)
        omega, A = (jnp.where(is_line, x, 0.0) for x in (self.frequencies, self.amplitudes))
        phases = omega[..., :, None] * jnp.expand_dims(times, tuple(range(omega.ndim)))
        z = self.constant[..., None] + jnp.sum(A[..., :, None] * jnp.exp(1j * phases), axis=-2)
        code = code_of(self.result)
        has_numbers = (code == CODE["successful"]) | (code == CODE["no_signal"])
        z = jnp.where(has_numbers[..., None], z, jnp.nan).reshape(*batch, *ts.shape)
        return z.real if self.is_real else z


class FrequencyDiffusion(WithStatus):
    """Change of the leading frequency between the two halves of a signal.

    - `first`, `second`: the frequency in each half [rad per unit of time].
    - `rate`: log10 |Δω/ω|, at least log10 of the spacing of floating point numbers, −15.7.
    - `result`: the status, one of `FREQUENCY_RESULTS`; the numbers are NaN unless `successful`.

    The first axes are those of a batch, then of the degrees of freedom.
    """

    first: Float[Array, "*batch"]
    second: Float[Array, "*batch"]
    rate: Float[Array, "*batch"]
    result: FREQUENCY_RESULTS


def frequencies(
    ts: Any,
    signal: Any = None,
    *,
    count: int = 8,
    window: int = 2,
    refine: bool = True,
    throw: bool = True,
) -> Frequencies:
    r"""Frequency analysis (NAFF) of a signal that is sampled at uniform times.

    Lines are found one by one, as the maximum over σ of

        |⟨r, e^{iσt}⟩|,   ⟨f, g⟩ = Σ_n χ(t_n) f(t_n) ḡ(t_n) / N,   χ ∝ (1 + cos πu)^window

    where r is the residual of the lines before and u goes from −1 to 1 over the window. A fast
    Fourier transform gives the initial guess, Newton's method the maximum. Then all amplitudes, and
    with ``refine=True`` all frequencies, are fitted by least squares in ⟨·,·⟩ (Gauss–Newton), so
    that near lines do not bias each other. A constant is always fitted with them.

    **Arguments**

    - `ts`: times, shape (N,), uniform to their rounding, ascending or not, N ≥ 32; or (*batch, N).
      Or a `Solution`: then the signal of each degree of freedom is q_j − i p_j, shape
      (*batch, *state, N), in which H = (q² + p²)/2 has the frequency +1.
    - `signal`: shape (*batch, N), complex or real. A real one has lines at ω > 0 only. If there are
      several axes, the last but one is that of the degrees of freedom (`state_axes`).
    - `count`: number of lines, 3·count < N (6·count < N if real); static.
    - `window`: power of Hann's window, 0 to 5; static. A line that is not among the `count` biases
      the others by T^−(2·window+2), relative to its amplitude.
    - `refine`: fit all frequencies together at the end; False is Laskar's procedure.
    - `throw`: raise if a signal has another status than `successful`.

    It may be compiled by `jit`, batched by `vmap`, and differentiated.

    **Returns** a `Frequencies`.

    **Raises** `ValueError` for times that are not uniform and invalid shapes, counts and windows;
    `TypeError` if x64 is off; `FrequencyError` when a signal is not `successful` and `throw` is
    True (inside jit an equinox runtime error).

    **Accuracy** round-off, below 1e-13 ω for 2048 samples, for a signal of at most `count` lines
    that are further apart than the resolution; see `docs/frequencies.md`. float32 signals are
    analysed in float64, at the uniform times that fit the rounded ones best.

    **Source** Laskar 1990, *Icarus* 88, 266; 1993, *Physica D* 67, 257; 2003, arXiv:math/0305364.
    Joint refinement by least squares: our own, in place of the corrections of Šidlichovský &
    Nesvorný 1996, *Celest. Mech. Dyn. Astron.* 65, 137.

    **Example**

    ```python
    ts = 0.1 * np.arange(2048)
    found = dvi.frequencies(ts, np.exp(0.7j * ts) + 0.1 * np.exp(-1.9j * ts), count=2)
    print(np.round(found.frequencies, 9), np.round(np.abs(found.amplitudes), 9))
    # [ 0.7 -1.9] [1.  0.1]
    ```
    """
    settings = settings_of(count, window, refine)
    ts, signal, eps, state_axes = signals_of(ts, signal)
    check_count(settings, signal)
    return require_success(analyse(ts, signal, settings, eps, state_axes)[0], throw)


def frequency_diffusion(
    ts: Any, signal: Any = None, *, count: int = 4, window: int = 2, throw: bool = True
) -> FrequencyDiffusion:
    r"""Change of the leading frequency between the two halves of a signal (frequency diffusion).

        log10 |ω(second half) − ω(first half)| / |ω(first half)|

    On a torus this is near the error of the method, T^−(2·window+2), or that of the integrator; for
    chaotic motion it is greater by orders of magnitude. In the second half the line is taken that
    is nearest to the leading one of the first half, among those of at least half its amplitude.

    **Arguments** `ts`, `signal`, `window`, `throw` as for `frequencies`; `count` lines are fitted
    in each half, so that the others do not bias the leading one.

    **Returns** a `FrequencyDiffusion`. The status of a chaotic signal of which only weaker lines
    are unresolved is `successful`, since it has a leading frequency in each half.

    **Raises** as `frequencies`.

    **Source** Laskar 1993, *Physica D* 67, 257; Dumas & Laskar 1993, *Phys. Rev. Lett.* 70, 2975.
    """
    settings = settings_of(count, window, True)
    ts, signal, eps, _ = signals_of(ts, signal)
    half = signal.shape[-1] // 2
    halves = jnp.stack([signal[..., :half], signal[..., half : 2 * half]])
    _check_samples(signal, 2 * _FEWEST)
    times = jnp.stack([ts[..., :half], ts[..., half : 2 * half]])
    times = times.reshape(2, *(1,) * (halves.ndim - times.ndim), *times.shape[1:])
    check_count(settings, halves, " in each half")
    _, raw = analyse(times, halves, settings, eps)
    first, second, rate, code = _change_of_leading(raw)
    return require_success(FrequencyDiffusion(first, second, rate, with_code(code)), throw)


@jax.jit
def _change_of_leading(raw: SpectralLines) -> tuple[Array, Array, Array, Array]:
    """The leading frequency in each half, the rate of `frequency_diffusion`, and the code."""
    omega, first = raw.s, raw.s[0, ..., 0]
    size = jnp.abs(raw.amplitudes)
    strong = size[1] >= 0.5 * size[0, ..., :1]
    distance = jnp.where(strong, jnp.abs(omega[1] - first[..., None]), jnp.inf)
    best = jnp.argmin(distance, axis=-1)[..., None]
    best = jnp.where(jnp.any(strong, axis=-1)[..., None], best, 0)
    second = jnp.take_along_axis(omega[1], best, axis=-1)[..., 0]
    rate = jnp.log10(jnp.maximum(jnp.abs((second - first) / first), EPS))
    code = jnp.where(lacks_numbers(raw.code), raw.code, 0)
    code = jnp.where(code[0] != 0, code[0], code[1])
    first, second, rate = (jnp.where(code == 0, x, jnp.nan) for x in (first, second, rate))
    return first, second, rate, code


def settings_of(count: Any, window: Any, refine: Any) -> LineSettings:
    refine = refine.item() if isinstance(refine, np.bool_) else refine
    return LineSettings(
        whole("count", count, hint="It is the number of lines."),
        whole("window", window, 0, 5, hint="It is the power of Hann's window."),
        one_of("refine", refine, (True, False)),
    )


def check_count(settings: LineSettings, signal: Array, where: str = "") -> None:
    unknowns, N = 3 if jnp.iscomplexobj(signal) else 6, signal.shape[-1]
    hint = f"There are {N} samples{where}, and each line has {unknowns} unknowns."
    whole("count", settings.lines, 1, (N - 1) // unknowns, hint)


def _check_samples(signal: Array, fewest: int) -> None:
    if (N := signal.shape[-1]) < fewest:
        raise ValueError(f"signal must have at least {fewest} samples, got {N}: save more often.")


def signals_of(ts: Any, signal: Any) -> tuple[Array, Array, float, int]:
    """Times (…, N) and signals (*batch, *state, N) in double precision; the relative spacing of the
    floating point numbers in which the times were given; the number of axes of the state. The
    signals of a `Solution` are q − i p."""
    state_axes = None
    if isinstance(ts, Solution) == (signal is not None):
        text = f"only {type(ts).__name__}" if signal is None else "a Solution and a signal"
        raise ValueError(
            f"give (ts, signal), or only a Solution, got {text}. Its signal is q − i p."
        )
    if isinstance(ts, Solution):
        qs, ps = (_double("the solution", x) for x in (ts.qs, ts.ps))
        state_axes = qs.ndim - ts.ts.ndim
        signal, ts = jnp.moveaxis(qs - 1j * ps, ts.ts.ndim - 1, -1), ts.ts
        ts = ts.reshape(*ts.shape[:-1], *(1,) * state_axes, ts.shape[-1])
    dtype: Any = getattr(ts, "dtype", np.dtype(float))
    eps = float(np.finfo(dtype).eps) if dtype.kind == "f" else EPS
    ts, signal = _real_times("ts", ts), _double("signal", signal)
    have_times = 0 not in (ts.ndim, signal.ndim) and ts.shape[-1] == signal.shape[-1]
    sizes = zip(ts.shape[::-1], signal.shape[::-1], strict=False)
    if not have_times or ts.ndim > signal.ndim or any(n not in (1, size) for n, size in sizes):
        raise ValueError(
            f"signal must have the time along its last axis, and ts its shape {signal.shape} or "
            f"{signal.shape[-1:]}, got ts of shape {ts.shape} and signal of shape {signal.shape}."
        )
    _check_samples(signal, _FEWEST)
    if not is_traced(ts):
        hint = f" ts has dtype {dtype}: give the times in float64." if eps > EPS else ""
        _check_steps(np.asarray(ts).reshape(-1, ts.shape[-1]), eps, hint)
    return ts, signal, eps, min(signal.ndim - 1, 1) if state_axes is None else state_axes


def _check_steps(ts: np.ndarray, eps: float, hint: str) -> None:
    ts = ts[np.isfinite(ts).all(axis=1)]  # other rows get a status
    unevenness = np.asarray(_unevenness(jnp.asarray(ts), eps)) if len(ts) else np.zeros(1)
    if not (unevenness <= 1).all():
        steps = np.diff(ts[unevenness.argmax()])
        raise ValueError(
            f"ts must have equal steps, other than zero, got steps from {steps.min():.17g} to "
            f"{steps.max():.17g}. Use dvi.Save(every=m) with dvi.Uniform().{hint}"
        )


def _real_times(name: str, value: Any) -> Array:
    value = _double(name, value)
    if jnp.iscomplexobj(value):
        raise TypeError(f"{name} must be real, got dtype {value.dtype}: give the times first.")
    return value


def _double(name: str, value: Any) -> Array:
    """An array in double precision, real or complex."""
    refuse_unit_or_mask(name, value)
    value = value if isinstance(value, jax.Array) else known(name, value)
    refuse_double_without_x64(name, value.dtype)
    if value.dtype.kind not in "fciu":
        raise TypeError(f"{name} must be an array of numbers, got dtype {value.dtype}.")
    if not x64_enabled():
        raise TypeError(
            "frequency analysis requires double precision: first call "
            'jax.config.update("jax_enable_x64", True).'
        )
    return jnp.asarray(value, jnp.complex128 if value.dtype.kind == "c" else jnp.float64)


def _lattice(ts: Array) -> tuple[Array, Array, Array]:
    """Spacing and centre of the best uniform times, and the largest deviation from them."""
    N = ts.shape[-1]
    n = np.arange(N).reshape((1,) * (ts.ndim - 1) + (N,)) - (N - 1) / 2
    h = (ts[..., -1:] - ts[..., :1]) / (N - 1)
    centre = (ts[..., -1:] + ts[..., :1]) / 2
    deviation = ts - centre - h * n  # small, so that the corrections have all digits
    change = jnp.sum(deviation * n, axis=-1, keepdims=True) * (12 / (N * (N**2 - 1)))
    shift = jnp.mean(deviation, axis=-1, keepdims=True)
    largest_deviation = jnp.max(jnp.abs(deviation - shift - change * n), axis=-1)
    return (h + change)[..., 0], (centre + shift)[..., 0], largest_deviation


@jax.jit
def _unevenness(ts: Array, eps: Any) -> Array:
    """Largest deviation from uniform times over the tolerance; NaN if all times are equal.

    The tolerance covers running sums in double precision and the rounding of each time to numbers
    of spacing `eps`; it is at most an eighth of a step.
    """
    h, _, largest_deviation = _lattice(ts)
    size = jnp.max(jnp.abs(ts), axis=-1)
    tolerance = 1e-9 * jnp.abs(h) + (4 * ts.shape[-1] * EPS + 2 * eps) * size
    return jnp.where(h != 0, largest_deviation / jnp.minimum(tolerance, jnp.abs(h) / 8), jnp.nan)


def analyse(
    ts: Array, signal: Array, settings: LineSettings, eps: float = EPS, state_axes: int = 0
) -> tuple[Frequencies, SpectralLines]:
    """The resolved lines of every signal; and all lines, with frequencies in place of s."""
    lead, N = signal.shape[:-1], signal.shape[-1]
    flat = (math.prod(lead), N)  # so that all shapes of a batch share one program
    ts = jnp.broadcast_to(ts, signal.shape).reshape(flat)
    results = _analyse_rows(ts, signal.reshape(flat), settings, jnp.asarray(eps))
    frequencies, raw = jax.tree.map(lambda x: x.reshape(*lead, *x.shape[1:]), results)
    return dataclasses.replace(frequencies, state_axes=state_axes), raw


@eqx.filter_jit
def _analyse_rows(ts: Array, signal: Array, settings: LineSettings, eps: Array):
    """`analyse` for signals (M, N) at times (M, N)."""
    h, centre, _ = _lattice(ts)
    N = signal.shape[-1]
    lines = jax.vmap(lambda z: lines_of(z, settings))(signal)
    irregular = ~(_unevenness(ts, eps) <= 1) & (lines.code != CODE["not_finite"])
    code = jnp.where(irregular, CODE["irregular_times"], lines.code)

    scale = 2 / (N * h)
    omega = lines.s * scale[..., None]
    A = lines.amplitudes * jnp.exp(-1j * omega * centre[..., None])
    if not jnp.iscomplexobj(signal):
        reverse = (h < 0)[..., None]  # Re A e^{iωt} = Re Ā e^{−iωt}
        omega, A = jnp.where(reverse, -omega, omega), 2 * jnp.where(reverse, jnp.conj(A), A)
    has_no_numbers = lacks_numbers(code)
    sure = lines.sure & ~has_no_numbers[..., None]
    frequencies = Frequencies(
        frequencies=jnp.where(sure, omega, jnp.nan),
        amplitudes=jnp.where(sure, A, jnp.nan),
        constant=jnp.where(has_no_numbers & (code != CODE["no_signal"]), jnp.nan, lines.constant),
        residual=jnp.where(has_no_numbers, jnp.nan, lines.residual),
        resolution=2 * jnp.pi / jnp.abs(N * h),
        result=with_code(code),
        is_real=not jnp.iscomplexobj(signal),
    )
    return frequencies, lines._replace(s=omega, amplitudes=A, code=code)
