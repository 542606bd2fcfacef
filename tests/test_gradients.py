"""Gradients of every kind against central differences, and against each other."""

import functools
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ADJOINTS, ARGS, SYSTEMS, central_difference
from jax.flatten_util import ravel_pytree

import dvi_jax as dvi
from dvi_jax.integration import reversible

FINAL = dvi.Save(final=True)
EVERY_FOURTH = dvi.Save(every=4, final=True)


def product(t0, t1, q0, p0, q1, p1, args):
    return jnp.sum(q1 * p1) * args["K"] + t1 * q0[0]


KINDS = (dvi.MaxDrift, dvi.Range, dvi.Trend, dvi.Mean, dvi.Last)
OBSERVE = {"alone": product, "reduced": [kind(product) for kind in KINDS]}


def assert_same(one, other, rtol, atol=0.0):
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(a, b, rtol=rtol, atol=atol)


def loss(x, system, adjoint, save=EVERY_FOURTH, observe=True):
    """A number that every saved and observed value enters, with weights of its own."""
    q, p, h, t0, epsilon, K = x
    sol = dvi.integrate(
        SYSTEMS[system][0], q, p, h=h, num_steps=17, t0=t0, epsilon=epsilon, args={"K": K},
        adjoint=adjoint, save=save, observe=OBSERVE if observe else None,
    )  # fmt: skip
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
def gradient(system, adjoint, save=EVERY_FOURTH):
    """The compiled loss with its gradient."""
    return jax.jit(jax.value_and_grad(lambda x: loss(x, system, ADJOINTS[adjoint], save)))


