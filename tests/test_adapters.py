"""Discrete Hamiltonians from Lagrangians and from other generating functions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import central_difference, flow, non_separable, symplectic_defect
from scipy.integrate import solve_ivp

import dvi_jax as dvi
from dvi_jax import generators, systems
from dvi_jax.engine.newton import find_root

KEPLER = systems.kepler()
K = KEPLER.args
Q, P = jnp.asarray(KEPLER.q0), jnp.asarray(KEPLER.p0)


def kepler_lagrangian(t0, t1, q, v, args):
    """The paper's (35) with attraction: |v|²/2 + K²/|q|."""
    return jnp.sum(v**2) / 2 + args["K"] ** 2 / jnp.sqrt(jnp.sum(q**2))


def curved(t, q, v, args):
    """L = (1 + q²) v²/2 + cos q: a mass that depends on q."""
    return jnp.sum((1 + q**2) * v**2) / 2 + jnp.sum(jnp.cos(q))


def curved_energy(t0, t1, q, p, args):
    """Its H = p²/(2 + 2q²) − cos q, by hand."""
    return jnp.sum(p**2 / (1 + q**2)) / 2 - jnp.sum(jnp.cos(q))


def relativistic(t, q, v, args):
    """L = −√(1 − |v|²) + 1/|q|, unit mass and speed of light; H = √(1 + |p|²) − 1/|q|."""
    return -jnp.sqrt(1 - jnp.sum(v**2)) + 1 / jnp.sqrt(jnp.sum(q**2))


def trapezoidal(L):
    def L_d(t0, t1, q0, q1, args):
        h = t1 - t0
        v = (q1 - q0) / h
        return h / 2 * (L(t0, q0, v, args) + L(t1, q1, v, args))

    return L_d


def midpoint(L):
    def L_d(t0, t1, q0, q1, args):
        h = t1 - t0
        return h * L(t0 + h / 2, (q0 + q1) / 2, (q1 - q0) / h, args)

    return L_d


def pendulum(t, q, v, args):
    return jnp.sum(v**2) / 2 + jnp.sum(jnp.cos(q))


def kepler_continuous(t, q, v, args):
    return kepler_lagrangian(t, t, q, v, args)


def run(H_D, q, p, num_steps=1000, method=dvi.TypeII(), force=None, **more):
    system = H_D if isinstance(H_D, dvi.System) else dvi.System(H_D, force)
    at = {"h": 0.1, "args": K, "method": method, **more}
    return dvi.integrate(system, q, p, num_steps=num_steps, **at)


def apart(one, two):
    """The largest distance between two trajectories."""
    return max(np.max(np.abs(one.qs - two.qs)), np.max(np.abs(one.ps - two.ps)))


@pytest.mark.slow
def test_the_lagrangian_of_the_paper_is_its_kepler_problem():
    """Values, trajectories, and explicit where that is."""
    H_D, exact = dvi.legendre(kepler_lagrangian), KEPLER.system.H_D
    assert abs(H_D(0.0, 0.1, Q, P, K) - exact(0.0, 0.1, Q, P, K)) < 2e-16
    system = dvi.System(H_D, KEPLER.system.force)
    assert dvi.Strang().is_explicit(system, Q, K)
    ours = run(system, Q, P, epsilon=0.01)
    theirs = run(KEPLER.system, Q, P, epsilon=0.01)
    assert apart(ours, theirs) < 1e-11

    def printed(t0, t1, q, v, args):  # (35) as it stands: −K²/r, a repulsion
        return jnp.sum(v**2) - kepler_lagrangian(t0, t1, q, v, args)

    assert apart(run(dvi.legendre(printed), Q, P, 10), run(exact, Q, P, 10)) > 1e-2


@pytest.mark.slow
def test_a_continuous_lagrangian_gives_its_hamiltonian():
    """Against H by hand; one that is not quadratic too, up to momenta far beyond its mass."""
    H = dvi.legendre(curved)
    q, p = jnp.array([0.4, -1.0]), jnp.array([0.7, 2.0])
    np.testing.assert_allclose(H(0.0, q, p, None), curved_energy(0, 0, q, p, None), rtol=1e-15)
    H = jax.jit(jax.value_and_grad(dvi.legendre(relativistic), argnums=2))
    for size in (0.0, 0.01, 1.0, 30.0, 1000.0):
        energy, velocity = H(0.0, Q, size * P, None)
        root = np.sqrt(1 + size**2 * (P @ P))
        np.testing.assert_allclose(energy, root - 1 / 1.2, rtol=1e-13)
        np.testing.assert_allclose(velocity, size * P / root, rtol=1e-13, atol=1e-16)
    curvature = jax.jit(jax.hessian(dvi.legendre(relativistic), argnums=2))(0.0, Q, P, None)
    exact = jax.hessian(lambda p: jnp.sqrt(1 + p @ p))(P)
    np.testing.assert_allclose(curvature, exact, rtol=0, atol=1e-15)


