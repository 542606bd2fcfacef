"""Root solvers: the roots, derivatives and statuses of Newton's method, by fewer operations."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import double_pendulum, symplectic_defect

import dvi_jax as dvi
import lanewise
from dvi_jax import systems
from dvi_jax._step import Equations, no_step_yet
from dvi_jax._types import Interval
from dvi_jax.engine.newton import Newton, find_root, over
from dvi_jax.engine.picard import Picard, PicardThenNewton
from dvi_jax.engine.simplified import _ELIMINATED, SimplifiedNewton, factorised

EPS = np.finfo(float).eps
MANY = PicardThenNewton(newton_up_to=0)
"""The default as it treats many unknowns, on few."""
OTHERS = {"simplified": SimplifiedNewton(), "picard": Picard(), "picard_then_newton": MANY}
EACH = pytest.mark.parametrize("name", list(OTHERS))


def chain(t0, t1, q0, p1, args):
    """Masses that depend on the positions, in a row: ∂²H/∂q∂p is tridiagonal."""
    d, w = jnp.diff(jnp.pad(q0, 1)), q0 * p1
    springs = jnp.sum(d**2 / 2 + 0.3 * d**4 / 4)
    return jnp.sum((1 + q0**2 / 2) * p1**2) / 2 + jnp.sum(w[1:] * w[:-1]) / 4 + springs


def drag(t0, t1, q0, p1, args):
    """W = −p."""
    return -p1


CHAIN = dvi.System(chain)


def march(solver, system, q, p, h, num_steps=1, epsilon=0.0, args=None, method=dvi.TypeII()):
    """(q, p, StepInfo) after so many steps with care: compiled in a tenth of the time of a run."""

    def steps(q, p, epsilon):
        equations = Equations(system, epsilon, args, solver)

        def step(k, state):
            q, p, so_far = state
            t0 = jnp.asarray(k * h, q.dtype)
            h_ = jnp.asarray(h, q.dtype)
            q, p, info = method.step(equations, Interval(t0, t0 + h_, h_), q, p)
            return q, p, so_far.then(info)

        return jax.lax.fori_loop(0, num_steps, step, (q, p, no_step_yet(q)))

    return jax.jit(steps)(jnp.asarray(q), jnp.asarray(p), epsilon)


def is_good(info):
    return bool(info.result == dvi.RESULTS.successful)


def box(n, seed=0, width=0.5):
    return np.random.default_rng(seed).uniform(-width, width, (2, n))


# --- ten bodies ------------------------------------------------------------------------------

GM = np.array([3e-4, 5e-11, 7e-10, 9e-10, 1e-10, 2.8e-7, 8.5e-8, 1.3e-8, 1.5e-8, 2.2e-12])
DISTANCES = np.array([0, 0.39, 0.72, 1, 1.52, 5.2, 9.5, 19.2, 30.1, 39.5])


def planets():
    """Ten bodies on circles: positions [au] and GM times velocities, shape (10, 3)."""
    angle = np.linspace(0, 5, 10)
    q = DISTANCES[:, None] * np.stack([np.cos(angle), np.sin(angle), np.sin(3 * angle) / 50], 1)
    speed = np.sqrt(GM[0] / np.maximum(DISTANCES, 0.1)) * (DISTANCES > 0)
    p = (GM * speed)[:, None] * np.stack([-np.sin(angle), np.cos(angle), np.cos(angle) / 50], 1)
    return q, p - GM[:, None] * p.sum(0) / GM.sum()


TEN = dvi.System(systems.n_body().system.H_D, force=drag)
TEN_ARGS = {"masses": GM, "G": 1.0}


def ten_bodies(solver, num_steps=100, epsilon=1e-6):
    return march(solver, TEN, *planets(), 0.5, num_steps, epsilon, TEN_ARGS)


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
        assert float(over(*info.residual)) < EPS


@pytest.mark.parametrize("differentiated", [False, True])
def test_picard_forms_no_matrix_of_the_unknowns(differentiated):
    def text(solver):
        def last(epsilon):
            return jnp.sum(ten_bodies(solver, num_steps=1, epsilon=epsilon)[0])

        text = str(jax.make_jaxpr(jax.grad(last) if differentiated else last)(1e-6))
        return "eliminate" in text, "[30,30]" in text

    assert text(Picard()) == (False, False)
    assert text(Newton()) == (True, True)  # what is looked for can be found


# --- the same roots --------------------------------------------------------------------------

WITH_MANY = {
    "pendulums": (dvi.System(double_pendulum, force=drag), *box(2), 0.05, 0.1),
    "chain 3": (CHAIN, *box(3), 0.05, 0.0),
    "chain 40": (CHAIN, *box(40), 0.1, 0.0),
}


@functools.cache
def newtons_step(case):
    system, q, p, h, epsilon = WITH_MANY[case]
    return march(Newton(), system, q, p, h, epsilon=epsilon)


@functools.cache
def newtons_energy():
    return energy_after_many_steps(Newton())


def energy_after_many_steps(solver):
    q, p = box(3, width=0.4)
    q, p, _ = march(solver, CHAIN, q, p, 0.05, 20_000, method=dvi.Strang())
    return float(chain(0, 0, q, p, None))


@EACH
@pytest.mark.parametrize("case", list(WITH_MANY))
def test_one_step_agrees_with_newton_to_a_few_ulp(name, case):
    system, q, p, h, epsilon = WITH_MANY[case]
    q1, p1, info = march(OTHERS[name], system, q, p, h, epsilon=epsilon)
    q_newton, p_newton, _ = newtons_step(case)
    assert int(info.iterations) >= 2
    scale = np.maximum(np.abs(p), np.abs(p_newton))
    assert np.max(np.abs(p1 - p_newton) / scale) <= 4 * EPS
    np.testing.assert_allclose(q1, q_newton, rtol=8 * EPS, atol=8 * EPS)


SOLVED = {
    "Adjoint": dvi.Adjoint(),
    "Strang": dvi.Strang(),
    "Gauss": dvi.GaussLegendre(1),
    "Lobatto": dvi.LobattoIIIAIIIB(2),
}


@pytest.mark.parametrize("method", list(SOLVED))
@pytest.mark.slow
def test_all_implicit_methods_agree_with_newton(method):
    q, p = box(5)
    runs = [
        march(solver, CHAIN, q, p, 0.05, 5, method=SOLVED[method])
        for solver in (Newton(), *OTHERS.values())
    ]
    for a, b, info in runs[1:]:
        assert is_good(info)
        np.testing.assert_allclose(a, runs[0][0], rtol=1e-14, atol=1e-15)
        np.testing.assert_allclose(b, runs[0][1], rtol=1e-14, atol=1e-15)


@EACH
@pytest.mark.slow
def test_the_map_stays_symplectic(name):
    q, p = box(5)

    def flow(epsilon):
        def of(z):
            system = dvi.System(chain, force=drag)
            q, p, _ = march(OTHERS[name], system, z[:5], z[5:], 0.1, 3, epsilon)
            return jnp.concatenate([q, p])

        return jax.jacfwd(of)(jnp.concatenate([q, p]))

    assert symplectic_defect(flow(0.0)) < 1e-12
    assert symplectic_defect(flow(0.1)) > 1e-3  # a drag is not


@EACH
@pytest.mark.slow
def test_a_long_run_keeps_energy_as_newton_does(name):
    """What a solve leaves must not add up: a bias of a unit of round-off a step would be seen."""
    assert abs(energy_after_many_steps(OTHERS[name]) - newtons_energy()) < 3e-14


# --- derivatives -----------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("adjoint", [dvi.Direct(), dvi.Reversible(checkpoint_every=5)])
def test_gradients_are_newtons(adjoint):
    q, p = box(20)

    def gradient(solver):
        def loss(q, p, epsilon):
            sol = dvi.integrate(
                dvi.System(chain, force=drag), q, p, h=0.05, num_steps=12, epsilon=epsilon,
                newton=solver, adjoint=adjoint, throw=False,
            )  # fmt: skip
            return jnp.sum(sol.qs[-1] ** 2) + jnp.sum(jnp.sin(sol.ps[-1]))

        return jax.jit(jax.grad(loss, (0, 1, 2)))(q, p, 0.1)

    reference = gradient(Newton())
    for solver in (*OTHERS.values(), PicardThenNewton()):
        for a, b in zip(gradient(solver), reference, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-13)


@pytest.mark.slow
def test_the_gradient_of_steps_is_newtons():
    q, p = box(20)

    def gradient(solver):
        def loss(z, epsilon):
            system = dvi.System(chain, force=drag)
            q1, p1, _ = march(solver, system, z[:20], z[20:], 0.05, 3, epsilon)
            return jnp.sum(q1**2) + jnp.sum(jnp.sin(p1))

        return jax.grad(loss, (0, 1))(jnp.concatenate([q, p]), 0.1)

    reference = gradient(Newton())
    for solver in (Picard(), PicardThenNewton()):
        for a, b in zip(gradient(solver), reference, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-14)


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

    def root(a):
        return find_root(lambda x: 4 * x - a, a / 4 * jnp.ones(1), jnp.ones(1), Picard())[0][0]

    assert bool(jnp.isnan(jax.jit(jax.grad(root))(1.0)))
    many = jax.grad(lambda a: find_root(lambda x: 4 * x - a, jnp.ones(1), jnp.ones(1), MANY)[0][0])
    np.testing.assert_allclose(jax.jit(many)(1.0), 0.25, rtol=1e-15)


# --- when it does not contract ---------------------------------------------------------------


PENDULUMS = dvi.System(lambda t0, t1, q, p, a: p @ p / 2 - jnp.sum(jnp.cos(q)), force=drag)


def strongly_damped(solver, gamma):
    """Pendulums with W = −p: fixed-point iteration multiplies an error by h γ = 0.1 γ."""
    return march(solver, PENDULUMS, *box(6), 0.1, 8, gamma)


@pytest.mark.slow
def test_picard_says_when_it_does_not_converge_and_the_default_goes_on_by_newton():
    q, _, _ = strongly_damped(Newton(), 30.0)
    assert bool(strongly_damped(Picard(), 30.0)[2].result == dvi.RESULTS.not_converged)
    assert is_good(strongly_damped(SimplifiedNewton(), 30.0)[2])
    found, _, info = strongly_damped(PicardThenNewton(), 30.0)
    assert is_good(info)
    np.testing.assert_allclose(found, q, rtol=1e-14)
    # Given up after the second correction, not after twelve; then Newton's one or two.
    assert int(info.iterations) <= 8 * (2 + 2)


def test_slow_contraction_is_given_up_too():
    *_, default = strongly_damped(PicardThenNewton(), 7.0)
    *_, picard = strongly_damped(Picard(max_steps=200), 7.0)
    assert is_good(default)
    assert is_good(picard)
    assert int(default.iterations) <= 8 * (2 + 2)
    assert int(picard.iterations) > 8 * 30


@pytest.mark.slow
@pytest.mark.parametrize("form", ["arrays", "components"])
@pytest.mark.parametrize("name", ["picard", "picard_then_newton"])
def test_a_lane_that_fails_does_not_spoil_its_neighbours(name, form):
    gammas = jnp.array([0.1, 30.0, 1.0, 0.0])

    def run(gamma):
        sol = dvi.integrate(
            PENDULUMS, *box(6), h=0.1, num_steps=8, epsilon=gamma, newton=OTHERS[name],
            layout=dvi.Layout(form=form), throw=False,
        )  # fmt: skip
        return sol.qs, sol.result == dvi.RESULTS.successful

    qs, good = jax.jit(jax.vmap(run))(gammas)
    calm, all_good = jax.jit(jax.vmap(run))(gammas.at[1].set(0.5))
    assert all(all_good)
    np.testing.assert_array_equal(good, [True, name != "picard", True, True])
    np.testing.assert_array_equal(qs[jnp.array([0, 2, 3])], calm[jnp.array([0, 2, 3])])
    assert bool(jnp.all(jnp.isnan(qs[1][1:]))) == (name == "picard")


@pytest.mark.parametrize("name", ["picard", "picard_then_newton"])
@pytest.mark.slow
def test_a_step_that_fails_leaves_the_bits_of_its_neighbours(name):
    def run(gamma):
        q, p = box(6)
        return march(OTHERS[name], PENDULUMS, q, p, 0.1, 2, gamma)

    def lanes(gammas):
        q, _, info = jax.vmap(run)(gammas)
        return q, info.result == dvi.RESULTS.successful, info.iterations

    q, good, _ = lanes(jnp.array([0.1, 30.0, 1.0]))
    calm, all_good, _ = lanes(jnp.array([0.1, 0.5, 1.0]))
    assert all(all_good)
    np.testing.assert_array_equal(good, [True, name != "picard", True])
    np.testing.assert_array_equal(q[::2], calm[::2])


@pytest.mark.slow
def test_many_lanes_take_the_iterations_of_one():
    """No test may rest on the NaN that stands for a first correction: a batch may lose it."""
    q, p = np.random.default_rng(5).uniform(-0.3, 0.3, (2, 256, 20))

    def run(q, p):
        return march(PicardThenNewton(), CHAIN, q, p, 0.02, 2)[2].iterations

    together = jax.vmap(run)(q, p)
    np.testing.assert_array_equal(together[:4], [run(*x) for x in zip(q[:4], p[:4], strict=True)])


@EACH
def test_nan_stops_at_once(name):
    _, info = jax.jit(lambda x: find_root(jnp.log, x, jnp.ones(1), OTHERS[name]))(-jnp.ones(1))
    assert not bool(info.converged)
    # Newton's method, which goes on after Picard's first iteration, stops after its second.
    assert int(info.iterations) <= (3 if name == "picard_then_newton" else 2)


@pytest.mark.slow
def test_round_off_of_a_component_that_is_nothing_else_is_accepted():
    """A planar orbit seen from oblique axes, as for Newton's method in test_integrate.py."""
    turn = np.linalg.qr(np.array([[1.0, 2.0, 0.3], [0.4, 1.0, 2.0], [2.0, 0.1, 1.0]]))[0]

    def drag(t0, t1, q0, p1, args):
        return -p1 * jnp.sqrt(p1 @ p1)

    system = dvi.System(lambda t0, t1, q, p, a: p @ p / 2 - 1 / jnp.sqrt(q @ q), force=drag)
    q, p = turn @ [0.0, 1.2, 0.0], turn @ [-1.0, -0.6, 0.0]
    reference, *_ = march(Newton(), system, q, p, 0.05, 200, 0.01)
    for solver in (Picard(), SimplifiedNewton()):
        found, _, info = march(solver, system, q, p, 0.05, 200, 0.01)
        assert is_good(info)
        np.testing.assert_allclose(found, reference, atol=1e-12)


