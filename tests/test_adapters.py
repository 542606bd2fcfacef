"""Discrete Hamiltonians from Lagrangians and from other generating functions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import central_difference, flow, non_separable
from scipy.integrate import solve_ivp

import dvi_jax as dvi
from dvi_jax import generators, systems
from dvi_jax.engine.newton import find_root

KEPLER = systems.kepler()
K = KEPLER.args
Q, P = jnp.asarray(KEPLER.q0), jnp.asarray(KEPLER.p0)
slow = pytest.mark.slow


def kepler_lagrangian(t0, t1, q, v, args):
    """The paper's (35) with attraction: |v|²/2 + K²/|q|."""
    return jnp.sum(v**2) / 2 + args["K"] ** 2 / jnp.sqrt(jnp.sum(q**2))


def kepler_continuous(t, q, v, args):
    return kepler_lagrangian(t, t, q, v, args)


def curved(t, q, v, args):
    """L = (1 + q²) v²/2 + cos q: a mass that depends on q."""
    return jnp.sum((1 + q**2) * v**2) / 2 + jnp.sum(jnp.cos(q))


def curved_energy(t0, t1, q, p, args):
    """Its H = p²/(2 + 2q²) − cos q, by hand."""
    return jnp.sum(p**2 / (1 + q**2)) / 2 - jnp.sum(jnp.cos(q))


def relativistic(t, q, v, args):
    """L = −√(1 − |v|²) + 1/|q|, unit mass and speed of light; H = √(1 + |p|²) − 1/|q|."""
    return -jnp.sqrt(1 - jnp.sum(v**2)) + 1 / jnp.sqrt(jnp.sum(q**2))


def pendulum(t, q, v, args):
    return jnp.sum(v**2) / 2 + jnp.sum(jnp.cos(q))


def trapezoidal(L):
    def L_d(t0, t1, q0, q1, args):
        v = (q1 - q0) / (t1 - t0)
        return (t1 - t0) / 2 * (L(t0, q0, v, args) + L(t1, q1, v, args))

    return L_d


def midpoint(L):
    def L_d(t0, t1, q0, q1, args):
        h = t1 - t0
        return h * L(t0 + h / 2, (q0 + q1) / 2, (q1 - q0) / h, args)

    return L_d


def backwards(t0, t1, q1, p0, args):
    """H⁻ of a non-separable, driven H, its weight at t0 and t1 not the same."""
    swing = 1 + 0.2 * jnp.sin(t0) + 0.1 * jnp.cos(3 * t1)
    return swing * non_separable(t0, t1, q1, p0, args)


def drag(t0, t1, q0, v, args):
    """F = −(1 + q²) v + cos t."""
    return -(1 + q0**2) * v + jnp.cos(t0)


def with_drag(H_D):
    return dvi.System(H_D, dvi.velocity_force(H_D, drag))


CURVED = dvi.from_lagrangian(trapezoidal(curved))
FORCED = with_drag(CURVED)


def run(H_D, q, p, num_steps=1000, method=dvi.TypeII(), **more):
    system = H_D if isinstance(H_D, dvi.System) else dvi.System(H_D)
    at = {"h": 0.1, "args": K, "method": method, **more}
    return dvi.integrate(system, q, p, num_steps=num_steps, **at)


def apart(one, two):
    """The largest distance between two trajectories."""
    return max(np.max(np.abs(one.qs - two.qs)), np.max(np.abs(one.ps - two.ps)))


@slow
def test_the_hamiltonians_of_discrete_and_continuous_lagrangians():
    """Values, trajectories, and explicit where that is."""
    H_D, exact = dvi.legendre(kepler_lagrangian), KEPLER.system.H_D
    assert abs(H_D(0.0, 0.1, Q, P, K) - exact(0.0, 0.1, Q, P, K)) < 2e-16
    system = dvi.System(H_D, KEPLER.system.force)
    assert dvi.Strang().is_explicit(system, Q, K)
    assert apart(run(system, Q, P, epsilon=0.01), run(KEPLER.system, Q, P, epsilon=0.01)) < 1e-11

    def printed(t0, t1, q, v, args):  # (35) as printed: −K²/r, a repulsion
        return jnp.sum(v**2) - kepler_lagrangian(t0, t1, q, v, args)

    assert apart(run(dvi.legendre(printed), Q, P, 10), run(exact, Q, P, 10)) > 1e-2
    # Against H by hand; one that is not quadratic too, up to momenta far beyond its mass.
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