@pytest.mark.slow
def test_discretise_takes_the_hamiltonian_of_a_lagrangian():
    for order in (1, 2):
        ours = run(dvi.discretise(dvi.legendre(curved), order), [0.4], [0.7], 50)
        hand = dvi.discretise(lambda t, q, p, args: curved_energy(t, t, q, p, args), order)
        assert apart(ours, run(hand, [0.4], [0.7], 50)) < 1e-13


@pytest.mark.slow
def test_one_map_by_each_of_its_generating_functions():
    """(q1, p0) of (12)–(13) satisfy what types I and III say of them, at many points."""
    points = np.random.default_rng(0).uniform(-0.7, 0.7, (50, 2, 1))  # beyond, III has none

    def ends(H_D, q0, p1):
        fall, v = jax.grad(H_D, argnums=(2, 3))(0.2, 0.3, q0, p1, None)
        return q0 + 0.1 * v, p1 + 0.1 * fall

    @jax.jit
    @jax.vmap
    def defects(point):
        q0, p1 = point
        q1, p0 = ends(CURVED, q0, p1)
        D = jax.grad(trapezoidal(curved), argnums=(2, 3))(0.2, 0.3, q0, q1, None)
        of_type_i = jnp.concatenate([p0 + D[0], p1 - D[1]])
        q1, p0 = ends(dvi.from_type_iii(backwards), q0, p1)
        fall, v = jax.grad(backwards, argnums=(2, 3))(0.2, 0.3, q1, p0, None)
        of_type_iii = jnp.concatenate([q1 - q0 - 0.1 * v, p1 - p0 + 0.1 * fall])
        fall, v = jax.grad(backwards, argnums=(2, 3))(0.2, 0.3, q0, p1, None)
        return jnp.stack([of_type_i, of_type_iii, jnp.concatenate([q1 - q0 - 0.1 * v] * 2)])

    one, three, wrong = np.max(np.abs(defects(points)), axis=(0, 2))
    assert one < 1e-14
    assert three < 1e-15
    assert wrong > 1e-3  # type II with H⁻ in place of H_D


@pytest.mark.slow
def test_velocities_that_are_round_off_of_positions_are_found():
    """At small h, near turning points, v is known to eps |q0|/h only: no NaN comes of that."""
    H_D, h = jax.jit(jax.vmap(CURVED, in_axes=(None, None, 0, 0, None))), 1e-3
    q = jnp.full((400, 1), 1.3)
    p = h / 2 * jnp.sin(q) + jnp.linspace(-1e-5, 1e-5, 400)[:, None]
    assert np.isfinite(H_D(0.0, h, q, p, None)).all()


