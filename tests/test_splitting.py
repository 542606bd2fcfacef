"""Splitting methods: known flows, generalised orders, and the method of Wisdom and Holman."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import central_difference, symplectic_defect

import dvi_jax as dvi
from dvi_jax import systems
from dvi_jax.methods._schemes import corrector, near_integrable, sequence_of
from dvi_jax.problem import flows
from dvi_jax.problem.kepler import change
from dvi_jax.systems.n_body import hamiltonian
from lanewise.jaxprs.extent import operation_count

Q0, P0 = np.array([1.0, 0.0]), np.array([0.2, 1.1])


def quartic(t0, t1, q0, p1, args):
    return args["eps"] * jnp.sum(q0**4)


SPLIT = dvi.System(dvi.Split([flows.Kepler(k=1.0), quartic]))
SPRING = dvi.System(dvi.Split([flows.Harmonic(omega=1.3), quartic]))
"""It compiles faster, for what does not depend on the known flow."""


def end(method, h, num_steps, system=SPLIT, eps=1e-3, **options):
    sol = dvi.integrate(
        system, Q0, P0, h=h, num_steps=num_steps, args={"eps": eps}, method=method,
        save=dvi.Save(final=True), **options,
    )  # fmt: skip
    return np.concatenate([sol.qs[-1], sol.ps[-1]])


def orbit(eccentricity):
    """A state at the pericentre of an orbit with μ = 1, and the semi-latus rectum 1."""
    q_min = 1 / (1 + eccentricity)
    return np.array([q_min, 0.0, 0.0]), np.array([0.0, 1 / q_min, 0.0])


@jax.jit
def advanced(h, q, v):
    def one(h, q, v):
        dq, dv, found = change(h, q[None], v[None], jnp.ones(1))
        return q + dq[0], v + dv[0], found

    return jax.vmap(one)(h, q, v)


@pytest.mark.slow
def test_kepler_flow_conserves_the_orbit_for_all_eccentricities_and_long_steps():
    eccentricities = np.repeat([0.0, 0.3, 0.9, 0.999, 1.0, 1.2, 10.0], 6)
    hs = np.tile([1e-3, 0.3, -2.0, 20.0, -300.0, 4000.0], 7)
    q, v = map(np.array, zip(*map(orbit, eccentricities), strict=True))
    q1, v1, found = advanced(hs, q, v)
    assert found.all()
    eccentricity = np.cross(v1, np.cross(q1, v1)) - q1 / np.linalg.norm(q1, axis=1)[:, None]
    # The energy is a difference of large terms: its error is relative to the kinetic energy.
    scale = 1 + eccentricities**2 + (v1**2).sum(1)
    momentum = np.linalg.norm(np.cross(q1, v1), axis=1)
    assert np.abs(momentum - 1).max() < 3e-9  # |q| ≈ 4e4 at the end of the longest arcs
    assert (np.abs(eccentricity[:, 0] - eccentricities) / scale).max() < 3e-9
    # Back to the start by −h.
    q2, v2, _ = advanced(-hs, q1, v1)
    short = np.abs(hs) < 3
    assert np.abs(q2 - q)[short].max() < 2e-13
    assert np.abs(v2 - v)[short].max() < 2e-11  # the speed at the pericentre for e = 10 is 11


def test_kepler_flow_agrees_with_kepler_equation():
    # M = E − e sin E by a solver of our own here: bisection in the eccentric anomaly.
    e, a = 0.7, 1 / (1 - 0.49)
    q, v = orbit(e)
    h = np.linspace(-20, 20, 9)
    mean = h / a**1.5
    low, high = mean - 1, mean + 1
    for _ in range(60):
        middle = (low + high) / 2
        late = middle - e * np.sin(middle) > mean
        low, high = np.where(late, low, middle), np.where(late, middle, high)
    exact = a * np.stack([np.cos(low) - e, np.sqrt(1 - e * e) * np.sin(low)], 1)
    found, _, _ = advanced(h, np.tile(q, (9, 1)), np.tile(v, (9, 1)))
    assert np.abs(found[:, :2] - exact).max() < 1e-13


@pytest.mark.slow
def test_derivative_of_kepler_flow_on_both_sides_of_a_parabola():
    derivative = jax.jit(jax.jacfwd(kepler_flow))
    for speed in (0.9, np.sqrt(2.0), 1.9):
        x = jnp.array([2.5, 1.0, 0.1, -0.2, speed, 1.0])
        for i in range(6):
            ours = derivative(x)[:, i]
            other = central_difference(jax.jit(kepler_flow), x, jnp.eye(6)[i], step=1e-4)
            assert np.abs(ours - other).max() < 2e-10 * max(1, np.abs(ours).max())


def kepler_flow(x):
    """The flow over the time x[0] from (q, v) = (x[1:3], x[3:5]) with μ = x[5]."""
    dq, dv, _ = change(x[0], x[None, 1:3], x[None, 3:5], x[5:])
    return jnp.concatenate([dq[0], dv[0]])


def test_the_derivative_of_kepler_flow_is_a_short_program():
    """The search for the root and the sums of its functions are not differentiated."""
    x = jnp.array([0.1, 1.0, 0.1, -0.2, 1.0, 1.0])
    plain = operation_count(jax.make_jaxpr(kepler_flow)(x).jaxpr)
    both = operation_count(jax.make_jaxpr(lambda x: jax.jvp(kepler_flow, (x,), (x,)))(x).jaxpr)
    assert both < 1.5 * plain


@pytest.mark.slow
@pytest.mark.parametrize("time", [0.1, 5.0])
def test_second_derivatives_of_kepler_flow(time):
    """In ellipses and hyperbolas, by series and by trigonometric functions."""
    first = jax.jit(jax.jacfwd(kepler_flow))
    second, by_reverse = (
        jax.jit(jax.jacfwd(jax.jacrev(kepler_flow))),
        jax.jit(jax.jacrev(kepler_flow)),
    )
    for speed in (0.9, 1.9):
        x = jnp.array([time, 1.0, 0.1, -0.2, speed, 1.0])
        scale = np.abs(first(x)).max()
        np.testing.assert_allclose(first(x), by_reverse(x), rtol=0, atol=1e-14 * scale)
        ours = second(x)
        for i in range(6):
            other = central_difference(first, x, jnp.eye(6)[i], step=1e-4)
            np.testing.assert_allclose(ours[..., i], other, rtol=0, atol=1e-8 * np.abs(ours).max())


def test_a_body_at_the_centre_fails_and_does_not_affect_the_others():
    def run(q0):
        return dvi.integrate(
            SPLIT, q0, P0, h=0.1, num_steps=5, args={"eps": 1e-3}, throw=False,
            save=dvi.Save(final=True),
        )  # fmt: skip

    sol = jax.vmap(run)(jnp.array([[1.0, 0.0], [0.0, 0.0], [1.0, 0.0]]))
    assert sol.status.tolist() == ["successful", "not_finite", "successful"]
    np.testing.assert_array_equal(sol.qs[0], sol.qs[2])


@pytest.mark.slow
@pytest.mark.parametrize(
    "flow",
    [
        flows.Kepler(k=1.3, mass=0.7),
        flows.Harmonic(omega=np.array([0.0, 2.0]), mass=0.7),
        flows.Rotation(rate=0.4),
    ],
    ids=lambda flow: type(flow).__name__,
)
def test_flows_belong_to_their_hamiltonians(flow):
    # The derivative of the flow is the vector field of H, also after a finite time.
    def state(h):
        dq, dp, _ = flow.change(h, jnp.asarray(Q0), jnp.asarray(P0), None)
        return Q0 + dq, P0 + dp

    (q, p), (dq, dp) = jax.jvp(state, (0.3,), (1.0,))
    of_q, of_p = jax.grad(lambda q, p: flow(0.0, 0.0, q, p, None), argnums=(0, 1))(q, p)
    np.testing.assert_allclose([dq, dp], [of_p, -of_q], atol=1e-14)
    assert np.abs(state(0.0)[0] - Q0).max() == 0


@pytest.mark.parametrize("orders", [(2, 2), (8, 2), (8, 4), (10, 4), (8, 6, 4), (10, 6, 4)])
def test_perturbation_is_integrated_by_a_quadrature_of_the_first_order(orders):
    # To first order in ε a scheme is the quadrature Σ b_i f(c_i), with c_i = a_1 + … + a_i.
    a, b = near_integrable(orders)
    nodes = np.cumsum(a)[:-1]
    moments = [abs(np.sum(b * nodes**k) - 1 / (k + 1)) for k in range(orders[0] + 1)]
    assert max(moments[: orders[0]]) < 5e-16
    assert moments[orders[0]] > 1e-7  # and not by a better one


def test_words_join_neighbouring_flows():
    assert sequence_of(dvi.Strang(), 3) == ((0, 0.5), (1, 0.5), (2, 1.0), (1, 0.5), (0, 0.5))
    found = sequence_of(dvi.BlanesMoan(4), 2)
    assert [i for i, _ in found] == [0, 1] * 6 + [0]
    # The published coefficients of Blanes & Moan 2002, table 2, S₆.
    assert found[0][1] == pytest.approx(0.0792036964311957, abs=1e-15)
    assert found[1][1] == pytest.approx(0.209515106613362, abs=1e-15)


def test_corrector_cancels_the_error_of_leapfrog_to_its_order():
    def left(order, x):
        error = x / (2 * np.sinh(x / 2)) - 1
        return error - sum(2 * b * x * np.sinh(a * x) for a, b in corrector(order))

    x = 0.5
    assert abs(left(3, x)) > 1e-5
    assert abs(left(3, x) / left(3, x / 2)) == pytest.approx(16, rel=0.1)
    assert abs(left(7, x) / left(7, x / 2)) == pytest.approx(256, rel=0.1)
    # The printed value of order 3, Wisdom, Holman & Touma 1996.
    assert abs(corrector(3)[1][1]) == pytest.approx(0.0249005960278, abs=1e-12)


@pytest.mark.slow
def test_orders_in_h():
    exact = end(dvi.Splitting(dvi.KahanLi(8)), 0.05, 160)
    steps = np.array([20, 30, 40, 60])
    for scheme, order in ((dvi.Strang(), 2), (dvi.BlanesMoan(6), 6)):
        errors = [np.abs(end(dvi.Splitting(scheme), 8 / n, int(n)) - exact).max() for n in steps]
        found = np.log(errors[0] / errors[-1]) / np.log(3)
        assert found == pytest.approx(order, abs=0.35), (scheme, errors)


@pytest.mark.slow
def test_generalised_orders_in_epsilon_and_h():
    """The error of (8, 4) is O(ε h⁸ + ε² h⁴): for small ε it falls as h⁸, for larger ones as h⁴."""

    def errors(eps, steps):
        exact = end(dvi.Splitting(dvi.KahanLi(8)), 0.05, 160, eps=eps)
        return [np.abs(end(dvi.Splitting((8, 4)), 8 / n, n, eps=eps) - exact).max() for n in steps]

    small, large = errors(1e-6, (8, 12)), errors(3e-2, (48, 96))
    assert np.log(small[0] / small[1]) / np.log(1.5) > 6.5
    assert np.log2(large[0] / large[1]) == pytest.approx(4, abs=0.35)
    # The negative control: the error of leapfrog is proportional to ε, and falls as h².
    exact = end(dvi.Splitting(dvi.KahanLi(8)), 0.05, 160, eps=1e-6)
    strang = [np.abs(end(dvi.Splitting(), 8 / n, n, eps=1e-6) - exact).max() for n in (24, 36)]
    assert np.log(strang[0] / strang[1]) / np.log(1.5) == pytest.approx(2, abs=0.5)


@pytest.mark.slow
def test_parts_that_are_not_exact_are_solved_to_the_order_of_the_scheme():
    def coupled(t0, t1, q0, p1, args):
        return args["eps"] * (q0 @ p1) ** 2

    system = dvi.System(dvi.Split([flows.Harmonic(omega=1.3), coupled]))
    exact = end(dvi.GaussLegendre(4), 0.02, 200, system, eps=0.1)
    errors = [
        np.abs(end(dvi.Splitting(dvi.BlanesMoan(4)), 4 / n, n, system, eps=0.1) - exact).max()
        for n in (10, 20)
    ]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(4, abs=0.4)
    assert not dvi.Splitting().is_explicit(system, Q0, {"eps": 0.1})
    assert dvi.Splitting().is_explicit(SPLIT, Q0, {"eps": 0.1})


@pytest.mark.slow
@pytest.mark.parametrize("perturbed", [1, pytest.param(None, marks=pytest.mark.slow)])
def test_perturbing_force_and_time_enter_a_part(perturbed):
    def force(t0, t1, q0, p1, args):
        return -p1 + jnp.cos(t0)

    def make(method):
        parts = dvi.Split([flows.Harmonic(omega=1.3), quartic], perturbed=perturbed)
        return end(method, 0.1, 40, dvi.System(parts, force=force), epsilon=0.05)

    def plain(t0, t1, q0, p1, args):
        return p1 @ p1 / 2 + 1.69 * q0 @ q0 / 2 + quartic(t0, t1, q0, p1, args)

    exact = end(dvi.GaussLegendre(4), 0.02, 200, dvi.System(plain, force=force), epsilon=0.05)
    assert np.abs(make(dvi.Splitting(dvi.BlanesMoan(6))) - exact).max() < 1e-7
    assert 1e-7 < np.abs(make(dvi.Splitting()) - exact).max() < 1e-2


def defects(method, system, q, p, args=None, h=0.3):
    """The defect of MᵀJM = J for the derivative M of one step, and that of an inverse step."""
    n = q.size

    def step(z):
        sol = dvi.integrate(
            system, z[:n].reshape(q.shape), z[n:].reshape(q.shape), h=h, num_steps=1, args=args,
            method=method, save=dvi.Save(final=True), throw=False,
            adjoint=dvi.Reversible(report_defect=True),
        )  # fmt: skip
        end = jnp.concatenate([sol.q_final.ravel(), sol.p_final.ravel()])
        return end, sol.stats["round_trip_defect"]

    M, back = jax.jit(jax.jacfwd(step, has_aux=True))(jnp.append(q, p))
    return symplectic_defect(np.asarray(M)), float(back)


WRONG = flows.Known(quartic, lambda h, q, p, args: (q, p - h * jnp.stack([q[1], -q[0]])))


@pytest.mark.slow
@pytest.mark.parametrize(
    "method",
    [dvi.Splitting(), *(pytest.param(m, marks=pytest.mark.slow)
     for m in (dvi.Splitting((8, 4)), dvi.Yoshida(4, base=dvi.Splitting())))],
)  # fmt: skip
def test_steps_are_symplectic_and_invertible(method):
    """Unless a flow belongs to another Hamiltonian than that of its part."""
    system = dvi.System(dvi.Split([flows.Harmonic(omega=1.3), WRONG]))
    wrong, right = (defects(method, x, Q0, P0, {"eps": 0.1}) for x in (system, SPLIT))
    assert max(right) < 1e-13
    assert wrong[0] > 0.1


@pytest.mark.slow
def test_saved_states_do_not_depend_on_how_often_they_are_saved():
    method = dvi.Splitting()
    options = {"h": 0.2, "num_steps": 120, "args": {"eps": 1e-3}, "method": method}
    often = dvi.integrate(SPRING, Q0, P0, **options)
    once = dvi.integrate(SPRING, Q0, P0, **options, save=dvi.Save(every=50, final=True))
    np.testing.assert_array_equal(often.qs[np.array([50, 100, 120])], once.qs[1:])

    # Reductions read every whole step; the states agree to round-off.
    def energy(q, p):
        return SPRING.hamiltonian(0.0, 0.0, q, p, 0.0, {"eps": 1e-3})

    observe = {"drift": dvi.MaxDrift(energy), "energy": energy}
    alone = dvi.integrate(SPRING, Q0, P0, **options, observe=observe, save=dvi.Save(every=40))
    assert np.abs(alone.qs - often.qs[::40]).max() < 1e-12
    np.testing.assert_allclose(
        alone.observed["energy"], jax.vmap(energy)(alone.qs, alone.ps), rtol=1e-14
    )
    every = jax.vmap(energy)(often.qs, often.ps)
    assert alone.observed["drift"] == pytest.approx(np.abs(every - every[0]).max(), abs=1e-12)


def loss(x, adjoint):
    sol = dvi.integrate(
        SPLIT, x[:2], x[2:4], h=0.3, num_steps=12, args={"eps": x[4]}, method=dvi.Splitting(),
        save=dvi.Save(final=True), adjoint=adjoint,
    )  # fmt: skip
    return sol.q_final @ jnp.array([1.0, -2.0])


def gradient(adjoint):
    return jax.jit(jax.grad(lambda x: loss(x, adjoint)))(jnp.array([*Q0, *P0, 0.05]))


@pytest.mark.slow
def test_gradient_by_reconstructed_states():
    f, x = jax.jit(lambda x: loss(x, dvi.Reversible())), jnp.array([*Q0, *P0, 0.05])
    other = [central_difference(f, x, e, step=1e-4) for e in jnp.eye(5)]
    np.testing.assert_allclose(gradient(dvi.Reversible(checkpoint_every=4)), other, rtol=1e-8)


@pytest.mark.slow
def test_gradients_by_all_adjoints():
    expected = gradient(dvi.Reversible())
    for adjoint in (dvi.Checkpointed(), dvi.Direct()):
        np.testing.assert_allclose(gradient(adjoint), expected, rtol=1e-11)


FORCED = dvi.System(SPLIT.H_D, force=lambda t0, t1, q0, p1, args: -q0)
STEP_FROM_TIMES = dvi.discretise(lambda t, q, p, args: q @ q, order=2)


@pytest.mark.parametrize(
    ("make", "error", "word"),
    [
        (lambda: dvi.Split([quartic]), ValueError, "two or more"),
        (lambda: dvi.Split([quartic, quartic], flows=[None]), ValueError, "one entry"),
        (lambda: dvi.Split([flows.Kepler(), quartic], perturbed=0), ValueError, "a known flow"),
        (lambda: dvi.Split([STEP_FROM_TIMES, quartic]), ValueError, "t1 − t0"),
        (lambda: dvi.Splitting((7, 3)), ValueError, r"orders.*got \(7, 3\)"),
        (lambda: dvi.Splitting(dvi.GaussLegendre(2)), TypeError, "must be a composition"),
        (lambda: end(dvi.Splitting(), 0.1, 2, dvi.System(quartic)), TypeError, "dvi.Split"),
        (lambda: end(dvi.Splitting((8, 4)), 0.1, 2, FORCED, epsilon=0.1), ValueError, "two parts"),
        *((lambda m=m: end(m, 0.1, 2, arithmetic=dvi.DoubleDouble()), ValueError, "Kepler flow")
          for m in (dvi.Splitting(), dvi.Adjoint(dvi.Splitting()))),
        (lambda: dvi.WisdomHolman("democratic", corrector=3), ValueError, "must be 0 unless"),
        (lambda: dvi.WisdomHolman("helio"), ValueError, "coordinates must be one of"),
    ],
)  # fmt: skip
def test_bad_parts_and_schemes_are_refused(make, error, word):
    with pytest.raises(error, match=word):
        make()


@pytest.mark.slow
def test_a_flow_of_another_hamiltonian_is_refused():
    def make(flow):
        return dvi.System(dvi.Split([flows.Harmonic(omega=1.3), quartic], flows=[None, flow]))

    def right(h, q, p, args):
        return q, p - 4 * h * args["eps"] * q**3

    ends = [end(dvi.Splitting(), 0.1, 5, system, eps=0.1) for system in (make(right), SPRING)]
    np.testing.assert_allclose(*ends)
    for wrong in (lambda h, q, p, a: (q, p + h * q**3), lambda h, q, p, a: (q, 2 * p)):
        with pytest.raises(ValueError, match="flow of part 1 of Split must be that"):
            end(dvi.Splitting(), 0.1, 5, make(wrong), eps=0.1)


def large(t0, t1, q0, p1, args):
    return p1 @ p1 / 2 + q0 @ q0 / 2


def kinetic(t0, t1, q0, p1, args):
    return p1 @ p1 / 2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("parts", "scheme", "warns"),
    [
        ([quartic, flows.Harmonic(omega=1.3)], (8, 4), True),
        ([quartic, flows.Kepler(k=1.0)], (4, 2), True),
        ([lambda *at: 1e-3 * large(*at), large], (2, 2), True),
        ([flows.Harmonic(omega=1.3), quartic], (8, 4), False),
        ([kinetic, lambda *at: large(*at) - kinetic(*at)], (4, 2), False),
        ([quartic, flows.Harmonic(omega=1.3)], dvi.Strang(), False),
    ],
)
def test_the_smaller_part_first_warns(parts, scheme, warns):
    """The error of (8, 4) is then 2 000 times as large; that of `Strang` is about the same."""
    system, method = dvi.System(dvi.Split(parts)), dvi.Splitting(scheme)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        end(method, 0.1, 2, system)
    assert any("smaller one" in str(w.message) for w in caught) is warns


def small(t0, t1, q0, p1, args):
    return 1e-3 * large(t0, t1, q0, p1, args)


def growing(t0, t1, q0, p1, args):
    return 1e-3 * t0 * large(t0, t1, q0, p1, args)


def push(t0, t1, q0, p1, args):
    return -q0 - p1


@pytest.mark.parametrize(
    ("split", "options", "warns"),
    [
        (dvi.Split([small, large], perturbed=0), {"perturbation": large, "epsilon": 1e2}, False),
        (dvi.Split([small, large], perturbed=0), {"perturbation": large, "epsilon": 1e-2}, True),
        (dvi.Split([large, small], perturbed=1), {"perturbation": large, "epsilon": 1e2}, True),
        (dvi.Split([large, small], perturbed=1), {"perturbation": large, "epsilon": 1e-2}, False),
        (dvi.Split([small, large], perturbed=0), {"force": push, "epsilon": 1e2}, False),
        (dvi.Split([growing, large]), {"t0": 1e3}, False),
        (dvi.Split([growing, large]), {"t0": 1e3, "epsilon": 1e-3, "slow_time": True}, True),
    ],
)
def test_the_size_of_a_part_is_that_with_its_perturbation(split, options, warns):
    """The sizes were those of the parts alone, at the time t where they depend on ε t."""
    terms = {k: v for k, v in options.items() if k in ("perturbation", "force", "slow_time")}
    run = {k: v for k, v in options.items() if k not in terms}
    method = dvi.Splitting((4, 2))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        dvi.integrate(
            dvi.System(split, **terms), [0.6], [0.8], h=0.01, num_steps=1, method=method, **run
        )
    assert any("smaller one" in str(w.message) for w in caught) is warns


THREE = systems.n_body(
    masses=[1.0, 1e-3, 3e-4],
    q0=[[0.0, 0.0], [1.0, 0.0], [-0.3, 1.8]],
    p0=[[0.0, 0.0], [0.0, 1e-3], [-2.2e-4, -0.3e-4]],
    h=0.3,
)


def energy_error(method, h, num_steps, problem=THREE):
    sol = dvi.integrate(problem, h=h, num_steps=num_steps, method=method, save=dvi.Save(every=8))
    H = jax.vmap(lambda q, p: hamiltonian(0.0, 0.0, q, p, problem.args))(sol.qs, sol.ps)
    return float(jnp.abs(H / H[0] - 1).max())


@pytest.mark.slow
def test_wisdom_holman_converges_to_the_same_orbit():
    def final(method, n):
        how = {"h": 12.0 / n, "num_steps": n, "save": dvi.Save(final=True)}
        return dvi.integrate(THREE, method=method, **how).q_final

    exact = final(dvi.KahanLi(8), 480)
    for method in (dvi.WisdomHolman(), dvi.WisdomHolman("democratic")):
        errors = [np.abs(final(method, n) - exact).max() for n in (40, 80)]
        assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.2)
    assert np.abs(final(dvi.WisdomHolman(scheme=(10, 6, 4)), 40) - exact).max() < 1e-8


@pytest.mark.slow
def test_corrector_and_generalised_orders_lower_the_energy_error():
    plain = energy_error(dvi.WisdomHolman(), 0.2, 400)
    assert energy_error(dvi.WisdomHolman(corrector=3), 0.2, 400) < plain / 10
    assert energy_error(dvi.WisdomHolman(corrector=11), 0.2, 400) < plain / 100


@pytest.mark.slow
def test_wisdom_holman_is_symplectic_and_invertible():
    p = np.array(THREE.p0)
    for method in (dvi.WisdomHolman(corrector=3), dvi.WisdomHolman("democratic")):
        defect, back = defects(method, THREE.system, np.array(THREE.q0), p, THREE.args)
        # Momenta are 1e-3 of the positions: entries of the derivative are up to 1e3.
        assert defect < 1e-11
        assert back < 1e-13


@pytest.mark.slow
def test_wisdom_holman_with_forces_and_a_perturbation():
    def drag(t0, t1, q0, p1, args):
        return -p1

    def oblate(t0, t1, q0, p1, args):
        return -1e-3 / jnp.sum((q0[1] - q0[0]) ** 2) ** 1.5

    for change_ in ({"force": drag}, {"perturbation": oblate}):
        system = dvi.System(hamiltonian, **change_)

        def final(method, n, system=system):
            sol = dvi.integrate(
                system, THREE.q0, THREE.p0, args=THREE.args, h=6.0 / n, num_steps=n, epsilon=0.05,
                method=method, save=dvi.Save(final=True),
            )  # fmt: skip
            return sol.q_final

        exact = final(dvi.GaussLegendre(3), 120)
        errors = [np.abs(final(dvi.WisdomHolman(), n) - exact).max() for n in (30, 60)]
        assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.25)


def test_wisdom_holman_refuses_other_systems():
    def bent(t0, t1, q0, p1, args):
        return jnp.sum(jnp.sqrt(1 + p1**2)) + jnp.sum(q0**2)

    def mixed(t0, t1, q0, p1, args):
        return jnp.sum(p1**2 * (1 + q0**2))

    def skew(t0, t1, q0, p1, args):
        return jnp.sum(p1**2) + p1[0, 0] * p1[1, 1] + jnp.sum(q0**2)

    q = np.ones((2, 2))
    for H, match in ((bent, "quadratic"), (mixed, "q0 enters"), (skew, "is not p/m")):
        with pytest.raises(ValueError, match=match):
            dvi.integrate(dvi.System(H), q, q, h=0.1, num_steps=2, method=dvi.WisdomHolman())
    turned = systems.n_body(THREE.args["masses"][::-1], THREE.q0[::-1], THREE.p0[::-1])
    with pytest.raises(ValueError, match="body 2 has the mass 1 and body 0 only"):
        dvi.integrate(turned, num_steps=2, method=dvi.WisdomHolman())
    with pytest.raises(ValueError, match=r"\(bodies, 2\)"):
        dvi.integrate(systems.kepler(), h=0.1, num_steps=2, method=dvi.WisdomHolman())


@pytest.mark.slow
def test_wisdom_holman_in_float32_and_with_compensated_sums():
    q, p = (np.asarray(x, np.float32) for x in (THREE.q0, THREE.p0))
    args = jax.tree.map(np.float32, THREE.args)
    run = {"h": 0.25, "num_steps": 40, "method": dvi.WisdomHolman(), "save": dvi.Save(final=True)}
    single = dvi.integrate(THREE.system, q, p, args=args, **run).q_final
    double = dvi.integrate(THREE, **run).q_final
    assert single.dtype == np.float32
    assert 1e-9 < np.abs(single - double).max() < 1e-5
    compensated = dvi.integrate(THREE, **run, arithmetic=dvi.Compensated()).q_final
    assert np.abs(compensated - double).max() < 1e-13


@pytest.mark.slow
def test_flows_that_are_not_exact_are_not_joined():
    def coupled(t0, t1, q0, p1, args):
        return p1 @ p1 / 2 + (1 + q0[0] ** 2) * p1[1] ** 2 / 4

    system = dvi.System(dvi.Split([coupled, lambda t0, t1, q0, p1, args: q0 @ q0]))
    options = {"h": 0.3, "num_steps": 20}
    often = dvi.integrate(system, Q0, P0, **options, observe=dvi.MaxDrift(lambda *step: step[4][0]))
    once = dvi.integrate(system, Q0, P0, **options, save=dvi.Save(final=True))
    assert np.abs(often.qs[-1] - once.q_final).max() < 1e-13


def jupiter_saturn(coordinates="jacobi", corrector=0):
    """A simulation of WHFast with the Sun, Jupiter and Saturn, and the same problem here."""
    rebound = pytest.importorskip("rebound")
    from dvi_jax import interop

    planets = systems.outer_solar_system()
    sim = rebound.Simulation()
    sim.G = planets.args["G"]
    for m, q, p in zip(planets.args["masses"][:3], planets.q0, planets.p0, strict=False):
        sim.add(m=m, **dict(zip(("x", "y", "z", "vx", "vy", "vz"), (*q, *(p / m)), strict=True)))
    sim.move_to_com()
    problem = interop.from_rebound(sim)
    sim.integrator, sim.dt = "whfast", 100.0
    names = {"jacobi": "jacobi", "democratic": "democraticheliocentric"}
    sim.integrator.coordinates, sim.integrator.safe_mode = names[coordinates], 0
    sim.integrator.corrector = corrector
    return sim, problem


@pytest.mark.slow
@pytest.mark.parametrize(
    ("coordinates", "corrector"), [("jacobi", 0), ("jacobi", 11), ("democratic", 0)]
)
def test_the_states_are_those_of_whfast(coordinates, corrector):
    sim, problem = jupiter_saturn(coordinates, corrector)
    sim.dt = 200.0  # round-off of the phases grows as steps^1.5 in both programs
    sim.steps(2200)
    sim.synchronize()
    sol = dvi.integrate(
        problem, h=200.0, num_steps=2200, method=dvi.WisdomHolman(coordinates, corrector),
        save=dvi.Save(final=True),
    )  # fmt: skip
    theirs = np.array([[b.x, b.y, b.z] for b in sim.particles])
    apart = np.linalg.norm(sol.q_final - theirs, axis=1)[1:] / np.linalg.norm(theirs, axis=1)[1:]
    assert apart.max() < 1e-11  # after 100 revolutions of Jupiter


@pytest.mark.slow
def test_derivatives_by_states_and_masses():
    """Against WHFast's variational equations for a state, and against differences for masses,
    which WHFast's equations do not support."""
    _, problem = jupiter_saturn()
    masses, v = np.array(problem.args["masses"]), problem.velocities

    def final(x, steps=500):
        q, v, m = x
        sol = dvi.integrate(
            problem.system, q, m[:, None] * v, args={"masses": m, "G": problem.args["G"]}, h=100.0,
            num_steps=steps, method=dvi.WisdomHolman(), save=dvi.Save(final=True),
        )  # fmt: skip
        return sol.q_final

    x = tuple(map(jnp.asarray, (problem.q0, v, masses)))
    moved = jax.jit(lambda x, dx: jax.jvp(final, (x,), (dx,))[1])
    for which, body in ((0, 2), (1, 1)):
        other, _ = jupiter_saturn()
        variation = other.add_variation()
        setattr(variation.particles[body], ("x", "vx")[which], 1.0)
        other.steps(500)
        other.synchronize()
        theirs = np.array([[b.x, b.y, b.z] for b in variation.particles])
        tangent = tuple(jnp.zeros_like(y) for y in x)
        tangent = (*tangent[:which], tangent[which].at[body, 0].set(1.0), *tangent[which + 1 :])
        assert np.abs(moved(x, tangent) - theirs).max() < 1e-9 * np.abs(theirs).max()
    rng = np.random.default_rng(0)
    tangent = tuple(jnp.asarray(y * rng.normal(size=y.shape)) for y in x)
    ours = moved(x, tangent)
    other = central_difference(jax.jit(final), x, tangent, step=1e-5)
    assert np.abs(ours - other).max() < 1e-9 * np.abs(ours).max()


