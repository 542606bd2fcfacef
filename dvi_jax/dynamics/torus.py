"""Fundamental frequencies of a torus: its lines are their integer combinations."""

import functools
import itertools
import math
from typing import Any, NamedTuple

import numpy as np

from ..base.checks import finite, instance, positive, whole
from .frequencies import Frequencies
from .results import (
    CODE,
    FREQUENCY_RESULTS,
    WithStatus,
    code_of,
    lacks_numbers,
    refuse_traced,
    require_success,
    with_code,
)

_TOLERANCE = 1e-2  # Default tolerance of a combination, over the resolution
_ORDERS = {1: 64, 2: 20, 3: 12, 4: 8, 5: 6}  # Default order by the number of frequencies, else 5
_SUBSETS = 300  # Sets of lines that are tried as a basis


class FundamentalFrequencies(WithStatus):
    r"""Independent frequencies ω, and the lines as their integer combinations k·ω.

    - `frequencies`: ω [rad per unit of time], shape (num,); NaN if there are fewer.
    - `combinations`: k of every line, integers, shape (n, count, num); zeros where there is no
      line or no combination matches. n counts the degrees of freedom, all axes of the state.
    - `misfits`: line − k·ω [rad per unit of time], shape (n, count); for the nearest combination
      if none is within the tolerance, NaN where there is no line.
    - `matched`: whether it is within the tolerance, shape (n, count).
    - `unexplained`: fraction of Σ|A|² in lines that are not combinations; the largest of the
      degrees of freedom.
    - `result`: the status, one of `FREQUENCY_RESULTS`.

    The first axes are those of a batch.
    """

    frequencies: np.ndarray
    combinations: np.ndarray
    misfits: np.ndarray
    matched: np.ndarray
    unexplained: np.ndarray
    result: FREQUENCY_RESULTS


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
    r"""The independent frequencies of a torus, such that all lines are integer combinations.

        ω_line = k·ω,    k integers, Σ|k_a| ≤ order

    The sets tried as a basis are the leading lines of the degrees of freedom, then the strongest
    lines that are not combinations of stronger ones, then other sets of strong lines. The result is
    the one that leaves the fewest strong lines unexplained, with the smallest k. ω is then fitted
    by least squares to all lines that are combinations, weighted by their amplitudes. A basis is
    not unique: ω' = Mω with an integer M of determinant ±1 is another.

    **Arguments**

    - `lines`: the result of `frequencies`, shape (*batch, *state, count): each entry of the batch
      is a trajectory, the n entries of its state are its degrees of freedom. For a `Solution` both
      are known; for signals given as arrays the last axis before count is the state, and axes
      added by `vmap` are batch. To select one trajectory, index the axes of the batch only.
    - `num`: number of frequencies, by default n. Fewer for a chain whose centre of mass moves
      freely, or a degenerate system.
    - `guess`: frequencies, shape (num,), good to half the resolution, to be used as the basis.
    - `order`: largest Σ|k_a|; by default 64, 20, 12, 8, 6 for num = 1 … 5, then 5.
    - `tolerance`: of line − k·ω [rad per unit of time]; by default a hundredth of the resolution.
    - `threshold`: least amplitude of a strong line, over that of the leading line of its degree of
      freedom. Strong lines can be part of a basis, and must be combinations.
    - `throw`: raise if a trajectory has another status than `successful`.

    It runs on the CPU, in NumPy: not under jit or vmap.

    **Returns** a `FundamentalFrequencies`, with the status `resonant` if there are fewer than num
    independent frequencies, `not_quasi_periodic` if a strong line is not a combination, or the
    status of a degree of freedom whose analysis failed. One with `no_signal` has no lines, and does
    not change the status.

    **Raises** `ValueError` for invalid arguments; `FrequencyError` if `throw` is True.

    **Source** the procedure of Laskar 1990, *Icarus* 88, 266, with our own choice of a basis.
    """
    hint = "Write dvi.fundamental_frequencies(dvi.frequencies(solution))."
    instance("lines", lines, Frequencies, "a result of dvi.frequencies", hint)
    refuse_traced("fundamental_frequencies", lines.frequencies)
    omega, A = np.asarray(lines.frequencies), np.asarray(lines.amplitudes)
    code, resolution = np.asarray(code_of(lines.result)), np.asarray(lines.resolution)
    axes = min(lines.state_axes, omega.ndim - 1)  # fewer if one degree of freedom was selected
    lead, state = omega.shape[: omega.ndim - 1 - axes], omega.shape[omega.ndim - 1 - axes : -1]
    shape = (*lead, math.prod(state))
    omega, A = (x.reshape(*shape, x.shape[-1]) for x in (omega, A))
    code, resolution = code.reshape(shape), resolution.reshape(shape)
    search = search_of(omega.shape[-2], num, guess, order, tolerance, threshold)
    tori, codes = tori_of(omega, A, code, resolution, search, soft=True)
    return require_success(as_batch(tori, codes, lead), throw)


