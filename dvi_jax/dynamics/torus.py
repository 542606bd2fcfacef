"""Fundamental frequencies: the integer combinations that the lines of a torus are."""

import functools
import itertools
import math
from typing import Any, NamedTuple

import numpy as np

from lanewise.jaxapi import is_traced

from .._checks import instance, positive, whole
from .frequencies import Frequencies
from .results import (
    CODE,
    FREQUENCY_RESULTS,
    WITHOUT_NUMBERS,
    WithStatus,
    code_of,
    raise_on_failure,
    with_code,
)

_SHARE = 1e-2
"""Tolerance of a combination, over the resolution."""

_ORDERS = {1: 64, 2: 20, 3: 12, 4: 8, 5: 6}
"""Largest Σ|k_a| by the number of frequencies; 5 for more: some thousand combinations each."""

_SUBSETS = 300
"""Choices of lines that are tried as a basis."""


class FundamentalFrequencies(WithStatus):
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
    hint = "dvi.fundamental_frequencies(dvi.frequencies(solution))."
    instance("lines", lines, Frequencies, "what dvi.frequencies returned", hint)
    if is_traced(lines.frequencies):
        raise ValueError("integer combinations are found on the host: not under jit or vmap.")
    omega, A = np.asarray(lines.frequencies), np.asarray(lines.amplitudes)
    code, resolution = np.asarray(code_of(lines.result)), np.asarray(lines.resolution)
    axes = min(lines.state_axes, omega.ndim - 1)  # of a single degree of freedom, taken out
    lead, state = omega.shape[: omega.ndim - 1 - axes], omega.shape[omega.ndim - 1 - axes : -1]
    shape = (*lead, math.prod(state))
    omega, A = (x.reshape(*shape, x.shape[-1]) for x in (omega, A))
    code, resolution = code.reshape(shape), resolution.reshape(shape)
    search = search_of(omega.shape[-2], num, guess, order, tolerance, threshold)
    tori, codes = tori_of(omega, A, code, resolution, search, soft=True)
    found = gathered(tori, codes, omega.shape, search.num)
    return raise_on_failure(found) if throw else found


class Search(NamedTuple):
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


def search_of(n: int, num: Any, guess: Any, order: Any, tolerance: Any, threshold: Any) -> Search:
    if n == 0:
        raise ValueError("a torus needs at least one degree of freedom, got lines of none.")
    if guess is not None:
        try:
            guess = np.atleast_1d(np.asarray(guess, float))
        except (TypeError, ValueError):
            raise ValueError(f"guess must hold finite frequencies, got {guess!r}.") from None
    if num is None:
        num = n if guess is None else len(guess)
    num = whole("num", num, hint="It is the number of frequencies.")
    if guess is not None and (guess.shape != (num,) or not np.isfinite(guess).all()):
        raise ValueError(f"guess must hold {num} finite frequencies, got {guess}.")
    order = _ORDERS.get(num, 5) if order is None else whole("order", order, hint="It is Σ|k|.")
    tolerance = None if tolerance is None else positive("tolerance", tolerance)
    fraction = "It is a fraction of the leading amplitude."
    if positive("threshold", threshold, hint=fraction) > 1:
        raise ValueError(f"threshold must be at most 1, got {threshold!r}. {fraction}")
    return Search(num, order, tolerance, float(threshold), guess)


def tori_of(
    omega, A, code, resolution, search: Search, soft: bool
) -> tuple[list[_Torus], np.ndarray]:
    """Of every trajectory the torus, and the code of its status; `soft`: a line in doubt counts."""
    n, count = omega.shape[-2:]
    M = math.prod(omega.shape[:-2])
    lines = (x.reshape(M, n, count) for x in (omega, A))
    signals = (x.reshape(M, n) for x in (code, resolution))
    tori, codes = [], []
    for nu, a, status, width in zip(*lines, *signals, strict=True):
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


def _torus(nu, size, resolution, tolerance, search: Search) -> tuple[_Torus, str]:
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


def _bases(nu, strong, resolution, tolerance, search: Search):
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
        fits = {k: left >= abs(k) for k in range(-order, order + 1)}
        table = np.concatenate(
            [np.column_stack([table[fit], np.full(fit.sum(), k)]) for k, fit in fits.items()]
        )
    size = np.abs(table)
    return table[
        np.argsort(size.sum(axis=1) + size.max(axis=1, initial=0) / (order + 1), kind="stable")
    ]


def gathered(
    tori: list[_Torus], codes: np.ndarray, shape: tuple[int, ...], num: int
) -> FundamentalFrequencies:
    """The tori of a batch of lines of this shape, (*batch, n, count)."""
    lead, n, count = shape[:-2], *shape[-2:]
    some = tori or [_nothing(n, count, num)]  # an empty batch has shapes and types too
    parts = (np.stack(part)[: len(tori)] for part in zip(*some, strict=True))
    parts = (x.reshape((*lead, *x.shape[1:])) for x in parts)
    return FundamentalFrequencies(*parts, result=with_code(codes.reshape(lead)))