@slow
def test_velocities_that_are_round_off_of_positions_are_found():
    """At small h, near turning points, v is known to eps |q0|/h only: no NaN comes of that."""
    H_D, h = jax.jit(jax.vmap(CURVED, in_axes=(None, None, 0, 0, None))), 1e-3
    q = jnp.full((400, 1), 1.3)
    p = h / 2 * jnp.sin(q) + jnp.linspace(-1e-5, 1e-5, 400)[:, None]
    assert np.isfinite(H_D(0.0, h, q, p, None)).all()


def lagrangian_of(H_D):
    """L_d(q0, q1) = p1·(q1 − q0) − h H_D(q0, p1), stationary in p1: type I from type II."""

    def L_d(t0, t1, q0, q1, args):
        h = t1 - t0

        def off(p1):
            return q0 + h * jax.grad(H_D, argnums=3)(t0, t1, q0, p1, args) - q1

        p1, _ = find_root(off, (q1 - q0) / h, q1, dvi.Newton())
        return p1 @ (q1 - q0) - h * H_D(t0, t1, q0, p1, args)

    return L_d


@slow
def test_type_ii_to_type_i_and_back():
    q, p = jnp.array([0.3]), jnp.array([0.4])
    round_trip = dvi.from_lagrangian(lagrangian_of(backwards))

    @jax.jit
    def both(p):
        at = (0.2, 0.3, q, p, None)
        pair = [jax.value_and_grad(H, argnums=(2, 3))(*at) for H in (round_trip, backwards)]
        return [jnp.stack([H, *map(jnp.sum, slopes)]) for H, slopes in pair]

    at = (0.5, 0.5, q, p, None)  # at equal times both are the Hamiltonian
    np.testing.assert_allclose(jax.jit(dvi.from_type_iii(backwards))(*at), backwards(*at))
    for x in (p, -p, 3 * p):
        ours, theirs = map(np.asarray, both(x))
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=3e-15 * np.max(np.abs(theirs)))
    assert abs(both(p)[0][0] - both(p * 1.001)[0][0]) > 1e-5


ADJOINT, STRANG = dvi.Adjoint(), dvi.Strang()
KICKS, DRIFTS = STRANG, dvi.Strang(base=ADJOINT)


def exchanged(t0, t1, q0, p1, args):
    """The adjoint evaluates at (t1, t0, q1, p0): so H_D is H⁻ with its times exchanged."""
    return backwards(t1, t0, q0, p1, args)


def pendulum_energy(t0, t1, q, p, args):
    return p @ p / 2 - jnp.sum(jnp.cos(q))


def discretised(order):
    H = dvi.legendre(curved)
    by_hand = dvi.discretise(lambda t, q, p, args: curved_energy(t, t, q, p, args), order)
    return dvi.discretise(H, order), by_hand


ONE = ([0.4], [0.7])
THREE = (jnp.array([0.3]), jnp.array([0.4]))
MAPS = {
    "trapezoidal pendulum": (
        dvi.from_lagrangian(trapezoidal(pendulum)), ONE, 1000, 1e-12,
        (pendulum_energy, KICKS), [(pendulum_energy, DRIFTS, 1e-3)],
    ),
    "trapezoidal kepler": (
        dvi.from_lagrangian(trapezoidal(kepler_continuous)), (Q, P), 1000, 1e-10,
        (KEPLER.system.H_D, KICKS), [(KEPLER.system.H_D, DRIFTS, 1e-3)],
    ),
    "midpoint": (
        dvi.from_lagrangian(midpoint(curved)), ONE, 1000, 1e-11,
        (curved_energy, dvi.GaussLegendre(1)), [(curved_energy, STRANG, 1e-4)],
    ),
    "type III": (
        dvi.from_type_iii(backwards), THREE, 200, 1e-12,
        (exchanged, ADJOINT), [(exchanged, dvi.TypeII(), 1e-3), (backwards, ADJOINT, 1e-3)],
    ),
    **{
        f"discretise {order}": (ours, ONE, 50, 1e-13, (theirs, dvi.TypeII()), [])
        for order in (1, 2) for ours, theirs in [discretised(order)]
    },
}  # fmt: skip
"""H_D, start, steps, tolerance; the same map by another method, and maps that are not the same."""