class BasisSearch(NamedTuple):
    """Number of frequencies and limits of the search."""

    num: int
    order: int
    tolerance: float | None
    threshold: float
    guess: np.ndarray | None


def search_of(n: int, num, guess, order, tolerance, threshold) -> BasisSearch:
    if n == 0:
        raise ValueError("signal or lines must have degrees of freedom, got 0.")
    if guess is not None:
        guess = np.array([finite("each frequency of guess", x) for x in np.atleast_1d(guess)])
    if num is None:
        num = n if guess is None else len(guess)
    num = whole("num", num, hint="It is the number of frequencies.")
    if guess is not None and len(guess) != num:
        raise ValueError(f"guess must have the length num = {num}, got {len(guess)}.")
    order = _ORDERS.get(num, 5) if order is None else whole("order", order, hint="It limits Σ|k|.")
    tolerance = None if tolerance is None else positive("tolerance", tolerance)
    fraction = "It is a fraction of the leading amplitude."
    if positive("threshold", threshold, hint=fraction) > 1:
        raise ValueError(f"threshold must be at most 1, got {threshold!r}.")
    return BasisSearch(num, order, tolerance, float(threshold), guess)


def tori_of(omega, A, code, resolution, search: BasisSearch, soft: bool):
    """The arrays of `FundamentalFrequencies`, each with the trajectories along its first axis, and
    the codes of their statuses; `soft`: that of an analysis with unresolved lines is kept."""
    n, count = omega.shape[-2:]
    M = math.prod(omega.shape[:-2])
    lines = (x.reshape(M, n, count) for x in (omega, A))
    signals = (x.reshape(M, n) for x in (code, resolution))
    tori, codes = [], []
    for nu, a, status, width in zip(*lines, *signals, strict=True):
        silent = status == CODE["no_signal"]
        is_hard = lacks_numbers(status) & ~silent
        if is_hard.any() or silent.all():
            tori.append(_no_torus(n, count, search.num))
            codes.append(status[is_hard][0] if is_hard.any() else CODE["no_signal"])
            continue
        tolerance = _TOLERANCE * width.max() if search.tolerance is None else search.tolerance
        torus, problem = _torus(nu, np.abs(a), width.max(), tolerance, search)
        doubt = status[(status != 0) & ~silent]
        tori.append(torus)
        codes.append(doubt[0] if soft and len(doubt) else CODE[problem])
    # An empty batch has shapes and types too.
    templates = tori or [_no_torus(n, count, search.num)]
    arrays = [np.stack(x)[: len(tori)] for x in zip(*templates, strict=True)]
    return arrays, np.array(codes, int)


def as_batch(arrays, codes: np.ndarray, lead: tuple[int, ...]) -> FundamentalFrequencies:
    """The result of `tori_of` with the axes `lead` of a batch."""
    parts = (x.reshape((*lead, *x.shape[1:])) for x in arrays)
    return FundamentalFrequencies(*parts, result=with_code(codes.reshape(lead)))


def _no_torus(n: int, count: int, num: int) -> tuple[Any, ...]:
    no_lines = np.full((n, count), np.nan)
    no_match = np.zeros((n, count), bool)
    return np.full(num, np.nan), np.zeros((n, count, num), int), no_lines, no_match, np.nan


