"""The order of a composition, from its coefficients alone."""

import functools
import itertools
import math

Word = tuple[int, ...]


@functools.lru_cache(maxsize=64)
def order_defects(
    coefficients: tuple[float, ...], order: int, base_order: int = 1, symmetric_base: bool = False
) -> tuple[float, ...]:
    r"""How far … ∘ Φ*_{c₂h} ∘ Φ_{c₁h} is from the exact flow, one number for each power of h.

    As operators on functions the base map and its adjoint are

        Φ_h = exp(hX₁ + h²X₂ + h³X₃ + …),    Φ*_h = exp(hX₁ − h²X₂ + h³X₃ − …)

    where X₁ is the vector field of the equations. A product of such exponentials is a series of
    words X_i X_j X_k …, of degree n = i + j + k + … with h^n. The composition is of order r when
    those of degree 1 to r are the words of exp(hX₁). For a base of order s the generators X₂, …,
    X_s are zero, for a symmetric one all with even index.

    **Returns** for each degree n = 1, …, `order` the largest |coefficient of a word − that in
    exp(hX₁)|, in units of max(1, (Σ|c_i|)^n / n!), the size of what cancels.

    **Source** Hairer, Lubich & Wanner 2006, *Geometric Numerical Integration*, III.4–5 (the
    Baker–Campbell–Hausdorff formula and order conditions), III.3 (the same by trees).
    """
    letters = [1, *range(base_order + 1, order + 1)]
    if symmetric_base:
        letters = [k for k in letters if k % 2 == 1]
    words = _words(order, letters)
    # The product of two series is a convolution: a word is cut in two at every place.
    product = {word: float(word == ()) for word in words}
    # Operators on functions compose in reverse: c₁, which acts first, is the left factor.
    for c, sign in zip(coefficients, itertools.cycle((1, -1))):
        factor = {word: _in_exponential(word, c, sign) for word in words}
        product = {
            word: sum(product[word[:i]] * factor[word[i:]] for i in range(len(word) + 1))
            for word in words
        }
    length = math.fsum(abs(c) for c in coefficients)
    worst = [0.0] * (order + 1)
    for word in words:
        exact = 1 / math.factorial(len(word)) if set(word) <= {1} else 0.0
        # Terms of this size cancel in the sum: their round-off is not a defect of the coefficients.
        unit = max(1.0, length ** sum(word) / math.factorial(sum(word)))
        worst[sum(word)] = max(worst[sum(word)], abs(product[word] - exact) / unit)
    return tuple(worst[1:])


def _words(degree: int, letters: list[int]) -> list[Word]:
    """All words of letters whose sum is at most `degree`, the empty one included."""
    heads = [letter for letter in letters if letter <= degree]
    return [(), *((head, *tail) for head in heads for tail in _words(degree - head, letters))]


def _in_exponential(word: Word, c: float, sign: int) -> float:
    """Coefficient of a word in exp(Σ_k sign^{k−1} c^k X_k)."""
    # A word of n letters occurs once in the n-th power of the exponent, which is divided by n!.
    degree = sum(word)
    return sign ** (degree - len(word)) * c**degree / math.factorial(len(word))
