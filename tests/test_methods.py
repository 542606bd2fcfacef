"""Every method on more systems than it is certified on, and the parts of methods."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ARGS, IN_EVERY_RUN, SYSTEMS, covering, flow, problem, state

import dvi_jax as dvi
from dvi_jax.base.types import Interval
from dvi_jax.methods import warn_of_dissipation
from dvi_jax.methods._order_conditions import order_defects
from dvi_jax.methods.step import Equations, inverse_step, step
from dvi_jax.testing import METHODS, check_inverse, check_reversible, check_symplectic, problems

SYMPLECTIC = {k: m for k, m in METHODS.items() if m.is_symplectic}
INVERTIBLE = {k: m for k, m in METHODS.items() if m.is_invertible}
OTHERS = ["pendulum", "kepler", "double_pendulum"]
"""Systems besides those of the certificate, which are not separable and rosettes."""
SEPARABLE = dvi.System(lambda t0, t1, q, p, args: jnp.sum(p**2) / 2 - jnp.sum(jnp.cos(q)))


def pairs(methods, names, shift=0):
    """(system, method), every one of both; those that take long to compile are marked slow."""

    def is_long(system, method):
        return system == "double_pendulum" or method not in IN_EVERY_RUN

    return [
        pytest.param(s, m, marks=[pytest.mark.slow] if is_long(s, m) else [])
        for s, m in covering(names, methods, shift)
    ]


@pytest.mark.parametrize(
    ("system", "method"), [*pairs(SYMPLECTIC, OTHERS), *pairs(["RungeKutta4"], OTHERS)]
)
def test_symplectic_methods_are_and_runge_kutta_is_not(system, method):
    measured = check_symplectic(METHODS[method], problem(system))
    assert method in SYMPLECTIC or measured.value > 1e-9


@pytest.mark.slow
def test_a_dissipative_force_contracts():
    """With the force the same map is not symplectic: its determinant is below one."""
    step = flow(SYSTEMS["non_separable"][0], METHODS["TypeII"], 0.1, epsilon=0.3)
    M = np.asarray(jax.jit(jax.jacfwd(step))(state("non_separable")))
    assert np.linalg.det(M) < 0.99


def measured_order(method, problem):
    """The order between the two smallest steps whose errors are above round-off, force on."""
    high = [12, 16, 24, 32, 48, 64, 72]
    number = np.array([16, 32, 64, 128] if method.order <= 4 else high)
    exact, _ = problems.reference(problem, problems.STRENGTH)
    advance, x = problems.flow(problem, method), problems.inputs(problem, 0.0)
    ends = [advance(x | {"h": problems.SPAN * problem.h / n}, n) for n in number]
    errors = np.array([np.max(np.abs(end - exact)) for end in ends])
    keep = errors > 1e-12
    assert keep.sum() >= 3, f"fewer than three points above round-off: {errors}"
    return -(np.diff(np.log(errors[keep])) / np.diff(np.log(number[keep])))[-1]


@pytest.mark.parametrize(("system", "method"), pairs(METHODS, ["double_pendulum"]))
def test_order_with_a_damped_and_driven_force(system, method):
    """The order is that declared, on a non-separable, forced, implicit problem."""
    m = METHODS[method]
    assert abs(measured_order(m, problem(system, h=0.05)) - m.order) < 0.2


@pytest.mark.parametrize(("system", "method"), pairs(INVERTIBLE, OTHERS, shift=1))
def test_inverse_undoes_the_step_with_the_force_on(system, method):
    assert check_inverse(METHODS[method], problem(system)).value < 1e-13


@pytest.mark.parametrize(("system", "method"), pairs(METHODS, OTHERS, shift=2))
def test_symmetric_methods_reverse_and_others_do_not(system, method):
    measured = check_reversible(METHODS[method], problem(system))
    assert measured.claimed == METHODS[method].is_symmetric
    assert measured.claimed or measured.value > 1e-9


def test_order_conditions_hold_and_the_next_ones_do_not():
    for method in METHODS.values():
        if hasattr(method, "fractions"):
            base, order = method.base, method.order + 1
            defects = order_defects(method.fractions(), order, base.order, base.is_symmetric)
            assert max(defects[:-1]) < 5e-16, method
            assert defects[-1] > 1e-9, method


def test_order_conditions_agree_with_those_by_hand():
    """Σc = 1 (1), Σ±c² = 0 (2), and of a symmetric base Σc³ = 0 (3)."""
    c = (0.7, -0.2, 0.5)
    first, second = order_defects(c, 2)
    assert first == pytest.approx(0, abs=1e-16)
    assert second == pytest.approx((0.49 - 0.04 + 0.25) / max(1, 1.4**2 / 2))
    _, even, third = order_defects(c, 3, 2, True)
    assert even == pytest.approx(0, abs=1e-16)
    assert third == pytest.approx(0.343 - 0.008 + 0.125)


def wrong_digits():
    """KahanLi(8) with its third digits changed, symmetric still."""
    c = list(dvi.KahanLi(8).fractions())
    for i, sign in ((0, 1), (2, -1), (-1, 1), (-3, -1)):
        c[i] += sign * 1e-3
    return tuple(c)


@pytest.mark.parametrize(
    ("coefficients", "claimed", "found"),
    [((0.5, 0.5), 3, 2), ((0.3, 0.7), 2, 1), ((0.3, 0.2, 0.2, 0.3), 4, 2), ((1.0,), 2, 1),
     (wrong_digits(), 8, 2)],
)  # fmt: skip
def test_an_order_that_coefficients_do_not_have_is_rejected(coefficients, claimed, found):
    assert dvi.Composition(coefficients, order=found).order == found
    with pytest.raises(ValueError, match=f"at most {found}, .* got {claimed}"):
        dvi.Composition(coefficients, order=claimed)


def test_printed_digits_are_enough_for_a_claim():
    """Twelve digits pass, six do not."""

    def yoshida(digits):
        outer = [round(x, digits) for x in (0.784513610477557, 0.235573213359358)]
        outer.append(-1.177679984178871)
        coefficients = (*outer, 1 - 2 * sum(outer), *outer[::-1])
        return dvi.Composition(coefficients, order=6, base=dvi.Strang())

    assert yoshida(12).is_symmetric
    with pytest.raises(ValueError, match="conditions of order"):
        yoshida(6)


@pytest.mark.slow
def test_adjoint_is_the_inverse_of_the_step_backwards():
    s, q, p = SYSTEMS["double_pendulum"]
    q, p = jnp.asarray(q), jnp.asarray(p)
    equations = Equations(s, jnp.asarray(0.3), ARGS)
    interval = Interval(jnp.asarray(0.2), jnp.asarray(0.3), jnp.asarray(0.1))
    q1, p1, _ = dvi.Adjoint().step(equations, interval, q, p)
    q0, p0, _ = step(equations, interval.reversed(), q1, p1)
    np.testing.assert_allclose(q0, q, atol=1e-14)
    np.testing.assert_allclose(p0, p, atol=1e-14)
    plain, _, _ = step(equations, interval, q, p)
    assert np.max(np.abs(plain - q1)) > 1e-3  # and is another map


def test_discrete_equations_hold_for_the_step():
    """(12)–(13) as printed, evaluated by hand for H = (q² + 1)(p² + 1)/2 and W = −(1 + q²)p."""
    s = dvi.System(SYSTEMS["non_separable"][0].H_D, lambda t0, t1, q, p, args: -(1 + q**2) * p)
    q0, p0, h, e = 0.3, 0.4, 0.1, 0.2
    sol = dvi.integrate(s, [q0], [p0], h=h, num_steps=1, epsilon=e)
    q1, p1 = float(sol.qs[1, 0]), float(sol.ps[1, 0])
    assert abs((q1 - q0) / h - (q0**2 + 1) * p1) < 1e-14
    assert abs((p1 - p0) / h + q0 * (p1**2 + 1) + e * (1 + q0**2) * p1) < 1e-14


def test_strang_is_velocity_verlet_and_of_the_adjoint_position_verlet():
    q, p, h = 0.5, 0.3, 0.1
    half = p - h / 2 * np.sin(q)
    end = q + h * half
    middle = q + h / 2 * p
    p1 = p - h * np.sin(middle)
    for base, expected in (
        (dvi.TypeII(), (end, half - h / 2 * np.sin(end))),
        (dvi.Adjoint(), (middle + h / 2 * p1, p1)),
    ):
        sol = dvi.integrate(SEPARABLE, [q], [p], h=h, num_steps=1, method=dvi.Strang(base=base))
        np.testing.assert_allclose([sol.qs[1, 0], sol.ps[1, 0]], expected, rtol=1e-14)


def test_inverse_step_solves_where_the_step_does_not():
    """H = p²(1 + q²)/2 − cos q: explicit in neither direction; H = p²/2 − cos q: in both."""
    q, p = jnp.array([0.3]), jnp.array([0.4])
    interval = Interval(jnp.asarray(0.0), jnp.asarray(0.1), jnp.asarray(0.1))
    for s, solves in ((SEPARABLE, False), (SYSTEMS["non_separable"][0], True)):
        for f in (step, inverse_step):
            _, _, info = f(Equations(s, jnp.asarray(0.0)), interval, q, p)
            assert (int(info.iterations) > 0) == solves


def test_explicitness_is_read_from_the_system():
    spring = dvi.System(lambda t0, t1, q, p, args: args * (jnp.sum(p**2) + jnp.sum(q**2)) / 2)
    damped = dvi.System(spring.H_D, force=lambda t0, t1, q, p, args: -p)
    q = jnp.zeros(3)
    for method, explicit in (
        (dvi.TypeII(), [True, False]),
        (dvi.Strang(), [True, False]),
        (dvi.Adjoint(), [True, True]),  # it solves for q, which W does not depend on
    ):
        assert [method.is_explicit(s, q, 1.0) for s in (spring, damped)] == explicit
    assert dvi.TypeII().is_explicit(dvi.System(lambda t0, t1, q, p, args: p @ p / 2 + q @ q))
    with pytest.raises(ValueError, match="cannot be evaluated"):
        dvi.TypeII().is_explicit(spring)


def test_a_substep_backwards_against_strong_dissipation_warns():
    """W = −p, Yoshida(4) goes back by 0.85 h: from εh = 0.3/0.85 on."""
    methods = dvi.Strang(), dvi.Yoshida(4), dvi.Composition((1.0,), base=dvi.Yoshida(4))
    assert [method.has_negative_substeps for method in methods] == [False, True, True]
    system = dvi.System(SYSTEMS["pendulum"][0].H_D, force=lambda t0, t1, q, p, args: -p)
    undamped = dvi.System(SYSTEMS["pendulum"][0].H_D)
    q, p, t0, h = jnp.array([0.4]), jnp.array([0.7]), jnp.asarray(0.0), jnp.asarray(0.1)

    def check(method, epsilon, s=system, h=h):
        equations = Equations(s, jnp.asarray(epsilon))
        warn_of_dissipation(method, equations, lambda: Interval(t0, t0 + h, h), q, p)

    for method in (dvi.Yoshida(4), dvi.Adjoint(dvi.Yoshida(4))):
        with pytest.warns(UserWarning, match=r"backwards .* 0.85 h.*substep is 0\.306\. .*St"):
            check(method, 3.6)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check(dvi.Yoshida(4), 3.5)
        check(dvi.Strang(), 50.0)
        check(dvi.Yoshida(4), 50.0, undamped)
        check(dvi.Yoshida(4), -50.0)  # the force drives: backwards it damps
    with pytest.warns(UserWarning, match="substep backwards"):
        dvi.integrate(system, q, p, h=0.1, num_steps=2, epsilon=3.6, method=dvi.Yoshida(4))


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        *((lambda c=c: dvi.Composition(c), ValueError, "sum to 1")
          for c in ((), (0.5, 0.6), (np.nan, 1.0))),
        *((lambda c=c: dvi.Composition(c), TypeError, "sequence of numbers")
          for c in (0.5, "half", [None])),
        *((lambda c=c, n=n: c(n), ValueError, f"{orders}, got {n}") for c, n, orders in (
            (dvi.Yoshida, 5, "4, 6, 8"), (dvi.Suzuki, 6, "must be 4"), (dvi.BlanesMoan, 8, "4, 6"),
            (dvi.McLachlan, 2, "4, 6, 8"), (dvi.KahanLi, 4, "6, 8"))),
        (lambda: dvi.Composition((0.5, 0.5), order=13), ValueError, "from 1 to 12"),
        *((lambda m=m, base=base: m(base), *error) for base, *error in (
            (dvi.RungeKutta4(), ValueError, "with an inverse step"),
            (dvi.TypeII, TypeError, "must be a method"), (4, TypeError, "must be a method"))
          for m in (lambda base: dvi.Composition((0.5, 0.5), base=base), dvi.Strang, dvi.Adjoint)),
    ],
)  # fmt: skip
def test_invalid_methods_are_rejected(make, error, message):
    with pytest.raises(error, match=message):
        make()