@slow
@pytest.mark.parametrize("name", MAPS)
def test_an_adapted_hamiltonian_has_the_map_of_a_known_method(name):
    """Trapezoidal: kick, drift, kick; midpoint: the implicit midpoint rule; type III: adjoint."""
    H_D, start, num_steps, tolerance, (same, method), others = MAPS[name]
    ours = run(H_D, *start, num_steps)
    assert apart(ours, run(same, *start, num_steps, method)) < tolerance
    for other, method, distance in others:
        assert apart(ours, run(other, *start, num_steps, method)) > distance


@slow
@pytest.mark.parametrize("epsilon", [0.0, 0.2])
def test_discrete_euler_lagrange_equations_hold(epsilon):
    """Unforced: D2 L_d(q_{k−1}, q_k) + D1 L_d(q_k, q_{k+1}) = 0; forced: with h ε F there."""
    L_d, sol = trapezoidal(curved), run(FORCED, *ONE, 100, epsilon=epsilon)
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
    assert np.max(np.abs(equations(t, q.at[50].add(1e-6), epsilon))) > 1e-6
    assert np.max(np.abs(equations(t, q, epsilon + 0.01))) > 1e-5  # another force


def exact_end(epsilon, t_end):
    """SciPy's DOP853, the equations by hand: q̇ = p/(1 + q²), ṗ = q p²/(1 + q²)² − sin q + εF."""

    def field(t, z):
        q, p = z
        v = p / (1 + q**2)
        return v, q * v**2 - np.sin(q) + epsilon * (-(1 + q**2) * v + np.cos(t))

    start, how = [0.4, 0.7], {"method": "DOP853", "rtol": 1e-13, "atol": 1e-14}
    return solve_ivp(field, (0, t_end), start, **how).y[:, -1]


@slow
@pytest.mark.parametrize(
    ("rule", "epsilon", "method", "order"),
    [
        (trapezoidal, 0.0, dvi.TypeII(), 2),
        (midpoint, 0.0, dvi.TypeII(), 2),
        (trapezoidal, 0.2, dvi.TypeII(), 1),
        (trapezoidal, 0.2, STRANG, 2),
    ],
)
def test_order(rule, epsilon, method, order):
    """Two, of a symmetric L_d; one with a force, which is on the left end; two again composed."""
    system, t_end, errors = with_drag(dvi.from_lagrangian(rule(curved))), 2.0, []
    step = jax.jit(lambda z, t0, h: flow(system, method, h, t0=t0, epsilon=epsilon)(z))
    for n in (32, 64, 128):
        z = jnp.array([0.4, 0.7])
        for k in range(n):
            z = step(z, k * t_end / n, t_end / n)
        errors.append(np.max(np.abs(z - exact_end(epsilon, t_end))))
    errors = np.array(errors)
    assert np.all(errors > 1e-10)
    np.testing.assert_allclose(np.log2(errors[:-1] / errors[1:]), order, atol=0.2)


@slow
def test_symmetries_of_an_adapted_hamiltonian():
    """Rotation of the midpoint Kepler problem: its identity holds, and it is found."""
    system = dvi.System(dvi.from_lagrangian(midpoint(kepler_continuous)))
    rng = np.random.default_rng(1)
    samples = 1.5 + rng.uniform(-0.5, 0.5, (30, 2)), rng.uniform(-1, 1, (30, 2))
    first, second = dvi.solution_pairs(system, h=0.1, samples=samples, args=K)

    def worst(generator):
        def identity(a, b):
            return jnp.abs(dvi.noether_identity(system, [generator], [None], 0, a, b, args=K))

        return float(jnp.max(jax.jit(jax.vmap(identity))(first, second)))

    assert worst(generators.rotation()) < 1e-13
    assert worst(generators.space_translation([1.0, 0.0])) > 1e-3
    how = {"h": 0.1, "samples": samples, "args": K, "time": False}
    found = dvi.find_symmetries(system, dvi.Polynomials(1), **how)
    assert len(found) == 1
    assert found.variational


