"""Rigid bodies in rotation matrices: helper functions, tops against Euler's angles, discovery."""

import functools
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import polar
from scipy.spatial.transform import Rotation
from test_constraints import EIGHTH, FOURTH, defect_of_two_form, run

import dvi_jax as dvi
from dvi_jax import systems
from dvi_jax.systems import rigid

sys.path.append(str(Path(__file__).parents[1] / "examples"))
import heavy_top as example

slow = pytest.mark.slow
LAGRANGE = systems.heavy_top()
MOMENTS = np.array([1.0, 2.0, 2.5])


@pytest.mark.slow
def test_rotations_and_quaternions_are_those_of_scipy():
    angles = np.array([0.3, 0.7, -1.1])
    R = rigid.rotation(*angles)
    assert np.max(np.abs(R - Rotation.from_euler("ZXZ", angles).as_matrix())) < 1e-15
    assert np.max(np.abs(rigid.euler_angles(R) - angles)) < 1e-15
    # also half turns, for which w is zero
    signs = np.array([[1, -1, -1], [-1, 1, -1], [-1, -1, 1], [1, 1, 1]])
    half_turns = signs[:, :, None] * np.eye(3)
    many = np.concatenate([Rotation.random(300, random_state=1).as_matrix(), half_turns])
    found = np.asarray(rigid.quaternion(many))
    known = np.roll(Rotation.from_matrix(many).as_quat(), 1, axis=1)
    assert np.max(np.abs(np.abs(np.sum(found * known, axis=1)) - 1)) < 1e-15
    assert np.all(found[:, 0] >= 0)
    again = Rotation.from_quat(np.roll(found, -1, axis=1)).as_matrix()
    assert np.max(np.abs(again - many)) < 2e-15
    # the negative control: the conjugate turns back
    back = Rotation.from_quat(np.roll(found * [1, -1, -1, -1], -1, axis=1)).as_matrix()
    assert np.max(np.abs(back - many)) > 1


@pytest.mark.slow
def test_momenta_and_energies_are_those_of_the_inertia_tensor():
    R, pi = rigid.rotation(0.4, 1.1, -0.3), jnp.array([0.3, -0.2, 0.5])
    P = rigid.momentum(R, pi, MOMENTS)
    assert np.max(np.abs(rigid.body_momentum(R, P) - pi)) < 1e-15
    assert abs(rigid.rotational_energy(P, MOMENTS) - np.sum(pi**2 / MOMENTS) / 2) < 1e-15
    spatial = P @ R.T - R @ P.T  # the angular momentum on fixed axes as a matrix
    wanted = np.array(R @ pi)
    assert np.max(np.abs([spatial[2, 1], spatial[0, 2], spatial[1, 0]] - wanted)) < 1e-15
    assert np.max(np.abs(rigid.orthonormal(R))) < 1e-15
    assert np.max(np.abs(rigid.orthonormal(2 * R) - np.array([3, 0, 0, 3, 0, 3]))) < 1e-14
    velocity = P / rigid.second_moments(MOMENTS)[None]
    assert np.max(np.abs(velocity.T @ R + R.T @ velocity)) < 1e-15


FLAT = {
    "water": (1.022, 1.920, 2.942),
    "plate": (1.0, 1.0, 2.0),
    "ring": (2.0, 1.0, 1.0),
    "plate with rounded moments": (0.1, 0.2, 0.1 + 0.2),
    "rod": (0.0, 1.0, 1.0),
    "rod along the third axis": (0.7, 0.7, 0.0),
    "nearly flat": (1.0, 2.0, 3.0 - 1e-6),
    "solid": (1.0, 1.6, 2.0),
}


