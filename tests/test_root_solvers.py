"""Root solvers: the roots, derivatives and statuses of Newton's method, by fewer operations."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import covering, double_pendulum, symplectic_defect

import dvi_jax as dvi
import lanewise
from dvi_jax import systems
from dvi_jax.base.types import Interval
from dvi_jax.engine.newton import NestedNewton, Newton, find_root, relative_size
from dvi_jax.engine.picard import Picard, PicardThenNewton
from dvi_jax.engine.simplified import SimplifiedNewton, factorise
from dvi_jax.methods.step import Equations, no_step_yet
from lanewise.jaxprs.extent import operation_count

EPS = np.finfo(float).eps
MANY = PicardThenNewton(newton_up_to=0)
"""The default as it treats many unknowns, on few."""
OTHERS = {"simplified": SimplifiedNewton(), "picard": Picard(), "picard_then_newton": MANY}
EACH = pytest.mark.parametrize("name", list(OTHERS))
ONE = jnp.ones(1)


def chain(t0, t1, q0, p1, args):
    """Masses that depend on the positions, in a row: ∂²H/∂q∂p is tridiagonal."""
    d, w = jnp.diff(jnp.pad(q0, 1)), q0 * p1
    springs = jnp.sum(d**2 / 2 + 0.3 * d**4 / 4)
    return jnp.sum((1 + q0**2 / 2) * p1**2) / 2 + jnp.sum(w[1:] * w[:-1]) / 4 + springs


def drag(t0, t1, q0, p1, args):
    """W = −p."""
    return -p1


CHAIN, DAMPED_CHAIN = dvi.System(chain), dvi.System(chain, force=drag)
PENDULUMS = dvi.System(lambda t0, t1, q, p, a: p @ p / 2 - jnp.sum(jnp.cos(q)), force=drag)


def march(solver, system, q, p, h, num_steps=1, epsilon=0.0, args=None, method=dvi.TypeII()):
    """(q, p, StepInfo) after some steps: compiled in a tenth of the time of a run."""

    def steps(q, p, epsilon):
        equations = Equations(system, epsilon, args, solver)

        def step(k, state):
            q, p, so_far = state
            t0, h_ = jnp.asarray(k * h, q.dtype), jnp.asarray(h, q.dtype)
            q, p, info = method.step(equations, Interval(t0, t0 + h_, h_), q, p)
            return q, p, so_far.then(info)

        return jax.lax.fori_loop(0, num_steps, step, (q, p, no_step_yet(q)))

    return jax.jit(steps)(jnp.asarray(q), jnp.asarray(p), epsilon)


def is_good(info):
    return bool(info.result == dvi.RESULTS.successful)


def box(n, seed=0, width=0.5):
    return np.random.default_rng(seed).uniform(-width, width, (2, n))


def test_newton_finds_the_root_to_round_off_and_counts():
    root, info = find_root(lambda x: x**3 - 2, jnp.array([1.5]), 2 * ONE, Newton())
    assert abs(float(root[0]) - 2 ** (1 / 3)) < 4e-16
    assert bool(info.converged)
    assert 2 <= int(info.iterations) <= 4
    # The last correction is the root's error times the factor by which corrections shrink.
    worst, scale = map(float, info.residual)
    assert scale == 2
    assert worst < 1e-10


def test_newton_reports_that_there_is_no_root():
    _, info = find_root(lambda x: x**2 + 1, 0.3 * ONE, ONE, Newton())
    assert not bool(info.converged)
    assert int(info.iterations) == 20


@pytest.mark.parametrize(
    ("name", "most"), [("newton", 2), *((n, 3 - (n != "picard_then_newton")) for n in OTHERS)]
)
def test_nan_stops_at_once(name, most):
    """Newton's method, which continues after Picard's first iteration, stops after its second."""
    solver = {"newton": Newton(), **OTHERS}[name]
    _, info = jax.jit(lambda x: find_root(jnp.log, x, ONE, solver))(-ONE)
    assert not bool(info.converged)
    assert int(info.iterations) <= most


def test_a_slow_trajectory_does_not_change_others():
    def solve(a):
        x, info = find_root(lambda x: x + a * jnp.sin(3 * x) - 1, ONE, ONE, Newton())
        return x[0], info.iterations

    a = jnp.array([0.0, 0.1, 0.3, 5.0])
    together = jax.jit(jax.vmap(solve))(a)
    alone = [jax.jit(solve)(x) for x in a]
    # Alone and in a batch are different programs: equal up to a rounding.
    np.testing.assert_allclose(together[0][:3], [x for x, _ in alone[:3]], rtol=4e-16)
    np.testing.assert_array_equal(together[1][:3], [k for _, k in alone[:3]])


def cube_root(a):
    return find_root(lambda x: x**3 - a, ONE, ONE, Newton())[0][0]


@pytest.mark.slow
def test_root_derivatives_are_those_of_the_implicit_function():
    a = 2.0
    np.testing.assert_allclose(jax.grad(cube_root)(a), a ** (-2 / 3) / 3, rtol=1e-14)
    np.testing.assert_allclose(jax.jacfwd(cube_root)(a), a ** (-2 / 3) / 3, rtol=1e-14)
    np.testing.assert_allclose(jax.hessian(cube_root)(a), -2 / 9 * a ** (-5 / 3), rtol=1e-13)


def test_no_iteration_is_differentiated():
    # Reverse mode through a while loop would raise; one loop, the forward solve, is there.
    assert str(jax.make_jaxpr(jax.grad(cube_root))(2.0)).count(" while[") == 1


@pytest.mark.parametrize("n", [2, 5])
def test_batched_newton_calls_no_lapack(n):
    def one(x):
        def F(y):
            return y + 0.1 * jnp.sin(y) * jnp.sum(y) - x

        return jnp.sum(find_root(F, x, x, Newton())[0])

    for f in (one, jax.grad(one)):
        for batch in (jax.vmap(f), lanewise.batched(f)):
            text = jax.jit(batch).lower(jnp.ones((3, n))).as_text()
            assert not any(name in text for name in ("getrf", "trsm"))


WHIRL = jnp.array([[1.0, 1.0], [-1.0, 1.0]])
"""At h ε = 1 the Jacobian 1 − h ε WHIRL is [[0, −1], [1, 0]], which has no pivot."""


@pytest.mark.parametrize("strength", [0.1, 1.0])
def test_a_jacobian_without_pivots_is_solved_with_exchanged_rows(strength):
    x, known = jnp.array([0.3, 0.4]), jnp.array([1.0, 2.0])

    def solve(strength):
        root, info = find_root(lambda x: x - known - strength * WHIRL @ x, x, jnp.ones(2), Newton())
        return root, info.converged

    expected = np.linalg.solve(np.eye(2) - strength * np.asarray(WHIRL), known)
    for run in (solve, lanewise.batched(solve)):
        strengths = jnp.asarray(strength) if run is solve else jnp.full(5, strength)
        root, converged = jax.jit(run)(strengths)
        assert np.all(converged)
        np.testing.assert_allclose(root, np.broadcast_to(expected, root.shape), rtol=1e-15)


GM = np.array([3e-4, 5e-11, 7e-10, 9e-10, 1e-10, 2.8e-7, 8.5e-8, 1.3e-8, 1.5e-8, 2.2e-12])
DISTANCES = np.array([0, 0.39, 0.72, 1, 1.52, 5.2, 9.5, 19.2, 30.1, 39.5])
TEN = dvi.System(systems.n_body().system.H_D, force=drag)


def ten_bodies(solver, num_steps=100, epsilon=1e-6):
    """Ten bodies on circles: positions [au] and GM times velocities, shape (10, 3)."""
    angle = np.linspace(0, 5, 10)
    q = DISTANCES[:, None] * np.stack([np.cos(angle), np.sin(angle), np.sin(3 * angle) / 50], 1)
    speed = np.sqrt(GM[0] / np.maximum(DISTANCES, 0.1)) * (DISTANCES > 0)
    p = (GM * speed)[:, None] * np.stack([-np.sin(angle), np.cos(angle), np.cos(angle) / 50], 1)
    p = p - GM[:, None] * p.sum(0) / GM.sum()
    return march(solver, TEN, q, p, 0.5, num_steps, epsilon, {"masses": GM, "G": 1.0})


@pytest.mark.slow
def test_ten_bodies_take_two_iterations():
    q1, p1, _ = ten_bodies(Newton(), num_steps=1)
    q, _, _ = ten_bodies(Newton())
    for solver in (Picard(), PicardThenNewton()):
        a, b, _ = ten_bodies(solver, num_steps=1)
        np.testing.assert_allclose(a, q1, rtol=4 * EPS, atol=EPS)
        np.testing.assert_allclose(b, p1, rtol=4 * EPS)
        a, _, info = ten_bodies(solver)
        np.testing.assert_allclose(a, q, rtol=1e-12, atol=1e-13)
        assert is_good(info)
        assert int(info.iterations) <= 2.05 * 100
        assert float(relative_size(*info.residual)) < EPS


@pytest.mark.parametrize("differentiated", [False, True])
def test_picard_forms_no_matrix_of_the_unknowns(differentiated):
    def text(solver):
        def last(epsilon):
            return jnp.sum(ten_bodies(solver, num_steps=1, epsilon=epsilon)[0])

        text = str(jax.make_jaxpr(jax.grad(last) if differentiated else last)(1e-6))
        return "eliminate" in text, "[30,30]" in text

    assert text(Picard()) == (False, False)
    assert text(Newton()) == (True, True)  # the search finds them where they are


WITH_MANY = {
    "pendulums": (dvi.System(double_pendulum, force=drag), *box(2), 0.05, 1, 0.1),
    "chain 3": (CHAIN, *box(3), 0.05),
    "chain 40": (CHAIN, *box(40), 0.1),
}


@functools.cache
def newtons_step(case):
    return march(Newton(), *WITH_MANY[case])


@pytest.mark.parametrize(
    ("name", "case"),
    [pytest.param(*x, marks=() if x in covering(OTHERS, WITH_MANY) else pytest.mark.slow)
     for x in itertools.product(OTHERS, WITH_MANY)],
)  # fmt: skip
def test_one_step_agrees_with_newton_to_a_few_ulp(name, case):
    q1, p1, info = march(OTHERS[name], *WITH_MANY[case])
    q_newton, p_newton, _ = newtons_step(case)
    assert int(info.iterations) >= 2
    scale = np.maximum(np.abs(WITH_MANY[case][2]), np.abs(p_newton))
    assert np.max(np.abs(p1 - p_newton) / scale) <= 4 * EPS
    np.testing.assert_allclose(q1, q_newton, rtol=8 * EPS, atol=8 * EPS)


@pytest.mark.parametrize(
    "method", [dvi.Adjoint(), dvi.Strang(), dvi.GaussLegendre(1), dvi.LobattoIIIAIIIB(2)]
)
@pytest.mark.slow
def test_all_implicit_methods_agree_with_newton(method):
    q, p = box(5)
    first, *runs = (
        march(solver, CHAIN, q, p, 0.05, 5, method=method)
        for solver in (Newton(), *OTHERS.values())
    )
    for a, b, info in runs:
        assert is_good(info)
        np.testing.assert_allclose(a, first[0], rtol=1e-14, atol=1e-15)
        np.testing.assert_allclose(b, first[1], rtol=1e-14, atol=1e-15)


@EACH
@pytest.mark.slow
def test_the_map_stays_symplectic(name):
    q, p = box(5)

    def flow(epsilon):
        def of(z):
            q, p, _ = march(OTHERS[name], DAMPED_CHAIN, z[:5], z[5:], 0.1, 3, epsilon)
            return jnp.concatenate([q, p])

        return jax.jacfwd(of)(jnp.concatenate([q, p]))

    assert symplectic_defect(flow(0.0)) < 1e-12
    assert symplectic_defect(flow(0.1)) > 1e-3  # with drag it is not


@functools.cache
def energy_after_many_steps(solver):
    q, p, _ = march(solver, CHAIN, *box(3, width=0.4), 0.05, 20_000, method=dvi.Strang())
    return float(chain(0, 0, q, p, None))


@EACH
@pytest.mark.slow
def test_a_long_run_conserves_energy_as_newton_does(name):
    """The residual of a solve must not add up: a bias of one rounding per step would be seen."""
    assert abs(energy_after_many_steps(OTHERS[name]) - energy_after_many_steps(Newton())) < 3e-14


@pytest.mark.slow
@pytest.mark.parametrize(
    "solver", [Newton(), *(pytest.param(OTHERS[n], marks=pytest.mark.slow) for n in OTHERS)]
)
def test_a_component_of_pure_round_off_is_accepted(solver):
    """A planar orbit in oblique axes: the third momentum is only rounding."""
    turn = np.linalg.qr(np.array([[1.0, 2.0, 0.3], [0.4, 1.0, 2.0], [2.0, 0.1, 1.0]]))[0]
    system = dvi.System(
        lambda t0, t1, q, p, a: p @ p / 2 - 1 / jnp.sqrt(q @ q),
        force=lambda t0, t1, q0, p1, args: -p1 * jnp.sqrt(p1 @ p1),
    )
    q, p = np.array([0.0, 1.2, 0.0]), np.array([-1.0, -0.6, 0.0])
    flat, *_ = march(Newton(), system, q, p, 0.05, 200, 0.01)
    oblique, _, info = march(solver, system, turn @ q, turn @ p, 0.05, 200, 0.01)
    assert is_good(info)
    np.testing.assert_allclose(oblique @ turn, flat, atol=1e-12)


@pytest.mark.slow
def test_a_light_slow_component_is_solved_for_on_its_own_scale():
    """Two masses, 1 and 1e-12; the light one converges slowly, which the other must not hide."""

    def H(t0, t1, q, p, m):
        return jnp.sum(p**2 / (2 * m)) + jnp.sum(m * q**2) / 2

    m = np.array([1.0, 1e-12])
    system = dvi.System(H, force=lambda t0, t1, q, p, m: -p * (m < 1))
    for solver in (Picard(max_steps=200), MANY):
        q, p = jnp.ones(2), m
        for _ in range(3):
            _, p_newton, _ = march(Newton(), system, q, p, 0.1, 1, 6.0, m)
            q, p1, info = march(solver, system, q, p, 0.1, 1, 6.0, m)
            assert is_good(info)
            error = np.abs(p1 - p_newton) / np.maximum(np.abs(p), np.abs(p1))
            p = p1
            assert np.max(error) < 8 * EPS


def test_no_iteration_ends_before_it_has_converged():
    """With too few iterations the status reports it; with enough the root is good."""

    def F(x):
        return x - 1 + 0.1 * jnp.sin(x)

    verdicts = []
    for most in (2, 4, 6, 12, 14):
        root, info = find_root(F, jnp.full(3, 0.5), jnp.ones(3), Picard(max_steps=most))
        verdicts.append(bool(info.converged))
        if verdicts[-1]:
            assert float(jnp.max(jnp.abs(F(root)))) <= 4 * EPS
    assert verdicts == sorted(verdicts)
    assert not verdicts[0]
    assert verdicts[-1]


@pytest.mark.slow
def test_single_precision():
    q, p = np.float32(box(6))
    reference, *_ = march(Newton(), CHAIN, *box(6), 0.05, 50)
    for solver in OTHERS.values():
        found, _, info = march(solver, CHAIN, q, p, 0.05, 50)
        assert is_good(info)
        assert found.dtype == jnp.float32
        assert 1e-8 < np.max(np.abs(found - reference)) < 2e-5


@pytest.mark.slow
def test_compensated_arithmetic_keeps_its_accuracy():
    starts = np.random.default_rng(0).uniform(-0.4, 0.4, (2, 16, 3))

    def run(solver, arithmetic):
        how = {"h": 1 / 64, "num_steps": 4096, "arithmetic": arithmetic, "newton": solver}

        def one(q, p):
            return dvi.integrate(CHAIN, q, p, save=dvi.Save(final=True), **how).qs[-1]

        return np.asarray(jax.jit(jax.vmap(one))(*starts))

    # Medians: some of the starts are unstable, and amplify any difference.
    exact = run(Newton(), dvi.Compensated())
    for solver in OTHERS.values():
        assert np.median(np.abs(run(solver, dvi.Compensated()) - exact)) < EPS / 2
    assert np.median(np.abs(run(Picard(), dvi.FloatingPoint()) - exact)) > 3 * EPS


@pytest.mark.slow
@pytest.mark.parametrize("adjoint", [dvi.Direct(), dvi.Reversible(checkpoint_every=5)])
def test_gradients_are_newtons(adjoint):
    def gradient(solver):
        how = {"h": 0.05, "num_steps": 12, "newton": solver, "adjoint": adjoint, "throw": False}

        def loss(q, p, epsilon):
            sol = dvi.integrate(DAMPED_CHAIN, q, p, epsilon=epsilon, **how)
            return jnp.sum(sol.qs[-1] ** 2) + jnp.sum(jnp.sin(sol.ps[-1]))

        return jax.jit(jax.grad(loss, (0, 1, 2)))(*box(20), 0.1)

    reference = gradient(Newton())
    for solver in (*OTHERS.values(), PicardThenNewton()):
        for a, b in zip(gradient(solver), reference, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-13)


@EACH
@pytest.mark.slow
def test_derivatives_of_a_root_to_second_order(name):
    def derivatives(solver):
        def of(a):
            def F(x):
                return x - 1 + 0.3 * jnp.tanh(a * x) * jnp.flip(x)

            return jnp.sum(find_root(F, jnp.ones(2), jnp.ones(2), solver)[0] ** 2)

        return [jax.jit(f(of))(0.7) for f in (jax.grad, jax.jacfwd, jax.hessian)]

    for a, b in zip(derivatives(OTHERS[name]), derivatives(Newton()), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12)


def test_a_derivative_that_picard_cannot_find_is_nan():
    """A root that is known, where the Jacobian is far from the identity."""

    def root(a, solver):
        return find_root(lambda x: 4 * x - a, a / 4 * ONE, ONE, solver)[0][0]

    gradient = jax.jit(jax.grad(root), static_argnums=1)
    assert bool(jnp.isnan(gradient(1.0, Picard())))
    np.testing.assert_allclose(gradient(1.0, MANY), 0.25, rtol=1e-15)


def strongly_damped(solver, gamma):
    """Pendulums with W = −p: fixed-point iteration multiplies an error by h γ = 0.1 γ."""
    return march(solver, PENDULUMS, *box(6), 0.1, 8, gamma)


@pytest.mark.slow
def test_picard_reports_that_it_does_not_converge_and_the_default_continues_with_newton():
    q, _, _ = strongly_damped(Newton(), 30.0)
    assert bool(strongly_damped(Picard(), 30.0)[2].result == dvi.RESULTS.not_converged)
    assert is_good(strongly_damped(SimplifiedNewton(), 30.0)[2])
    found, _, info = strongly_damped(PicardThenNewton(), 30.0)
    assert is_good(info)
    np.testing.assert_allclose(found, q, rtol=1e-14)
    # Stopped after the second correction, not after twelve; then Newton's one or two.
    assert int(info.iterations) <= 8 * (2 + 2)


def test_slow_contraction_is_stopped_too():
    *_, default = strongly_damped(PicardThenNewton(), 7.0)
    *_, picard = strongly_damped(Picard(max_steps=200), 7.0)
    assert is_good(default)
    assert is_good(picard)
    assert int(default.iterations) <= 8 * (2 + 2)
    assert int(picard.iterations) > 8 * 30


@pytest.mark.slow
@pytest.mark.parametrize("form", ["arrays", "auto"])
@pytest.mark.parametrize("name", ["picard", "picard_then_newton"])
def test_a_trajectory_that_fails_leaves_the_bits_of_others(name, form):
    how = {"h": 0.1, "num_steps": 8, "newton": OTHERS[name], "throw": False}

    def run(gamma):
        sol = dvi.integrate(PENDULUMS, *box(6), epsilon=gamma, layout=dvi.Layout(form=form), **how)
        return sol.qs, sol.result == dvi.RESULTS.successful

    gammas = jnp.array([0.1, 30.0, 1.0, 0.0])
    qs, good = jax.jit(jax.vmap(run))(gammas)
    calm, all_good = jax.jit(jax.vmap(run))(gammas.at[1].set(0.5))
    assert all(all_good)
    np.testing.assert_array_equal(good, [True, name != "picard", True, True])
    np.testing.assert_array_equal(qs[jnp.array([0, 2, 3])], calm[jnp.array([0, 2, 3])])
    assert bool(jnp.all(jnp.isnan(qs[1][1:]))) == (name == "picard")


@pytest.mark.slow
def test_many_trajectories_take_the_iterations_of_one():
    """No test may rest on the NaN in place of a first correction: a batch may ignore it."""
    q, p = np.random.default_rng(5).uniform(-0.3, 0.3, (2, 256, 20))

    def run(q, p):
        return march(PicardThenNewton(), CHAIN, q, p, 0.02, 2)[2].iterations

    together = jax.vmap(run)(q, p)
    np.testing.assert_array_equal(together[:4], [run(*x) for x in zip(q[:4], p[:4], strict=True)])


@pytest.mark.slow
@EACH
def test_machine_code_agrees_with_arrays(name):
    q, p = np.random.default_rng(3).uniform(-0.5, 0.5, (2, 8, 3))
    how = {"h": 0.05, "num_steps": 150, "newton": OTHERS[name], "save": dvi.Save(final=True)}

    def run(form):
        def one(q, p):
            sol = dvi.integrate(CHAIN, q, p, layout=dvi.Layout(form=form), throw=False, **how)
            return sol.qs[-1], sol.stats["newton_iterations"], sol.stats["max_residual"]

        return jax.jit(jax.vmap(one))(q, p)

    compiled, arrays = run("auto"), run("arrays")
    np.testing.assert_allclose(compiled[0], arrays[0], rtol=1e-12, atol=1e-13)
    # An iteration more or less is round-off in the test for the last one.
    np.testing.assert_allclose(compiled[1], arrays[1], rtol=0.01)
    for residual in (compiled[2], arrays[2]):
        assert np.all(np.asarray(residual) < 4 * EPS)


@pytest.mark.slow
def test_trajectories_that_need_pivots_agree_and_leave_others_unchanged():
    system = dvi.System(
        lambda t0, t1, q, p, a: (p @ p + q @ q) / 2, force=lambda t0, t1, q, p, a: WHIRL @ p
    )
    how = {"h": 0.5, "num_steps": 40, "throw": False, "save": dvi.Save(final=True)}

    def run(form, *epsilons):
        def one(epsilon):
            start = [0.3, 0.1], [0.2, 0.5]
            layout = dvi.Layout(form=form)
            sol = dvi.integrate(system, *start, epsilon=epsilon, layout=layout, **how)
            return sol.qs[-1], sol.result == dvi.RESULTS.successful

        return jax.jit(jax.vmap(one))(jnp.array(epsilons))

    q, good = run("auto", 0.02, 2.0, -0.1)
    q_arrays, _ = run("arrays", 0.02, 2.0, -0.1)
    calm, _ = run("auto", 0.02, 0.1, -0.1)
    assert all(good)
    np.testing.assert_allclose(q, q_arrays, rtol=1e-12)
    np.testing.assert_array_equal(q[::2], calm[::2])


@pytest.mark.slow
def test_simplified_newton_is_compiled_as_one_piece():
    """Gauss' method with three coordinates: twelve unknowns."""
    how = {"h": 0.05, "num_steps": 4, "newton": SimplifiedNewton()}

    def end(q, p):
        return dvi.integrate(CHAIN, q, p, method=dvi.GaussLegendre(2), **how).qs[-1]

    (part,) = lanewise.explain(end, *box(3)).parts
    assert part.reason is None
    assert part.operations < 6000


