"""Actions of quasi-periodic motion, from the lines of its frequency analysis."""

import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..base.checks import positive
from . import results
from .frequencies import Frequencies, analyse, check_count, settings_of, signals_of
from .lines import EPS
from .results import CODE, FREQUENCY_RESULTS, WithStatus, lacks_numbers, require_success
from .torus import FundamentalFrequencies, as_batch, search_of, tori_of

_CONSTANT = 64 * EPS  # A q or p with less spread, relative to its size, is constant to round-off


class Actions(WithStatus):
    r"""Actions of quasi-periodic motion.

    - `actions`: J_a [units of p·q], shape (num,); `frequencies`: ω_a, shape (num,), in the same
      order. NaN where the status is not `successful`.
    - `errors`: estimated contribution to each action of lines that were not found or are not
      combinations, shape (num,).
    - `residual`: rms of the residual of q_j/s_j − i s_j p_j, divided by (2 rms q_j rms p_j)^½; the
      largest of the degrees of freedom.
    - `scales`: s_j [units of (q/p)^½], shape (n,).
    - `torus`: the `FundamentalFrequencies`; `lines`: the `Frequencies` of each q_j/s_j − i s_j p_j,
      shape (n, count).
    - `result`: the status, one of `FREQUENCY_RESULTS`.

    The first axes are those of a batch.
    """

    actions: np.ndarray
    frequencies: np.ndarray
    errors: np.ndarray
    residual: np.ndarray
    scales: np.ndarray
    torus: FundamentalFrequencies
    lines: Frequencies
    result: FREQUENCY_RESULTS


def actions(
    ts: Any,
    signal: Any = None,
    *,
    count: int = 24,
    window: int = 2,
    num: int | None = None,
    guess: Any = None,
    order: int | None = None,
    leftover: float = 1e-2,
    throw: bool = True,
) -> Actions:
    r"""The actions of quasi-periodic trajectories, J_a = (1/2π) ∮ p·dq around the torus.

    With angles θ, q(θ) = Σ_k q_k e^{ik·θ} and p(θ) alike, the mean of p·∂q/∂θ_a over the torus is
    Σ_k i k_a q_k·p̄_k, and with z_j = q_j − i p_j

        J_a = ½ Σ_j Σ_k k_a |z_{j,k}|²

    over the lines k·ω of every degree of freedom. For H = ω(q² + p²)/2 that is J = (q² + p²)/2 and
    H = ωJ. J depends on the basis of frequencies: for ω' = Mω, J' = M⁻ᵀ J. So that neither the
    lines nor their errors depend on the units, z_j = q_j/s_j − i s_j p_j is analysed, which is
    canonical and does not change J; s_{j}² = rms Δ²q_j / rms Δ²p_j. Second differences give more
    weight to the weak lines of high frequency, on which the accuracy depends. s_j = 1 where q_j or
    p_j is constant.

    **Arguments**

    - `ts`: a `Solution`; or times, shape (N,), with `signal`: q_j − i p_j of canonical q and p,
      shape (*batch, n, N), or (N,) for one degree of freedom. The torus must be contractible in
      phase space: a rotating angle is not a sum of lines.
    - `count`: lines for each degree of freedom; `window`: see `frequencies`.
    - `num`, `guess`, `order`: see `fundamental_frequencies`.
    - `leftover`: largest `residual` of quasi-periodic motion: rms of the part of the signal that is
      not a combination of the num frequencies, divided by (2 rms q_j rms p_j)^½ (about their means;
      for an oscillator 2 rms q rms p = 2J). It does not depend on units.
    - `throw`: raise if a trajectory has another status than `successful`.

    The Fourier transforms run on the device, the rest on the CPU: not under jit or vmap.

    **Returns** an `Actions`.

    **Raises** as `frequencies` and `fundamental_frequencies`; `TypeError` for a real signal.

    **Accuracy** the square of the residual, times the order k of the remaining lines: `errors`. The
    lines of a smooth torus decrease exponentially, so that a larger `count` helps fast. The status
    is `not_quasi_periodic` if the error of an action is as large as ½Σ|k_a||z|² or as the largest
    action; an action that is small because its lines cancel is returned with its error.

    **Source** our own, from the definition; compare Binney & Spergel 1984, *Mon. Not. R. Astron.
    Soc.* 206, 159, and Laskar 1999, in *Hamiltonian Systems with Three or More Degrees of
    Freedom*, 134.
    """
    settings = settings_of(count, window, True)
    ts, signal, eps, axes = signals_of(ts, signal)
    if not jnp.iscomplexobj(signal):
        shape = signal.shape
        raise TypeError(f"signal must be complex, q − i p, got a real array of shape {shape}.")
    results.refuse_traced("actions", ts, signal)
    # One axis for all degrees of freedom of a trajectory.
    lead, N = signal.shape[: signal.ndim - 1 - axes], signal.shape[-1]
    signal = signal.reshape(*lead, math.prod(signal.shape[len(lead) : -1]), N)
    if ts.ndim > 1 and axes != 1:
        ts = ts.reshape(*lead, 1, N)
    check_count(settings, signal)
    if leftover != math.inf:
        leftover = positive("leftover", leftover)
    search = search_of(signal.shape[-2], num, guess, order, None, 1e-3)
    signal, scales, size = _in_canonical_units(signal)
    lines, raw = analyse(ts, signal, settings, eps, 1)
    arrays = lines.frequencies, lines.amplitudes, lines.resolution, raw.amplitudes, raw.code
    omega, A, resolution, raw_A, code = map(np.asarray, arrays)
    tori, codes = tori_of(omega, A, code, resolution, search, soft=False)
    _, combinations, _, is_combination, _ = tori

    n = omega.shape[-2]
    power = np.where(np.isfinite(omega), np.abs(A) ** 2, 0.0).reshape(len(codes), n, count)
    doubt = np.abs(raw_A.reshape(power.shape)) ** 2
    doubt = np.where((power == 0) & np.isfinite(doubt), doubt, 0.0)
    size = np.asarray(size).reshape(len(codes), n)
    fraction = np.nan_to_num(np.asarray(lines.residual)).reshape(len(codes), n) ** 2
    J, errors = (np.full((len(codes), search.num), np.nan) for _ in range(2))
    residual = np.full(len(codes), np.nan)
    for i in range(len(codes)):
        if lacks_numbers(codes[i]):
            continue
        arrays = combinations, is_combination, power, doubt, fraction, size
        residual[i], action, error, is_accurate = _of_torus(*(x[i] for x in arrays))
        if codes[i] in (0, CODE["not_quasi_periodic"]):
            is_torus = is_accurate and residual[i] <= leftover
            codes[i] = 0 if is_torus else CODE["not_quasi_periodic"]
        if codes[i] == 0:
            J[i], errors[i] = action, error
    torus = as_batch(tori, codes, lead)
    result = Actions(
        actions=J.reshape(*lead, search.num),
        frequencies=np.where(np.isfinite(J.reshape(*lead, search.num)), torus.frequencies, np.nan),
        errors=errors.reshape(*lead, search.num),
        residual=residual.reshape(lead),
        scales=np.asarray(scales).reshape(*lead, n),
        torus=torus,
        lines=lines,
        result=torus.result,
    )
    return require_success(result, throw)


