"""Faults that were reported once, each as the script that showed it, made small."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compilation import AS_FOR_USERS
from jax import lax

import dvi_jax as dvi

KEPLER = dvi.System(lambda t0, t1, q, p, a: p @ p / 2 - 1 / jnp.linalg.norm(q))
Q0, P0 = [0.3, 1.2], [-1.0, -0.6]
FINAL, SLOW = dvi.Save(final=True), pytest.mark.slow


def kinetic(t0, t1, q0, p0, q1, p1, a):
    return p1 @ p1


def weighted(t0, t1, q0, p0, q1, p1, a):
    return a * (p1 @ p1)


def test_a_swept_argument_that_only_an_observable_uses():
    """XLA aborted the process, also in the next test."""
    weights = np.linspace(1.0, 2.0, 6)
    observe = {"drift": dvi.MaxDrift(kinetic), "last": dvi.Last(weighted)}
    how = {"h": 0.05, "num_steps": 5, "observe": observe, "progress": False}
    found = dvi.sweep(KEPLER, Q0, P0, args=dvi.Axis("a", weights), **how)
    np.testing.assert_allclose(found["last"], weights * found["last"][0], rtol=1e-14)
    assert np.all(found["drift"] == found["drift"][0])


def test_an_observable_of_one_trajectory():
    run = {"h": 0.05, "num_steps": 500}
    values = np.sum(np.asarray(dvi.integrate(KEPLER, Q0, P0, **run).ps[1:]) ** 2, axis=1)
    drift = np.max(np.abs(values - values[0]))
    for settings in ({}, {"adjoint": dvi.Reversible(checkpoint_every=500)}):
        how = run | settings | {"observe": dvi.MaxDrift(kinetic), "save": FINAL}
        found = dvi.integrate(KEPLER, Q0, P0, **how)
        np.testing.assert_allclose(found.observed, drift, rtol=1e-14)


def final_momenta(system, q, p, args, h, stop=None):
    def one(q, p, args):
        run = {"epsilon": 1.0, "args": args, "stop": stop, "save": FINAL, "throw": False}
        found = dvi.integrate(system, q, p, h=h, num_steps=10, **run)
        return found.ps[-1], found.result == dvi.RESULTS.successful

    found, successful = jax.jit(jax.vmap(one, in_axes=(0, 0, None)))(q, p, args)
    assert successful.all()
    return found


def by_hand(force, q, p, h, mass):
    """The momenta after ten steps, in double precision."""
    for _ in range(10):
        p = p + h * force(q)
        q = q + h * p / mass
    return p


def kinetic_energy(t0, t1, q, p, a):
    return jnp.sum(p * (p / (2 * a["m"])))


def test_a_product_that_would_underflow_in_another_order():
    """An atom in a light field, in SI units and float32: hbar·(c3·|E|²), hbar·c3 subnormal."""
    hbar, c3, mass, h = 1.05e-34, 1e-8, 1.4e-25, 1e-9

    def light(t0, t1, q, p, a):
        return a["hbar"] * (a["c3"] * jnp.square(3.1622777e9 * jnp.cos(8e6 * q)))

    q = np.linspace(0, 1e-7, 9, dtype=np.float32)[:, None]
    args = {k: np.float32(v) for k, v in {"m": mass, "hbar": hbar, "c3": c3}.items()}
    found = final_momenta(dvi.System(kinetic_energy, force=light), q, 0 * q, args, h)
    assert np.float32(hbar) * np.float32(c3) < np.finfo(np.float32).tiny
    expected = by_hand(
        lambda q: hbar * c3 * 1e19 * np.cos(8e6 * q) ** 2, q.astype(float), 0.0, h, mass
    )
    np.testing.assert_allclose(found, expected, rtol=1e-4)


@pytest.mark.parametrize("stop", [None, dvi.Stop(lambda t, q, p, a: jnp.linalg.norm(q) - 1e13)])
def test_a_product_that_would_overflow_in_another_order(stop):
    """Sun and Earth in SI units and float32: m·(M·…), while m·M is infinite."""
    G, M, m, h = 6.674e-11, 2e30, 6e24, 36000.0

    def gravity(t0, t1, q, p, a):
        r = jnp.linalg.norm(q)
        return -a["m"] * (a["M"] * (a["G"] * (q / r / jnp.sum(jnp.square(q)))))

    q, p = np.array([1.5e11, 0]), np.array([0, m * 3e4])
    args = {k: np.float32(v) for k, v in {"G": G, "M": M, "m": m}.items()}
    starts = (np.tile(np.float32(x), (9, 1)) for x in (q, p))
    system = dvi.System(kinetic_energy, force=gravity)
    found = final_momenta(system, *starts, args, np.float32(h), stop)
    with np.errstate(over="ignore"):
        assert np.isinf(np.float32(m) * np.float32(M))
    expected = by_hand(lambda q: -G * M * m * q / np.linalg.norm(q) ** 3, q, p, h, m)
    np.testing.assert_allclose(found, np.tile(expected, (9, 1)), rtol=1e-5)


@pytest.mark.parametrize("epsilon", [0.1, 0.6])
def test_a_root_where_the_jacobian_of_autodiff_is_not_the_true_one(epsilon):
    """Friction behind stop_gradient: Newton converges linearly, and must not stop too early."""
    h = 0.1
    system = dvi.System(
        lambda t0, t1, q, p, a: p @ p / 2 + q @ q / 2,
        force=lambda t0, t1, q, p, a: -lax.stop_gradient(p),
    )

    def one(q, p):
        found = dvi.integrate(system, q, p, h=h, num_steps=50, epsilon=epsilon, throw=False)
        return found.qs, found.ps, found.result == dvi.RESULTS.successful

    rng = np.random.default_rng(0)
    qs, ps, successful = jax.jit(jax.vmap(one))(*rng.uniform(0.5, 1, (2, 16, 1)))
    q0, p0, p1 = qs[:, :-1], ps[:, :-1], ps[:, 1:]
    defect = np.abs(p1 - p0 + h * q0 + h * epsilon * p1) / (np.abs(p0) + np.abs(p1))
    assert np.max(defect) < 2e-15
    assert successful.all()


def test_a_batch_that_is_fine_under_debug_nans():
    system = dvi.System(lambda t0, t1, q, p, a: p @ p / 2 + q @ q / 2)

    def one(q):
        return dvi.integrate(system, q, jnp.zeros(2), h=0.1, num_steps=200, save=FINAL).qs[-1]

    expected = jax.jit(jax.vmap(one))(jnp.ones((64, 2)))
    with jax.debug_nans(True):
        found = jax.jit(jax.vmap(one))(jnp.ones((64, 2)))
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize(
    "adjoint",
    [dvi.Reversible(), dvi.Checkpointed(), pytest.param(dvi.Direct(), marks=SLOW)],
)
def test_gradient_of_a_batch_with_a_branch_in_the_hamiltonian(adjoint):
    def H(t0, t1, q, p, a):
        def square(y):
            return y @ y

        def cosine(y):
            return jnp.sum(jnp.cos(y))

        inner = lax.cond(q[0] + p[0] > 0, square, cosine, q + 0.3 * p)
        return p @ p / 2 + q @ q / 2 + 0.1 * inner

    def last(q):
        run = {"h": 0.05, "num_steps": 4, "adjoint": adjoint, "throw": False}
        return dvi.integrate(dvi.System(H), q, jnp.array([0.1, 0.2]), **run).qs[-1].sum()

    q = jnp.array([[0.4, 0.3], [-0.4, 0.2]])
    of_batch = jax.jit(jax.grad(lambda q: jax.vmap(last)(q).sum()))(q)
    moved = np.asarray(q)[:, None, None] + 1e-5 * np.array([1, -1])[:, None, None] * np.eye(2)
    ends = jax.jit(jax.vmap(last))(moved.reshape(-1, 2)).reshape(2, 2, 2)
    np.testing.assert_allclose(of_batch, (ends[:, 0] - ends[:, 1]) / 2e-5, atol=1e-9)


def test_the_drift_over_one_step_is_zero():
    """q² is contracted into no difference, which would give its rounding error."""
    run = {"h": 0.1, "num_steps": 1, "observe": dvi.MaxDrift(lambda *at: at[4][0] ** 2)}
    one = jax.jit(jax.vmap(lambda q: dvi.integrate(KEPLER, q, jnp.ones(2), **run).observed))
    assert np.all(one(np.random.default_rng(0).uniform(0.5, 1.0, (16, 2))) == 0.0)


def test_products_of_the_stages_of_gauss():
    """`jnp.prod` under `vmap` takes axes in another order: the Jacobian of the stages was wrong,
    and no step converged."""
    system = dvi.System(lambda t0, t1, q, p, args: p @ p / 2 + p[1] * jnp.prod(q))

    how = {"h": 0.1, "num_steps": 3, "method": dvi.GaussLegendre(2)}

    def end(layout):
        return dvi.integrate(system, [0.5, 0.3], [0.3, -0.4], layout=layout, **how).qs

    np.testing.assert_allclose(end(dvi.Layout()), end(dvi.Layout(form="arrays")), rtol=1e-13)


SEEN = {
    "times": {
        "save": dvi.Save(ts=np.linspace(0.01, 0.39, 6)),
        "observe": lambda t0, t1, q0, p0, q, p, args: jnp.arctan(q[0]),
    },
    "crossings": {"observe": dvi.Section(lambda t, q, p, args: q[0] - 0.5, 0, max_crossings=2)},
    "stop": {"stop": dvi.Stop(lambda t, q, p, args: jnp.sin(q[0]) - 0.5)},
}


@pytest.mark.parametrize("seen", SEEN.values(), ids=SEEN)
def test_points_inside_of_steps_have_the_same_bits(seen):
    """XLA computed them, which rounds differently in its vectors than in the remainder."""
    system = dvi.System(lambda t0, t1, q, p, args: p @ p / 2 + q[0] * jnp.arctan(q[1]))

    def one(q):
        p = jnp.array([1.0, 0.3])
        sol = dvi.integrate(system, q, p, h=0.1, num_steps=4, throw=False, **seen)
        return sol.qs, sol.observed, sol.stop

    starts = np.random.default_rng(5).uniform(0.3, 0.5, (263, 2))
    batch = jax.jit(jax.vmap(one), compiler_options=AS_FOR_USERS)
    found, turned = jax.tree.leaves(batch(starts)), jax.tree.leaves(batch(starts[::-1]))
    for a, b in zip(found, turned, strict=True):
        np.testing.assert_array_equal(a, b[::-1])