LAGRANGIANS = {
    "pendulum": (pendulum, [0.4], [0.7], lambda t0, t1, q, p, a: p @ p / 2 - jnp.sum(jnp.cos(q))),
    "kepler": (kepler_continuous, Q, P, KEPLER.system.H_D),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pendulum", "kepler"])
def test_trapezoidal_lagrangian_is_kick_drift_kick(name):
    L, q, p, H_D = LAGRANGIANS[name]
    ours = run(dvi.from_lagrangian(trapezoidal(L)), q, p)
    tolerance = 1e-12 if name == "pendulum" else 1e-10  # what 1000 steps make of round-off
    assert apart(ours, run(H_D, q, p, method=dvi.Strang())) < tolerance
    assert apart(ours, run(H_D, q, p, method=dvi.Strang(base=dvi.Adjoint()))) > 1e-3


@pytest.mark.slow
def test_midpoint_lagrangian_is_the_implicit_midpoint_rule():
    ours = run(dvi.from_lagrangian(midpoint(curved)), [0.4], [0.7])
    theirs = run(curved_energy, [0.4], [0.7], method=dvi.GaussLegendre(1))
    assert apart(ours, theirs) < 1e-11
    assert apart(ours, run(curved_energy, [0.4], [0.7], method=dvi.Strang())) > 1e-4


def backwards(t0, t1, q1, p0, args):
    """H⁻ of a non-separable, driven H, its weight at t0 and t1 not the same."""
    swing = 1 + 0.2 * jnp.sin(t0) + 0.1 * jnp.cos(3 * t1)
    return swing * non_separable(t0, t1, q1, p0, args)


@pytest.mark.slow
def test_type_iii_is_the_adjoint_of_type_ii():
    """The adjoint evaluates at (t1, t0, q1, p0): so H_D is H⁻ with its times exchanged."""

    def exchanged(t0, t1, q0, p1, args):
        return backwards(t1, t0, q0, p1, args)

    q, p = jnp.array([0.3]), jnp.array([0.4])
    H_D = dvi.from_type_iii(backwards)
    ours = run(H_D, q, p, 200)
    assert apart(ours, run(exchanged, q, p, 200, dvi.Adjoint())) < 1e-12
    assert apart(ours, run(exchanged, q, p, 200)) > 1e-3
    assert apart(ours, run(backwards, q, p, 200, dvi.Adjoint())) > 1e-3
    np.testing.assert_allclose(H_D(0.5, 0.5, q, p, None), backwards(0.5, 0.5, q, p, None))


def lagrangian_of(H_D):
    """L_d(q0, q1) = p1·(q1 − q0) − h H_D(q0, p1), stationary in p1: type I from type II."""

    def L_d(t0, t1, q0, q1, args):
        h = t1 - t0

        def off(p1):
            return q0 + h * jax.grad(H_D, argnums=3)(t0, t1, q0, p1, args) - q1

        p1, _ = find_root(off, (q1 - q0) / h, q1, dvi.Newton())
        return p1 @ (q1 - q0) - h * H_D(t0, t1, q0, p1, args)

    return L_d


@pytest.mark.slow
def test_type_ii_to_type_i_and_back():
    q, p = jnp.array([0.3]), jnp.array([0.4])
    round_trip = dvi.from_lagrangian(lagrangian_of(backwards))

    @jax.jit
    def both(p):
        at = (0.2, 0.3, q, p, None)
        pair = [jax.value_and_grad(H, argnums=(2, 3))(*at) for H in (round_trip, backwards)]
        return [jnp.stack([H, *map(jnp.sum, slopes)]) for H, slopes in pair]

    for x in (p, -p, 3 * p):
        ours, theirs = map(np.asarray, both(x))
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=3e-15 * np.max(np.abs(theirs)))
    assert abs(both(p)[0][0] - both(p * 1.001)[0][0]) > 1e-5


def drag(t0, t1, q0, v, args):
    """F = −(1 + q²) v + cos t."""
    return -(1 + q0**2) * v + jnp.cos(t0)


CURVED = dvi.from_lagrangian(trapezoidal(curved))
FORCED = dvi.System(CURVED, dvi.velocity_force(CURVED, drag))


@pytest.mark.slow
@pytest.mark.parametrize("epsilon", [0.0, 0.2])
def test_discrete_euler_lagrange_equations_hold(epsilon):
    """Unforced: D2 L_d(q_{k−1}, q_k) + D1 L_d(q_k, q_{k+1}) = 0; forced: with h ε F there."""
    L_d, sol = trapezoidal(curved), run(FORCED, [0.4], [0.7], 100, epsilon=epsilon)
    t, q = sol.ts, sol.qs

    @jax.jit
    def equations(t, q, size):
        def each(ta, tb, tc, a, b, c):
            one = jax.grad(L_d, argnums=3)(ta, tb, a, b, None)
            two = jax.grad(L_d, argnums=2)(tb, tc, b, c, None)
            F = drag(tb, tc, b, (c - b) / (tc - tb), None)
            return one + two + size * (tc - tb) * F

        return jax.vmap(each)(t[:-2], t[1:-1], t[2:], q[:-2], q[1:-1], q[2:])

    assert np.max(np.abs(equations(t, q, epsilon))) < 1e-13
    moved = q.at[50].add(1e-6)
    assert np.max(np.abs(equations(t, moved, epsilon))) > 1e-6
    assert np.max(np.abs(equations(t, q, epsilon + 0.01))) > 1e-5  # another force


