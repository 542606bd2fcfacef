"""Series in ε in pairs of numbers: secular terms that float64 does not distinguish from zero."""

import warnings
from fractions import Fraction
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi
from dvi_jax.discover.algebra.block_triangular import BlockTriangular, larger_than
from dvi_jax.discover.algebra.pair_series import staircase
from dvi_jax.discover.functions.sampling import as_samples
from dvi_jax.discover.invariants.changes import StepMap, terms_in_pairs
from dvi_jax.engine.pair_matrices import Left, plus, zeros
from dvi_jax.engine.pairs import Pair
from dvi_jax.methods.step import Equations


def exact(x, *index):
    """An element of a matrix of pairs."""
    return Fraction(float(x.hi[index])) + Fraction(float(x.lo[index]))


def random_pair(rng, *shape):
    hi = rng.normal(size=shape) * 10.0 ** rng.uniform(-3, 3, shape)
    return Pair(hi, 2.0**-54 * rng.uniform(-1, 1, shape) * hi)


@pytest.mark.parametrize("columns", [1, 7, 600])
def test_products_of_matrices_have_31_digits(columns):
    rng = np.random.default_rng(columns)
    x, y = random_pair(rng, 2, columns), random_pair(rng, columns, 3)
    product = Left(x) @ y
    for i, j in np.ndindex(2, 3):
        right = sum(exact(x, i, k) * exact(y, k, j) for k in range(columns))
        size = np.max(np.abs(x.hi[i])) * np.max(np.abs(y.hi[:, j])) * np.sqrt(columns)
        assert abs(exact(product, i, j) - right) < 2.0**-102 * size
        assert abs(Fraction(float((x.hi @ y.hi)[i, j])) - right) > 2.0**-80 * size  # in float64


def conditions(secular):
    """A_0 … A_3 with three null vectors of A_0. The first is lost at order 1, and the second at
    order 3. The third has a secular term of the size `secular` at order 3."""
    rng = np.random.default_rng(0)
    terms = rng.normal(size=(4, 40, 9))
    terms[0, :, -3:] = 0.0
    terms[1:, :, :4] = 0.0  # so that the corrections have no defects of their own
    terms = [Pair(x, np.zeros_like(x)) for x in terms]
    for m in range(1, 4):
        in_range = Left(terms[0].hi[:, :4]) @ rng.normal(size=(4, 2))
        for hidden, column in ((0, -2), (1, -1)):
            if hidden or m < 3:
                for part, x in zip(terms[m], in_range, strict=True):
                    part[:, column] = x[:, hidden]
    end = Pair(*(x[:, -1:] for x in terms[3]))
    # The first one, two orders later, cancels this.
    end = plus(end, 2.0 * terms[1].hi[:, -3:-2])
    for part, x in zip(terms[3], plus(end, secular * rng.normal(size=(40, 1))), strict=True):
        part[:, -1:] = x
    return terms


@pytest.mark.parametrize(("secular", "count"), [(0.0, 1), (1e-22, 0), (1e-6, 0)])
def test_null_vectors_with_a_tiny_secular_term_are_lost(secular, count):
    terms = conditions(secular)
    steps = staircase(terms, np.eye(9), noise=1e-31)
    assert [step.series.hi.shape[1] for step in steps] == [3, 2, 2, count]
    assert sum(step.unclear for step in steps) == 0
    in_float64 = BlockTriangular(np.stack([x.hi for x in terms], axis=1), larger_than(1e-10))
    assert in_float64.null(3)[0].shape[2] == (count if secular == 1e-6 else 1)
    for k, step in enumerate(steps):
        left = zeros(40, step.series.hi.shape[1])
        for m in range(k + 1):
            c = Pair(*(x[m * 9 : (m + 1) * 9] for x in step.series))
            left = plus(left, Left(terms[k - m]) @ c)
        assert np.max(np.abs(left.hi), initial=0.0) < 1e-29
        assert step.nonzero.min(initial=1.0) > 1e-24


# q'' = −q − ε (q² + args p)
DAMPED = dvi.System(
    lambda t0, t1, q, p, args: (p @ p + q @ q) / 2,
    force=lambda t0, t1, q, p, args: -(q**2) - args * p,
)


