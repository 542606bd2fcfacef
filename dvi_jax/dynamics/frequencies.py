"""Frequency analysis: the lines of a quasi-periodic signal, after Laskar."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from .._compat import is_traced, x64_enabled
from .._precision import refuse_double_without_x64
from .._solution import Solution
from .lines import EPS, Settings, lines_of
from .results import (
    CODE,
    FREQUENCY_RESULTS,
    WITHOUT_NUMBERS,
    name_of,
    raise_on_failure,
    with_code,
)

_FEWEST = 32
"""Samples below which there is no window to speak of."""


class Frequencies(eqx.Module):
    r"""Lines of a signal, strongest first.

        z(t) ≈ c + Σ_k A_k e^{iω_k t}          (complex)
        x(t) ≈ c + Re Σ_k A_k e^{iω_k t}       (real, ω_k > 0)

    - `frequencies`: ω_k [rad per unit of time], shape (count,); `amplitudes`: A_k, complex, units
      of the signal, shape (count,). NaN for lines that are not there, or not to be told.
    - `constant`: c, complex (its imaginary part is 0 for a real signal).
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

    **Accuracy** round-off, below 1e-13 ω for 2048 samples, for a signal of no more than `count`
    lines that are further apart than the resolution; see docs/frequencies.md. float32 is computed
    in float64.

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
    _, raw = analyse(times, halves, settings)
    first = raw.frequencies[0, ..., 0]
    size = jnp.abs(raw.amplitudes)
    strong = size[1] >= 0.5 * size[0, ..., :1]
    away = jnp.where(strong, jnp.abs(raw.frequencies[1] - first[..., None]), jnp.inf)
    best = jnp.argmin(away, axis=-1)[..., None]
    best = jnp.where(jnp.any(strong, axis=-1)[..., None], best, 0)
    second = jnp.take_along_axis(raw.frequencies[1], best, axis=-1)[..., 0]
    rate = jnp.log10(jnp.maximum(jnp.abs((second - first) / first), EPS))
    code = jnp.where(raw.code < len(WITHOUT_NUMBERS) + 1, raw.code, 0)
    code = jnp.where(code[0] != 0, code[0], code[1])
    first, second, rate = (jnp.where(code == 0, x, jnp.nan) for x in (first, second, rate))
    of = FrequencyDiffusion(first, second, rate, with_code(code))
    return raise_on_failure(of) if throw else of


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
    unknowns = 3 * settings.lines * (1 if jnp.iscomplexobj(signal) else 2)
    if unknowns >= signal.shape[-1]:
        raise ValueError(
            f"count = {settings.lines} lines have {unknowns} unknowns, which {signal.shape[-1]} "
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
    allowed = 1e-9 * jnp.abs(h[..., 0]) + 4 * N * EPS * size  # times may be a running sum
    return jnp.where(h[..., 0] != 0, off / allowed, jnp.nan)


@eqx.filter_jit
def analyse(ts: Array, signal: Array, settings: Settings) -> tuple[Frequencies, Raw]:
    """The lines of every signal: those that are sure, and all."""
    lead, N = signal.shape[:-1], signal.shape[-1]
    ts = jnp.broadcast_to(ts, signal.shape)
    h = (ts[..., -1] - ts[..., 0]) / (N - 1)
    flat = signal.reshape(-1, N)
    lines = jax.vmap(lambda z: lines_of(z, settings))(flat)
    lines = jax.tree.map(lambda x: x.reshape(*lead, *x.shape[1:]), lines)
    irregular = ~(_unevenness(ts) <= 1)
    code = jnp.where(
        (lines.code != CODE["not_finite"]) & irregular, CODE["irregular_times"], lines.code
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
        constant=jnp.where(hard & (code != CODE["no_signal"]), jnp.nan, lines.constant),
        residual=jnp.where(hard, jnp.nan, lines.residual),
        resolution=2 * jnp.pi / jnp.abs(N * h),
        result=with_code(code),
        is_real=not jnp.iscomplexobj(signal),
    )
    return found, raw
