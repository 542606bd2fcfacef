"""Root solvers: the roots, derivatives and statuses of Newton's method, by fewer operations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import double_pendulum, symplectic_defect

import dvi_jax as dvi
from dvi_jax import systems
from dvi_jax.engine.linear import UNROLLED_UP_TO
from dvi_jax.engine.newton import Newton, Trusted, find_root
from dvi_jax.engine.picard import Picard, PicardThenNewton
from dvi_jax.engine.simplified import SimplifiedNewton, factorised

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


def ten_bodies(solver, num_steps=100, **kwargs):
    q, p = planets()
    kwargs = {"h": 0.5, "epsilon": 1e-6, "args": TEN_ARGS} | kwargs
    return dvi.integrate(TEN, q, p, num_steps=num_steps, newton=solver, **kwargs)


def test_ten_bodies_take_two_iterations_and_no_jacobian():
    reference = ten_bodies(Newton())
    for solver in (Picard(), PicardThenNewton()):
        sol = ten_bodies(solver)
        assert int(sol.stats["newton_iterations"]) <= 2.05 * 100
        assert float(sol.stats["max_residual"]) < EPS
        np.testing.assert_allclose(sol.qs[1], reference.qs[1], rtol=4 * EPS, atol=EPS)
        np.testing.assert_allclose(sol.ps[1], reference.ps[1], rtol=4 * EPS)
        np.testing.assert_allclose(sol.qs, reference.qs, rtol=1e-12, atol=1e-13)


def text_of(solver, differentiated=False):
    def last(epsilon):
        at = {"adjoint": dvi.Direct(), "throw": False, "epsilon": epsilon}
        return jnp.sum(ten_bodies(solver, num_steps=3, **at).qs[-1])

    return str(jax.make_jaxpr(jax.grad(last) if differentiated else last)(1e-6))


@pytest.mark.parametrize("differentiated", [False, True])
def test_picard_forms_no_matrix_of_the_unknowns(differentiated):
    text = text_of(Picard(), differentiated)
    assert "lu[" not in text
    assert "[30,30]" not in text
    newton = text_of(Newton(), differentiated)  # what is looked for is there
    assert "lu[" in newton
    assert "[30,30]" in newton


# --- the same roots --------------------------------------------------------------------------

WITH_MANY = {
    "pendulums": (dvi.System(double_pendulum, force=drag), *box(2), 0.05, 0.1),
    "chain 3": (CHAIN, *box(3), 0.05, 0.0),
    "chain 12": (CHAIN, *box(12), 0.05, 0.0),
    "chain 40": (CHAIN, *box(40), 0.1, 0.0),
}


@EACH
@pytest.mark.parametrize("case", list(WITH_MANY))
def test_one_step_agrees_with_newton_to_a_few_ulp(name, case):
    system, q, p, h, epsilon = WITH_MANY[case]

    def step(solver):
        return dvi.integrate(system, q, p, h=h, num_steps=1, epsilon=epsilon, newton=solver)

    sol, reference = step(OTHERS[name]), step(Newton())
    assert int(sol.stats["newton_iterations"]) >= 2
    scale = np.maximum(np.abs(p), np.abs(reference.ps[-1]))
    assert np.max(np.abs(sol.ps[-1] - reference.ps[-1]) / scale) <= 4 * EPS
    np.testing.assert_allclose(sol.qs[-1], reference.qs[-1], rtol=8 * EPS, atol=8 * EPS)


@EACH
def test_all_implicit_methods_agree_with_newton(name):
    q, p = box(5)
    methods = [
        dvi.Adjoint(), dvi.Strang(), dvi.Yoshida(4), dvi.GaussLegendre(2), dvi.LobattoIIIAIIIB(3)
    ]  # fmt: skip
    for method in methods:
        at = {"h": 0.05, "num_steps": 5, "method": method}
        sol = dvi.integrate(CHAIN, q, p, newton=OTHERS[name], **at)
        reference = dvi.integrate(CHAIN, q, p, newton=Newton(), **at)
        np.testing.assert_allclose(sol.qs, reference.qs, rtol=1e-14, atol=1e-15)
        np.testing.assert_allclose(sol.ps, reference.ps, rtol=1e-14, atol=1e-15)


@EACH
def test_the_map_stays_symplectic(name):
    q, p = box(5)

    def flow(epsilon):
        def of(z):
            sol = dvi.integrate(
                dvi.System(chain, force=drag), z[:5], z[5:], h=0.1, num_steps=3, epsilon=epsilon,
                newton=OTHERS[name], throw=False,
            )  # fmt: skip
            return jnp.concatenate([sol.qs[-1], sol.ps[-1]])

        return jax.jit(jax.jacfwd(of))(np.concatenate([q, p]))

    assert symplectic_defect(flow(0.0)) < 1e-12
    assert symplectic_defect(flow(0.1)) > 1e-3  # a drag is not


@EACH
def test_a_long_run_keeps_energy_as_newton_does(name):
    """What a solve leaves must not add up: a bias of a unit of round-off a step would be seen."""
    q, p = box(3, width=0.4)
    at = {"h": 0.05, "num_steps": 20_000, "save": dvi.Save(final=True), "method": dvi.Strang()}
    sol = dvi.integrate(CHAIN, q, p, newton=OTHERS[name], **at)
    reference = dvi.integrate(CHAIN, q, p, newton=Newton(), **at)

    def energy(s):
        return chain(0, 0, s.qs[-1], s.ps[-1], None)

    assert abs(float(energy(sol) - energy(reference))) < 1e-11


# --- derivatives -----------------------------------------------------------------------------


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


@EACH
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


def strongly_damped(solver, gamma, **kwargs):
    """Pendulums with W = −p, h γ = 0.1 γ: a contraction by that factor."""
    q, p = box(6)
    system = dvi.System(lambda t0, t1, q, p, a: p @ p / 2 - jnp.sum(jnp.cos(q)), force=drag)
    return dvi.integrate(
        system, q, p, h=0.1, num_steps=8, epsilon=gamma, newton=solver, throw=False, **kwargs
    )


def test_picard_says_when_it_does_not_converge_and_the_default_goes_on_by_newton():
    reference = strongly_damped(Newton(), 30.0)
    assert strongly_damped(Picard(), 30.0).status == "not_converged"
    for solver in (SimplifiedNewton(), PicardThenNewton()):
        sol = strongly_damped(solver, 30.0)
        assert sol.status == "successful"
        np.testing.assert_allclose(sol.qs, reference.qs, rtol=1e-14)
    # Given up after the second correction, not after twelve; then Newton's one or two.
    assert int(sol.stats["newton_iterations"]) <= 8 * (2 + 2)


def test_slow_contraction_is_given_up_too():
    sol = strongly_damped(PicardThenNewton(), 7.0)
    assert int(sol.stats["newton_iterations"]) <= 8 * (2 + 2)
    assert int(strongly_damped(Picard(), 7.0).stats["newton_iterations"]) > 8 * 30


@pytest.mark.parametrize("form", ["arrays", "components"])
@pytest.mark.parametrize("name", ["picard", "picard_then_newton"])
def test_a_lane_that_fails_does_not_spoil_its_neighbours(name, form):
    gammas = jnp.array([0.1, 30.0, 1.0, 0.0])

    def run(gamma):
        sol = strongly_damped(OTHERS[name], gamma, layout=dvi.Layout(form=form))
        return sol.qs, sol.result == dvi.RESULTS.successful

    qs, good = jax.jit(jax.vmap(run))(gammas)
    calm, all_good = jax.jit(jax.vmap(run))(gammas.at[1].set(0.5))
    assert all(all_good)
    np.testing.assert_array_equal(good, [True, name != "picard", True, True])
    np.testing.assert_array_equal(qs[jnp.array([0, 2, 3])], calm[jnp.array([0, 2, 3])])
    assert bool(jnp.all(jnp.isnan(qs[1][1:]))) == (name == "picard")


@EACH
def test_nan_stops_at_once(name):
    _, info = jax.jit(lambda x: find_root(jnp.log, x, jnp.ones(1), OTHERS[name]))(-jnp.ones(1))
    assert not bool(info.converged)
    assert int(info.iterations) <= 2


def test_round_off_of_a_component_that_is_nothing_else_is_accepted():
    """A planar orbit seen from oblique axes, as for Newton's method in test_integrate.py."""
    turn = np.linalg.qr(np.array([[1.0, 2.0, 0.3], [0.4, 1.0, 2.0], [2.0, 0.1, 1.0]]))[0]

    def drag(t0, t1, q0, p1, args):
        return -p1 * jnp.sqrt(p1 @ p1)

    system = dvi.System(lambda t0, t1, q, p, a: p @ p / 2 - 1 / jnp.sqrt(q @ q), force=drag)
    q, p = turn @ [0.0, 1.2, 0.0], turn @ [-1.0, -0.6, 0.0]
    at = {"h": 0.05, "num_steps": 200, "epsilon": 0.01}
    reference = dvi.integrate(system, q, p, **at)
    for solver in (Picard(), SimplifiedNewton()):
        np.testing.assert_allclose(
            dvi.integrate(system, q, p, newton=solver, **at).qs, reference.qs, atol=1e-12
        )