def find(degree, order, system=DAMPED, args=0.0, **how):
    """What is found with two samples for each function."""
    basis = dvi.Polynomials(degree)
    count = 2 * basis.for_shape((1,)).size + 20
    samples = np.random.default_rng(0).uniform(-0.5, 0.5, (2, count, 1))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # above order 6
        return dvi.discover_invariants(
            system, basis, order, h=0.1, samples=samples, args=args, **how
        )


@pytest.mark.slow
def test_terms_in_pairs_are_those_of_exact_arithmetic():
    """Polynomials in ε: with p1 = p + h (−q − ε q²), q1 = q + h p1."""
    basis, h = dvi.Polynomials(4).for_shape((1,)), Fraction(0.1)
    monomials: Any = basis.function
    samples = as_samples(np.random.default_rng(0).uniform(-0.5, 0.5, (2, 3, 1)))
    stepped = StepMap(Equations(DAMPED, jnp.zeros(()), 0.0), np.asarray(0.1), dvi.TypeII(), basis)
    terms = terms_in_pairs(stepped, 3, samples)
    for i, (q, p) in enumerate(zip(samples.q[:, 0], samples.p[:, 0], strict=True)):
        q, p = Fraction(float(q)), Fraction(float(p))
        p1 = p - h * q, -h * q**2
        q1 = q + h * p1[0], h * p1[1]
        for j, powers in enumerate(monomials.counts.tolist()):
            series = [Fraction(1)]
            for factor, power in zip((q1, p1), powers, strict=True):
                for _ in range(power):
                    shifted = [Fraction(0), *(x * factor[1] for x in series)]
                    series = [x * factor[0] for x in series] + [Fraction(0)]
                    series = [x + y for x, y in zip(series, shifted, strict=True)]
            series[0] -= q ** powers[0] * p ** powers[1]
            for m in range(4):
                known = series[m] if m < len(series) else 0
                assert abs(exact(terms, i, m, j) - known) < 1e-32
    assert float(np.max(np.abs(terms.lo))) > 1e-20


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rate", "arithmetic", "count"),
    [
        (1e-14, dvi.FloatingPoint(), 1),  # wrong
        (1e-14, dvi.DoubleDouble(), 0),
        pytest.param(1e-40, dvi.DoubleDouble(), 1, marks=pytest.mark.slow),  # below 31 digits
    ],
)
def test_a_tiny_damping_is_seen_in_pairs_and_not_in_float64(rate, arithmetic, count):
    """With damping the energy has no correction of order 1."""
    found = find(4, 1, args=rate, arithmetic=arithmetic)
    assert found.survivors == (2, count)
    assert found.count == count
    assert not found.undecided
    assert found.gap > 1e10


def test_a_tolerance_is_rejected_in_pairs():
    with pytest.raises(ValueError, match=r"tolerance=0.001 is for approximate invariants"):
        find(4, 1, tolerance=1e-3, arithmetic=dvi.DoubleDouble())


@pytest.mark.slow
def test_order_eight_is_decided_in_pairs():
    """The square of the energy has no correction of order 7 in polynomials of degree 10, which
    its term of degree 11 shows; in float64 it passes."""
    assert find(10, 8).survivors == (5, 4, 4, 3, 3, 2, 2, 2, 2)
    integrator = dvi.Integrator(arithmetic=dvi.DoubleDouble(), root_finder=dvi.Newton())
    found = find(10, 8, integrator=integrator)
    assert found.survivors == (5, 4, 4, 3, 3, 2, 2, 1, 1)
    assert found.count == 1
    assert not found.warnings
    assert found.gap > 1e8
    assert np.max(found.residuals) < 1e-11  # of the coefficients in float64


@pytest.mark.slow
@pytest.mark.parametrize("method", [dvi.TypeII(), dvi.Strang(), dvi.GaussLegendre(2)])
def test_implicit_steps_in_pairs(method):
    """With q·p in H_D each step requires a solve; the counts are those of float64."""
    system = dvi.System(
        lambda t0, t1, q, p, args: (p @ p + q @ q) / 2 + q @ p / 4,
        force=lambda t0, t1, q, p, args: -(q**3),
    )
    in_float64 = find(4, 1, system, method=method)
    found = find(4, 1, system, method=method, arithmetic=dvi.DoubleDouble())
    assert found.survivors == in_float64.survivors == (2, 1)
    assert found.gap > 1e20
    assert in_float64.gap < 1e16
