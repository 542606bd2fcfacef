"""Fundamental frequencies and actions of quasi-periodic motion, from its lines."""

import functools
import itertools
import math
from numbers import Real
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from lanewise.jaxapi import is_traced

from .._solution import Solution
from .frequencies import Frequencies, Raw, analyse, check_count, settings_of, signals_of
from .lines import EPS
from .results import (
    CODE,
    FREQUENCY_RESULTS,
    WITHOUT_NUMBERS,
    code_of,
    name_of,
    raise_on_failure,
    with_code,
)

_SHARE = 1e-2
"""Tolerance of a combination, over the resolution."""

_ORDERS = {1: 64, 2: 20, 3: 12, 4: 8, 5: 6}
"""Largest Σ|k_a| by the number of frequencies; 5 for more: some thousand combinations each."""

_SUBSETS = 300
"""Choices of lines that are tried as a basis."""

_STILL = 64 * EPS
"""A q or p whose spread is below this share of its size is constant, but for round-off."""


class FundamentalFrequencies(eqx.Module):
    r"""Independent frequencies and the combinations k·ω that the lines are.

    - `frequencies`: ω [rad per unit of time], shape (num,); NaN where there are fewer.
    - `combinations`: k of every line, integers, shape (n, count, num); zeros where there is no
      line, or none of the combinations. The n degrees of freedom are those of the state, flattened.
    - `misfits`: line − k·ω [rad per unit of time], shape (n, count); to the nearest combination
      where none is within the tolerance, NaN where there is no line.
    - `matched`: whether it is within the tolerance, shape (n, count).
    - `unexplained`: share of Σ|A|² in lines that are no combinations, each degree of freedom by
      itself, the largest of them.
    - `result`: the status, one of `FREQUENCY_RESULTS`.

    Axes of a batch stand in front.
    """

    frequencies: np.ndarray
    combinations: np.ndarray
    misfits: np.ndarray
    matched: np.ndarray
    unexplained: np.ndarray
    result: FREQUENCY_RESULTS

    @property
    def status(self) -> Any:
        """The name of `result`; an array of names for a batch."""
        return name_of(self.result)


class Actions(eqx.Module):
    r"""Actions of quasi-periodic motion.

    - `actions`: J_a [units of p·q], shape (num,); `frequencies`: ω_a, shape (num,), in the same
      order. NaN where the status is not `successful`.
    - `errors`: an estimate of what the lines that were not found, or are no combinations, would
      add to each action, shape (num,).
    - `residual`: root of the mean square of what is left over of q_j/s_j − i s_j p_j, over
      2 rms q_j rms p_j; the largest of the degrees of freedom.
    - `scales`: s_j [units of (q/p)^½], shape (n,).
    - `torus`: the `FundamentalFrequencies`; `lines`: the `Frequencies` of each q_j/s_j − i s_j p_j,
      shape (n, count).
    - `result`: the status, one of `FREQUENCY_RESULTS`.

    Axes of a batch stand in front.
    """

    actions: np.ndarray
    frequencies: np.ndarray
    errors: np.ndarray
    residual: np.ndarray
    scales: np.ndarray
    torus: FundamentalFrequencies
    lines: Frequencies
    result: FREQUENCY_RESULTS

    @property
    def status(self) -> Any:
        """The name of `result`; an array of names for a batch."""
        return name_of(self.result)