def test_a_light_slow_component_is_solved_by_its_own_measure():
    """Two masses, 1 and 1e-12; the light one contracts slowly, which the other must not hide."""

    def H(t0, t1, q, p, m):
        return jnp.sum(p**2 / (2 * m)) + jnp.sum(m * q**2) / 2

    m = np.array([1.0, 1e-12])
    system = dvi.System(H, force=lambda t0, t1, q, p, m: -p * (m < 1))
    at = {"h": 0.1, "num_steps": 20, "epsilon": 6.0, "args": m}
    reference = dvi.integrate(system, [1.0, 1.0], m, newton=Newton(), **at)
    for solver in (Picard(max_steps=200), MANY):
        sol = dvi.integrate(system, [1.0, 1.0], m, newton=solver, **at)
        np.testing.assert_allclose(sol.ps, reference.ps, rtol=1e-13)


# --- on trust, and everywhere ----------------------------------------------------------------


@EACH
def test_components_on_trust_agree_with_arrays(name):
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
    # On trust, and not by care in the end: the number of iterations is the same in every step.
    assert all(np.asarray(components[1]) % 150 == 0)
    np.testing.assert_array_equal(components[2], 64 * EPS)


def test_trust_is_refused_to_what_has_not_converged():
    def F(x):
        return x - 1 + 0.5 * jnp.sin(x)

    x0, one = jnp.full(3, 0.5), jnp.ones(3)
    verdicts = []
    for effort in (2, 3, 4, 5, 6):
        root, info = find_root(F, x0, one, Trusted(Picard(), jnp.asarray(effort)))
        verdicts.append(float(info.residual) <= 0)
        if verdicts[-1]:
            assert float(jnp.max(jnp.abs(F(root)))) <= 4 * EPS
    assert verdicts == sorted(verdicts)
    assert not verdicts[0]
    assert verdicts[-1]