@pytest.mark.slow
def test_energy_of_the_planets_does_not_drift_by_round_off():
    """Two bodies for 10⁶ steps: without the correction of Kepler's equation in its own rounding the
    mean error of these orbits is 2e-13."""
    sun = systems.n_body(
        masses=[1.0, 1e-3], q0=[[0.0, 0.0], [0.95, 0.0]], p0=[[0.0, -1e-3], [0.0, 1e-3]], h=0.1
    )

    def error(h):
        how = {"h": h, "num_steps": 1_000_000, "method": dvi.WisdomHolman()}
        sol = dvi.integrate(sun, save=dvi.Save(final=True), **how)
        H = [hamiltonian(0.0, 0.0, q, p, sun.args) for q, p in zip(sol.qs, sol.ps, strict=True)]
        return H[-1] / H[0] - 1

    found = jax.jit(jax.vmap(error))(0.006 * (1 + 0.01 * jnp.linspace(-1, 1, 64)))
    assert abs(found.mean()) < 5 * found.std() / 8
    assert found.std() < 1e-12


@pytest.mark.slow
def test_discovery_and_drift_with_a_splitting_method():
    def nothing(t0, t1, q0, p1, args):
        return jnp.zeros((), q0.dtype)

    parts = dvi.Split([flows.Harmonic(omega=1.0), nothing], perturbed=1)
    system = dvi.System(parts, force=lambda t0, t1, q0, p1, args: -(q0**3))
    options = {"h": 0.1, "integrator": dvi.Integrator(method=dvi.Splitting())}
    samples = np.random.default_rng(0).uniform(-1, 1, (2, 200, 1))
    found = dvi.discover_invariants(
        system, dvi.Polynomials(4), order=1, samples=samples, representative="simplest", **options
    )
    # The flow of the oscillator is exact: its energy is the part without ε, without a term h q p.
    q, p = jnp.array([0.7]), jnp.array([0.3])
    assert float(found.invariants[0].evaluate(q, p, 0.0)) == pytest.approx(0.29, abs=1e-12)
    law = dvi.drift_order(
        system, found.invariants[0], [0.4], [0.3], num_steps=500, epsilons=[0.02, 0.05, 0.1],
        **options,
    )  # fmt: skip
    assert law.slope == pytest.approx(2, abs=0.1)
