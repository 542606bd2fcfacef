"""Explicit methods for charged particles: order, volume, symplecticity, fields by functions."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi
from dvi_jax import systems

MIRROR = systems.magnetic_mirror()
FINAL = dvi.Save(final=True)


def end(system, q0, p0, method, h, steps, **options):
    sol = dvi.integrate(system, q0, p0, h=h, num_steps=steps, method=method, save=FINAL, **options)
    return jnp.concatenate([sol.qs[-1].ravel(), sol.ps[-1].ravel()])


def slopes(system, q0, p0, method, steps, T=2.0, **options):
    """Orders, from runs with twice and four times as many steps, against order 8."""
    exact = end(system, q0, p0, dvi.GaussLegendre(4), T / 200, 200, **options)
    errors = [
        float(jnp.abs(end(system, q0, p0, method, T / n, n, **options) - exact).max())
        for n in (steps, 2 * steps)
    ]
    assert errors[1] > 1e-12  # above round-off, or the slope says nothing
    return np.log2(errors[0] / errors[1])


def waves(t, q, p, args):
    """A field that depends on place and time, with a potential."""
    A = jnp.stack([-q[1] * (1 + q[2] ** 2), jnp.sin(q[0] + t), q[0] * q[1]])
    return jnp.sum((p - A) ** 2) / (2 * 1.5) + jnp.cos(q[0] - t) + q[2] ** 2


WAVES = dvi.System(dvi.discretise(waves))
Q, P = jnp.asarray([0.3, -0.2, 0.5]), jnp.asarray([0.4, 1.1, -0.3])


@pytest.mark.parametrize(
    ("method", "order"),
    [
        (dvi.Boris(), 2),
        pytest.param(dvi.Yoshida(4, base=dvi.Boris()), 4, marks=pytest.mark.slow),
        (dvi.MagneticSplitting(), 2),
        pytest.param(dvi.MagneticSplitting(dvi.BlanesMoan(4), nodes=4), 4, marks=pytest.mark.slow),
    ],
)
def test_the_order_in_a_field_of_place_and_time(method, order):
    assert abs(slopes(WAVES, Q, P, method, 20) - order) < 0.25


def matrix(method, system=WAVES):
    """The derivative of a step with respect to (q, p)."""

    def step(z):
        return end(system, z[:3], z[3:], method, 0.2, 1, throw=False)

    return np.asarray(jax.jacfwd(step)(jnp.concatenate([Q, P])))


def test_boris_preserves_volume_and_the_splitting_the_symplectic_form():
    J = np.block([[np.zeros((3, 3)), np.eye(3)], [-np.eye(3), np.zeros((3, 3))]])

    def defect(D):
        return np.abs(D.T @ J @ D - J).max()

    boris, splitting = matrix(dvi.Boris()), matrix(dvi.MagneticSplitting(nodes=4))
    assert abs(np.linalg.det(boris) - 1) < 1e-13 < 1e-5 < defect(boris)
    assert defect(splitting) < 1e-13


@pytest.mark.slow
def test_few_nodes_are_not_symplectic_in_this_field():
    J = np.block([[np.zeros((3, 3)), np.eye(3)], [-np.eye(3), np.zeros((3, 3))]])
    D = matrix(dvi.MagneticSplitting(nodes=1))
    assert np.abs(D.T @ J @ D - J).max() > 1e-10


@pytest.mark.parametrize("method", [dvi.Boris(), dvi.MagneticSplitting()])
def test_a_step_backwards_undoes_a_step(method):
    there = dvi.integrate(WAVES, Q, P, h=0.1, num_steps=50, method=method, save=FINAL)
    back = dvi.integrate(
        WAVES, there.qs[-1], there.ps[-1], t0=there.ts[-1], h=-0.1, num_steps=50, method=method,
        save=FINAL,
    )  # fmt: skip
    assert jnp.abs(back.qs[-1] - Q).max() < 1e-12
    assert jnp.abs(back.ps[-1] - P).max() < 1e-12


def test_the_speed_in_a_magnetic_field_alone_is_exact():
    drift = {"energy": dvi.MaxDrift(MIRROR.observables["energy"])}
    run: Any = {"num_steps": 20_000, "h": 0.5, "save": FINAL, "observe": drift}
    assert dvi.integrate(MIRROR, method=dvi.Boris(), **run).observed["energy"] < 1e-12
    # Symplectic: the error does not grow; and it is there.
    short, long = (
        dvi.integrate(MIRROR, method=dvi.MagneticSplitting(), **(run | {"num_steps": n}))
        for n in (2_000, 20_000)
    )
    assert 1e-4 < long.observed["energy"] < 1.5 * short.observed["energy"]


def test_uniform_fields_against_the_exact_solution():
    problem = systems.uniform_field()
    assert problem.exact is not None
    q, p = problem.exact(jnp.asarray([2.0]), problem.q0, problem.p0, problem.args)
    exact = jnp.concatenate([q[0], p[0]])
    for method in (dvi.Boris(), dvi.MagneticSplitting(dvi.Yoshida(8))):
        state = end(problem.system, problem.q0, problem.p0, method, 0.02, 100, args=problem.args)
        assert jnp.abs(state - exact).max() < (1e-3 if isinstance(method, dvi.Boris) else 1e-11)


def B_of(q):
    return jnp.stack([-q[0] * q[2], -q[1] * q[2], 1 + q[2] ** 2])


def lorentz(t0, t1, q, p, args):
    """E + v × B of a charge and a mass 1, with a friction."""
    return jnp.cross(p, B_of(q)) + jnp.stack([q[1], -q[0], 0.1 * q[2]]) - args["friction"] * p


def test_fields_given_by_functions():
    """The same motion with A in H, and with B in a force."""

    def H(q, p):
        A = (1 + q[2] ** 2) / 2 * jnp.stack([-q[1], q[0], 0.0 * q[2]])
        return jnp.sum((p - A) ** 2) / 2

    def W(t0, t1, q, p, args):
        return jnp.stack([q[1], -q[0], 0.1 * q[2]])

    of_A = dvi.System(dvi.discretise(H), force=W)
    of_B = dvi.System(dvi.discretise(lambda q, p: p @ p / 2), force=lorentz)
    v = P - (1 + Q[2] ** 2) / 2 * jnp.stack([-Q[1], Q[0], 0.0])
    first = end(of_A, Q, P, dvi.Boris(), 0.1, 30, epsilon=1.0)
    second = end(of_B, Q, v, dvi.Boris(), 0.1, 30, epsilon=1.0, args={"friction": 0.0})
    assert jnp.abs(first[:3] - second[:3]).max() < 1e-13


@pytest.mark.parametrize("power", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_frictions_have_order_two(power):
    """A friction −v is linear and has no iteration; −|v|² v is solved for."""

    def W(t0, t1, q, p, args):
        return jnp.cross(p, B_of(q)) - (p if power == 1 else p * jnp.sum(p * p))

    system = dvi.System(dvi.discretise(lambda q, p: p @ p / 2 + q @ q / 2), force=W)
    assert abs(slopes(system, Q, P, dvi.Boris(), 20, epsilon=0.7) - 2) < 0.1
    sol = dvi.integrate(system, Q, P, h=0.1, num_steps=5, epsilon=0.7, method=dvi.Boris())
    assert (sol.stats["newton_iterations"] > 0) == (power == 3)
    with pytest.raises(ValueError, match="does not depend on p"):
        dvi.integrate(system, Q, P, h=0.1, num_steps=5, epsilon=0.7, method=dvi.MagneticSplitting())


@pytest.mark.slow
def test_particles_that_interact_and_the_plane():
    def H(t, q, p, args):
        A = args["B"] / 2 * jnp.stack([-q[:, 1], q[:, 0]], axis=1)
        v = (p - A) / args["m"][:, None]
        d = q[:, None] - q[None]
        pairs = jnp.sum(jnp.triu(1 / (0.1 + jnp.sum(d * d, axis=-1)), 1))
        return jnp.sum(args["m"][:, None] * v * v) / 2 + pairs

    system = dvi.System(dvi.discretise(H))
    q, p = jax.random.normal(jax.random.key(0), (2, 3, 2))
    args = {"B": 2.0, "m": jnp.asarray([1.0, 2.0, 0.5])}
    for method in (dvi.Boris(), dvi.MagneticSplitting()):
        assert abs(slopes(system, q, p, method, 60, T=0.6, args=args) - 2) < 0.25


@pytest.mark.parametrize(
    "method", [dvi.Boris(), pytest.param(dvi.MagneticSplitting(), marks=pytest.mark.slow)]
)
def test_gradients(method):
    def loss(B0):
        args = MIRROR.args | {"B0": B0}
        q0, p0 = jnp.asarray(MIRROR.q0), jnp.asarray(MIRROR.p0)
        return jnp.sum(end(MIRROR.system, q0, p0, method, 0.1, 40, args=args, throw=False) ** 2)

    step = 1e-4
    difference = (loss(1 + step) - loss(1 - step)) / (2 * step)
    assert abs(jax.grad(loss)(1.0) - difference) < 1e-6 * abs(difference)


def test_a_particle_has_the_same_bits_alone_and_in_a_batch():
    @jax.jit
    @jax.vmap
    def run(B0):
        args = MIRROR.args | {"B0": B0}
        return dvi.integrate(
            MIRROR, args=args, num_steps=40, method=dvi.Boris(), save=FINAL, throw=False
        )

    batch, alone = run(jnp.asarray([0.9, 1.0, jnp.inf])), run(jnp.ones(1))
    assert (batch.qs[1] == alone.qs[0]).all()
    assert list(batch.status) == ["successful", "successful", "not_finite"]


def test_compensated_sums_start_from_the_same_state():
    run: Any = {"h": 0.1, "num_steps": 100, "method": dvi.Boris(), "save": FINAL}
    plain = dvi.integrate(WAVES, Q, P, **run)
    other = dvi.integrate(WAVES, Q, P, arithmetic=dvi.Compensated(), **run)
    assert jnp.abs(plain.qs - other.qs).max() < 1e-12
    assert jnp.abs(plain.ps - other.ps).max() < 1e-12


def quartic(q, p):
    return jnp.sum(p**4)


def two_masses(q, p):
    return p[0] ** 2 + p[1] ** 2 / 4 + q @ q


def joint(t, q, p, args):
    A = jnp.stack([q[::-1, 1], -q[::-1, 0]], axis=1)  # of the other particle
    return jnp.sum((p - A) ** 2) / 2


@pytest.mark.parametrize(
    ("H", "shape", "message"),
    [
        (quartic, (3,), "not quadratic"),
        (two_masses, (2,), "one positive mass"),
        (joint, (2, 2), "its own position only"),
        (lambda q, p: p @ p / 2, (4,), r"shape \(2,\) or \(3,\)"),
    ],
)
def test_other_systems_are_refused(H, shape, message):
    q = 0.3 + jnp.arange(float(np.prod(shape))).reshape(shape)
    for method in (dvi.Boris(), dvi.MagneticSplitting()):
        with pytest.raises(ValueError, match=message):
            dvi.integrate(
                dvi.System(dvi.discretise(H)), q, q + 0.5, h=0.1, num_steps=1, method=method
            )


@pytest.mark.parametrize(
    "method",
    [
        dvi.Boris(),
        *(
            pytest.param(m, marks=pytest.mark.slow)
            for m in (dvi.MagneticSplitting(), dvi.HigueraCary())
        ),
    ],
)
def test_a_potential_without_a_field_is_accepted(method):
    """A is a gradient: the particle moves uniformly, but p changes."""

    def H(q, p):
        P = p - 3 * jnp.stack([jnp.cos(q[0]) * q[1], jnp.sin(q[0]), 0 * q[0]])
        if isinstance(method, dvi.HigueraCary):
            return jnp.sqrt(1 + jnp.sum(P**2))
        return jnp.sum(P**2) / 2

    q, p = [0.3, 0.7, 0.1], [0.5, 0.2, 0.1]
    sol = dvi.integrate(dvi.System(dvi.discretise(H)), q, p, h=0.1, num_steps=8, method=method)
    assert jnp.abs(jnp.diff(sol.qs, 2, axis=0)).max() < 1e-14
    assert jnp.abs(sol.ps[-1] - sol.ps[0]).max() > 0.1


@pytest.mark.parametrize("method", [dvi.Boris(), dvi.MagneticSplitting()])
def test_single_precision_stays_single(method):
    q, p = Q.astype(jnp.float32), P.astype(jnp.float32)
    sol = jax.eval_shape(
        lambda q, p: dvi.integrate(WAVES, q, p, h=0.1, num_steps=1, method=method, throw=False),
        q,
        p,
    )
    assert sol.qs.dtype == sol.ps.dtype == jnp.float32


def test_the_same_hamiltonian_in_other_forms_gives_the_same_steps():
    """Its potential is read from the program of H where p − A is used in squares only."""

    def A(q):
        return jnp.stack([-q[1] * (1 + q[2] ** 2), jnp.sin(q[0]), q[0] * q[1]])

    def phi(q):
        return jnp.cos(q[0]) + q[2] ** 2

    def extra(q):  # A = B + extra
        return jnp.stack([q[1], q[2] ** 2, -q[0]])

    def in_squares(t0, t1, q, p, args):
        return jnp.sum((p - A(q)) ** 2) / 3 + phi(q)

    def with_the_other_sign(t0, t1, q, p, args):
        return (p + -A(q)) @ (p + -A(q)) / 3 + phi(q)

    def expanded(t0, t1, q, p, args):
        return (p @ p - 2 * p @ A(q) + A(q) @ A(q)) / 3 + phi(q)

    def with_a_linear_term(t0, t1, q, p, args):
        u = p - (A(q) - extra(q))
        return (u @ u - 2 * u @ extra(q) + extra(q) @ extra(q)) / 3 + phi(q)

    forms = [with_the_other_sign, expanded, with_a_linear_term]
    expected = end(dvi.System(in_squares), Q, P, dvi.Boris(), 0.1, 3)
    for form in forms:
        found = end(dvi.System(form), Q, P, dvi.Boris(), 0.1, 3)
        np.testing.assert_allclose(found, expected, atol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("method", [dvi.Boris(), dvi.MagneticSplitting()])
def test_second_derivatives(method):
    """Reverse over reverse, against a difference of gradients."""

    def loss(x):
        q = jnp.asarray([x, -0.2, 0.5])
        return end(WAVES, q, P, method, 0.1, 6, throw=False)[0]

    curvature = jax.grad(jax.grad(loss))(0.3)
    difference = (jax.grad(loss)(0.3 + 1e-4) - jax.grad(loss)(0.3 - 1e-4)) / 2e-4
    assert abs(curvature - difference) < 1e-5 * abs(difference)


@pytest.mark.parametrize(
    "method", [dvi.Boris(), pytest.param(dvi.HigueraCary(), marks=pytest.mark.slow)]
)
def test_a_run_stops_at_a_plane(method):
    """Of a motion that is uniform along z: at the right time, with the momenta of H."""

    def H(q, p):
        P = p - 0.5 * jnp.stack([-q[1], q[0], 0 * q[2]])
        return jnp.sqrt(1 + P @ P) if isinstance(method, dvi.HigueraCary) else P @ P / 2

    system = dvi.System(dvi.discretise(H))
    sol = dvi.integrate(
        system, [0.3, -0.2, 0.0], [0.4, 1.1, 0.5], h=0.1, num_steps=100, method=method,
        stop=dvi.Stop(lambda t, q, p, args: q[2] - 0.575), throw=False,
    )  # fmt: skip
    speed = 0.5
    if isinstance(method, dvi.HigueraCary):
        speed = 0.5 / np.sqrt(1 + 0.5**2 + 0.3**2 + 0.95**2)
    assert sol.status == "stopped"
    assert abs(sol.stop.q[2] - 0.575) < 1e-14
    assert abs(sol.stop.t - 0.575 / speed) < 1e-12
    assert abs(sol.stop.p[2] - 0.5) < 1e-14


@pytest.mark.slow
@pytest.mark.parametrize("method", [dvi.Boris(), dvi.MagneticSplitting(), dvi.HigueraCary()])
def test_pairs_of_numbers(method):
    """The states agree with those of float64, and have its errors of rounding no longer."""

    def H(q, p):
        P = p - jnp.stack([-q[1] * (1 + q[2] ** 2), q[0], q[0] * q[1]])
        return jnp.sqrt(1 + P @ P) if isinstance(method, dvi.HigueraCary) else P @ P / 2

    system, back = dvi.System(dvi.discretise(H)), {}
    for name, arithmetic in (("plain", dvi.FloatingPoint()), ("pairs", dvi.DoubleDouble())):
        run: Any = {"num_steps": 20, "method": method, "arithmetic": arithmetic}
        sol = dvi.integrate(system, Q, P, h=0.1, **run)
        back[name] = sol.qs[-1]
        assert sol.status == "successful"
    assert 0 < jnp.abs(back["plain"] - back["pairs"]).max() < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("method", [dvi.Boris(), dvi.MagneticSplitting()])
def test_deviations_are_derivatives(method):
    """The tangent map against differences of states."""
    run: Any = {"h": 0.1, "num_steps": 10, "method": method, "save": FINAL}
    sol = dvi.integrate(WAVES, Q, P, observe=dvi.TangentMap(), **run)
    step = 1e-5
    for i in range(3):
        ends = [end(WAVES, Q.at[i].add(s), P, method, 0.1, 10) for s in (step, -step)]
        difference = (ends[0] - ends[1]) / (2 * step)
        assert jnp.abs(sol.observed.reshape(6, 6)[:, i] - difference).max() < 1e-8


@pytest.mark.slow
@pytest.mark.parametrize(
    "lattice",
    [
        dvi.Given(jnp.asarray([0.0, 0.1, 0.25, 0.3, 0.5, 0.6])),
        dvi.AdaptiveReversible(lambda q, p: 1 / (1 + q @ q)),
    ],
)
def test_time_grids(lattice):
    """The states are near those of Gauss's method of order 8 at the same times."""
    run: Any = {} if isinstance(lattice, dvi.Given) else {"h": 0.05}

    def H(q, p):
        A = 0.5 * jnp.stack([-q[1] * (1 + q[2] ** 2), q[0], 0 * q[0]])
        return jnp.sum((p - A) ** 2) / 2 + q[0] ** 2

    system = dvi.System(dvi.discretise(H))
    sol = dvi.integrate(system, Q, P, num_steps=5, lattice=lattice, method=dvi.Boris(), **run)
    exact = end(system, Q, P, dvi.GaussLegendre(4), sol.ts[-1] / 20, 20)
    assert jnp.abs(jnp.concatenate([sol.qs[-1], sol.ps[-1]]) - exact).max() < 2e-3
    assert len(np.unique(np.round(np.diff(sol.ts), 12))) > 1


def test_a_time_grid_with_time_as_a_coordinate_is_refused():
    lattice = dvi.TimeTransformed(lambda q, p: 1 / (1 + q @ q))
    with pytest.raises(ValueError, match=r"shape \(4,\)"):
        dvi.integrate(WAVES, Q, P, h=0.1, num_steps=2, lattice=lattice, method=dvi.Boris())