def errors_at(system, numbers, exact, t_end=2.0, epsilon=0.0, method=dvi.TypeII()):
    z = jnp.array([0.4, 0.7])
    step = jax.jit(lambda z, t0, h: flow(system, method, h, t0=t0, epsilon=epsilon)(z))
    errors = []
    for n in numbers:
        state = z
        for k in range(n):
            state = step(state, k * t_end / n, t_end / n)
        errors.append(np.max(np.abs(state - exact)))
    return np.array(errors)


def exact_end(epsilon, t_end=2.0):
    """SciPy's DOP853, the equations by hand: q̇ = p/(1 + q²), ṗ = q p²/(1 + q²)² − sin q + εF."""

    def field(t, z):
        q, p = z
        v = p / (1 + q**2)
        return v, q * v**2 - np.sin(q) + epsilon * (-(1 + q**2) * v + np.cos(t))

    return solve_ivp(field, (0, t_end), [0.4, 0.7], method="DOP853", rtol=1e-13, atol=1e-14).y[
        :, -1
    ]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rule", "epsilon", "method", "order"),
    [
        (trapezoidal, 0.0, dvi.TypeII(), 2),
        (midpoint, 0.0, dvi.TypeII(), 2),
        (trapezoidal, 0.2, dvi.TypeII(), 1),
        (trapezoidal, 0.2, dvi.Strang(), 2),
    ],
)
def test_order(rule, epsilon, method, order):
    """Two, of a symmetric L_d; one with a force, which is on the left end; two again composed."""
    H_D = dvi.from_lagrangian(rule(curved))
    system = dvi.System(H_D, dvi.velocity_force(H_D, drag))
    errors = errors_at(system, (32, 64, 128), exact_end(epsilon), epsilon=epsilon, method=method)
    assert np.all(errors > 1e-10)
    np.testing.assert_allclose(np.log2(errors[:-1] / errors[1:]), order, atol=0.2)


@pytest.mark.slow
def test_map_is_symplectic_and_damped_it_is_not():
    @jax.jit
    def jacobian(epsilon):
        return jax.jacfwd(flow(FORCED, dvi.TypeII(), 0.1, epsilon=epsilon))(jnp.array([0.4, 0.7]))

    assert symplectic_defect(np.asarray(jacobian(0.0))) <= 1e-13
    assert np.linalg.det(jacobian(0.3)) < 0.99


@pytest.mark.slow
def test_symmetries_of_an_adapted_hamiltonian():
    """Rotation of the midpoint Kepler problem: its identity holds, and it is found."""
    system = dvi.System(dvi.from_lagrangian(midpoint(kepler_continuous)))
    rng = np.random.default_rng(1)
    q, p = 1.5 + rng.uniform(-0.5, 0.5, (30, 2)), rng.uniform(-1, 1, (30, 2))
    first, second = dvi.solution_pairs(system, h=0.1, samples=(q, p), args=K)

    def worst(generator):
        def both(a, b):
            residual = dvi.determining_residual(system, generator, a, b, args=K)
            identity = dvi.noether_identity(system, [generator], [None], 0, a, b, args=K)
            return jnp.max(jnp.abs(residual)), jnp.abs(identity)

        return [float(jnp.max(x)) for x in jax.jit(jax.vmap(both))(first, second)]

    rotation = generators.rotation()
    assert worst(rotation)[1] < 1e-13
    assert worst(generators.space_translation([1.0, 0.0]))[1] > 1e-3
    found = dvi.find_symmetries(
        system, dvi.Polynomials(1), h=0.1, samples=(q, p), args=K, time=False
    )
    assert len(found) == 1
    assert found.variational