def _torus(nu, size, resolution, tolerance, search: BasisSearch) -> tuple[tuple[Any, ...], str]:
    """The torus with the best basis, and the name of its status."""
    n, count = nu.shape
    is_line = np.isfinite(nu)
    lead = np.nanmax(np.where(is_line, size, 0.0), axis=1, keepdims=True)
    share = np.where(is_line, size, 0.0) / np.where(lead > 0, lead, 1.0)
    order = np.argsort(-share, axis=None, kind="stable")
    flat, weight = nu.ravel()[order], share.ravel()[order]
    strong, weight = flat[weight >= search.threshold], weight[weight >= search.threshold]
    best, best_score = np.zeros(0), (np.inf, np.inf)
    for basis in _bases(nu, strong, resolution, tolerance, search):
        basis, k, _, is_combination = _fit(basis, strong, weight, tolerance, search.order)
        complexity = float(np.sum(np.abs(k).sum(axis=1) * weight * is_combination))
        score = (np.sum(~is_combination), complexity)
        is_simpler = score[0] == best_score[0] and score[1] < 0.8 * best_score[1]
        if score[0] < best_score[0] or is_simpler:
            best, best_score = basis, score
        if best_score[0] == 0 and len(basis) < search.num:
            break  # fewer frequencies explain all lines
    lines = np.where(is_line, nu, np.inf)
    lattice = combinations_up_to(len(best), search.order)
    k, misfit, is_combination = _match(best, lines.ravel(), tolerance, lattice)
    pad = search.num - len(best)
    power = np.where(is_line, size, 0.0) ** 2
    explains = is_combination.reshape(n, count) & is_line
    total = np.where(power.sum(axis=1) > 0, power.sum(axis=1), 1.0)
    combinations = np.zeros((len(k), search.num), int)
    combinations[:, : len(best)] = np.where(is_combination[:, None], k, 0)
    torus = (
        np.append(best, np.full(pad, np.nan)),
        combinations.reshape(n, count, search.num),
        np.where(is_line, misfit.reshape(n, count), np.nan),
        explains,
        float(np.max(np.sum(power * ~explains, axis=1) / total)),
    )
    if best_score[0] > 0:
        return torus, "not_quasi_periodic"
    return torus, "resonant" if pad else "successful"


def _bases(nu, strong, resolution, tolerance, search: BasisSearch):
    """Sets of frequencies that may be a basis, the most natural first."""
    num, order = search.num, search.order
    if search.guess is not None:
        k, _, close = _match(search.guess, strong, resolution / 2, combinations_up_to(num, 4))
        close &= np.abs(k).sum(axis=1) > 0
        if np.linalg.matrix_rank(k[close]) == num:
            yield np.linalg.lstsq(k[close].astype(float), strong[close], rcond=None)[0]
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
    k = combinations_up_to(len(basis), order)[1:]
    return bool((np.abs(k @ basis) > tolerance * np.maximum(1, np.abs(k).max(axis=1))).all())


def _fit(basis, lines, weight, tolerance, order):
    """Fit the basis to the lines that are its combinations, by least squares, twice."""
    lattice = combinations_up_to(len(basis), order)
    for _ in range(2):
        k, _, is_combination = _match(basis, lines, tolerance, lattice)
        rows = (k * weight[:, None])[is_combination]
        if len(basis) and np.linalg.matrix_rank(rows) == len(basis):
            basis = np.linalg.lstsq(rows, (lines * weight)[is_combination], rcond=None)[0]
    return basis, *_match(basis, lines, tolerance, lattice)


def _match(basis, lines, tolerance, lattice):
    """The simplest combination within the tolerance of each line, else the nearest."""
    if not len(basis):
        no_match = np.zeros(len(lines), bool)
        return np.zeros((len(lines), 0), int), np.where(np.isfinite(lines), lines, np.nan), no_match
    misfit = lines[:, None] - (lattice @ basis)[None, :]
    close = np.abs(misfit) <= tolerance
    is_combination = close.any(axis=1)
    index = np.where(is_combination, close.argmax(axis=1), np.abs(misfit).argmin(axis=1))
    return lattice[index], misfit[np.arange(len(lines)), index], is_combination


@functools.lru_cache(maxsize=32)
def combinations_up_to(num: int, order: int) -> np.ndarray:
    """All integer vectors with Σ|k_a| ≤ order, the simplest first: shape (M, num)."""
    table = np.zeros((1, 0), int)
    for _ in range(num):
        left = order - np.abs(table).sum(axis=1)
        fits = {k: left >= abs(k) for k in range(-order, order + 1)}
        longer = [np.column_stack([table[fit], np.full(fit.sum(), k)]) for k, fit in fits.items()]
        table = np.concatenate(longer)
    size = np.abs(table)
    complexity = size.sum(axis=1) + size.max(axis=1, initial=0) / (order + 1)
    return table[np.argsort(complexity, kind="stable")]
