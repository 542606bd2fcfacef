"""Explicit methods for relativistic charges: order, volume, motion without a force, recognition."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi

FINAL = dvi.Save(final=True)
METHODS = [dvi.RelativisticBoris(), dvi.HigueraCary(), dvi.Vay()]
slow = pytest.mark.slow


def waves(t, q, p, args):
    """A field of place and time with a potential, and with c = 1.3 and m = 1.5."""
    A = 2 * jnp.stack([-q[1] * (1 + q[2] ** 2), jnp.sin(q[0] + t), q[0] * q[1]])
    rest = (1.5 * 1.3) ** 2
    return 1.3 * jnp.sqrt(rest + jnp.sum((p - A) ** 2)) + jnp.cos(q[0] - t) + q[2] ** 2


WAVES = dvi.System(dvi.discretise(waves))
START = jnp.asarray([0.3, -0.2, 0.5, 0.4, 1.1, -2.3])


def end(system, z, method, h, steps, **options):
    q, p = jnp.split(z, 2)
    sol = dvi.integrate(
        system, q, p, h=h, num_steps=steps, method=method, save=FINAL, **{"throw": False, **options}
    )
    return jnp.concatenate([sol.qs[-1].ravel(), sol.ps[-1].ravel()])


def slope(system, z, method, steps, T=2.0, **options):
    exact = end(system, z, dvi.GaussLegendre(4), T / 200, 200, **options)
    errors = [
        float(jnp.abs(end(system, z, method, T / n, n, **options) - exact).max())
        for n in (steps, 2 * steps)
    ]
    assert errors[1] > 1e-12  # above round-off, or the slope says nothing
    return np.log2(errors[0] / errors[1])


@pytest.mark.parametrize(
    ("method", "order"),
    [
        pytest.param(METHODS[0], 2, marks=slow),
        pytest.param(METHODS[1], 2, marks=slow),
        pytest.param(METHODS[2], 2, marks=slow),
        pytest.param(dvi.Yoshida(4, base=METHODS[1]), 4, marks=slow),
    ],
)
def test_the_order_in_a_field_of_place_and_time(method, order):
    assert abs(slope(WAVES, START, method, 40) - order) < 0.1


@pytest.mark.parametrize(
    ("method", "preserves"),
    [pytest.param(METHODS[0], True, marks=slow), (METHODS[1], True), (METHODS[2], False)],
)
def test_boris_and_higuera_cary_preserve_the_volume_and_vay_does_not(method, preserves):
    D = jax.jacfwd(lambda z: end(WAVES, z, method, 0.2, 1))(START)
    defect = abs(np.linalg.det(np.asarray(D)) - 1)
    assert (defect < 1e-13) if preserves else (1e-4 < defect < 1e-2)


def lorentz(t0, t1, q, p, args):
    """E ŷ and B ẑ, of a charge, a mass and a speed of light 1."""
    v = p / jnp.sqrt(1 + p @ p)
    return jnp.cross(v, jnp.asarray([0.0, 0.0, 1.0])) + jnp.zeros_like(p).at[1].set(args["E"])


def in_a_potential(t, q, p, args):
    """The same fields, of potentials."""
    A = jnp.stack([-q[1], q[0], 0 * q[2]]) / 2
    return jnp.sqrt(1 + jnp.sum((p - A) ** 2)) - args["E"] * q[1]


FORCED = dvi.System(dvi.discretise(lambda q, p: jnp.sqrt(1 + p @ p)), force=lorentz)
POTENTIAL = dvi.System(dvi.discretise(in_a_potential))


def test_uniform_motion_where_the_lorentz_force_is_zero():
    """At v = E × B/B² (Vay 2008, Higuera & Cary 2017); Boris turns, more with larger steps."""
    gamma = 3.0
    v = np.sqrt(1 - 1 / gamma**2)
    run: Any = {"num_steps": 200, "epsilon": 1.0, "args": {"E": v}}

    def sideways(method, h):
        sol = dvi.integrate(FORCED, np.zeros(3), [gamma * v, 0, 0], h=h, method=method, **run)
        assert sol.status == "successful"
        return float(jnp.abs(sol.qs[:, 1]).max()), float(sol.qs[-1, 0] / sol.ts[-1] / v - 1)

    for method in METHODS[1:]:
        for h in (0.5, 5.0):
            assert max(map(abs, sideways(method, h))) < 1e-12
    (short, _), (far, faster) = sideways(METHODS[0], 0.5), sideways(METHODS[0], 5.0)
    assert 0.1 < short < 0.2
    assert 10 < far < 20
    assert 0.03 < faster < 0.04


@pytest.mark.parametrize(
    "method", [METHODS[1], *(pytest.param(m, marks=slow) for m in METHODS[::2])]
)
def test_fields_of_a_force_and_of_potentials(method):
    run: Any = {"args": {"E": 0.6}}
    P, A = jnp.asarray([0.4, 2.1, -0.3]), jnp.asarray([0.2, 0.5, 0.0])
    q = jnp.asarray([1.0, -0.4, 0.3])
    run_forced = run | {"epsilon": 1.0}
    first = end(FORCED, jnp.concatenate([q, P]), method, 0.1, 30, **run_forced)
    second = end(POTENTIAL, jnp.concatenate([q, P + A]), method, 0.1, 30, **run)
    assert jnp.abs(first[:3] - second[:3]).max() < 1e-13
    there = dvi.integrate(
        FORCED, q, P, h=0.1, num_steps=50, method=method, save=FINAL, **run_forced
    )
    back = dvi.integrate(FORCED, there.qs[-1], there.ps[-1], h=-0.1, num_steps=50, method=method,
                         save=FINAL, **run_forced)  # fmt: skip
    assert jnp.abs(back.qs[-1] - q).max() < 1e-12


def test_an_electron_in_units_of_the_si():
    """|A| is 2000 mc: the gyration has the radius γ m v/(eB) and the frequency eB/(γm)."""
    c, m, e, B, gamma = 299792458.0, 9.1093837e-31, 1.602176634e-19, 5.0, 20.0

    def H(t, q, p, args):
        A = e * B / 2 * jnp.stack([-q[1], q[0]])
        return c * jnp.sqrt((m * c) ** 2 + jnp.sum((p - A) ** 2))

    v = c * np.sqrt(1 - 1 / gamma**2)
    period, radius = 2 * np.pi * gamma * m / (e * B), gamma * m * v / (e * B)
    q, A = np.asarray([1.0, 0.3]), e * B / 2 * np.asarray([-0.3, 1.0])
    p = A + np.asarray([gamma * m * v, 0.0])
    sol = dvi.integrate(dvi.System(dvi.discretise(H)), q, p, h=period / 4000, num_steps=4000,
                        method=METHODS[1])  # fmt: skip
    offsets = np.asarray(sol.qs) - (q - [0, radius])
    assert np.abs(np.linalg.norm(offsets, axis=1) / radius - 1).max() < 1e-6
    assert np.abs(sol.qs[-1] - q).max() < 1e-5 * radius


@slow
@pytest.mark.parametrize("method", METHODS)
def test_particles_that_interact_in_a_plane(method):
    def H(t, q, p, args):
        A = args["B"] / 2 * jnp.stack([-q[:, 1], q[:, 0]], axis=1)
        energy = 2.0 * jnp.sqrt((2.0 * args["m"]) ** 2 + jnp.sum((p - A) ** 2, axis=1))
        d = q[:, None] - q[None]
        return jnp.sum(energy) + jnp.sum(jnp.triu(1 / (0.1 + jnp.sum(d * d, axis=-1)), 1))

    q, p = jax.random.normal(jax.random.key(0), (2, 3, 2))
    args, system = {"B": 2.0, "m": jnp.asarray([1.0, 2.0, 0.5])}, dvi.System(dvi.discretise(H))

    def state(m, steps):
        run: Any = {"h": 0.6 / steps, "num_steps": steps, "method": m, "args": args}
        return dvi.integrate(system, q, p, **run).qs[-1]

    exact = state(dvi.GaussLegendre(4), 200)
    errors = [float(jnp.abs(state(method, n) - exact).max()) for n in (60, 120)]
    assert abs(np.log2(errors[0] / errors[1]) - 2) < 0.1


@slow
def test_gradients():
    def loss(c):
        system = dvi.System(
            dvi.discretise(lambda t, q, p, args: args * jnp.sqrt(args**2 + p @ p) + q @ q)
        )
        return jnp.sum(end(system, START, METHODS[1], 0.1, 20, args=c) ** 2)

    step = 1e-4
    difference = (loss(1.3 + step) - loss(1.3 - step)) / (2 * step)
    assert abs(jax.grad(loss)(1.3) - difference) < 1e-6 * abs(difference)


def quadratic_force(t0, t1, q, p, args):
    return -p * jnp.sqrt(p @ p)


def joint(t, q, p, args):
    A = jnp.stack([q[::-1, 1], -q[::-1, 0]], axis=1)  # of the other particle
    return jnp.sum(jnp.sqrt(1 + jnp.sum((p - A) ** 2, axis=1)))


FREE = dvi.discretise(lambda q, p: jnp.sqrt(1 + p @ p))
OTHERS = {
    "quartic": (dvi.System(dvi.discretise(lambda q, p: p @ p / 2 + (p @ p) ** 2)), (3,)),
    "friction": (dvi.System(FREE, force=quadratic_force), (3,)),
    "joint": (dvi.System(dvi.discretise(joint)), (2, 2)),
}


@pytest.mark.parametrize("name", ["quartic", "friction", pytest.param("joint", marks=slow)])
def test_other_systems_are_refused(name):
    system, shape = OTHERS[name]
    q = 0.3 + jnp.arange(float(np.prod(shape))).reshape(shape)
    epsilon: Any = {} if system.force is None else {"epsilon": 1.0}
    with pytest.raises(ValueError, match="not that at the initial state"):
        dvi.integrate(system, q, q + 0.5, h=0.1, num_steps=1, method=METHODS[1], **epsilon)


def test_another_hamiltonian_in_a_traced_run_has_a_status():
    """A quartic one next to one of the form, with the same program."""

    def H(t, q, p, args):
        return jnp.sqrt(1 + p @ p) + args * (p @ p) ** 2

    @jax.jit
    @jax.vmap
    def run(args):
        return dvi.integrate(
            dvi.System(dvi.discretise(H)), START[:3], START[3:], h=0.1, num_steps=3, args=args,
            method=METHODS[1], throw=False,
        )  # fmt: skip

    statuses = run(jnp.asarray([0.0, 1e-3, jnp.nan])).status
    assert list(statuses) == ["successful", "not_converged", "not_finite"]


def test_the_method_without_relativity_refuses_it():
    with pytest.raises(ValueError, match="not quadratic"):
        dvi.integrate(
            POTENTIAL, START[:3], START[3:], h=0.1, num_steps=1, args={"E": 0.1}, method="Boris"
        )