def fundamental_frequencies(
    lines: Frequencies,
    *,
    num: int | None = None,
    guess: Any = None,
    order: int | None = None,
    tolerance: float | None = None,
    threshold: float = 1e-3,
    throw: bool = True,
) -> FundamentalFrequencies:
    r"""The independent frequencies of a torus, of whose integer combinations all lines are made.

        ω_line = k·ω,    k integers, Σ|k_a| ≤ order

    As a basis the leading lines of the degrees of freedom are tried, then the strongest lines
    that are no combinations of those before, then other choices among the strong lines; the one
    that leaves the fewest strong lines unexplained, with the smallest k, is kept. ω is then that
    of least squares over all lines that are combinations, weighted by their amplitudes. A basis
    is one of many: ω' = Mω with an integer M of determinant ±1 is another.

    **Arguments**

    - `lines`: what `frequencies` returned, shape (*batch, *state, count): each entry of the batch
      is a trajectory, the n entries of its state are its degrees of freedom. A `Solution` brings
      both; of signals that were given as arrays the last axis before count is the state, and what
      `vmap` adds is batch. To take one trajectory out, index the axes of the batch alone.
    - `num`: how many frequencies there are, by default n. Fewer for a chain whose centre of mass
      moves freely, or a degenerate system.
    - `guess`: frequencies, shape (num,), good to half the resolution, to be used as the basis.
    - `order`: largest Σ|k_a|; by default 64, 20, 12, 8, 6 for num = 1 … 5, then 5.
    - `tolerance`: of line − k·ω [rad per unit of time]; by default a hundredth of the resolution.
    - `threshold`: amplitude, over that of the leading line of its degree of freedom, from which
      on a line counts as strong: it can be part of a basis, and has to be a combination.
    - `throw`: raise if a trajectory has another status than `successful`.

    On the host, in NumPy: not under jit or vmap.

    **Returns** a `FundamentalFrequencies`, with the status `resonant` if there are fewer than num
    independent frequencies, `not_quasi_periodic` if a strong line is no combination, or the status
    of a degree of freedom whose analysis failed; one without signal only adds no lines.

    **Raises** `ValueError` for arguments that cannot be meant; `FrequencyError` if `throw` is True.

    **Source** the procedure of Laskar 1990, *Icarus* 88, 266, with our own choice of a basis.
    """
    if not isinstance(lines, Frequencies):
        raise TypeError(
            f"lines must be what dvi.frequencies returned, got {type(lines).__name__}: "
            "dvi.fundamental_frequencies(dvi.frequencies(solution))."
        )
    if is_traced(lines.frequencies):
        raise ValueError("integer combinations are found on the host: not under jit or vmap.")
    omega, A = np.asarray(lines.frequencies), np.asarray(lines.amplitudes)
    code, resolution = np.asarray(code_of(lines.result)), np.asarray(lines.resolution)
    axes = min(lines.state_axes, omega.ndim - 1)  # of a single degree of freedom, taken out
    lead, state = omega.shape[: omega.ndim - 1 - axes], omega.shape[omega.ndim - 1 - axes : -1]
    shape = (*lead, math.prod(state))
    omega, A = (x.reshape(*shape, x.shape[-1]) for x in (omega, A))
    code, resolution = code.reshape(shape), resolution.reshape(shape)
    search = _search(omega.shape[-2], num, guess, order, tolerance, threshold)
    tori, codes = _tori(omega, A, code, resolution, search, soft=True)
    found = _gathered(tori, codes, omega.shape, search.num)
    return raise_on_failure(found) if throw else found


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
    H = ωJ. J belongs to the frequencies beside it: for ω' = Mω, J' = M⁻ᵀ J. So that neither the
    lines found nor their errors depend on the units, z_j is taken as q_j/s_j − i s_j p_j, which is
    canonical and leaves J as it is; s_{j}² = rms Δ²q_j / rms Δ²p_j, of second differences: they
    weigh the weak lines of high frequency, on which the accuracy depends. s_j = 1 where q_j or p_j
    is constant.

    **Arguments**

    - `ts`: a `Solution`; or times, shape (N,), with `signal`: q_j − i p_j of canonical q and p,
      shape (*batch, n, N), or (N,) for one degree of freedom. A trajectory fills a torus that can
      be contracted in phase space: an angle that rotates is no sum of lines.
    - `count`: lines for each degree of freedom; `window`: see `frequencies`.
    - `num`, `guess`, `order`: see `fundamental_frequencies`.
    - `leftover`: root of the mean square of what is no combination of num frequencies, over
      2 rms q_j rms p_j (about their means; it is 2J of an oscillator), from which on the motion is
      not quasi-periodic. The same in all units.
    - `throw`: raise if a trajectory has another status than `successful`.

    The Fourier transforms run on the device, the rest on the host: not under jit or vmap.

    **Returns** an `Actions`.

    **Raises** as `frequencies` and `fundamental_frequencies`; `TypeError` for a real signal.

    **Accuracy** the square of the residual, times the order k of what is left over: `errors`. The
    lines of a smooth torus fall off exponentially, so that more lines help fast. An action whose
    error is as large as ½Σ|k_a||z|², or as the largest of the actions, makes the status
    `not_quasi_periodic`; one that is small because its lines cancel is given with its error.

    **Source** our own, from the definition; compare Binney & Spergel 1984, *Mon. Not. R. Astron.
    Soc.* 206, 159, and Laskar 1999, in *Hamiltonian Systems with Three or More Degrees of
    Freedom*, 134.
    """
    settings = settings_of(count, window, True)
    if isinstance(ts, Solution):
        ts, signal, eps, axes = signals_of(ts, signal)
        lead, N = signal.shape[: signal.ndim - 1 - axes], signal.shape[-1]
        signal = signal.reshape(*lead, math.prod(signal.shape[len(lead) : -1]), N)
        if ts.ndim > 1:
            ts = ts.reshape(*lead, 1, N)
    else:
        ts, signal, eps, _ = signals_of(ts, signal)
    if not jnp.iscomplexobj(signal):
        raise TypeError(
            "actions need q and p of every degree of freedom: the complex signal q − i p, shape "
            "(n, N), or a Solution; got a real one."
        )
    if is_traced(signal) or is_traced(ts):
        raise ValueError("actions are found on the host: not under jit or vmap. Give the batch.")
    if signal.ndim == 1:
        signal = signal[None]
    check_count(settings, signal)
    if not (_is_number(leftover) and leftover > 0):
        raise ValueError(f"leftover must be a positive number, got {leftover!r}.")
    search = _search(signal.shape[-2], num, guess, order, None, 1e-3)
    signal, scales, size = _balanced(signal)
    lines, raw = analyse(ts, signal, settings, eps, 1)
    lines, raw = _on_host(lines, raw)
    omega, A = np.asarray(lines.frequencies), np.asarray(lines.amplitudes)
    resolution = np.asarray(lines.resolution)
    tori, codes = _tori(omega, A, raw.code, resolution, search, soft=False)

    lead, n = omega.shape[:-2], omega.shape[-2]
    power = np.where(np.isfinite(omega), np.abs(A) ** 2, 0.0).reshape(len(tori), n, count)
    in_doubt = np.abs(raw.amplitudes.reshape(power.shape)) ** 2
    in_doubt = np.where(power > 0, 0.0, np.where(np.isfinite(in_doubt), in_doubt, 0.0))
    size = np.asarray(size).reshape(len(tori), n)
    left = np.nan_to_num(np.asarray(lines.residual)).reshape(len(tori), n) ** 2
    J, errors = (np.full((len(tori), search.num), np.nan) for _ in range(2))
    residual = np.full(len(tori), np.nan)
    for i, torus in enumerate(tori):
        if codes[i] in range(1, len(WITHOUT_NUMBERS) + 1):
            continue
        used = power[i] * torus.matched
        lost = power[i] - used + in_doubt[i]
        total = (power[i] + in_doubt[i]).sum(axis=1) / np.maximum(1 - left[i], EPS)
        rest = left[i] * total + lost.sum(axis=1)
        over = np.where(size[i] > 0, size[i], np.where(total > 0, total, 1.0))
        residual[i] = np.sqrt(np.max(rest / over))
        if codes[i] in (0, CODE["not_quasi_periodic"]):
            codes[i] = 0 if residual[i] <= leftover else CODE["not_quasi_periodic"]
        if codes[i] == 0:
            k = torus.combinations
            of_lines = np.einsum("jk,jka->a", used, k) / 2
            gross = np.einsum("jk,jka->a", used, np.abs(k)) / 2
            largest = np.abs(k * torus.matched[..., None]).max(axis=(0, 1)) + 1
            estimate = largest * rest.sum() / 2 + 1e-14 * gross
            if (estimate < np.minimum(gross, np.abs(of_lines).max())).all():
                J[i], errors[i] = of_lines, estimate
            else:
                codes[i] = CODE["not_quasi_periodic"]
    torus = _gathered(tori, codes, omega.shape, search.num)
    found = Actions(
        actions=J.reshape(*lead, search.num),
        frequencies=np.where(np.isfinite(J.reshape(*lead, search.num)), torus.frequencies, np.nan),
        errors=errors.reshape(*lead, search.num),
        residual=residual.reshape(lead),
        scales=np.asarray(scales).reshape(*lead, n),
        torus=torus,
        lines=lines,
        result=torus.result,
    )
    return raise_on_failure(found) if throw else found


@eqx.filter_jit
def _balanced(signal: Array) -> tuple[Array, Array, Array]:
    """q/s − i s p of every q − i p, with s, and 2 rms q rms p, 0 where one of them is constant."""

    def sizes(x):
        largest = jnp.max(jnp.abs(x), axis=-1)
        unit = x / jnp.where(largest > 0, largest, 1.0)[..., None]  # squares cannot overflow
        spread, bend = jnp.std(unit, axis=-1), jnp.std(jnp.diff(unit, 2, axis=-1), axis=-1)
        return largest, spread, bend, (spread > _STILL) & (bend > 0) & (largest < jnp.inf)

    (top_q, of_q, bend_q, moves_q), (top_p, of_p, bend_p, moves_p) = (
        sizes(x) for x in (signal.real, signal.imag)
    )
    both = moves_q & moves_p
    s = jnp.where(both, top_q, 1.0) ** 0.5 / jnp.where(both, top_p, 1.0) ** 0.5
    s = s * jnp.sqrt(jnp.where(both, bend_q, 1.0) / jnp.where(both, bend_p, 1.0))
    size = jnp.where(both, 2 * (top_q * of_q) * (top_p * of_p), 0.0)
    return signal.real / s[..., None] + 1j * s[..., None] * signal.imag, s, size


def _is_number(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


def _on_host(lines: Frequencies, raw: Raw) -> tuple[Frequencies, Raw]:
    return lines, Raw(*(np.asarray(x) for x in raw))  # pyright: ignore[reportArgumentType]


class _Search(NamedTuple):
    """What is asked for, and the combinations that are tried, the simplest first."""

    num: int
    order: int
    tolerance: float | None
    threshold: float
    guess: np.ndarray | None


class _Torus(NamedTuple):
    frequencies: np.ndarray
    combinations: np.ndarray
    misfits: np.ndarray
    matched: np.ndarray
    unexplained: float


def _search(n: int, num: Any, guess: Any, order: Any, tolerance: Any, threshold: Any) -> _Search:
    if n == 0:
        raise ValueError("a torus needs at least one degree of freedom, got lines of none.")
    if guess is not None:
        try:
            guess = np.atleast_1d(np.asarray(guess, float))
        except (TypeError, ValueError):
            raise ValueError(f"guess must hold finite frequencies, got {guess!r}.") from None
    if num is None:
        num = n if guess is None else len(guess)
    if isinstance(num, bool) or not isinstance(num, int | np.integer) or num < 1:
        raise ValueError(f"num, how many frequencies there are, must be positive, got {num!r}.")
    if guess is not None and (guess.shape != (num,) or not np.isfinite(guess).all()):
        raise ValueError(f"guess must hold {num} finite frequencies, got {guess}.")
    order = _ORDERS.get(int(num), 5) if order is None else order
    if isinstance(order, bool) or not isinstance(order, int | np.integer) or order < 1:
        raise ValueError(f"order, the largest Σ|k|, must be a positive integer, got {order!r}.")
    if tolerance is not None and not (_is_number(tolerance) and 0 < tolerance < math.inf):
        raise ValueError(f"tolerance, of a frequency, must be positive, got {tolerance!r}.")
    if not (_is_number(threshold) and 0 < threshold <= 1):
        raise ValueError(
            "threshold is a share of the leading amplitude, above 0 and up to 1, got "
            f"{threshold!r}."
        )
    tolerance = None if tolerance is None else float(tolerance)
    return _Search(int(num), int(order), tolerance, float(threshold), guess)


def _tori(
    omega, A, code, resolution, search: _Search, soft: bool
) -> tuple[list[_Torus], np.ndarray]:
    """Of every trajectory the torus, and the code of its status; `soft`: a line in doubt counts."""
    n, count = omega.shape[-2:]
    M = math.prod(omega.shape[:-2])
    rows = zip(
        omega.reshape(M, n, count), A.reshape(M, n, count), code.reshape(M, n),
        resolution.reshape(M, n), strict=True,
    )  # fmt: skip
    tori, codes = [], []
    for nu, a, status, width in rows:
        silent = status == CODE["no_signal"]
        hard = (status > 0) & (status <= len(WITHOUT_NUMBERS)) & ~silent
        if hard.any() or silent.all():
            tori.append(_nothing(n, count, search.num))
            codes.append(status[hard][0] if hard.any() else CODE["no_signal"])
            continue
        tolerance = _SHARE * width.max() if search.tolerance is None else search.tolerance
        torus, problem = _torus(nu, np.abs(a), width.max(), tolerance, search)
        doubt = status[(status != 0) & ~silent]
        tori.append(torus)
        codes.append(doubt[0] if soft and len(doubt) else CODE[problem])
    return tori, np.array(codes, int)


def _nothing(n: int, count: int, num: int) -> _Torus:
    none = np.full((n, count), np.nan)
    no = np.zeros((n, count), bool)
    return _Torus(np.full(num, np.nan), np.zeros((n, count, num), int), none, no, np.nan)


def _torus(nu, size, resolution, tolerance, search: _Search) -> tuple[_Torus, str]:
    """The best basis, with every line in it, and the name of the status."""
    n, count = nu.shape
    there = np.isfinite(nu)
    lead = np.nanmax(np.where(there, size, 0.0), axis=1, keepdims=True)
    share = np.where(there, size, 0.0) / np.where(lead > 0, lead, 1.0)
    order = np.argsort(-share, axis=None, kind="stable")
    flat, weight = nu.ravel()[order], share.ravel()[order]
    strong = weight >= search.threshold
    best, best_score = np.zeros(0), (np.inf, np.inf)
    for basis in _bases(nu, flat[strong], resolution, tolerance, search):
        basis, k, _, matched = _fitted(basis, flat[strong], weight[strong], tolerance, search.order)
        score = (np.sum(~matched), float(np.sum(np.abs(k).sum(axis=1) * weight[strong] * matched)))
        if score[0] < best_score[0] or (
            score[0] == best_score[0] and score[1] < 0.8 * best_score[1]
        ):
            best, best_score = basis, score
        if best_score[0] == 0 and len(basis) < search.num:
            break  # all lines are explained by fewer
    known = np.where(there, nu, np.inf)
    lattice = combinations_up_to(len(best), search.order)
    k, misfit, matched = _match(best, known.ravel(), tolerance, lattice)
    pad = search.num - len(best)
    power = np.where(there, size, 0.0) ** 2
    ours = matched.reshape(n, count) & there
    total = np.where(power.sum(axis=1) > 0, power.sum(axis=1), 1.0)
    combinations = np.zeros((len(k), search.num), int)
    combinations[:, : len(best)] = np.where(matched[:, None], k, 0)
    torus = _Torus(
        np.append(best, np.full(pad, np.nan)),
        combinations.reshape(n, count, search.num),
        np.where(there, misfit.reshape(n, count), np.nan),
        ours,
        float(np.max(np.sum(power * ~ours, axis=1) / total)),
    )
    if best_score[0] > 0:
        return torus, "not_quasi_periodic"
    return torus, "resonant" if pad else "successful"


def _bases(nu, strong, resolution, tolerance, search: _Search):
    """Choices of frequencies to count in, the most natural first."""
    num, order = search.num, search.order
    if search.guess is not None:
        low = combinations_up_to(num, 4)
        k, _, close = _match(search.guess, strong, resolution / 2, low)
        used = close & (np.abs(k).sum(axis=1) > 0)
        if np.linalg.matrix_rank(k[used]) == num:
            yield np.linalg.lstsq(k[used].astype(float), strong[used], rcond=None)[0]
        else:
            yield search.guess
        return
    firsts = np.array([row[0] for row in nu if np.isfinite(row[0])])
    if len(firsts) == num and _independent(firsts, tolerance, order):
        yield firsts
    greedy = np.zeros(0)
    for line in strong:
        if len(greedy) < num and _independent(np.append(greedy, line), tolerance, order):
            greedy = np.append(greedy, line)
    yield greedy
    if len(greedy) < num:
        return
    choices = itertools.combinations(strong[: 2 * num + 6], num)
    for choice in itertools.islice(choices, _SUBSETS):
        if _independent(np.array(choice), tolerance, order):
            yield np.array(choice)


def _independent(basis: np.ndarray, tolerance: float, order: int) -> bool:
    k = combinations_up_to(len(basis), order)
    return bool(
        (np.abs(k[1:] @ basis) > tolerance * np.maximum(1, np.abs(k[1:]).max(axis=1))).all()
    )


def _fitted(basis, lines, weight, tolerance, order):
    """Least squares of the basis over the lines that are its combinations, twice."""
    lattice = combinations_up_to(len(basis), order)
    for _ in range(2):
        k, _, matched = _match(basis, lines, tolerance, lattice)
        rows = (k * weight[:, None])[matched]
        if len(basis) and np.linalg.matrix_rank(rows) == len(basis):
            basis = np.linalg.lstsq(rows, (lines * weight)[matched], rcond=None)[0]
    return basis, *_match(basis, lines, tolerance, lattice)


def _match(basis, lines, tolerance, lattice):
    """The simplest combination within the tolerance of each line, else the nearest."""
    if not len(basis):
        none = np.zeros(len(lines), bool)
        return np.zeros((len(lines), 0), int), np.where(np.isfinite(lines), lines, np.nan), none
    off = lines[:, None] - (lattice @ basis)[None, :]
    close = np.abs(off) <= tolerance
    matched = close.any(axis=1)
    at = np.where(matched, close.argmax(axis=1), np.abs(off).argmin(axis=1))
    return lattice[at], off[np.arange(len(lines)), at], matched


@functools.lru_cache(maxsize=32)
def combinations_up_to(num: int, order: int) -> np.ndarray:
    """All integer vectors with Σ|k_a| ≤ order, the simplest first: shape (M, num)."""
    table = np.zeros((1, 0), int)
    for _ in range(num):
        left = order - np.abs(table).sum(axis=1)
        table = np.concatenate([
            np.column_stack([table[left >= abs(k)], np.full((left >= abs(k)).sum(), k)])
            for k in range(-order, order + 1)
        ])  # fmt: skip
    size = np.abs(table)
    return table[
        np.argsort(size.sum(axis=1) + size.max(axis=1, initial=0) / (order + 1), kind="stable")
    ]


def _gathered(tori: list[_Torus], codes: np.ndarray, shape, num: int) -> FundamentalFrequencies:
    lead, n, count = shape[:-2], *shape[-2:]
    one = _nothing(n, count, num)  # an empty batch has shapes and types too
    stacked = [
        np.stack([np.asarray(t[i]) for t in tori]) if tori else np.asarray(one[i])[None][:0]
        for i in range(5)
    ]
    return FundamentalFrequencies(
        frequencies=stacked[0].reshape(*lead, num),
        combinations=stacked[1].reshape(*lead, n, count, num),
        misfits=stacked[2].reshape(*lead, n, count),
        matched=stacked[3].reshape(*lead, n, count),
        unexplained=stacked[4].reshape(lead),
        result=with_code(jnp.asarray(codes.reshape(lead))),
    )
