"""Every method on more systems than it is certified on, and what methods are made of."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ARGS, IN_EVERY_RUN, SYSTEMS, covering, flow, problem, state

import dvi_jax as dvi
from dvi_jax._step import Equations, adjoint_step, inverse_step, step
from dvi_jax._types import Interval
from dvi_jax.methods import warn_of_dissipation
from dvi_jax.methods._composition import CompositionMethod, of_strang
from dvi_jax.methods._order_conditions import order_defects
from dvi_jax.testing import (
    METHODS,
    check_inverse,
    check_reversible,
    check_symplectic,
    problems,
)

SYMPLECTIC = {k: m for k, m in METHODS.items() if m.is_symplectic}
INVERTIBLE = {k: m for k, m in METHODS.items() if m.is_invertible}
OTHERS = ["pendulum", "kepler", "double_pendulum"]
"""Systems beside those of the certificate, which are not separable and rosettes."""


def is_long(system, method):
    return system == "double_pendulum" or method not in IN_EVERY_RUN


def pairs(methods, names, shift=0):
    """(system, method), every one of both; those that take long to compile are marked slow."""
    return [
        pytest.param(s, m, marks=[pytest.mark.slow] if is_long(s, m) else [])
        for s, m in covering(names, methods, shift)
    ]


@pytest.mark.parametrize(("system", "method"), pairs(SYMPLECTIC, OTHERS))
def test_undisturbed_step_is_symplectic(system, method):
    check_symplectic(METHODS[method], problem(system))


@pytest.mark.parametrize(("system", "method"), pairs(["RungeKutta4"], OTHERS))
def test_runge_kutta_is_not(system, method):
    assert check_symplectic(METHODS[method], problem(system)).value > 1e-9


@pytest.mark.slow
def test_a_dissipative_force_contracts():
    """With the disturbance on, the same map is not symplectic: its determinant is below one."""
    step = flow(SYSTEMS["non_separable"][0], METHODS["TypeII"], 0.1, epsilon=0.3)
    M = np.asarray(jax.jit(jax.jacfwd(step))(state("non_separable")))
    assert np.linalg.det(M) < 0.99


STEPS_FOR_HIGH_ORDER = [12, 16, 24, 32, 48, 64, 72]


def measured_order(method, problem):
    """The order between the two smallest steps whose errors are above round-off, force on."""
    number = np.array([16, 32, 64, 128] if method.order <= 4 else STEPS_FOR_HIGH_ORDER)
    exact, _ = problems.reference(problem, problems.FORCED)
    advance, x = problems.flow(problem, method), problems.inputs(problem, 0.0)
    ends = [advance(x | {"h": problems.SPAN * problem.h / n}, n) for n in number]
    errors = np.array([np.max(np.abs(end - exact)) for end in ends])
    keep = errors > 1e-12
    assert keep.sum() >= 3, f"fewer than three points above round-off: {errors}"
    return -(np.diff(np.log(errors[keep])) / np.diff(np.log(number[keep])))[-1]


@pytest.mark.parametrize(("system", "method"), pairs(METHODS, ["double_pendulum"]))
def test_order_with_a_damped_and_driven_force(system, method):
    """The order is that named, on a non-separable, forced, implicit problem."""
    m = METHODS[method]
    assert abs(measured_order(m, problem(system, h=0.05)) - m.order) < 0.2


def test_a_wrong_digit_is_refused():
    """KahanLi(8) with its third digits changed, symmetric still: order 2."""
    c = list(dvi.KahanLi(8).fractions())
    for i, sign in ((0, 1), (2, -1), (-1, 1), (-3, -1)):
        c[i] += sign * 1e-3
    with pytest.raises(ValueError, match=r"have order 2, not 8.*order 3.*Claim order=2"):
        dvi.Composition(c, order=8)


def test_conditions_of_order_hold_and_the_next_ones_do_not():
    for method in METHODS.values():
        if isinstance(method, CompositionMethod):
            base = method.base
            defects = order_defects(
                method.fractions(), method.order + 1, base.order, base.is_symmetric
            )
            assert max(defects[:-1]) < 5e-16, method
            assert defects[-1] > 1e-9, method


def test_conditions_of_order_agree_with_what_is_known():
    """By hand: Σc = 1 (1), Σ±c² = 0 (2), and of a symmetric base Σc³ = 0 (3)."""
    c = (0.7, -0.2, 0.5)
    first, second = order_defects(c, 2)
    unit = max(1, 1.4**2 / 2)
    assert first == pytest.approx(0, abs=1e-16)
    assert second == pytest.approx((0.49 - 0.04 + 0.25) / unit)
    _, even, third = order_defects(c, 3, 2, True)
    assert even == pytest.approx(0, abs=1e-16)
    assert third == pytest.approx(0.343 - 0.008 + 0.125)


@pytest.mark.parametrize(
    ("coefficients", "claimed", "found"),
    [((0.5, 0.5), 3, 2), ((0.3, 0.7), 2, 1), ((0.3, 0.2, 0.2, 0.3), 4, 2), ((1.0,), 2, 1)],
)
def test_an_order_that_coefficients_do_not_have_is_refused(coefficients, claimed, found):
    assert dvi.Composition(coefficients, order=found).order == found
    with pytest.raises(ValueError, match=f"have order {found}, not {claimed}"):
        dvi.Composition(coefficients, order=claimed)


def test_printed_digits_are_enough_for_a_claim():
    """Twelve digits pass, six do not."""
    good, poor = ([round(x, n) for x in (0.784513610477557, 0.235573213359358)] for n in (12, 6))
    third = -1.177679984178871
    assert dvi.Composition(of_strang((*good, third)), order=6).is_symmetric
    with pytest.raises(ValueError, match="give more digits"):
        dvi.Composition(of_strang((*poor, third)), order=6)


@pytest.mark.parametrize(("system", "method"), pairs(INVERTIBLE, OTHERS, shift=1))
def test_inverse_undoes_the_step_with_the_force_on(system, method):
    assert check_inverse(METHODS[method], problem(system)).value < 1e-13


@pytest.mark.parametrize(("system", "method"), pairs(METHODS, OTHERS, shift=2))
def test_symmetric_methods_reverse_and_others_do_not(system, method):
    measured = check_reversible(METHODS[method], problem(system))
    assert measured.claimed == METHODS[method].is_symmetric
    assert measured.claimed or measured.value > 1e-9


@pytest.mark.slow
def test_adjoint_is_the_inverse_of_the_step_backwards():
    s, q, p = SYSTEMS["double_pendulum"]
    q, p = jnp.asarray(q), jnp.asarray(p)
    equations = Equations(s, jnp.asarray(0.3), ARGS)
    interval = Interval(jnp.asarray(0.2), jnp.asarray(0.3), jnp.asarray(0.1))
    q1, p1, _ = adjoint_step(equations, interval, q, p)
    q0, p0, _ = step(equations, interval.reversed(), q1, p1)
    np.testing.assert_allclose(q0, q, atol=1e-14)
    np.testing.assert_allclose(p0, p, atol=1e-14)
    plain, _, _ = step(equations, interval, q, p)
    assert np.max(np.abs(plain - q1)) > 1e-3  # and is another map


def test_discrete_equations_hold_for_the_step():
    """(12)–(13) as printed, evaluated by hand for H = (q² + 1)(p² + 1)/2 and W = −(1 + q²)p."""
    s = dvi.System(
        lambda t0, t1, q, p, args: jnp.sum((q**2 + 1) * (p**2 + 1)) / 2,
        force=lambda t0, t1, q, p, args: -(1 + q**2) * p,
    )
    q0, p0, h, e = 0.3, 0.4, 0.1, 0.2
    sol = dvi.integrate(s, [q0], [p0], h=h, num_steps=1, epsilon=e)
    q1, p1 = float(sol.qs[1, 0]), float(sol.ps[1, 0])
    assert abs((q1 - q0) / h - (q0**2 + 1) * p1) < 1e-14
    assert abs((p1 - p0) / h + q0 * (p1**2 + 1) + e * (1 + q0**2) * p1) < 1e-14


def test_inverse_step_solves_where_the_step_does_not():
    """H = p²(1 + q²)/2 − cos q: explicit in neither direction; H = p²/2 − cos q: in both."""
    separable = dvi.System(lambda t0, t1, q, p, args: jnp.sum(p**2) / 2 - jnp.sum(jnp.cos(q)))
    q, p = jnp.array([0.3]), jnp.array([0.4])
    interval = Interval(jnp.asarray(0.0), jnp.asarray(0.1), jnp.asarray(0.1))
    for s, solves in ((separable, False), (SYSTEMS["non_separable"][0], True)):
        for f in (step, inverse_step):
            _, _, info = f(Equations(s, jnp.asarray(0.0)), interval, q, p)
            assert (int(info.iterations) > 0) == solves


def test_explicitness_is_read_from_the_system():
    spring = dvi.System(lambda t0, t1, q, p, args: args * (jnp.sum(p**2) + jnp.sum(q**2)) / 2)
    damped = dvi.System(spring.H_D, force=lambda t0, t1, q, p, args: -p)
    q = jnp.zeros(3)
    assert dvi.TypeII().is_explicit(spring, q, 1.0)
    assert dvi.Strang().is_explicit(spring, q, 1.0)
    assert not dvi.TypeII().is_explicit(damped, q, 1.0)
    assert dvi.Adjoint().is_explicit(damped, q, 1.0)  # the adjoint solves for q, where W has no say
    assert not dvi.Strang().is_explicit(damped, q, 1.0)
    assert dvi.TypeII().is_explicit(dvi.System(lambda t0, t1, q, p, args: p @ p / 2 + q @ q))
    with pytest.raises(ValueError, match="Give an example"):
        dvi.TypeII().is_explicit(spring)


def test_strang_is_velocity_verlet_when_separable():
    s = dvi.System(lambda t0, t1, q, p, args: jnp.sum(p**2) / 2 - jnp.sum(jnp.cos(q)))
    q, p, h = 0.5, 0.3, 0.1
    sol = dvi.integrate(s, [q], [p], h=h, num_steps=1, method=dvi.Strang())
    half = p - h / 2 * np.sin(q)
    q1 = q + h * half
    np.testing.assert_allclose(sol.qs[1], [q1], rtol=1e-15)
    np.testing.assert_allclose(sol.ps[1], [half - h / 2 * np.sin(q1)], rtol=1e-14)


def test_strang_of_the_adjoint_is_position_verlet_when_separable():
    s = dvi.System(lambda t0, t1, q, p, args: jnp.sum(p**2) / 2 - jnp.sum(jnp.cos(q)))
    q, p, h = 0.5, 0.3, 0.1
    method = dvi.Strang(base=dvi.Adjoint())
    sol = dvi.integrate(s, [q], [p], h=h, num_steps=1, method=method)
    middle = q + h / 2 * p
    p1 = p - h * np.sin(middle)
    np.testing.assert_allclose(sol.ps[1], [p1], rtol=1e-15)
    np.testing.assert_allclose(sol.qs[1], [middle + h / 2 * p1], rtol=1e-15)


def test_negative_substeps_are_told():
    assert not dvi.Strang().has_negative_substeps
    assert dvi.Yoshida(4).has_negative_substeps
    assert dvi.Composition((1.0,), base=dvi.Yoshida(4)).has_negative_substeps


def test_backwards_against_strong_dissipation_warns():
    """W = −p, Yoshida(4) goes back by 0.85 h: from εh = 0.3/0.85 on."""
    system = dvi.System(SYSTEMS["pendulum"][0].H_D, force=lambda t0, t1, q, p, args: -p)
    undamped = dvi.System(SYSTEMS["pendulum"][0].H_D)
    q, p, t0, h = jnp.array([0.4]), jnp.array([0.7]), jnp.asarray(0.0), jnp.asarray(0.1)

    def check(method, epsilon, s=system, h=h):
        equations = Equations(s, jnp.asarray(epsilon))
        warn_of_dissipation(method, equations, lambda: Interval(t0, t0 + h, h), q, p)

    with pytest.warns(UserWarning, match=r"Yoshida goes backwards by 0.85 .*by 0.306 .*Strang"):
        check(dvi.Yoshida(4), 3.6)
    with pytest.warns(UserWarning, match="order is worth little"):
        check(dvi.Adjoint(dvi.Yoshida(4)), 3.6)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check(dvi.Yoshida(4), 3.5)
        check(dvi.Strang(), 50.0)
        check(dvi.Yoshida(4), 50.0, undamped)
        check(dvi.Yoshida(4), -50.0)  # the force drives: backwards it damps
    with pytest.warns(UserWarning, match="goes backwards"):
        dvi.integrate(system, q, p, h=0.1, num_steps=2, epsilon=3.6, method=dvi.Yoshida(4))


@pytest.mark.parametrize("bad", [(), (0.5, 0.6), (np.nan, 1.0)])
def test_composition_refuses_inconsistent_coefficients(bad):
    with pytest.raises(ValueError, match="sum to 1"):
        dvi.Composition(bad)


@pytest.mark.parametrize("bad", [0.5, "half", [None]])
def test_composition_refuses_what_are_no_coefficients(bad):
    with pytest.raises(TypeError, match="sequence of numbers"):
        dvi.Composition(bad)


def test_orders_that_do_not_exist_are_refused():
    with pytest.raises(ValueError, match="orders 4, 6 and 8, got 5"):
        dvi.Yoshida(5)
    with pytest.raises(ValueError, match="order 4, got 6"):
        dvi.Suzuki(6)
    with pytest.raises(ValueError, match="orders 4 and 6, got 8"):
        dvi.BlanesMoan(8)
    with pytest.raises(ValueError, match="orders 4, 6 and 8, got 2"):
        dvi.McLachlan(2)
    with pytest.raises(ValueError, match="orders 6 and 8, got 4"):
        dvi.KahanLi(4)
    with pytest.raises(ValueError, match="from 1 to 12"):
        dvi.Composition((0.5, 0.5), order=13)
    with pytest.raises(ValueError, match="no inverse step"):
        dvi.Composition((0.5, 0.5), base=dvi.RungeKutta4())
    with pytest.raises(TypeError, match="base must be a method"):
        dvi.Composition((0.5, 0.5), base=dvi.TypeII)
    with pytest.raises(TypeError, match="base must be a method"):
        dvi.Yoshida(4, base=4)
    with pytest.raises(ValueError, match="no inverse step"):
        dvi.Strang(base=dvi.RungeKutta4())
    with pytest.raises(ValueError, match="no inverse step"):
        dvi.Adjoint(dvi.RungeKutta4())
    with pytest.raises(TypeError, match="method must be a method"):
        dvi.Adjoint(dvi.TypeII)


@pytest.mark.slow
def test_kepler_momentum_is_kept_to_round_off():
    s, q, p = SYSTEMS["kepler"]  # its disturbance is central: L survives it

    def L(t0, t1, q0, p0, q1, p1, args):
        return q1[0] * p1[1] - q1[1] * p1[0]

    def spread(method):
        sol = dvi.integrate(
            s,
            q,
            p,
            h=0.1,
            num_steps=10_000,
            epsilon=0.05,
            args=ARGS,
            method=method,
            observe=dvi.Range(L),
            save=dvi.Save(final=True),
        )
        return float(sol.observed) / 1.2

    assert spread(dvi.TypeII()) <= 1e-13
    assert spread(dvi.Strang()) <= 1e-13
    assert spread(dvi.RungeKutta4()) > 1e-6
