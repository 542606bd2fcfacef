"""Gradients of every kind against central differences, and against each other."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ADJOINTS, ARGS, SYSTEMS, central_difference
from jax.flatten_util import ravel_pytree

import dvi_jax as dvi


def product(t0, t1, q0, p0, q1, p1, args):
    return jnp.sum(q1 * p1) * args["K"] + t1 * q0[0]


OBSERVE = {
    "alone": product,
    "reduced": [
        dvi.MaxDrift(product),
        dvi.Range(product),
        dvi.Trend(product),
        dvi.Mean(product),
        dvi.Last(product),
    ],
}


EVERY_FOURTH = dvi.Save(every=4, final=True)


def loss(x, system, adjoint, save=EVERY_FOURTH, observe=True):
    """A number that every saved and observed value enters, with weights of its own."""
    q, p, h, t0, epsilon, K = x
    sol = dvi.integrate(
        SYSTEMS[system][0],
        q,
        p,
        h=h,
        num_steps=17,
        t0=t0,
        epsilon=epsilon,
        args={"K": K},
        adjoint=adjoint,
        save=save,
        observe=OBSERVE if observe else None,
    )
    weights = jnp.linspace(1.0, 2.0, sol.qs.size).reshape(sol.qs.shape)
    total = jnp.sum(weights * sol.qs**2) + jnp.sum(sol.ps / weights)
    total += jnp.sum(sol.ts**2) + jnp.sum(sol.hs**3)
    if observe:
        total += jnp.sum(sol.observed["alone"] ** 2)
        total += sum((i + 1) * r for i, r in enumerate(sol.observed["reduced"]))
    return total


def point(system):
    _, q, p = SYSTEMS[system]
    return (jnp.asarray(q), jnp.asarray(p), *map(jnp.asarray, (0.05, 0.3, 0.2, 1.1)))


@functools.cache
def gradient(system, adjoint):
    return jax.jit(jax.grad(lambda x: loss(x, system, ADJOINTS[adjoint])))


@functools.cache
def value(system):
    return jax.jit(lambda x: loss(x, system, ADJOINTS["Direct"]))


PAIRS = [
    *(("kepler", adjoint) for adjoint in ADJOINTS),
    *((s, a) for s in ("non_separable", "double_pendulum") for a in ("Direct", "Reversible")),
]
"""`Checkpointed` has no rules of its own for implicit steps: one system is enough for it."""


@pytest.mark.parametrize(
    ("system", "adjoint"),
    [
        pytest.param(*p, marks=[] if p == ("kepler", "Reversible") else pytest.mark.slow)
        for p in PAIRS
    ],
)
def test_gradient_equals_central_differences(system, adjoint):
    """In every input at once: along each axis of (q0, p0, h, t0, ε, args)."""
    x = point(system)
    flat, unravel = ravel_pytree(x)
    g, _ = ravel_pytree(gradient(system, adjoint)(x))
    for i in range(flat.size):
        axis = unravel(jnp.zeros_like(flat).at[i].set(1.0))
        expected = central_difference(value(system), x, axis)
        assert abs(float(g[i]) - float(expected)) <= 1e-6 * abs(float(expected)) + 1e-9, i


@pytest.mark.parametrize(("system", "adjoint"), [p for p in PAIRS if p[1] != "Direct"])
@pytest.mark.slow
def test_adjoints_agree_to_round_off(system, adjoint):
    x = point(system)
    direct, other = (jax.tree.leaves(gradient(system, a)(x)) for a in ("Direct", adjoint))
    for a, b in zip(other, direct, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize(
    "save",
    [dvi.Save(), dvi.Save(final=True), dvi.Save(every=8), dvi.Save(every=40)],
)
@pytest.mark.slow
def test_reversible_gradient_for_every_way_of_saving(save):
    x = point("kepler")
    a, b = (
        jax.jit(jax.grad(lambda x, a=a: loss(x, "kepler", ADJOINTS[a], save=save)))(x)
        for a in ("Reversible", "Direct")
    )
    for u, v in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(u, v, rtol=1e-11, atol=1e-12)


@pytest.mark.slow
def test_second_derivative_and_batched_gradient():
    x = point("non_separable")

    def in_epsilon(adjoint):
        def of(e):
            return loss((*x[:4], e, x[5]), "non_separable", ADJOINTS[adjoint], observe=False)

        return of

    hessian = jax.jit(jax.hessian(in_epsilon("Reversible")))(0.2)
    slope = jax.jit(jax.grad(in_epsilon("Direct")))
    expected = central_difference(slope, jnp.asarray(0.2), jnp.asarray(1.0))
    assert abs(float(hessian) - float(expected)) < 1e-6 * abs(float(expected))
    es = jnp.array([0.1, 0.2, 0.3])
    batch = jax.jit(jax.vmap(jax.grad(in_epsilon("Reversible"))))(es)
    np.testing.assert_allclose(batch, [slope(e) for e in es], rtol=1e-11)


@pytest.mark.slow
def test_gradient_through_the_times_of_a_given_lattice():
    s, q, p = SYSTEMS["kepler"]

    def final(ts, adjoint):
        sol = dvi.integrate(
            s, q, p, lattice=dvi.Given(ts), args=ARGS, epsilon=0.1, adjoint=ADJOINTS[adjoint]
        )
        return jnp.sum(sol.qs[-1])

    ts = jnp.array([0.0, 0.1, 0.25, 0.3, 0.5])
    g = jax.grad(lambda t: final(t, "Reversible"))(ts)
    for i in range(5):
        axis = jnp.zeros(5).at[i].set(1.0)
        expected = central_difference(lambda t: final(t, "Direct"), ts, axis)
        assert abs(float(g[i] - expected)) < 1e-8


@pytest.mark.slow
def test_gradient_into_a_module_force():
    """W as an equinox module: its arrays are differentiable, no args needed."""
    import equinox as eqx

    net = eqx.nn.MLP(1, 1, 4, 1, key=jax.random.key(0))
    net = jax.tree.map(lambda x: x.astype(jnp.float64) if eqx.is_array(x) else x, net)

    class Force(eqx.Module):
        net: eqx.nn.MLP

        def __call__(self, t0, t1, q0, p1, args):
            return self.net(q0)

    def final(force, adjoint):
        system = dvi.System(SYSTEMS["pendulum"][0].H_D, force=force)
        sol = dvi.integrate(
            system, [0.4], [0.7], h=0.1, num_steps=30, epsilon=0.5, adjoint=ADJOINTS[adjoint]
        )
        return jnp.sum(sol.qs[-1])

    a = eqx.filter_grad(final)(Force(net), "Reversible")
    b = eqx.filter_grad(final)(Force(net), "Direct")
    for u, v in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(u, v, rtol=1e-10, atol=1e-14)
    assert max(float(jnp.max(jnp.abs(u))) for u in jax.tree.leaves(a)) > 1e-3


@pytest.mark.slow
def test_where_rebuilt_states_miss_the_steps_are_taken_again():
    """Damped and driven over t = 80: rebuilding amplifies round-off by some e⁴⁰."""

    def damped_and_driven(t0, t1, q, p, args):
        return jnp.cos(t0) - p

    system = dvi.System(lambda t0, t1, q, p, args: (p @ p + q @ q) / 2, force=damped_and_driven)

    def slope(adjoint):
        def final(e):
            sol = dvi.integrate(
                system,
                [1.0],
                [0.0],
                h=0.1,
                num_steps=800,
                epsilon=e,
                save=dvi.Save(final=True),
                adjoint=adjoint,
            )
            return sol.qs[-1, 0]

        return float(jax.grad(final)(1.0))

    exact = slope(dvi.Direct())
    np.testing.assert_allclose(slope(dvi.Reversible(checkpoint_every=20)), exact, rtol=1e-9)
    np.testing.assert_allclose(slope(dvi.Reversible(checkpoint_every=1000)), exact, rtol=1e-9)


@pytest.mark.slow
def test_gradient_in_single_precision():
    system = SYSTEMS["pendulum"][0]

    def final(q):
        p = jnp.full_like(q, 0.7)
        sol = dvi.integrate(system, q, p, h=0.05, num_steps=300, save=dvi.Save(final=True))
        return sol.qs[-1, 0]

    g = jax.grad(final)(jnp.float32([0.4]))
    assert g.dtype == jnp.float32
    np.testing.assert_allclose(g, jax.grad(final)(jnp.array([0.4])), rtol=2e-3)


@pytest.mark.slow
def test_reversible_memory_is_flat_and_direct_is_not():
    def size(adjoint, n):
        def final(q):
            sol = dvi.integrate(
                SYSTEMS["kepler"][0],
                q,
                jnp.array([-1.0, -0.6]),
                h=0.01,
                num_steps=n,
                args=ARGS,
                save=dvi.Save(final=True),
                adjoint=adjoint,
            )
            return jnp.sum(sol.qs[-1])

        compiled = jax.jit(jax.grad(final)).lower(jnp.array([0.0, 1.2])).compile()
        return compiled.memory_analysis().temp_size_in_bytes

    growth = {n: size(a, 20_000) - size(a, 200) for n, a in ADJOINTS.items()}
    reversible = size(dvi.Reversible(), 20_000) - size(dvi.Reversible(), 200)
    assert growth["Direct"] > 20_000 * 8 * 10
    assert reversible < growth["Direct"] / 100


@pytest.mark.parametrize("bad", [0, -1, 1.5])
def test_adjoints_refuse_bad_settings(bad):
    with pytest.raises(ValueError, match="from 1 on"):
        dvi.Reversible(checkpoint_every=bad)
    with pytest.raises(ValueError, match="from 1 on"):
        dvi.Checkpointed(segments=bad)


# --- where a derivative written by hand could be missed or misapplied -------------------------


def closing_over(mu, where, adjoint):
    """A loss whose parameter is not handed over but closed over, in one of several places."""
    plain = SYSTEMS["kepler"][0]
    H, W, H1, observe = plain.H_D, plain.force, None, None
    if where == "H_D":
        H = lambda t0, t1, q, p, a: p @ p / 2 - mu / jnp.sqrt(q @ q)  # noqa: E731
    elif where == "force":
        W = lambda t0, t1, q, p, a: -mu * q  # noqa: E731
    elif where == "perturbation":
        H1 = lambda t0, t1, q, p, a: mu * jnp.sum(q**4)  # noqa: E731
    elif where == "partial":
        W = functools.partial(lambda m, t0, t1, q, p, a: -m * q, mu)
    else:
        observe = dvi.Mean(lambda t0, t1, q0, p0, q1, p1, a: mu * q1[0])
    sol = dvi.integrate(
        dvi.System(H, force=W, perturbation=H1),
        [0.0, 1.2],
        [-1.0, -0.6],
        h=0.1,
        num_steps=10,
        epsilon=0.1,
        args=ARGS,
        observe=observe,
        adjoint=adjoint,
    )
    return jnp.sum(sol.qs[-1]) + (0.0 if observe is None else sol.observed)


@pytest.mark.parametrize("where", ["H_D", "observable", "force", "perturbation", "partial"])
@pytest.mark.slow
def test_closed_over_parameters_have_gradients(where):
    compiled = jax.jit(jax.grad(closing_over), static_argnums=1)
    expected = compiled(1.0, where, dvi.Direct())
    assert abs(expected) > 1e-3
    # Whether the parameter is traced inside or outside of jit does not depend on where it is used.
    ways = (compiled, jax.grad(closing_over)) if where in ("H_D", "observable") else (compiled,)
    for gradient in ways:
        got = gradient(1.0, where, dvi.Reversible())
        np.testing.assert_allclose(got, expected, rtol=1e-11)


def shared(mu, adjoint):
    """A sum over lanes that share a parameter, as in a fit."""

    def lane(q):
        sol = dvi.integrate(
            SYSTEMS["kepler"][0],
            q,
            [-1.0, -0.6],
            h=0.05,
            num_steps=12,
            args={"K": mu},
            adjoint=ADJOINTS[adjoint],
            observe=lambda t0, t1, q0, p0, q1, p1, a: q1[0] > 0,  # no number: no gradient
        )
        return sol.qs

    return jnp.sum(jax.vmap(lane)(jnp.array([[0.5, 0.3], [0.0, 1.2]])) ** 2)


@pytest.mark.slow
def test_gradient_of_a_batch_with_a_shared_parameter():
    compiled = jax.jit(jax.grad(shared), static_argnums=1)
    expected = compiled(1.0, "Direct")
    np.testing.assert_allclose(compiled(1.0, "Reversible"), expected, rtol=1e-11)
    tangent = jax.jvp(jax.jit(lambda m: shared(m, "Reversible")), (1.0,), (1.0,))[1]
    np.testing.assert_allclose(tangent, expected, rtol=1e-11)


@pytest.mark.parametrize("form", ["arrays", pytest.param("components", marks=pytest.mark.slow)])
def test_a_failed_lane_that_is_left_out_spoils_no_shared_parameter(form):
    """A start that is none, and an implicit step without a root."""
    q = jnp.array([[0.3, 0.0], [jnp.nan, 0.1], [0.1, 0.1], [0.2, 0.1]])
    p = jnp.array([[0.3, 0.0], [0.1, 0.2], [60.0, 60.0], [0.0, 0.1]])

    def total(x, lanes, left_out):
        epsilon, K = x

        def one(q, p):
            sol = dvi.integrate(
                SYSTEMS["non_separable"][0], q, p, h=0.05, num_steps=20, epsilon=epsilon,
                args={"K": K}, save=dvi.Save(final=True), observe=dvi.Mean(product), throw=False,
                layout=dvi.Layout(form=form),
            )  # fmt: skip
            ok = sol.result == dvi.RESULTS.successful
            end, mean = sol.qs[-1], sol.observed
            if left_out:
                end, mean = jnp.where(ok, end, 0.0), jnp.where(ok, mean, 0.0)
            return jnp.sum(end**2) + jnp.sum(mean), ok

        values, ok = jax.vmap(one)(q[lanes], p[lanes])
        return jnp.sum(values), ok

    gradient = jax.jit(jax.grad(total, has_aux=True), static_argnums=2)
    every, good_twice = np.arange(4), np.array([0, 3, 0, 3])
    found, ok = gradient((0.2, 1.1), every, True)
    assert list(ok) == [True, False, False, True]
    twice, _ = gradient((0.2, 1.1), good_twice, False)
    np.testing.assert_allclose(found, np.array(twice) / 2, rtol=1e-12)
    spoilt, _ = gradient((0.2, 1.1), every, False)
    assert np.isnan(spoilt).all()  # NaN is not hidden where a failed lane is asked for


@pytest.mark.slow
def test_second_derivatives_in_every_combination_of_modes():
    def second(outer, inner, adjoint):
        return jax.jit(outer(inner(lambda m: shared(m, adjoint))))(1.0)

    direct = second(jax.jacfwd, jax.jacfwd, "Direct")
    for outer, inner in [
        (jax.grad, jax.grad),
        (jax.jacrev, jax.jacfwd),
        (jax.jacfwd, jax.jacrev),
        (jax.jacfwd, jax.jacfwd),
    ]:
        np.testing.assert_allclose(second(outer, inner, "Reversible"), direct, rtol=1e-10)


def light_and_heavy(ratio):
    """Two oscillators side by side, masses 1 and `ratio`; the second one damped."""

    def H(t0, t1, q, p, m):
        return jnp.sum(p**2 / (2 * m)) + jnp.sum(m * q**2) / 2

    system = dvi.System(H, force=lambda t0, t1, q, p, m: -p * jnp.array([0.0, 1.0]))
    return system, jnp.array([1.0, ratio])


@pytest.mark.slow
def test_defect_is_seen_in_a_component_that_is_small_beside_others():
    system, m = light_and_heavy(1e-9)

    def final(e, adjoint):
        sol = dvi.integrate(
            system,
            m,
            m**2,
            h=0.1,
            num_steps=100,
            epsilon=e,
            args=m,
            adjoint=adjoint,
            save=dvi.Save(final=True),
        )
        return sol.ps[-1, 1] * 1e18

    exact = jax.grad(final)(5.0, dvi.Direct())
    assert np.isfinite(exact)
    np.testing.assert_allclose(jax.grad(final)(5.0, dvi.Reversible()), exact, rtol=1e-9)
    # It is the look at the defect that does it: without, the rebuilt states are worth nothing.
    blind = jax.grad(final)(5.0, dvi.Reversible(max_defect=1e300))
    assert not abs(blind / exact - 1) < 1e-3


def rebuilt(num_steps, e=0.0, save=None, every=20, form="arrays", **settings):
    system, m = light_and_heavy(0.5)
    sol = dvi.integrate(
        system,
        m,
        m**2,
        h=0.1,
        num_steps=num_steps,
        epsilon=e,
        args=m,
        adjoint=dvi.Reversible(every, report_defect=True),
        save=save or dvi.Save(every=num_steps // 2),
        layout=dvi.Layout(form=form),
        **settings,
    )
    return sol.stats["round_trip_defect"]


@pytest.mark.parametrize("form", ["arrays", "components"])
@pytest.mark.slow
def test_round_trip_defect_says_how_well_states_are_rebuilt(form):
    """About round-off where the map keeps volume; e^(εt/2) times that where it is damped, whatever
    way the steps are cut into pieces."""
    assert 0 < rebuilt(101, every=7, form=form) < 1e-14
    damped = rebuilt(80, 5.0, every=80, save=dvi.Save(final=True), form=form)
    assert damped > 1e-14
    assert rebuilt(80, 5.0, every=10, save=dvi.Save(final=True), form=form) < damped / 10


@pytest.mark.slow
def test_round_trip_defect_is_not_invented():
    with pytest.raises(ValueError, match=r"none are: RungeKutta4 has no inverse step.*Leave"):
        rebuilt(4, method=dvi.RungeKutta4())
    with pytest.raises(ValueError, match="cannot be reported with progress"):
        rebuilt(4, progress=lambda *_: None)
    with pytest.raises(TypeError, match="report_defect must be True or False"):
        dvi.Reversible(report_defect=1)  # pyright: ignore[reportArgumentType]
