"""Maps of the package as solvers of diffrax, and the continuous limit that they tend to."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import measured_orders, non_separable

import dvi_jax as dvi
from dvi_jax import interop, systems
from dvi_jax.base.results import STATUS_NAMES

diffrax = pytest.importorskip("diffrax")

KEPLER = systems.kepler()
Q0, P0 = jnp.asarray(KEPLER.q0), jnp.asarray(KEPLER.p0)
EPSILON, H = 0.01, 0.0625
ACCURATE = diffrax.PIDController(rtol=1e-12, atol=1e-12)
MORE = [dvi.TypeII(), dvi.GaussLegendre(2), dvi.Yoshida(4), dvi.RungeKutta4()]


def by_diffrax(solver, t1=2.0, h=H, q0=Q0, epsilon=EPSILON, args=KEPLER.args, **options):
    term = interop.diffrax_term(KEPLER, epsilon)
    h = jnp.asarray(h)  # traced: one compilation for all
    return diffrax.diffeqsolve(term, solver, 0.0, t1, h, y0=(q0, P0), args=args, **options)


def ours(method, num_steps, h=H, system=KEPLER.system, **options):
    options = {"epsilon": EPSILON, "args": KEPLER.args, "method": method, **options}
    return dvi.integrate(system, Q0, P0, h=h, num_steps=num_steps, **options)


@pytest.mark.slow
@pytest.mark.parametrize(
    "method", [dvi.Strang(), *(pytest.param(m, marks=pytest.mark.slow) for m in MORE)], ids=str
)
def test_states_are_those_of_integrate(method):
    saveat = diffrax.SaveAt(t0=True, steps=True)
    theirs = by_diffrax(interop.diffrax_solver(method), saveat=saveat, max_steps=32)
    same = ours(method, 32)
    # h is a power of two, so that the times are the same bits; and hence everything.
    assert jnp.array_equal(theirs.ts, same.ts)
    np.testing.assert_allclose(theirs.ys[0], same.qs, rtol=0, atol=4e-16)
    np.testing.assert_allclose(theirs.ys[1], same.ps, rtol=0, atol=4e-16)
    unperturbed = ours(method, 32, epsilon=0.0)
    assert jnp.max(jnp.abs(theirs.ys[0] - unperturbed.qs)) > 1e-4


@pytest.mark.slow
def test_steps_backwards_and_of_any_size():
    """The states differ by the round-off of the times."""
    theirs = by_diffrax(interop.diffrax_solver(dvi.Strang()), h=0.1)
    np.testing.assert_allclose(theirs.ys[0][-1], ours(dvi.Strang(), 20, 0.1).qs[-1], atol=1e-13)

    def driven(t0, t1, q0, p1, args):
        return -q0 * jnp.cos(3 * t0)  # a time of the wrong sign would be seen

    system = dvi.System(KEPLER.system.H_D, force=driven)
    term, solver = interop.diffrax_term(system, 0.3), interop.diffrax_solver()
    back = diffrax.diffeqsolve(term, solver, 1.5, -0.5, -H, y0=(Q0, P0), args=KEPLER.args)
    same = ours(dvi.TypeII(), 32, -H, system, t0=1.5, epsilon=0.3)
    np.testing.assert_allclose(back.ys[0][-1], same.qs[-1], rtol=0, atol=1e-15)


def end_of(solver, adjoint, epsilon, K):
    sol = by_diffrax(solver, 1.0, epsilon=epsilon, args={"K": K}, adjoint=adjoint, max_steps=32)
    return jnp.sum(sol.ys[0][-1] ** 2 + sol.ys[1][-1])


def end_of_ours(method, epsilon, K):
    sol = ours(method, 16, epsilon=epsilon, args={"K": K}, save=dvi.Save(final=True))
    return jnp.sum(sol.qs[-1] ** 2 + sol.ps[-1])


@pytest.mark.parametrize("method", [dvi.TypeII(), dvi.GaussLegendre(1)], ids=str)
@pytest.mark.slow
def test_gradients_are_those_of_the_map(method):
    """By three adjoints; those of another method are other numbers."""
    at, solver = (EPSILON, 1.0), interop.diffrax_solver(method)
    wanted = jax.grad(end_of_ours, argnums=(1, 2))(method, *at)
    found = jax.grad(end_of, argnums=(2, 3))(solver, diffrax.RecursiveCheckpointAdjoint(), *at)
    np.testing.assert_allclose(found, wanted, rtol=1e-11)
    direct = jax.grad(end_of, argnums=2)(solver, diffrax.DirectAdjoint(), *at)
    forward = jax.jacfwd(end_of, argnums=2)(solver, diffrax.ForwardMode(), *at)
    np.testing.assert_allclose([direct, forward], [wanted[0]] * 2, rtol=1e-11)
    other = jax.grad(end_of_ours, argnums=(1, 2))(dvi.Strang(), *at)
    assert abs(np.asarray(other) / np.asarray(wanted) - 1).min() > 1e-5


@pytest.mark.slow
def test_batches_and_failed_solves():

    def end(q0):
        return by_diffrax(interop.diffrax_solver(dvi.Strang()), 1.0, q0=q0).ys[0][-1]

    starts = Q0[None] + jnp.array([[0.0, 0.0], [0.1, 0.2], [-0.3, 0.1]])
    together = jax.vmap(end)(starts)
    np.testing.assert_allclose(together, jnp.stack([end(q) for q in starts]), rtol=0, atol=1e-14)
    term, solver = interop.diffrax_term(dvi.System(non_separable)), interop.diffrax_solver()
    y0 = jnp.array([3.0]), jnp.array([3.0])

    def run(h, **options):
        return diffrax.diffeqsolve(term, solver, 0.0, 4 * h, h, y0=y0, **options)

    failed = run(2.0, throw=False)
    assert failed.result == diffrax.RESULTS.nonlinear_max_steps_reached
    assert not np.isfinite(failed.ys[0]).any()
    with pytest.raises(RuntimeError, match="nonlinear solver"):
        run(2.0)
    assert run(0.01).result == diffrax.RESULTS.successful


def test_no_failure_is_promoted_to_success():
    from dvi_jax.interop.diffrax_classes import diffrax_status

    texts = {n: diffrax.RESULTS[diffrax_status(getattr(dvi.RESULTS, n))] for n in STATUS_NAMES}
    assert [name for name, text in texts.items() if text == ""] == ["successful"]
    assert "Nonfinite" in texts["not_finite"]
    assert len(set(texts.values())) == 4


@pytest.mark.slow
def test_nothing_is_silently_ignored():
    solver, term = interop.diffrax_solver(), interop.diffrax_term(KEPLER)

    def run(term, y0=(Q0, P0), **options):
        return diffrax.diffeqsolve(term, solver, 0.0, H, H, y0=y0, args=KEPLER.args, **options)

    with pytest.raises(ValueError, match="DiscreteTerm"):
        run(diffrax.ODETerm(interop.vector_field(KEPLER)))
    with pytest.raises(RuntimeError, match="error estimates"):
        run(term, stepsize_controller=ACCURATE)
    with pytest.raises(ValueError, match="DiscreteTerm"):
        jax.grad(end_of, argnums=2)(solver, diffrax.BacksolveAdjoint(), 0.1, 1.0)
    with pytest.raises(TypeError, match="y0 must be a pair"):
        run(term, y0=jnp.concatenate([Q0, P0]))
    as_list = run(term, y0=[Q0, P0])  # the control: a list is a pair, too
    assert isinstance(as_list.ys, list)
    np.testing.assert_array_equal(as_list.ys[0], run(term).ys[0])


def test_arguments_of_a_wrong_type():
    with pytest.raises(TypeError, match="method"):
        interop.diffrax_solver(diffrax.Tsit5())
    with pytest.raises(TypeError, match=r"dvi\.System"):
        interop.diffrax_term(KEPLER.system.H_D)
    u = pytest.importorskip("astropy.units")
    for make in (interop.diffrax_term, interop.vector_field):
        with pytest.warns(UserWarning, match="no effect"):
            make(dvi.System(non_separable), epsilon=0.1)
        with pytest.raises(TypeError, match="epsilon has the unit 'm'"):
            make(KEPLER, epsilon=5 * u.m)


@pytest.mark.slow
def test_order_of_dense_output_and_other_solvers():

    def error(h):
        ts = jnp.linspace(0.03, 1.97, 23)
        solver, saveat = interop.diffrax_solver(dvi.KahanLi(8)), diffrax.SaveAt(ts=ts)
        sol = by_diffrax(solver, h=h, epsilon=0.0, saveat=saveat)
        q, _ = KEPLER.exact(ts, Q0, P0, KEPLER.args)
        return float(jnp.max(jnp.abs(sol.ys[0] - q)))

    orders = measured_orders([error(h) for h in (1 / 8, 1 / 16, 1 / 32)], 2, 1e-13)
    assert np.all(np.abs(orders - 4) < 0.5), orders
    sol = by_diffrax(diffrax.Dopri8(), 3.0, epsilon=0.0, stepsize_controller=ACCURATE)
    q, _ = KEPLER.exact(3.0, Q0, P0, KEPLER.args)
    np.testing.assert_allclose(sol.ys[0][-1], q, rtol=0, atol=1e-10)


@pytest.mark.slow
def test_the_map_tends_to_the_vector_field():
    """With a force, a perturbation and slow time, with order 2 of `Strang`."""

    def perturbation(t0, t1, q0, p1, args):
        return jnp.sum(q0**4) * jnp.cos(t1) / 4

    def drag(t0, t1, q0, p1, args):
        return -p1 * (1 + jnp.sin(t0))

    system = dvi.System(KEPLER.system.H_D, force=drag, perturbation=perturbation, slow_time=True)
    field = diffrax.ODETerm(interop.vector_field(system, 0.1))
    options = {"y0": (Q0, P0), "args": KEPLER.args, "stepsize_controller": ACCURATE}
    true = diffrax.diffeqsolve(field, diffrax.Dopri8(), 0.0, 2.0, 0.1, **options).ys[0][-1]

    def error(num_steps, epsilon=0.1):
        options = {"epsilon": epsilon, "save": dvi.Save(final=True)}
        sol = ours(dvi.Strang(), num_steps, 2.0 / num_steps, system, **options)
        return float(jnp.max(jnp.abs(sol.qs[-1] - true)))

    orders = measured_orders([error(n) for n in (40, 80, 160)], 2, 1e-11)
    assert np.all(np.abs(orders - 2) < 0.35), orders
    assert error(160, epsilon=0.11) > 30 * error(160)  # the control: another field


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