def _of_torus(k, is_combination, power, doubt, fraction, size):
    """The residual, the actions with their errors, and whether these are smaller than the actions.

    - `k`, `is_combination`, `power`: of the lines of each degree of freedom; `doubt`: power of
      unresolved lines; `fraction`: of the power outside of all lines.
    """
    combination_power = power * is_combination
    total = (power + doubt).sum(axis=1) / np.maximum(1 - fraction, EPS)
    rest_power = fraction * total + (power - combination_power + doubt).sum(axis=1)
    scale = np.where(size > 0, size, np.where(total > 0, total, 1.0))
    action, gross = (np.einsum("jk,jka->a", combination_power, x) / 2 for x in (k, np.abs(k)))
    largest = np.abs(k * is_combination[..., None]).max(axis=(0, 1)) + 1
    error = largest * rest_power.sum() / 2 + 1e-14 * gross
    is_accurate = bool((error < np.minimum(gross, np.abs(action).max())).all())
    return np.sqrt(np.max(rest_power / scale)), action, error, is_accurate


@eqx.filter_jit
def _in_canonical_units(signal: Array) -> tuple[Array, Array, Array]:
    """q/s − i s p for each q − i p, with s, and 2 rms q rms p, or 0 if one of them is constant."""

    def sizes(x):
        largest = jnp.max(jnp.abs(x), axis=-1)
        unit = x / jnp.where(largest > 0, largest, 1.0)[..., None]  # squares cannot overflow
        spread, bend = jnp.std(unit, axis=-1), jnp.std(jnp.diff(unit, 2, axis=-1), axis=-1)
        return largest, spread, bend, (spread > _CONSTANT) & (bend > 0) & (largest < jnp.inf)

    (largest_q, spread_q, bend_q, moves_q), (largest_p, spread_p, bend_p, moves_p) = (
        sizes(x) for x in (signal.real, signal.imag)
    )
    is_moving = moves_q & moves_p
    s = jnp.where(is_moving, largest_q, 1.0) ** 0.5 / jnp.where(is_moving, largest_p, 1.0) ** 0.5
    s = s * jnp.sqrt(jnp.where(is_moving, bend_q, 1.0) / jnp.where(is_moving, bend_p, 1.0))
    size = jnp.where(is_moving, 2 * (largest_q * spread_q) * (largest_p * spread_p), 0.0)
    return signal.real / s[..., None] + 1j * s[..., None] * signal.imag, s, size
