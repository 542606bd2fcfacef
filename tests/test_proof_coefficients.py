"""Exact coefficients: the form that the map conserves, and refusals of what it does not."""

from fractions import Fraction

import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi
from dvi_jax.discover.functions.basis import bind_basis
from dvi_jax.discover.invariants.series import InvariantSeries

pytest.importorskip("flint")
from dvi_jax.proof import coefficients


def spring(k=7, d=10, **more):
    """p²/2 + (k/d) q²/2, in operations without rounded constants."""
    return dvi.System(lambda t0, t1, q, p, args: p @ p / 2 + k * (q @ q) / (2 * d), **more)


def series(*orders, n=1, degree=2):
    """The invariant with such coefficients, {name: number} for each order of ε."""
    basis = bind_basis(dvi.Polynomials(degree), (n,))
    numbers = np.zeros((len(orders), basis.size))
    for row, terms in zip(numbers, orders, strict=True):
        for name, value in terms.items():
            row[basis.names.index(name)] = value
    return InvariantSeries(basis, jnp.asarray(numbers))


def energy(h, k=0.7):
    """p² + k q² − h k q p, what symplectic Euler conserves, with rounding."""
    return series({"p²": 1.0, "q²": k * (1 + 1e-14), "q p": -h * k})


@pytest.mark.parametrize("h", [1.0, 0.5, 0.25, 0.125, -0.5, 1.25])
def test_at_a_small_fraction_h_the_coefficients_are_fractions(h):
    """1, h and h² are dependent there: all forms of a coefficient are one number."""
    invariant = dvi.exact_coefficients(energy(h), h)
    values = {}
    for name, (d, *n) in zip(invariant.basis.names, invariant.numbers[0].tolist(), strict=True):
        assert n[1:] == [0, 0]
        values[name] = Fraction(n[0], d)
    k = Fraction(7, 10)
    assert values == dict.fromkeys(values, 0) | {"p²": 1, "q²": k, "q p": -Fraction(h) * k}
    with pytest.raises(ValueError, match=r"not conserved: at .* at the order ε"):
        dvi.exact_coefficients(energy(h), h, spring(7, 11))


@pytest.mark.slow
@pytest.mark.parametrize("h", [0.5, 0.1])
def test_the_map_decides_between_forms(h):
    """At h = 0.1 the number −0.7 is −1 + 3h, −7h and −7/10, to 17 digits."""
    with_map = dvi.exact_coefficients(energy(h), h, spring())
    without = dvi.exact_coefficients(energy(h), h)
    domain = np.array([0.5])
    bound = dvi.bound_drift(with_map, spring(), h=h, domain=domain, max_boxes=2)
    assert bound.per_step == (0.0,)
    if h == 0.1:
        assert str(with_map) == "7/10 q² − 7 h/10 q p + 1 p²"
        # The negative control: without the map another form is taken, which is not conserved.
        assert str(without) != str(with_map)
        assert dvi.bound_drift(without, spring(), h=h, domain=domain, max_boxes=2).per_step[0] > 0
    else:
        assert str(without) == str(with_map) == "7/10 q² − 7/20 q p + 1 p²"


def test_each_order_is_conserved():
    """k = 1 + 7ε/10: the terms of order ε, which depend on those of order 1."""
    h = 0.1
    system = spring(1, 1, perturbation=lambda t0, t1, q, p, args: 7 * (q @ q) / 20)
    zero, first = {"p²": 1.0, "q²": 1.0, "q p": -h}, {"q²": 0.7, "q p": -0.7 * h}
    invariant = dvi.exact_coefficients(series(zero, first), h, system)
    assert str(invariant) == "1 q² − 1 h q p + 1 p² + 7/10 ε q² − 7 h/10 ε q p"
    with pytest.raises(ValueError, match=r"order ε.1"):
        dvi.exact_coefficients(series(zero, first | {"q²": 0.8}), h, system)
    dvi.exact_coefficients(series(zero), h, system)  # conserved at the order of the invariant


@pytest.mark.slow
def test_an_implicit_step_and_elementary_functions():
    """The angular momentum of a force that is a function of |q|, with a step that is implicit."""
    system = dvi.System(
        lambda t0, t1, q, p, args: (p @ p) * (1 + q @ q) / 2 + jnp.exp(q @ q),
    )
    momentum = series({"q1 p2": 1.0, "q2 p1": -1.0}, n=2)
    assert str(dvi.exact_coefficients(momentum, 0.1, system)) == "1 q1 p2 − 1 q2 p1"
    wrong = series({"q1 p2": 1.0, "q2 p1": -0.999}, n=2)
    with pytest.raises(ValueError, match="is not conserved"):
        dvi.exact_coefficients(wrong, 0.1, system)


def test_wrong_numbers_are_seen(monkeypatch):
    """The negative control of the comparison: forms that are those of other functions."""
    forms = coefficients._forms
    monkeypatch.setattr(coefficients, "_forms", lambda ratio, h, e: forms(1.01 * ratio, h, e))
    with pytest.raises(ValueError, match=r"but the discovered one is .* be the same"):
        dvi.exact_coefficients(energy(0.5), 0.5)


def test_what_has_no_form():
    with pytest.raises(ValueError, match=r"q² over the largest, 0.4714.* has no form"):
        dvi.exact_coefficients(energy(0.5, np.sqrt(2) / 3), 0.5)
    with pytest.raises(ValueError, match="h must be"):
        dvi.exact_coefficients(energy(0.5), 0.0)