PAIRS = [
    *(("kepler", adjoint) for adjoint in ADJOINTS),
    *((s, a) for s in ("non_separable", "double_pendulum") for a in ("Direct", "Reversible")),
]
"""`Checkpointed` has no rules of its own for implicit steps: one system is enough for it."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("system", "adjoint"),
    [
        pytest.param(*p, marks=[] if p == ("kepler", "Reversible") else pytest.mark.slow)
        for p in PAIRS
    ],
)
def test_gradient_equals_central_differences(system, adjoint):
    """In every input at once: along each axis of (q0, p0, h, t0, ε, args)."""
    x, both = point(system), gradient(system, adjoint)
    flat, unravel = ravel_pytree(x)
    g, _ = ravel_pytree(both(x)[1])
    for i in range(flat.size):
        axis = unravel(jnp.zeros_like(flat).at[i].set(1.0))
        expected = central_difference(lambda x: both(x)[0], x, axis)
        assert abs(float(g[i]) - float(expected)) <= 1e-6 * abs(float(expected)) + 1e-9, i


SAVES = [dvi.Save(), FINAL, dvi.Save(every=8), dvi.Save(every=40)]


@pytest.mark.parametrize(
    ("system", "adjoint", "save"),
    [
        *((*pair, EVERY_FOURTH) for pair in PAIRS if pair[1] != "Direct"),
        *(("kepler", "Reversible", save) for save in SAVES),
    ],
)
@pytest.mark.slow
def test_adjoints_agree_to_round_off_for_every_way_of_saving(system, adjoint, save):
    x = point(system)
    direct, other = (gradient(system, a, save)(x) for a in ("Direct", adjoint))
    assert_same(other, direct, rtol=1e-11, atol=1e-12)


@pytest.mark.slow
def test_second_derivatives_and_batches_in_every_mode():
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
    # Of a batch with a shared parameter.

    def derivative(adjoint, *modes):
        f = functools.partial(shared, adjoint=adjoint)
        for mode in modes:
            f = mode(f)
        return jax.jit(f)(1.0)

    forward, reverse = jax.jacfwd, jax.grad
    expected = derivative("Direct", reverse)
    for mode in (forward, reverse):
        np.testing.assert_allclose(derivative("Reversible", mode), expected, rtol=1e-11)
    expected = derivative("Direct", forward, forward)
    for modes in itertools.product((forward, reverse), repeat=2):
        np.testing.assert_allclose(derivative("Reversible", *modes), expected, rtol=1e-10)


@pytest.mark.slow
def test_gradients_into_times_and_modules():
    s, q, p = SYSTEMS["kepler"]

    def final(ts, adjoint):
        how = {"args": ARGS, "epsilon": 0.1, "adjoint": ADJOINTS[adjoint]}
        return jnp.sum(dvi.integrate(s, q, p, lattice=dvi.Given(ts), **how).qs[-1])

    ts = jnp.array([0.0, 0.1, 0.25, 0.3, 0.5])
    g = jax.grad(lambda t: final(t, "Reversible"))(ts)
    for i in range(5):
        axis = jnp.zeros(5).at[i].set(1.0)
        expected = central_difference(lambda t: final(t, "Direct"), ts, axis)
        assert abs(float(g[i] - expected)) < 1e-8
    # W as an equinox module: its arrays are differentiable, no args needed.
    net = eqx.nn.MLP(1, 1, 4, 1, key=jax.random.key(0))
    net = jax.tree.map(lambda x: x.astype(jnp.float64) if eqx.is_array(x) else x, net)

    class Force(eqx.Module):
        net: eqx.nn.MLP

        def __call__(self, t0, t1, q0, p1, args):
            return self.net(q0)

    def end_of(force, adjoint):
        system = dvi.System(SYSTEMS["pendulum"][0].H_D, force=force)
        how = {"h": 0.1, "num_steps": 30, "epsilon": 0.5, "adjoint": ADJOINTS[adjoint]}
        return jnp.sum(dvi.integrate(system, [0.4], [0.7], **how).qs[-1])

    a, b = (eqx.filter_grad(end_of)(Force(net), adjoint) for adjoint in ("Reversible", "Direct"))
    assert_same(a, b, rtol=1e-10, atol=1e-14)
    assert max(float(jnp.max(jnp.abs(u))) for u in jax.tree.leaves(a)) > 1e-3


@pytest.mark.slow
def test_gradient_in_single_precision():
    def final(q):
        how = {"h": 0.05, "num_steps": 300, "epsilon": 0.0, "save": FINAL}
        return dvi.integrate(SYSTEMS["pendulum"][0], q, jnp.full_like(q, 0.7), **how).qs[-1, 0]

    g = jax.grad(final)(jnp.float32([0.4]))
    assert g.dtype == jnp.float32
    np.testing.assert_allclose(g, jax.grad(final)(jnp.array([0.4])), rtol=2e-3)


@pytest.mark.slow
def test_reversible_memory_is_flat_and_direct_is_not():
    def growth(adjoint):
        def size(n):
            def final(q):
                how = {"h": 0.01, "num_steps": n, "args": ARGS, "save": FINAL, "adjoint": adjoint}
                return jnp.sum(dvi.integrate(SYSTEMS["kepler"][0], q, [-1.0, -0.6], **how).qs[-1])

            compiled = jax.jit(jax.grad(final)).lower(jnp.array([0.0, 1.2])).compile()
            return compiled.memory_analysis().temp_size_in_bytes

        return size(20_000) - size(200)

    direct = growth(dvi.Direct())
    assert direct > 20_000 * 8 * 10
    assert growth(dvi.Reversible()) < direct / 100


def closing_over(mu, where, adjoint):
    """A loss whose parameter is not passed but closed over, in one of several places."""
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
    system, start = dvi.System(H, force=W, perturbation=H1), ([0.0, 1.2], [-1.0, -0.6])
    how = {"h": 0.1, "num_steps": 10, "epsilon": 0.1, "args": ARGS, "adjoint": adjoint}
    sol = dvi.integrate(system, *start, observe=observe, **how)
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
    """A sum over trajectories that share a parameter, as in a fit."""
    how = {"h": 0.05, "num_steps": 12, "args": {"K": mu}, "adjoint": ADJOINTS[adjoint]}

    def positive(t0, t1, q0, p0, q1, p1, a):
        return q1[0] > 0  # boolean: no gradient

    def one(q):
        return dvi.integrate(SYSTEMS["kepler"][0], q, [-1.0, -0.6], observe=positive, **how).qs

    return jnp.sum(jax.vmap(one)(jnp.array([[0.5, 0.3], [0.0, 1.2]])) ** 2)


@pytest.mark.parametrize(
    ("system", "form"),
    [
        ("kepler", "auto"),
        *(pytest.param("non_separable", x, marks=pytest.mark.slow) for x in ("arrays", "auto")),
    ],
)
def test_a_failed_trajectory_that_the_loss_omits_spoils_no_shared_parameter(system, form):
    """A start of NaN or at the centre, and an implicit step without a root."""
    bad = [0.0, 0.0] if system == "kepler" else [0.1, 0.1]
    q = jnp.array([[0.3, 0.0], [jnp.nan, 0.1], bad, [0.2, 0.1]])
    p = jnp.array([[0.3, 0.0], [0.1, 0.2], [60.0, 60.0], [0.0, 0.1]])
    how = {"h": 0.05, "num_steps": 20, "save": FINAL, "observe": dvi.Mean(product),
           "throw": False, "layout": dvi.Layout(form=form)}  # fmt: skip

    @jax.jit
    @functools.partial(jax.grad, has_aux=True)
    def gradient(x, which, omit):
        epsilon, K = x

        def one(q, p):
            sol = dvi.integrate(SYSTEMS[system][0], q, p, epsilon=epsilon, args={"K": K}, **how)
            ok = sol.result == dvi.RESULTS.successful
            end, mean = (jnp.where(ok | ~omit, x, 0.0) for x in (sol.qs[-1], sol.observed))
            return jnp.sum(end**2) + jnp.sum(mean), ok

        values, ok = jax.vmap(one)(q[which], p[which])
        return jnp.sum(values), ok

    every, good_twice = np.arange(4), np.array([0, 3, 0, 3])
    found, ok = gradient((0.2, 1.1), every, True)
    assert list(ok) == [True, False, False, True]
    twice, _ = gradient((0.2, 1.1), good_twice, False)
    np.testing.assert_allclose(found, np.array(twice) / 2, rtol=1e-12)
    spoilt, _ = gradient((0.2, 1.1), every, False)
    assert np.isnan(spoilt).all()  # NaN is not hidden where the loss uses a failed trajectory


@pytest.mark.slow
def test_where_reconstructed_states_miss_the_steps_are_computed_again():
    """Damped and driven over t = 80: reconstruction amplifies round-off by some e⁴⁰."""
    system = dvi.System(
        lambda t0, t1, q, p, args: (p @ p + q @ q) / 2,
        force=lambda t0, t1, q, p, args: jnp.cos(t0) - p,
    )

    def slope(adjoint):
        def final(e):
            how = {"h": 0.1, "num_steps": 800, "save": FINAL, "adjoint": adjoint}
            return dvi.integrate(system, [1.0], [0.0], epsilon=e, **how).qs[-1, 0]

        return float(jax.grad(final)(1.0))

    exact = slope(dvi.Direct())
    for every in (20, 1000):
        found = slope(dvi.Reversible(checkpoint_every=every))
        np.testing.assert_allclose(found, exact, rtol=1e-9)


def light_and_heavy(ratio, e, **how):
    """Two independent oscillators, masses 1 and `ratio`; the second one damped."""

    def H(t0, t1, q, p, m):
        return jnp.sum(p**2 / (2 * m)) + jnp.sum(m * q**2) / 2

    system = dvi.System(H, force=lambda t0, t1, q, p, m: -p * jnp.array([0.0, 1.0]))
    m = jnp.array([1.0, ratio])
    return dvi.integrate(system, m, m**2, h=0.1, epsilon=e, args=m, **how)


@pytest.mark.slow
def test_a_difference_is_seen_in_a_component_that_is_small_next_to_others():
    def slope(adjoint):
        def final(e):
            how = {"num_steps": 100, "adjoint": adjoint, "save": FINAL}
            return light_and_heavy(1e-9, e, **how).ps[-1, 1] * 1e18

        return jax.grad(final)(5.0)

    exact = slope(dvi.Direct())
    assert np.isfinite(exact)
    np.testing.assert_allclose(slope(dvi.Reversible()), exact, rtol=1e-9)
    # Without the test of the difference the reconstructed states are worthless.
    assert not abs(slope(dvi.Reversible(max_defect=1e300)) / exact - 1) < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("method", [dvi.Strang(), dvi.KahanLi(8), dvi.GaussLegendre(2)], ids=str)
def test_reconstruction_has_the_gradient_of_direct_for_eccentric_orbits(method):
    """From the pericentre, where a small error of a state is a large one of the derivative."""

    def kepler(t, q, p, mu):
        return p @ p / 2 - mu / jnp.linalg.norm(q)

    system = dvi.System(dvi.discretise(kepler))

    def slope(adjoint):
        def final(q0, p0, h):
            how = {"h": h, "num_steps": 400, "args": 1.0, "save": FINAL, "adjoint": adjoint}
            sol = dvi.integrate(system, q0, p0, method=method, **how)
            return sol.qs[-1] @ jnp.array([1.0, 0.7]) + sol.ps[-1] @ jnp.array([0.3, -0.2])

        return jax.jit(jax.grad(final, (0, 1)))

    direct, rebuilt = slope(dvi.Direct()), slope(dvi.Reversible())
    for e in (0.5, 0.9, 0.97, 0.99):
        q0, p0 = jnp.array([1 - e, 0.0]), jnp.array([0.0, np.sqrt((1 + e) / (1 - e))])
        for h in np.geomspace(0.003, 0.1, 8) * (1 - e) ** 1.5:
            exact, x = (np.ravel(slopes(q0, p0, h)) for slopes in (direct, rebuilt))
            np.testing.assert_allclose(x, exact, atol=1e-8 * np.abs(exact).max())


@pytest.mark.slow
def test_a_small_difference_of_reconstructed_states_is_not_accepted():
    """A damped motion of which reconstruction amplifies round-off by some 1e7 in 100 steps: with a
    limit of 1e-6 the gradient has an error of 6e-10 at 3.5."""
    system = dvi.System(
        lambda t0, t1, q, p, a: p @ p / 2 + jnp.sum(q**4) / 4,
        force=lambda t0, t1, q, p, a: 3 * jnp.cos(t0) - a * p,
    )

    def slope(adjoint):
        def final(a):
            how = {"epsilon": 1.0, "args": a, "save": FINAL, "adjoint": adjoint}
            sol = dvi.integrate(system, [1.0], [0.0], h=0.05, num_steps=600, **how)
            return sol.qs[-1, 0] + sol.ps[-1, 0]

        return jax.jit(jax.grad(final))

    exact, coarse, default = map(
        slope, (dvi.Direct(), dvi.Reversible(max_defect=1e-6), dvi.Reversible())
    )
    for a in (2.5, 3.0, 3.5):
        np.testing.assert_allclose(default(a), exact(a), rtol=1e-12)
    assert abs(float(coarse(3.5)) / float(exact(3.5)) - 1) > 1e-10


def rebuilt(num_steps, e=0.0, save=None, every=20, form="arrays", **how):
    save = save or dvi.Save(every=num_steps // 2)
    adjoint, layout = dvi.Reversible(every, report_defect=True), dvi.Layout(form=form)
    how = {"num_steps": num_steps, "save": save, "adjoint": adjoint, "layout": layout, **how}
    return light_and_heavy(0.5, e, **how).stats["round_trip_defect"]


@pytest.mark.parametrize("form", ["arrays", "auto"])
@pytest.mark.slow
def test_round_trip_defect_is_that_of_reconstructed_states(form):
    """About round-off where the map preserves volume; e^(εt/2) times that where it is damped, for
    every division of the steps into pieces."""
    assert 0 < rebuilt(101, every=7, form=form) < 1e-14
    damped = rebuilt(80, 5.0, every=80, save=FINAL, form=form)
    assert damped > 1e-14
    assert rebuilt(80, 5.0, every=10, save=FINAL, form=form) < damped / 10


@pytest.mark.parametrize("number", [float, jnp.asarray, jnp.float32])
def test_a_first_gradient_is_traced_once(number, monkeypatch):
    """H_D once for its shape and once for each half of a step, with numbers of several types: that
    of a number of Python is weak. And the reverse pass once."""
    calls, passes = [], []
    reverse_pass = reversible.ReversePass

    def H_D(t0, t1, q0, p1, args):
        calls.append(1)
        return jnp.sum(p1**2) / 2 + args * jnp.sum(q0**4)

    def loss(q):
        run = dvi.integrate(
            dvi.System(H_D), q, q, h=0.1, num_steps=10, args=number(0.3), throw=False
        )
        return run.qs[-1].sum()

    monkeypatch.setattr(
        reversible, "ReversePass", lambda *args: passes.append(1) or reverse_pass(*args)
    )
    jax.jit(jax.grad(loss)).lower(np.ones(60))
    assert (len(calls), len(passes)) == (3, 1)