@pytest.mark.slow
def test_a_light_slow_component_is_solved_by_its_own_measure():
    """Two masses, 1 and 1e-12; the light one contracts slowly, which the other must not hide."""

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


# --- machine code and XLA, and everywhere ----------------------------------------------------


@pytest.mark.slow
@EACH
def test_components_agree_with_arrays(name):
    q, p = np.random.default_rng(3).uniform(-0.5, 0.5, (2, 8, 3))

    def run(form):
        def one(q, p):
            sol = dvi.integrate(
                CHAIN, q, p, h=0.05, num_steps=150, newton=OTHERS[name],
                layout=dvi.Layout(form=form), save=dvi.Save(final=True), throw=False,
            )  # fmt: skip
            return sol.qs[-1], sol.stats["newton_iterations"], sol.stats["max_residual"]

        return jax.jit(jax.vmap(one))(q, p)

    components, arrays = run("components"), run("arrays")
    np.testing.assert_allclose(components[0], arrays[0], rtol=1e-12, atol=1e-13)
    # An iteration more or less is round-off in the test for the last one.
    np.testing.assert_allclose(components[1], arrays[1], rtol=0.01)
    for residual in (components[2], arrays[2]):
        assert np.all(np.asarray(residual) < 4 * EPS)


def test_no_iteration_ends_before_it_has_converged():
    """With fewer iterations than it takes, the status says so; with more, the root is good."""

    def F(x):
        return x - 1 + 0.1 * jnp.sin(x)

    x0, one = jnp.full(3, 0.5), jnp.ones(3)
    verdicts = []
    for most in (2, 3, 4, 5, 6, 12, 13, 14, 15):
        root, info = find_root(F, x0, one, Picard(max_steps=most))
        verdicts.append(bool(info.converged))
        if verdicts[-1]:
            assert float(jnp.max(jnp.abs(F(root)))) <= 4 * EPS
    assert verdicts == sorted(verdicts)
    assert not verdicts[0]
    assert verdicts[-1]