def test_single_precision():
    q, p = np.float32(box(6))
    reference = dvi.integrate(CHAIN, *box(6), h=0.05, num_steps=50)
    for solver in OTHERS.values():
        sol = dvi.integrate(CHAIN, q, p, h=0.05, num_steps=50, newton=solver)
        assert sol.qs.dtype == jnp.float32
        np.testing.assert_allclose(sol.qs, reference.qs, atol=2e-5)


def test_compensated_arithmetic_keeps_what_it_gains():
    q, p = box(3, width=0.4)

    def run(solver, arithmetic):
        sol = dvi.integrate(
            CHAIN, q, p, h=1 / 64, num_steps=4096, newton=solver, arithmetic=arithmetic,
            save=dvi.Save(final=True),
        )  # fmt: skip
        return np.asarray(sol.qs[-1])

    exact = run(Newton(), dvi.Compensated())
    for solver in OTHERS.values():
        np.testing.assert_allclose(run(solver, dvi.Compensated()), exact, rtol=0, atol=4 * EPS)
    assert np.max(np.abs(run(Picard(), dvi.FloatingPoint()) - exact)) > 16 * EPS


@pytest.mark.parametrize("n", [1, UNROLLED_UP_TO, UNROLLED_UP_TO + 1])
def test_factors_solve(n):
    A, b = np.random.default_rng(n).normal(size=(n, n)), np.arange(1.0, n + 1)
    np.testing.assert_allclose(A @ factorised(jnp.asarray(A))(b), b, rtol=1e-12)


# --- the door --------------------------------------------------------------------------------


def test_the_default_is_newtons_for_few_unknowns():
    q, p = box(3)
    at = {"h": 0.05, "num_steps": 20}
    default, reference = (
        dvi.integrate(CHAIN, q, p, **at),
        dvi.integrate(CHAIN, q, p, newton=Newton(), **at),
    )
    np.testing.assert_array_equal(default.qs, reference.qs)
    many = dvi.integrate(CHAIN, *box(20), **at)
    newton = dvi.integrate(CHAIN, *box(20), newton=Newton(), **at)
    assert int(many.stats["newton_iterations"]) > int(newton.stats["newton_iterations"])


@pytest.mark.parametrize("kind", [SimplifiedNewton, Picard])
@pytest.mark.parametrize(
    "bad", [{"rtol": -1.0}, {"max_steps": 0}, {"max_steps": True}, {"atol": np.inf}]
)
def test_settings_that_cannot_work_are_refused(kind, bad):
    with pytest.raises(ValueError, match="must be"):
        kind(**bad)


def test_the_default_refuses_other_kinds():
    with pytest.raises(ValueError, match="newton_up_to must be an integer"):
        PicardThenNewton(newton_up_to=-1)
    with pytest.raises(TypeError, match="picard must be a dvi"):
        PicardThenNewton(picard=Newton())
    with pytest.raises(
        TypeError, match=r"newton must be a RootSolver, got 'picard'; take .*Picard"
    ):
        dvi.integrate(CHAIN, *box(2), h=0.1, num_steps=1, newton="picard")
    with pytest.raises(TypeError, match="is a pair of parentheses missing"):
        dvi.integrate(CHAIN, *box(2), h=0.1, num_steps=1, newton=dvi.Picard)