@slow
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

    def value(x, closed_over):
        def closed(t0, t1, a, b, args):
            return with_args(t0, t1, a, b, x[2])

        system = dvi.System(getattr(dvi, adapt)(closed if closed_over else with_args))
        how = {"h": 0.1, "num_steps": 3, "save": dvi.Save(final=True)}
        sol = dvi.integrate(system, x[:1], x[1:2], args=None if closed_over else x[2], **how)
        return jnp.sum(sol.qs[-1] ** 3) + jnp.sum(sol.ps[-1])

    def through_args(x):
        return value(x, False)

    x, direction = jnp.array([0.4, 0.7, 0.3]), jnp.array([0.6, -0.8, 0.5])
    reverse = jax.jit(jax.grad(through_args))(x)
    _, forward = jax.jit(lambda x, d: jax.jvp(lambda x: value(x, True), (x,), (d,)))(x, direction)
    np.testing.assert_allclose(forward, reverse @ direction, rtol=1e-12)
    quotient = central_difference(jax.jit(through_args), x, direction)
    np.testing.assert_allclose(forward, quotient, rtol=1e-9)
    assert np.min(np.abs(reverse)) > 1e-4


@slow
def test_a_batch_is_the_loop_and_a_failed_trajectory_changes_no_other():
    """Of log cosh v the momenta are between −1 and 1: beyond there is no v."""
    H_D = dvi.legendre(lambda t0, t1, q, v, args: jnp.sum(jnp.log(jnp.cosh(v))) - jnp.sum(q**2) / 2)

    def end(p):
        sol = run(H_D, jnp.array([0.1]), p, 3, throw=False)
        return sol.qs[-1], sol.result == dvi.RESULTS.successful

    ps, one = jnp.array([[0.6], [1.7], [0.8]]), jax.jit(end)
    batch, good = jax.jit(jax.vmap(end))(ps)
    np.testing.assert_array_equal(good, [True, False, True])
    np.testing.assert_allclose(batch[::2], [one(p)[0] for p in ps[::2]], rtol=1e-14)
    assert np.isnan(batch[1]).all()
    assert not one(ps[1])[1]


@pytest.mark.parametrize(
    ("H_D", "method"),
    [
        (dvi.legendre(lambda t0, t1, q, v, a: jnp.sum(q * v) - jnp.sum(q**2)), dvi.TypeII()),
        (dvi.legendre(lambda t0, t1, q, v, a: jnp.sum(v**4) - jnp.sum(q**2)), dvi.TypeII()),
        pytest.param(dvi.from_lagrangian(trapezoidal(pendulum)), dvi.RungeKutta4(), marks=slow),
    ],
    ids=["linear", "flat at rest", "a method on the diagonal"],
)
def test_an_inner_solve_without_a_solution_has_a_status(H_D, method):
    assert run(H_D, *ONE, 2, method, throw=False).status == "not_finite"


def test_invalid_functions_and_a_slow_time_are_rejected():

    def three(t, q, v):
        return 0.0

    def either(t, q, v, args, more=None):
        return 0.0

    for call, message in (
        (lambda: dvi.legendre(three), r"got three.*accepts neither"),
        (lambda: dvi.legendre(either), "accepts both"),
        (lambda: dvi.legendre(3.0), r"L must be .* got 3\.0, which accepts neither"),
        (lambda: dvi.from_lagrangian(curved), r"L_d must take the arguments .* curved"),
        (lambda: dvi.from_type_iii(curved), "H_minus must take the arguments"),
        (lambda: dvi.velocity_force(backwards, curved), "F must take the arguments"),
    ):
        with pytest.raises(TypeError, match=message):
            call()
    for adapt, name in (
        (dvi.legendre, "L_D"),
        (dvi.from_lagrangian, "L_d"),
        (dvi.from_type_iii, "H_minus"),
    ):
        system = dvi.System(adapt(lambda t0, t1, a, b, args: a * b))
        with pytest.raises(ValueError, match=rf"{name}\(.*must return a real scalar .*\(2,\) and"):
            run(system, Q, P, 1)
    for adapt in (dvi.from_lagrangian, dvi.from_type_iii):
        with pytest.raises(ValueError, match="step as t1 − t0"):
            dvi.System(adapt(backwards), slow_time=True)
    assert dvi.System(dvi.legendre(kepler_lagrangian), slow_time=True).slow_time
