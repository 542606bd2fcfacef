"""Coefficients without rounding, closed forms, and the report of a search for invariants."""

import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi
from dvi_jax.discover.invariants.digits import LinearConditions, closed_form, digits_of

MAGNETIC = dvi.System(
    lambda t0, t1, q, p, args: (p[0] ** 2 + (p[1] - q[0]) ** 2) / 2,
    perturbation=lambda t0, t1, q, p, args: -(p[1] - q[0]) * q[0] ** 2 / 2,
)
"""A charge in the field 1 + εx: p2 is conserved exactly."""
QUARTIC = dvi.System(lambda t0, t1, q, p, args: p @ p / 2 + (q @ q) ** 2 / 4)
SPRING = dvi.System(
    lambda t0, t1, q, p, args: (p @ p + q @ q) / 2, force=lambda t0, t1, q, p, args: -(q**3)
)


def samples(n, count=400):
    return tuple(np.random.default_rng(0).uniform(-1, 1, (2, count, n)))


def discover(system, degree, order=0, n=2, **how):
    basis = dvi.Polynomials(degree)
    return dvi.discover_invariants(system, basis, order, h=0.1, samples=samples(n), **how)


@pytest.mark.slow
def test_exact_coefficients():
    """Its coefficients of order 1 were 1e-10, and its drift was reported as ε^4.8."""
    found = discover(MAGNETIC, 4, 1, representative="simplest")
    c = np.asarray(found.coefficients[0])
    assert (np.count_nonzero(c), c[0, found.basis.names.index("p2")]) == (1, 0.5)
    run = {"h": 0.1, "num_steps": 200, "epsilons": [0.01, 0.03, 0.1, 0.3]}
    order = dvi.drift_order(MAGNETIC, found.invariants[0], [0.3, 0.2], [0.1, 0.5], **run)
    np.testing.assert_array_equal(order.drifts, 0)
    assert str(order).startswith("no order: conserved to round-off at every ε")
    # The negative control: the other invariant has a correction, and drifts.
    order = dvi.drift_order(MAGNETIC, found.invariants[1], [0.3, 0.2], [0.1, 0.5], **run)
    assert 1.5 < order.slope < 2.5
    # Those of q³p³ and q²p⁴ in order 2 are 10 and −50 over 1 172 229 201, by rational algebra.
    (series,) = discover(SPRING, 8, 2, n=1, representative="simplest").invariants
    c = dict(zip(series.basis.names, np.asarray(series.coefficients[2]), strict=True))
    assert c["q³ p³"] == pytest.approx(10 / 1172229201, rel=1e-3)
    assert c["q² p⁴"] == pytest.approx(-50 / 1172229201, rel=1e-3)
    assert sum(value != 0 for value in c.values()) == 5
    known = series.recognised
    assert {known[x] for x in ("0.251256", "0.0502513", "0.00251256")} == {
        "50/199",
        "10/199",
        "1/398",
    }
    # The estimated errors are not much smaller than the true ones, nor much larger.
    error = abs(np.asarray(series.coefficients[1]) - 50 / 199).min()
    (estimate,) = series.errors[1, np.array(series.basis.names) == "q⁴"]
    assert error < 3 * estimate < 1e-11


def test_rounding_is_removed_and_small_terms_are_not():
    rows = np.random.default_rng(0).normal(size=(200, 6))
    truth = np.array([1.0, 0.3, 1e-9, 0.0, 0.0, 0.0])
    rows[:, 0] = -rows[:, 1:] @ truth[1:]
    conditions = LinearConditions.from_terms(rows[:, None])

    def change(shares):
        return float(np.max(np.abs(rows @ shares[0])))

    noisy = truth + np.array([0, 0, 0, 3e-14, -2e-14, 1e-14])
    found = conditions.without_rounding(noisy[None], change)[0]
    np.testing.assert_array_equal(found != 0, truth != 0)
    np.testing.assert_allclose(found, truth, atol=1e-13)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.25, "1/4"),
        (-0.25, "−1/4"),
        (50 / 199, "50/199"),
        (np.sqrt(2) / 4, "√2/4"),
        (2 * np.sqrt(3) / 5, "2√3/5"),
        (np.pi / 6, "π/6"),
        (1.5 / np.pi, "3/(2π)"),
    ],
)
def test_closed_forms_are_recognised_to_all_digits_only(value, text):
    assert closed_form(value, 1e-13) == text
    assert closed_form(value * (1 + 1e-9), 1e-13) is None
    assert closed_form(value, 1e-2 * value) is None  # too few digits to decide


@pytest.mark.parametrize("error", [1e-14, 1e-11, 1e-8, 1e-5, 1e-3])
def test_random_numbers_are_not_recognised(error):
    numbers = 10 ** np.random.default_rng(1).uniform(-2, 1, 10_000)
    assert np.mean([closed_form(x, error * x) is not None for x in numbers]) < 1e-3


def test_formulas_show_the_digits_that_errors_leave():
    basis = dvi.Basis({"a": lambda q, p: q[0], "b": lambda q, p: p[0]}).for_shape((1,))
    c = jnp.array([[1 / 3, 0.123456789]])
    known = dvi.InvariantSeries(basis, c, errors=np.array([[1e-4, 1e-12]]))
    assert str(known) == "0.333 a + 0.123457 b"
    assert known.recognised == {}
    assert str(dvi.InvariantSeries(basis, c)) == "0.333333 a + 0.123457 b"
    np.testing.assert_array_equal(
        digits_of(np.ones(4), np.array([0, 1e-20, 0.004, 1])), [6, 6, 2, 2]
    )


@pytest.mark.slow
@pytest.mark.parametrize(("method", "order"), [(dvi.TypeII(), 1), (dvi.Strang(), 2)])
def test_an_energy_that_is_not_found_has_a_reason_and_a_remedy(method, order):
    found = discover(QUARTIC, 4, method=method)
    assert found.count == 1  # the angular momentum
    assert found.energy is not None
    assert found.energy.order == pytest.approx(order, abs=0.1)
    power = {1: "O(h)", 2: "O(h²)"}[order]
    assert f"energy is conserved to {power} only by this map" in str(found)
    assert ("dvi.ShadowHamiltonian(2)" in str(found)) == (order == 1)
    # With the tolerance that the report gives, the energy is found, and no more.
    nearly = discover(QUARTIC, 4, method=method, tolerance=found.energy.tolerance)
    assert nearly.survivors == (3,)
    assert [np.count_nonzero(c) > 2 for c in nearly.coefficients] == [False, True]
    assert nearly.energy is None


@pytest.mark.slow
def test_the_report_is_in_plain_words(tmp_path):
    found = discover(QUARTIC, 4)
    text = str(found)
    assert text.startswith("1 independent conserved quantity among the combinations of 69 ")
    assert "combinations conserved: 2 for ε = 0;" in text
    assert "functions of these that are conserved too: 1" in text
    assert 0 < found.seconds < 600
    found.save(tmp_path / "found.npz")
    again = dvi.Discovery.load(tmp_path / "found.npz", dvi.Polynomials(4))
    assert (str(again), again.energy) == (text, found.energy)
    np.testing.assert_array_equal(again.errors, found.errors)
    assert "add it to the basis, which lacks it" in str(discover(QUARTIC, 3))
    found = discover(dvi.System(SPRING.H_D), 2, n=1)
    assert (found.count, found.energy) == (1, None)
    assert "energy is" not in str(found)