@pytest.mark.parametrize("n", [1, 64, 65])
def test_factors_solve(n):
    """Above 64 unknowns by LAPACK's factors."""
    A, b = np.random.default_rng(n).normal(size=(n, n)), np.arange(1.0, n + 1)
    np.testing.assert_allclose(A @ factorise(jnp.asarray(A))(jnp.asarray(b)), b, atol=1e-12 * n)


@pytest.mark.slow
def test_the_default_is_newtons_for_few_unknowns_and_picards_for_many():
    few = [march(s, CHAIN, *box(3), 0.05, 20) for s in (PicardThenNewton(), Newton())]
    np.testing.assert_array_equal(few[0][0], few[1][0])
    many = [march(s, CHAIN, *box(20), 0.05, 20) for s in (PicardThenNewton(), Picard())]
    assert int(many[0][2].iterations) == int(many[1][2].iterations)
    sol = dvi.integrate(CHAIN, *box(3), h=0.05, num_steps=20)
    np.testing.assert_allclose(sol.qs[-1], few[0][0], rtol=1e-14)


def test_settings_that_cannot_work_are_rejected():
    for kind in (Newton, SimplifiedNewton, Picard):
        for bad in (
            {"rtol": -1.0}, {"rtol": 0.0}, {"max_steps": 0}, {"max_steps": True}, {"atol": np.inf}
        ):  # fmt: skip
            with pytest.raises(ValueError, match=r"must be|both 0"):
                kind(**bad)
    with pytest.raises(ValueError, match="newton_up_to must be an integer"):
        PicardThenNewton(newton_up_to=-1)
    with pytest.raises(TypeError, match="picard must be a dvi"):
        PicardThenNewton(picard=Newton())