@pytest.mark.slow
def test_flat_bodies_and_rods_turn_as_by_eulers_equations():
    """Against DOP853 for Ω and R, with moments between those of solids, plates and rods."""
    body = dvi.System(
        lambda t0, t1, q0, p1, args: rigid.rotational_energy(p1, args), constraint=rigid.orthonormal
    )
    R0 = rigid.rotation(0.1, 0.2, 0.3)
    moments = np.array([*FLAT.values()])
    spins = np.where(moments > 0, [0.3, 1.1, -0.7], 0.0)

    def end(I, spin):  # noqa: E741
        P0 = rigid.momentum(R0, I * spin, I)
        sol = dvi.integrate(body, R0, P0, args=I, h=0.02, num_steps=100,
                            method=dvi.Yoshida(4, base=dvi.Rattle()))  # fmt: skip
        energies = jax.vmap(lambda P: rigid.rotational_energy(P, I))(sol.ps)
        return sol.qs[-1], rigid.body_momentum(sol.qs[-1], sol.ps[-1]), energies

    for name, I, spin, R, pi, energies in zip(  # noqa: E741
        FLAT, moments, spins, *jax.vmap(end)(jnp.asarray(moments), jnp.asarray(spins)), strict=True
    ):
        divisor = np.where(I > 0, I, 1.0)

        def rates(t, y, I=I, divisor=divisor):  # noqa: E741
            turning = np.cross(I * y[:3], y[:3]) / divisor
            spin = np.cross(np.eye(3), y[:3])
            return np.concatenate([turning, (y[3:].reshape(3, 3) @ spin).ravel()])

        start = np.concatenate([spin, np.asarray(R0).ravel()])
        exact = solve_ivp(rates, (0, 2), start, method="DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
        assert np.max(np.abs(R - exact[3:].reshape(3, 3))) < 1e-6, name
        assert np.max(np.abs(pi - I * exact[:3])) < 1e-6, name
        assert np.max(np.abs(energies / energies[0] - 1)) < 1e-6, name
        kinetic = np.sum(I * spin**2) / 2
        assert energies[0] == pytest.approx(kinetic, rel=1e-7), name


@pytest.mark.parametrize("I", [(1.0, 1.0, 3.0), (0.1, 0.2, 0.31), (0.0, 1.0, 2.0)])
def test_moments_that_no_body_has_are_refused(I):  # noqa: E741
    R, pi = jnp.eye(3), jnp.array([0.1, 0.2, 0.3])
    for function in (
        rigid.second_moments,
        functools.partial(rigid.momentum, R, pi),
        functools.partial(rigid.rotational_energy, R),
    ):
        with pytest.raises(ValueError, match="at most the sum of the two others, got"):
            function(np.array(I))
        # Traced moments give NaN, in some component.
        assert np.isnan(jax.jit(function)(jnp.array(I))).any()
    free = systems.rigid_body()
    named = dict(zip(("I1", "I2", "I3"), I, strict=True))
    with pytest.raises(ValueError, match="I"):
        free.check(free.q0, free.p0, named)
    top = systems.spinning_top()
    with pytest.raises(ValueError, match="C must be at most 2 A"):
        top.check(top.q0, top.p0, {"A": 1.0, "C": 2.5, "w": 1.0})


@pytest.mark.slow
def test_derivatives_of_flat_bodies_are_those_of_the_moments():
    slopes = jax.jacfwd(rigid.second_moments)(jnp.array([1.0, 1.0, 2.0]))
    np.testing.assert_allclose(slopes, 0.5 - np.eye(3))


@slow
def test_the_nearest_rotation_is_the_polar_factor():
    rng = np.random.default_rng(0)
    q0 = LAGRANGE.q0 + 0.1 * rng.normal(size=(3, 3))
    found = dvi.project(LAGRANGE, q0, LAGRANGE.p0)
    assert found.distance > 0.1
    assert np.max(np.abs(found.q - polar(q0)[0])) < 1e-14
    assert run(LAGRANGE, 1, q0=found.q, p0=found.p).status == "successful"


@functools.cache
def free_body():
    return dvi.System(lambda t0, t1, q0, p1, args: rigid.rotational_energy(p1, args),
                      constraint=rigid.orthonormal)  # fmt: skip


@slow
def test_a_free_body_moves_as_in_the_variables_of_andoyer():
    known = systems.rigid_body()
    from dvi_jax.systems.rigid_body import body_momentum, orientation

    R0 = orientation(known.q0, known.p0)
    moments = jnp.array([known.args[f"I{i}"] for i in (1, 2, 3)])
    P0 = rigid.momentum(R0, body_momentum(jnp.asarray(known.q0), jnp.asarray(known.p0)), moments)
    sol = dvi.integrate(free_body(), R0, P0, args=moments, h=0.05, num_steps=100, method=EIGHTH,
                        save=dvi.Save(final=True))  # fmt: skip
    R1 = orientation(*jax.jit(known.exact)(5.0, known.q0, known.p0, known.args))
    assert np.max(np.abs(R1 - R0)) > 0.5
    assert np.max(np.abs(sol.qs[-1] - R1)) < 1e-12
    spatial = [q @ rigid.body_momentum(q, p) for q, p in ((R0, P0), (sol.qs[-1], sol.ps[-1]))]
    assert np.max(np.abs(spatial[1] - spatial[0])) < 1e-14


@functools.cache
def top_step():
    @jax.jit
    def step(q, p):
        args = jax.tree.map(jnp.asarray, LAGRANGE.args)
        equations = dvi.Equations(LAGRANGE.system, jnp.zeros(()), args)
        h = jnp.asarray(0.1)
        return dvi.Rattle().step(equations, dvi.Interval(0 * h, h, h), q, p)[:2]

    return step


@slow
def test_the_map_of_a_top_is_symplectic_on_the_manifold():
    q, p = jnp.asarray(LAGRANGE.q0), jnp.asarray(LAGRANGE.p0)
    defect = defect_of_two_form(LAGRANGE.system, LAGRANGE.args, top_step(), q, p)
    assert defect < 1e-13

    def scaled(q, p):
        q, p = top_step()(q, p)
        return q, 1.001 * p

    assert defect_of_two_form(LAGRANGE.system, LAGRANGE.args, scaled, q, p) > 1e-4


@slow
def test_a_top_converges_to_its_exact_solution():
    """By `Rattle`; the method of order 4: test_library.py."""
    q, _ = jax.jit(LAGRANGE.exact)(1.0, LAGRANGE.q0, LAGRANGE.p0, LAGRANGE.args)
    a, b = (np.max(np.abs(run(LAGRANGE, n, h=1 / n).qs[-1] - q)) for n in (20, 40))
    assert abs(np.log2(a / b) - 2) < 0.15


@slow
@pytest.mark.parametrize("kind", ["lagrange", "kovalevskaya"])
def test_a_heavy_top_moves_as_in_eulers_angles(kind):
    """Lagrange's equations in (φ, θ, ψ) by DOP853, derived by autodiff from the velocities."""
    made = systems.heavy_top(kind)
    moments, c = jnp.asarray(made.args["I"]), jnp.asarray(made.args["c"])

    def spin(angles, rates):
        (_, theta, psi), (phi1, theta1, psi1) = angles, rates
        s, x, y = jnp.sin(theta), jnp.sin(psi), jnp.cos(psi)
        return jnp.stack([phi1 * s * x + theta1 * y, phi1 * s * y - theta1 * x,
                          phi1 * jnp.cos(theta) + psi1])  # fmt: skip

    def L(angles, rates):
        height = rigid.rotation(*angles)[2] @ c
        return jnp.sum(moments * spin(angles, rates) ** 2) / 2 - height

    @jax.jit
    def field(y):
        a, v = y[:3], y[3:]
        inertia = jax.hessian(L, 1)(a, v)
        moving = jax.jvp(lambda a: jax.grad(L, 1)(a, v), (a,), (v,))[1]
        return jnp.concatenate([v, jnp.linalg.solve(inertia, jax.grad(L)(a, v) - moving)])

    q0, p0 = jnp.asarray(made.q0), jnp.asarray(made.p0)
    angles = rigid.euler_angles(q0)
    omega = rigid.body_momentum(q0, p0) / moments
    rates = jnp.linalg.solve(jax.jacfwd(spin, 1)(angles, jnp.zeros(3)), omega)
    y0 = np.concatenate([angles, rates])
    found = solve_ivp(lambda t, y: field(y), (0, 5), y0, "DOP853", rtol=1e-13, atol=1e-14)
    expected = rigid.rotation(*jnp.asarray(found.y[:3, -1]))
    off = np.max(np.abs(run(made, 500, h=0.01, method=EIGHTH).qs[-1] - expected))
    assert found.success
    assert off < 1e-9


@slow
def test_a_satellite_librates_at_the_known_frequency():
    """Pitch in the orbital plane: ω √(3 (I2 − I1)/I3) for small angles."""
    made = systems.satellite()
    I1, I2, I3 = made.args["I"]
    q0 = rigid.rotation(1e-4, 0.0, 0.0)
    p0 = rigid.momentum(q0, jnp.array([0.0, 0.0, I3]), made.args["I"])
    sol = run(made, 2000, h=0.01, q0=q0, p0=p0, method=FOURTH, save=dvi.Save())
    pitch = np.unwrap(np.arctan2(sol.qs[:, 1, 0], sol.qs[:, 0, 0])) - sol.ts
    frequency = np.sqrt(3 * (I2 - I1) / I3)
    assert np.max(np.abs(pitch - 1e-4 * np.cos(frequency * sol.ts))) < 1e-9


@slow
def test_a_dumbbell_stays_in_its_relative_equilibrium():
    """Radial on a circular orbit, with Ω² Σ m_i r_i = Σ m_i/r_i² and the tension of the rod."""
    made = systems.dumbbell()
    m1, m2, length = (made.args[key] for key in ("m1", "m2", "l"))
    r = np.array([1.0, 1.0 + length])
    m = np.array([m1, m2])
    rate = np.sqrt(np.sum(m / r**2) / np.sum(m * r))
    q0 = r[:, None] * np.array([1.0, 0.0, 0.0])
    p0 = m[:, None] * rate * r[:, None] * np.array([0.0, 1.0, 0.0])
    tension = dvi.ConstraintForce(multipliers=True)
    sol = run(made, 1000, q0=q0, p0=p0, method=EIGHTH, observe=tension, save=dvi.Save())
    angle = rate * sol.ts[-1]
    expected = r[:, None] * np.array([np.cos(angle), np.sin(angle), 0.0])
    assert np.max(np.abs(sol.qs[-1] - expected)) < 1e-11
    force = m1 * (1 / r[0] ** 2 - rate**2 * r[0])  # the rod pushes the inner mass outwards
    assert np.max(np.abs(np.abs(sol.observed[:, 0]) * length - abs(force))) < 1e-10


@slow
def test_angular_momentum_does_not_drift_with_compensated_steps():
    sol = run(LAGRANGE, 10**6, h=1 / 128, arithmetic=dvi.Compensated(), observe={
        key: dvi.MaxDrift(LAGRANGE.observables[key]) for key in LAGRANGE.invariants[1:]
    })  # fmt: skip
    drifts = [float(x) for x in sol.observed.values()]
    assert max(drifts) < 2e-14


@slow
def test_a_gradient_with_respect_to_moments_and_centre_is_that_of_differences():
    pi = rigid.body_momentum(jnp.asarray(LAGRANGE.q0), jnp.asarray(LAGRANGE.p0))

    def height(args):
        # P depends on the moments: another one would not be along the constraint.
        p0 = rigid.momentum(jnp.asarray(LAGRANGE.q0), pi, args["I"])
        sol = run(LAGRANGE, 20, h=0.05, p0=p0, args=args)
        return sol.qs[-1][2] @ jnp.array([1.0, 2.0, 3.0])

    args = {key: jnp.asarray(x) for key, x in LAGRANGE.args.items()}
    found = jax.jit(jax.grad(height))(args)
    value = jax.jit(height)
    for key in args:
        for i in range(3):

            def along(s, key=key, i=i):
                return value(args | {key: args[key].at[i].add(s)})

            d = 2e-4
            difference = (8 * (along(d) - along(-d)) - along(2 * d) + along(-2 * d)) / (12 * d)
            assert abs(found[key][i] - difference) < 1e-9


@slow
def test_discovery_finds_the_integrals_of_lagranges_top():
    result = example.found(LAGRANGE, 2)
    assert set(map(str, result.invariants)) == {
        "0.5 π3",
        "0.5 γ3 + 0.25 π1² + 0.25 π2²",
        "0.5 π1 γ1 + 0.5 π2 γ2 + 0.5 π3 γ3",
        "0.5 γ1² + 0.5 γ2² + 0.5 γ3²",
    }
    assert np.all(result.powers == 0)


@slow
def test_discovery_finds_kovalevskayas_integral_among_polynomials_of_degree_4():
    """209 monomials, of which 182 are independent where |γ| = 1."""
    result = example.found(systems.heavy_top("kovalevskaya"), 4)
    assert result.basis.size == 182
    found = [str(x) for x in result.invariants]
    assert len(found) == 4
    K = "0.5 γ1² + 0.5 γ2² − 0.5 π1² γ1 − π1 π2 γ2 + 0.5 π2² γ1"
    assert f"{K} + 0.125 π1⁴ + 0.25 π1² π2² + 0.125 π2⁴" in found
    assert "0.5 γ1 + 0.25 π1² + 0.25 π2² + 0.5 π3²" in found


@slow
def test_discovery_finds_no_integral_of_a_top_that_has_none():
    """The control: the two Casimirs and the energy alone."""
    result = example.found(example.asymmetric(), 4)
    assert len(result.invariants) == 3