WHIRL = jnp.array([[1.0, 1.0], [-1.0, 1.0]])


def whirl(t0, t1, q0, p1, args):
    """W with ∂W/∂p1 = WHIRL: at h ε = 1 the Jacobian is [[0, −1], [1, 0]], which has no pivot."""
    return WHIRL @ p1


@pytest.mark.parametrize("strength", [0.1, 1.0])
def test_a_jacobian_without_pivots_is_solved_with_exchanged_rows(strength):
    x, known = jnp.array([0.3, 0.4]), jnp.array([1.0, 2.0])

    def solve(strength):
        def F(x):
            return x - known - strength * WHIRL @ x

        root, info = find_root(F, x, jnp.ones(2), Newton())
        return root, info.converged

    expected = np.linalg.solve(np.eye(2) - strength * np.asarray(WHIRL), known)
    for run in (solve, lanewise.batched(solve)):
        strengths = jnp.asarray(strength) if run is solve else jnp.full(5, strength)
        root, converged = jax.jit(run)(strengths)
        assert np.all(converged)
        np.testing.assert_allclose(root, np.broadcast_to(expected, root.shape), rtol=1e-15)


@pytest.mark.slow
def test_lanes_that_need_pivots_agree_and_leave_the_others_alone():
    system = dvi.System(lambda t0, t1, q, p, a: (p @ p + q @ q) / 2, force=whirl)

    def run(form, *epsilons):
        def one(epsilon):
            sol = dvi.integrate(
                system, [0.3, 0.1], [0.2, 0.5], h=0.5, num_steps=40, epsilon=epsilon,
                layout=dvi.Layout(form=form), throw=False, save=dvi.Save(final=True),
            )  # fmt: skip
            return sol.qs[-1], sol.result == dvi.RESULTS.successful

        return jax.jit(jax.vmap(one))(jnp.array(epsilons))

    q, good = run("components", 0.02, 2.0, -0.1)
    q_arrays, _ = run("arrays", 0.02, 2.0, -0.1)
    calm, _ = run("components", 0.02, 0.1, -0.1)
    assert all(good)
    np.testing.assert_allclose(q, q_arrays, rtol=1e-12)
    np.testing.assert_array_equal(q[::2], calm[::2])


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
def test_compensated_arithmetic_keeps_what_it_gains():
    starts = np.random.default_rng(0).uniform(-0.4, 0.4, (2, 16, 3))

    def run(solver, arithmetic):
        def one(q, p):
            return dvi.integrate(
                CHAIN, q, p, h=1 / 64, num_steps=4096, newton=solver, arithmetic=arithmetic,
                save=dvi.Save(final=True),
            ).qs[-1]  # fmt: skip

        return np.asarray(jax.jit(jax.vmap(one))(*starts))

    # Medians: some of the starts are unstable, and increase any difference.
    exact = run(Newton(), dvi.Compensated())
    for solver in OTHERS.values():
        assert np.median(np.abs(run(solver, dvi.Compensated()) - exact)) < EPS / 2
    assert np.median(np.abs(run(Picard(), dvi.FloatingPoint()) - exact)) > 3 * EPS