@pytest.mark.parametrize("size", [1, 2, 4])
def test_an_equation_with_a_loop_is_not_written_out_in_front_of_the_loop(size):
    """Each evaluation of a nonseparable Lagrangian has one: a second copy of the iteration would
    double the code, and no trajectory of a batch would wait less."""

    def count(F, solver):
        x = jnp.ones(size)
        search = jax.make_jaxpr(lambda x: find_root(lambda y: F(y) - x, x, x, solver)[0])(x)
        return operation_count(search.jaxpr)

    def plain(y):
        return y + jnp.sin(y) / 2

    def iterated(y):
        return jax.lax.fori_loop(0, 3 + jnp.int32(y[0] > 0), lambda _, z: z - (plain(z) - y), y)

    def in_branch(y):
        return jax.lax.cond(y[0] > 0, iterated, plain, y)

    assert count(plain, NestedNewton()) < 0.7 * count(plain, Newton())
    for F in (iterated, in_branch, jax.jit(iterated)):
        assert count(F, NestedNewton()) == count(F, Newton())


def test_the_velocity_of_a_lagrangian_is_solved_for_in_one_loop():
    def evaluation(solver):
        H = dvi.legendre(lambda t, q, v, args: (1 + q @ q) * (v @ v) / 2 + (v @ v) ** 2, solver)
        return jax.make_jaxpr(lambda p: jax.grad(H, 2)(0.0, ONE, p, None))(ONE).jaxpr

    assert operation_count(evaluation(Newton())) == operation_count(evaluation(NestedNewton()))
