"""Maps of the package as solvers of diffrax, and the continuous limit that they tend to."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import measured_orders

import dvi_jax as dvi
from dvi_jax import interop, systems
from dvi_jax._results import STATUS_NAMES

diffrax = pytest.importorskip("diffrax")

KEPLER = systems.kepler()
Q0, P0 = jnp.asarray(KEPLER.q0), jnp.asarray(KEPLER.p0)
EPSILON, H = 0.01, 0.0625
MORE = [dvi.TypeII(), dvi.GaussLegendre(2), dvi.Yoshida(4), dvi.RungeKutta4()]


def by_diffrax(solver, t1=2.0, t0=0.0, h=H, q0=Q0, epsilon=EPSILON, args=KEPLER.args, **options):
    term = interop.diffrax_term(KEPLER, epsilon)
    h = jnp.asarray(h)  # traced: one compilation for all
    return diffrax.diffeqsolve(term, solver, t0, t1, h, y0=(q0, P0), args=args, **options)


def non_separable(t0, t1, q0, p1, args):
    return jnp.sum((q0**2 + 1) * (p1**2 + 1)) / 2


@pytest.mark.parametrize(
    "method",
    [dvi.Strang(), *(pytest.param(m, marks=pytest.mark.slow) for m in MORE)],
    ids=str,
)
def test_states_are_those_of_integrate(method):
    saveat = diffrax.SaveAt(t0=True, steps=True)
    theirs = by_diffrax(interop.diffrax_solver(method), saveat=saveat, max_steps=32)
    ours = dvi.integrate(
        KEPLER.system, Q0, P0, h=H, num_steps=32, epsilon=EPSILON, args=KEPLER.args, method=method
    )
    # h is a power of two, so that the times are the same bits; and hence everything.
    assert jnp.array_equal(theirs.ts, ours.ts)
    np.testing.assert_allclose(theirs.ys[0], ours.qs, rtol=0, atol=4e-16)
    np.testing.assert_allclose(theirs.ys[1], ours.ps, rtol=0, atol=4e-16)
    other = dvi.integrate(
        KEPLER.system, Q0, P0, h=H, num_steps=32, epsilon=0.0, args=KEPLER.args, method=method
    )
    assert jnp.max(jnp.abs(theirs.ys[0] - other.qs)) > 1e-4  # its ε is heard


def test_a_step_that_is_no_power_of_two_differs_by_the_rounding_of_times():
    solver = interop.diffrax_solver(dvi.Strang())
    theirs = by_diffrax(solver, h=0.1)
    ours = dvi.integrate(
        KEPLER.system, Q0, P0, h=0.1, num_steps=20, epsilon=EPSILON, args=KEPLER.args,
        method=dvi.Strang(),
    )  # fmt: skip
    np.testing.assert_allclose(theirs.ys[0][-1], ours.qs[-1], rtol=0, atol=1e-13)


def test_backwards_in_time():
    def driven(t0, t1, q0, p1, args):
        return -q0 * jnp.cos(3 * t0)  # a time of the wrong sign would be seen

    system = dvi.System(KEPLER.system.H_D, force=driven)
    back = diffrax.diffeqsolve(
        interop.diffrax_term(system, 0.3), interop.diffrax_solver(), 1.5, -0.5, -H, y0=(Q0, P0),
        args=KEPLER.args,
    )  # fmt: skip
    ours = dvi.integrate(system, Q0, P0, h=-H, num_steps=32, t0=1.5, epsilon=0.3, args=KEPLER.args)
    np.testing.assert_allclose(back.ys[0][-1], ours.qs[-1], rtol=0, atol=1e-15)


def end_of(solver, adjoint, epsilon, K):
    sol = by_diffrax(solver, 1.0, epsilon=epsilon, args={"K": K}, adjoint=adjoint, max_steps=32)
    return jnp.sum(sol.ys[0][-1] ** 2 + sol.ys[1][-1])


def end_of_ours(method, epsilon, K):
    sol = dvi.integrate(
        KEPLER.system, Q0, P0, h=H, num_steps=16, epsilon=epsilon, args={"K": K}, method=method,
        save=dvi.Save(final=True),
    )  # fmt: skip
    return jnp.sum(sol.qs[-1] ** 2 + sol.ps[-1])


@pytest.mark.parametrize("method", [dvi.TypeII(), dvi.GaussLegendre(1)], ids=str)
@pytest.mark.slow
def test_gradients_are_those_of_the_map(method):
    at = (EPSILON, 1.0)
    wanted = jax.grad(end_of_ours, argnums=(1, 2))(method, *at)
    adjoint = diffrax.RecursiveCheckpointAdjoint()
    found = jax.grad(end_of, argnums=(2, 3))(interop.diffrax_solver(method), adjoint, *at)
    np.testing.assert_allclose(found, wanted, rtol=1e-11)
    # Those of the flow, or of another method, are other numbers.
    other = jax.grad(end_of_ours, argnums=(1, 2))(dvi.Strang(), *at)
    assert abs(np.asarray(other) / np.asarray(wanted) - 1).min() > 1e-5


@pytest.mark.slow
def test_gradients_by_other_adjoints():
    at, solver = (EPSILON, 1.0), interop.diffrax_solver(dvi.Strang())
    wanted = jax.grad(end_of_ours, argnums=1)(dvi.Strang(), *at)
    direct = jax.grad(end_of, argnums=2)(solver, diffrax.DirectAdjoint(), *at)
    forward = jax.jvp(lambda e: end_of(solver, diffrax.ForwardMode(), e, 1.0), (EPSILON,), (1.0,))[
        1
    ]
    np.testing.assert_allclose([direct, forward], [wanted, wanted], rtol=1e-11)


@pytest.mark.slow
def test_a_batch_is_the_loop():
    def end(q0):
        return by_diffrax(interop.diffrax_solver(dvi.Strang()), 1.0, q0=q0).ys[0][-1]

    starts = Q0[None] + jnp.array([[0.0, 0.0], [0.1, 0.2], [-0.3, 0.1]])
    together = jax.vmap(end)(starts)
    np.testing.assert_allclose(together, jnp.stack([end(q) for q in starts]), rtol=0, atol=1e-14)


@pytest.mark.slow
def test_a_failed_solve_is_told_in_words_of_diffrax():
    system = dvi.System(non_separable)
    start = (jnp.array([3.0]), jnp.array([3.0]))

    def run(h, **options):
        return diffrax.diffeqsolve(
            interop.diffrax_term(system), interop.diffrax_solver(), 0.0, 4 * h, h, y0=start,
            **options,
        )  # fmt: skip

    found = run(2.0, throw=False)
    assert found.result == diffrax.RESULTS.nonlinear_max_steps_reached
    assert not np.isfinite(found.ys[0]).any()
    with pytest.raises(RuntimeError, match="nonlinear solver"):
        run(2.0)
    assert run(0.01).result == diffrax.RESULTS.successful


def test_no_failure_is_promoted_to_success():
    from dvi_jax.interop.diffrax_classes import promoted

    found = {n: diffrax.RESULTS[promoted(getattr(dvi.RESULTS, n))] for n in STATUS_NAMES}
    assert [name for name, text in found.items() if text == ""] == ["successful"]
    assert "Nonfinite" in found["not_finite"]
    assert len(set(found.values())) == 4


def test_nothing_is_silently_ignored():
    field = diffrax.ODETerm(interop.vector_field(KEPLER))
    solver = interop.diffrax_solver()

    def run(term, **options):
        diffrax.diffeqsolve(term, solver, 0.0, 1.0, H, args=KEPLER.args, **options)

    with pytest.raises(ValueError, match="DiscreteTerm"):
        run(field, y0=(Q0, P0))
    term = interop.diffrax_term(KEPLER)
    control = diffrax.PIDController(rtol=1e-6, atol=1e-6)
    with pytest.raises(RuntimeError, match="error estimates"):
        run(term, y0=(Q0, P0), stepsize_controller=control)
    with pytest.raises(ValueError, match="DiscreteTerm"):
        jax.grad(end_of, argnums=2)(solver, diffrax.BacksolveAdjoint(), 0.1, 1.0)
    with pytest.raises(TypeError, match="positions from momenta"):
        run(term, y0=jnp.concatenate([Q0, P0]))
    with pytest.raises(TypeError, match="method"):
        interop.diffrax_solver(diffrax.Tsit5())
    undisturbed = dvi.System(non_separable)
    for make in (interop.diffrax_term, interop.vector_field):
        with pytest.warns(UserWarning, match="no effect"):
            make(undisturbed, epsilon=0.1)
    with pytest.raises(TypeError, match=r"dvi\.System"):
        interop.diffrax_term(KEPLER.system.H_D)


@pytest.mark.slow
def test_dense_output_has_order_four_and_is_not_the_map():
    def error(h):
        ts = jnp.linspace(0.03, 1.97, 23)
        sol = by_diffrax(
            interop.diffrax_solver(dvi.KahanLi(8)), h=h, epsilon=0.0,
            saveat=diffrax.SaveAt(ts=ts),
        )  # fmt: skip
        q, _ = KEPLER.exact(ts, Q0, P0, KEPLER.args)
        return float(jnp.max(jnp.abs(sol.ys[0] - q)))

    orders = measured_orders([error(h) for h in (1 / 8, 1 / 16, 1 / 32)], 2, 1e-13)
    assert np.all(np.abs(orders - 4) < 0.5), orders


@pytest.mark.slow
def test_the_map_tends_to_the_vector_field():
    """Of the forced problem, with a perturbation, and in slow time: order 2 of `Strang`."""

    def perturbation(t0, t1, q0, p1, args):
        return jnp.sum(q0**4) * jnp.cos(t1) / 4

    def drag(t0, t1, q0, p1, args):
        return -p1 * (1 + jnp.sin(t0))

    system = dvi.System(KEPLER.system.H_D, force=drag, perturbation=perturbation, slow_time=True)
    field = diffrax.ODETerm(interop.vector_field(system, 0.1))
    true = diffrax.diffeqsolve(
        field, diffrax.Dopri8(), 0.0, 2.0, 0.1, y0=(Q0, P0), args=KEPLER.args,
        stepsize_controller=diffrax.PIDController(rtol=1e-12, atol=1e-12),
    ).ys[0][-1]  # fmt: skip

    def error(num_steps, epsilon=0.1):
        sol = dvi.integrate(
            system, Q0, P0, h=2.0 / num_steps, num_steps=num_steps, epsilon=epsilon,
            args=KEPLER.args, method=dvi.Strang(), save=dvi.Save(final=True),
        )  # fmt: skip
        return float(jnp.max(jnp.abs(sol.qs[-1] - true)))

    orders = measured_orders([error(n) for n in (40, 80, 160)], 2, 1e-11)
    assert np.all(np.abs(orders - 2) < 0.35), orders
    assert error(160, epsilon=0.11) > 30 * error(160)  # of another field it would not


@pytest.mark.slow
def test_their_solvers_take_our_term():
    options = {"stepsize_controller": diffrax.PIDController(rtol=1e-12, atol=1e-12)}
    sol = by_diffrax(diffrax.Dopri8(), 3.0, epsilon=0.0, **options)
    q, _ = KEPLER.exact(3.0, Q0, P0, KEPLER.args)
    np.testing.assert_allclose(sol.ys[0][-1], q, rtol=0, atol=1e-10)


@pytest.mark.slow
def test_a_discrete_lagrangian_has_no_field_and_hides_no_nan():
    def L_d(t0, t1, q0, q1, args):
        return jnp.sum((q1 - q0) ** 2) / (2 * (t1 - t0)) - (t1 - t0) * jnp.sum(q0**2) / 2

    system = dvi.System(dvi.from_lagrangian(L_d))
    rate = interop.vector_field(system)(0.0, (jnp.ones(1), jnp.ones(1)), None)
    assert np.isnan(rate[1]).all()
    h2 = dvi.System(dvi.discretise(lambda t, q, p, args: jnp.sum(p**2 + q**2) / 2, order=2))
    rate = interop.vector_field(h2)(0.0, (jnp.ones(1), 2 * jnp.ones(1)), None)
    np.testing.assert_allclose(np.concatenate(rate), [2, -1], rtol=1e-15)


def test_a_pair_may_be_a_list():
    solver, term = interop.diffrax_solver(), interop.diffrax_term(KEPLER)
    found = diffrax.diffeqsolve(term, solver, 0.0, H, H, y0=[Q0, P0], args=KEPLER.args)
    wanted = by_diffrax(solver, t1=H, epsilon=0.0)
    assert isinstance(found.ys, list)
    np.testing.assert_array_equal(found.ys[0], wanted.ys[0])


def test_a_strength_with_a_unit_is_refused():
    u = pytest.importorskip("astropy.units")
    for make in (interop.diffrax_term, interop.vector_field):
        with pytest.raises(TypeError, match="epsilon has the unit 'm'"):
            make(KEPLER, epsilon=5 * u.m)