@pytest.mark.slow
@pytest.mark.parametrize("adapt", ["from_lagrangian", "from_type_iii"])
def test_gradients_go_through_the_inner_solve(adapt):
    """Reverse and forward against a difference quotient, in q, p and args; values closed over."""
    with_args = {
        "from_lagrangian": trapezoidal(
            lambda t, q, v, args: curved(t, q, v, None) - args * jnp.sum(q**4)
        ),
        "from_type_iii": lambda t0, t1, q1, p0, args: (
            backwards(t0, t1, q1, p0, None) + args * jnp.sum(q1**4)
        ),
    }[adapt]

    def value(x):
        def closed(t0, t1, a, b, args):
            return with_args(t0, t1, a, b, x[2])  # not through args

        steps = {"h": 0.1, "num_steps": 3, "save": dvi.Save(final=True)}
        system = dvi.System(getattr(dvi, adapt)(closed))
        sol = dvi.integrate(system, x[:1], x[1:2], **steps)
        return jnp.sum(sol.qs[-1] ** 3) + jnp.sum(sol.ps[-1])

    def through_args(x):
        steps = {"h": 0.1, "num_steps": 3, "save": dvi.Save(final=True)}
        system = dvi.System(getattr(dvi, adapt)(with_args))
        sol = dvi.integrate(system, x[:1], x[1:2], args=x[2], **steps)
        return jnp.sum(sol.qs[-1] ** 3) + jnp.sum(sol.ps[-1])

    x, direction = jnp.array([0.4, 0.7, 0.3]), jnp.array([0.6, -0.8, 0.5])
    reverse = jax.jit(jax.grad(through_args))(x)
    _, forward = jax.jit(lambda x, d: jax.jvp(value, (x,), (d,)))(x, direction)
    np.testing.assert_allclose(forward, reverse @ direction, rtol=1e-12)
    quotient = central_difference(jax.jit(through_args), x, direction)
    np.testing.assert_allclose(forward, quotient, rtol=1e-9)
    assert np.min(np.abs(reverse)) > 1e-4


@pytest.mark.slow
def test_a_batch_is_the_loop_and_a_lost_lane_spoils_no_other():
    """Of log cosh v the momenta are between −1 and 1: beyond there is no v."""
    H_D = dvi.legendre(lambda t0, t1, q, v, args: jnp.sum(jnp.log(jnp.cosh(v))) - jnp.sum(q**2) / 2)

    def end(p):
        sol = run(H_D, jnp.array([0.1]), p, 3, throw=False)
        return sol.qs[-1], sol.result == dvi.RESULTS.successful

    ps = jnp.array([[0.6], [1.7], [0.8]])
    batch, good = jax.jit(jax.vmap(end))(ps)
    np.testing.assert_array_equal(good, [True, False, True])
    one = jax.jit(end)
    np.testing.assert_allclose(batch[::2], [one(p)[0] for p in ps[::2]], rtol=1e-14)
    assert np.isnan(batch[1]).all()
    assert not one(ps[1])[1]


@pytest.mark.parametrize(
    "L",
    [
        lambda t0, t1, q, v, args: jnp.sum(q * v) - jnp.sum(q**2),
        lambda t0, t1, q, v, args: jnp.sum(v**4) - jnp.sum(q**2),
    ],
    ids=["linear", "flat at rest"],
)
def test_a_lagrangian_that_is_not_regular_is_told(L):
    assert run(dvi.legendre(L), [0.4], [0.7], 2, throw=False).status == "not_finite"


@pytest.mark.slow
def test_a_method_on_the_diagonal_is_told():
    H_D = dvi.from_lagrangian(trapezoidal(pendulum))
    sol = run(H_D, [0.4], [0.7], 2, dvi.RungeKutta4(), throw=False)
    assert sol.status == "not_finite"


def test_bad_input_is_refused():
    def three(t, q, v):
        return 0.0

    def either(t, q, v, args, more=None):
        return 0.0

    with pytest.raises(TypeError, match=r"discrete Lagrangian .* got three.*takes neither"):
        dvi.legendre(three)
    with pytest.raises(TypeError, match="four arguments and five: wrap it"):
        dvi.legendre(either)
    with pytest.raises(TypeError, match=r"L must be .* got 3\.0, which takes neither"):
        dvi.legendre(3.0)
    with pytest.raises(TypeError, match=r"L_d must take five .* curved"):
        dvi.from_lagrangian(curved)
    with pytest.raises(TypeError, match="H_minus must take five"):
        dvi.from_type_iii(curved)
    with pytest.raises(TypeError, match="F must take five"):
        dvi.velocity_force(backwards, curved)
    for adapt, name in [
        (dvi.legendre, "L_D"),
        (dvi.from_lagrangian, "L_d"),
        (dvi.from_type_iii, "H_minus"),
    ]:
        system = dvi.System(adapt(lambda t0, t1, a, b, args: a * b))
        with pytest.raises(ValueError, match=rf"{name}\(.*must return a real scalar .*\(2,\)"):
            run(system, Q, P, 1)


@pytest.mark.parametrize("adapt", [dvi.from_lagrangian, dvi.from_type_iii])
def test_a_slow_time_has_no_step_in_it(adapt):
    with pytest.raises(ValueError, match="step from t1 − t0"):
        dvi.System(adapt(backwards), slow_time=True)
    assert dvi.System(dvi.legendre(kepler_lagrangian), slow_time=True).slow_time
