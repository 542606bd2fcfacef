"""Adaptive steps by a transformation of time."""

import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi

KEPLER = dvi.System(lambda t0, t1, q, p, args: p @ p / 2 - 1 / jnp.sqrt(q @ q))
DRIVEN = dvi.System(
    lambda t0, t1, q, p, args: (p @ p + (1 + 0.3 * jnp.cos(t0)) * (q @ q)) / 2,
    force=lambda t0, t1, q, p, args: -p + jnp.sin(2 * t0) * q,
)


def radius(t, q, p, args):
    return jnp.sqrt(q @ q)


def radius_32(t, q, p, args):
    return (q @ q) ** 0.75


def energy(t0, t1, q0, p0, q1, p1, args):
    return p1 @ p1 / 2 - 1 / jnp.sqrt(q1 @ q1)


def momentum(t0, t1, q0, p0, q1, p1, args):
    return q1[0] * p1[1] - q1[1] * p1[0]


def start(e):
    return [1 - e, 0.0], [0.0, np.sqrt((1 + e) / (1 - e))]


def fictitious_period(e, power):
    """∮ dt / r^power over one revolution with a = 1."""
    E = np.linspace(0, 2 * np.pi, 4001)[:-1]
    return 2 * np.pi * np.mean((1 - e * np.cos(E)) ** (1 - power))


FINAL = dvi.Save(final=True)


def kepler(steps, periods, e=0.9, speed=radius_32, power=1.5, **settings):
    given = {"h": 2 * np.pi / steps, "num_steps": steps * periods, "method": dvi.Strang()}
    if speed is not None:
        given["h"] = fictitious_period(e, power) / steps
        given["lattice"] = dvi.TimeTransformed(speed)
    return dvi.integrate(KEPLER, *start(e), **given, **{"save": FINAL, **settings})


def worst(observe, *args, **settings):
    return float(kepler(*args, observe=dvi.Range(observe), **settings).observed)


@pytest.mark.parametrize(
    ("e", "periods", "few", "many"),
    [(0.9, 10, 200, 4000), (0.9, 100, 200, 4000), (0.99, 10, 400, 200_000)],
)
@pytest.mark.slow
def test_eccentric_orbits_need_far_fewer_steps(e, periods, few, many):
    """A twentieth of the steps of the uniform grid, and still a smaller error in energy."""
    transformed = worst(energy, few, periods, e=e)
    uniform = worst(energy, many, periods, e=e, speed=None)
    assert transformed < uniform < 0.02  # the uniform grid is in its range of convergence
    assert worst(energy, few, periods, e=e, speed=None) > 10 * transformed


@pytest.mark.slow
def test_energy_error_has_the_order_of_the_method_and_no_drift():
    coarse, fine = (worst(energy, n, 10) for n in (100, 200))
    assert np.log2(coarse / fine) == pytest.approx(2, abs=0.1)
    assert worst(energy, 100, 40) < 1.2 * coarse


@pytest.mark.slow
def test_the_orbit_converges_to_keplers():
    """Positions at the times that are returned, against Kepler's equation."""
    errors = []
    for n in (100, 200, 400):
        sol = kepler(n, 2, e=0.6, speed=radius, power=1.0, save=dvi.Save(every=n // 4))
        t = np.asarray(sol.ts)
        E = t.copy()
        for _ in range(50):
            E = E - (E - 0.6 * np.sin(E) - t) / (1 - 0.6 * np.cos(E))
        exact = np.stack([np.cos(E) - 0.6, 0.8 * np.sin(E)], 1)
        errors.append(np.max(np.abs(exact - sol.qs)))
    np.testing.assert_allclose(np.log2(np.array(errors[:-1]) / errors[1:]), 2, atol=0.1)


@pytest.mark.slow
def test_momentum_stays_exact_under_a_speed_that_is_invariant_too():
    assert worst(momentum, 100, 10) < 1e-12
    tilted = worst(momentum, 100, 10, speed=lambda t, q, p, args: radius(t, q, p, args) + q[0] / 4)
    assert tilted > 1e-4


@pytest.mark.slow
def test_a_forced_system_converges_with_other_steps_to_the_same_motion():
    def speed(t, q, p, args):
        return 1 / (1 + args["b"] * (q @ q))

    def run(h, num_steps, **how):
        given = {"h": h, "num_steps": num_steps, "epsilon": 0.3, "args": {"b": 0.5}}
        return dvi.integrate(DRIVEN, [0.8], [0.3], **given, **how)

    fine = run(1e-3, 4000, method=dvi.Yoshida(4))
    errors = []
    for n in (40, 80, 160):
        sol = run(4.0 / n, n, method=dvi.Strang(), lattice=dvi.TimeTransformed(speed))
        t, q = np.asarray(sol.ts), np.asarray(sol.qs)[:, 0]
        assert t[-1] < 4
        assert np.ptp(sol.hs) > 0.1 * np.max(sol.hs)
        np.testing.assert_allclose(np.diff(t), sol.hs, rtol=1e-9)
        spline = np.interp(t, fine.ts, np.asarray(fine.qs)[:, 0])
        errors.append(np.max(np.abs(spline - q)))
    np.testing.assert_allclose(np.log2(np.array(errors[:-1]) / errors[1:]), 2, atol=0.2)


@pytest.mark.slow
def test_a_failed_step_has_a_status():
    how = {"h": 50.0, "num_steps": 20, "lattice": dvi.TimeTransformed(radius), "throw": False}
    failing = dvi.integrate(KEPLER, *start(0.9), **how)
    assert failing.status != "successful"
    assert np.isnan(failing.qs[-1]).all()


@pytest.mark.slow
def test_observables_are_bound_to_the_system_that_was_given():
    kept = dvi.AdiabaticInvariant(
        [dvi.Generator(xi=lambda t, q, p, args: jnp.stack([-q[1], q[0]]))], [None]
    )
    sol = kepler(50, 2, observe={"L": dvi.MaxDrift(kept)})
    assert float(sol.observed["L"]) < 1e-13