def test_simplified_newton_is_compiled_as_one_piece():
    """Gauss' method with three coordinates: twelve unknowns."""

    def end(q, p):
        return dvi.integrate(
            CHAIN, q, p, h=0.05, num_steps=4, method=dvi.GaussLegendre(2),
            newton=SimplifiedNewton(),
        ).qs[-1]  # fmt: skip

    (part,) = lanewise.explain(end, *box(3)).parts
    assert part.reason is None
    assert part.operations < 6000


@pytest.mark.parametrize("n", [1, _ELIMINATED, _ELIMINATED + 1])
def test_factors_solve(n):
    A, b = np.random.default_rng(n).normal(size=(n, n)), np.arange(1.0, n + 1)
    np.testing.assert_allclose(A @ factorised(jnp.asarray(A))(jnp.asarray(b)), b, atol=1e-12 * n)


# --- the door --------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_default_is_newtons_for_few_unknowns_and_picards_for_many():
    few = [march(s, CHAIN, *box(3), 0.05, 20) for s in (PicardThenNewton(), Newton())]
    np.testing.assert_array_equal(few[0][0], few[1][0])
    many = [march(s, CHAIN, *box(20), 0.05, 20) for s in (PicardThenNewton(), Picard())]
    assert int(many[0][2].iterations) == int(many[1][2].iterations)
    sol = dvi.integrate(CHAIN, *box(3), h=0.05, num_steps=20)
    np.testing.assert_allclose(sol.qs[-1], few[0][0], rtol=1e-14)


@pytest.mark.parametrize("kind", [SimplifiedNewton, Picard])
@pytest.mark.parametrize(
    "bad", [{"rtol": -1.0}, {"max_steps": 0}, {"max_steps": True}, {"atol": np.inf}]
)
def test_settings_that_cannot_work_are_refused(kind, bad):
    with pytest.raises(ValueError, match="must be"):
        kind(**bad)


def test_the_default_refuses_other_kinds():
    with pytest.raises(ValueError, match="newton_up_to must be a whole number"):
        PicardThenNewton(newton_up_to=-1)
    with pytest.raises(TypeError, match="picard must be a dvi"):
        PicardThenNewton(picard=Newton())
    with pytest.raises(
        TypeError, match=r"root_finder must be a RootSolver, got 'picard'. Take .*Picard"
    ):
        dvi.integrate(CHAIN, *box(2), h=0.1, num_steps=1, newton="picard")
    with pytest.raises(TypeError, match="is a pair of parentheses missing"):
        dvi.integrate(CHAIN, *box(2), h=0.1, num_steps=1, newton=dvi.Picard)
