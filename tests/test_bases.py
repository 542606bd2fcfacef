"""Bases of functions of (q, p, t): names, values, sums and products."""

import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi


def test_monomials_are_what_their_names_say():
    basis = dvi.Polynomials(3, constant=True).for_shape((2,))
    q, p = np.array([2.0, 3.0]), np.array([5.0, 7.0])
    values = dict(zip(basis.names, basis(q, p), strict=True))
    assert basis.size == 35
    assert values["1"] == 1
    assert values["q1² p2"] == 2**2 * 7
    assert values["q1 q2 p1"] == 2 * 3 * 5
    assert values["p2³"] == 7**3
    some = dvi.Polynomials(2, variables=["q2", "p1"]).for_shape((2,))
    assert some.names == ("q2", "p1", "q2²", "q2 p1", "p1²")
    with pytest.raises(ValueError, match=r"variable 'x', but .* are q1, q2"):
        dvi.Polynomials(2, variables=["x"]).for_shape((2,))


def test_bases_add_and_multiply():
    radius = dvi.Basis({"1/r": lambda q, p: 1 / jnp.sqrt(q @ q)})
    basis = (dvi.Polynomials(1, constant=True) * radius + dvi.Polynomials(1)).for_shape((2,))
    assert basis.names[:2] == ("1/r", "q1 1/r")
    assert basis.size == 9
    q, p = np.array([3.0, 4.0]), np.array([5.0, 7.0])
    np.testing.assert_allclose(basis(q, p)[:3], [0.2, 0.6, 0.8])


def test_families_have_the_functions_that_their_names_say():
    basis = dvi.Chebyshev(6, "t", domain=[0.0, 4.0]).for_shape(())
    t = 1.3
    expected = [np.polynomial.chebyshev.chebval(t / 2 - 1, np.eye(6)[k]) for k in range(6)]
    np.testing.assert_allclose(basis(0.0, 0.0, t), expected, rtol=1e-13)
    assert basis.names[:3] == ("1", "T1(t)", "T2(t)")
    assert basis.uses_time
    assert not dvi.Chebyshev(6, "q").for_shape(()).uses_time
    basis = dvi.Trigonometric(2, "q", period=np.pi, constant=True).for_shape(())
    np.testing.assert_allclose(
        basis(0.3, 0.0), [1, np.cos(0.6), np.sin(0.6), np.cos(1.2), np.sin(1.2)]
    )
    assert basis.names == ("1", "cos 2q", "sin 2q", "cos 4q", "sin 4q")
    q, p = np.array([3.0, 4.0]), np.array([0.6, 0.8])
    basis = dvi.Radial([-1, 0, 3]).for_shape((2,))
    np.testing.assert_allclose(basis(q, p), [0.2, 1, 125])
    assert basis.names == ("1/r", "1", "r³")
    of_p = dvi.Radial(variables=["p1", "p2"]).for_shape((2,))
    np.testing.assert_allclose(of_p(q, p), [1.0])


def test_formulas_and_functions_of_time():
    basis = dvi.Polynomials(1, constant=True).for_shape(())
    assert basis.names == ("1", "q", "p")
    assert basis.formula([0.5, 1.0, -2.0]) == "0.5 + q − 2 p"
    assert basis.formula([-1.0, 0.0, 0.0]) == "−1"
    assert basis.formula([0.0, 0.0, 0.0]) == "0"
    timed = dvi.Basis({"q t": lambda q, p, t: q * t}).for_shape(())
    plain = dvi.Basis({"q": lambda q, p: q}).for_shape(())
    assert (timed.uses_time, plain.uses_time) == (True, False)
    assert float(timed(2.0, 0.0, 3.0)[0]) == 6
    product = dvi.Polynomials(2, variables=["q"]) * dvi.Chebyshev(2, "τ", domain=(0, 1))
    assert product.for_shape(()).names == ("q", "q T1(τ)", "q²", "q² T1(τ)")
    assert product.for_shape(()).uses_time


@pytest.mark.parametrize(
    ("make", "error", "says"),
    [
        (lambda: dvi.Chebyshev(0, "q"), ValueError, "count must be an integer of at least 1"),
        (lambda: dvi.Chebyshev(3, "q", domain=(1, 1)), ValueError, "a < b"),
        (lambda: dvi.Chebyshev(3, "x").for_shape(()), ValueError, "the variable 'x', but"),
        (lambda: dvi.Trigonometric(2, "q", period=0.0), ValueError, "period must be a positive"),
        (lambda: dvi.Radial([0.5]), ValueError, "one or more integers"),
        (lambda: dvi.Basis([]), ValueError, "at least one"),
        (lambda: dvi.Basis([lambda q: q]), TypeError, r"must take .*got \(q\)"),
        (lambda: dvi.Basis([3.0]), TypeError, "must be a function"),
    ],
)
def test_bad_families_are_refused(make, error, says):
    with pytest.raises(error, match=says):
        make()


def test_a_basis_that_is_too_large_to_search_is_refused_at_once():
    with pytest.raises(ValueError, match=r"Polynomials\(400\) of 4 variables has 1.09\d+e\+09"):
        dvi.Polynomials(400).for_shape((2,))
    assert len(dvi.Polynomials(19).for_shape((2,)).names) == 8854  # just below the limit
