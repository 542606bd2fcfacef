"""Adaptive steps by a transformation of time."""

import jax
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


def test_the_number_of_steps_does_not_follow_from_a_time():
    with pytest.raises(ValueError, match="t1 and duration must be left out"):
        dvi.integrate(KEPLER, *start(0.5), h=0.1, t1=3.0, lattice=dvi.TimeTransformed(radius))


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


def momentum_like(t0, t1, q0, p0, q1, p1, args):
    return t1 * q1[0] * p0[1] - t0 * q0[1]


@pytest.mark.slow
@pytest.mark.parametrize("method", [dvi.TypeII(), dvi.Strang()])
def test_a_constant_speed_is_a_uniform_grid(method):
    """Also with a force and an explicit time; the step is then g h."""
    given = {"num_steps": 50, "epsilon": 0.2, "t0": 0.3, "observe": momentum_like, "method": method}

    def run(h, lattice):
        sol = dvi.integrate(DRIVEN, [0.4, 0.1], [0.3, -0.2], h=h, lattice=lattice, **given)
        return sol.ts, sol.qs, sol.ps, sol.hs, sol.observed

    plain = run(0.1, dvi.Uniform())
    slowed = run(0.05, dvi.TimeTransformed(lambda t, q, p, args: 2.0))
    for a, b in zip(plain, slowed, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-12)


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
def test_gradients_batches_and_statuses_go_through():
    def last(e):
        q = jnp.stack([1 - e, 0.0 * e])
        p = jnp.stack([0.0 * e, jnp.sqrt((1 + e) / (1 - e))])
        how = {"h": 0.1, "num_steps": 30, "lattice": dvi.TimeTransformed(radius), "save": FINAL}
        sol = dvi.integrate(KEPLER, q, p, **how)
        return sol.qs[-1, 0] + sol.ts[-1]

    e, step = jnp.asarray(0.5), 1e-5
    slope = jax.grad(last)(e)
    expected = (last(e + step) - last(e - step)) / (2 * step)
    assert slope == pytest.approx(float(expected), rel=1e-7)
    assert jax.jvp(last, (e,), (jnp.ones(()),))[1] == pytest.approx(float(slope), rel=1e-9)
    batch = jax.vmap(last)(jnp.array([0.3, 0.5]))
    assert batch[1] == pytest.approx(float(last(e)), rel=1e-12)
    how = {"h": 50.0, "num_steps": 20, "lattice": dvi.TimeTransformed(radius), "throw": False}
    failing = dvi.integrate(KEPLER, *start(0.9), **how)
    assert failing.status != "successful"
    assert np.isnan(failing.qs[-1]).all()


@pytest.mark.parametrize(
    ("speed", "observe", "says"),
    [
        (lambda t, q, p, args: -1.0, None, "one positive number, .* it returns -1"),
        (lambda t, q, p, args: q, None, "one positive number, .* it returns an array"),
        (radius, dvi.Trend(energy), "fictitious time"),
    ],
)
def test_invalid_speeds_and_observables_are_rejected(speed, observe, says):
    how = {"h": 0.1, "num_steps": 3, "lattice": dvi.TimeTransformed(speed), "observe": observe}
    with pytest.raises(ValueError, match=says):
        dvi.integrate(KEPLER, *start(0.5), **how)
    for wrong, says in (
        (0.5, "must be a function"),
        (lambda t, q, p: 1.0, "must take the arguments"),
    ):
        with pytest.raises(TypeError, match=says):
            dvi.TimeTransformed(wrong)


@pytest.mark.slow
def test_observables_are_bound_to_the_system_that_was_given():
    kept = dvi.AdiabaticInvariant(
        [dvi.Generator(xi=lambda t, q, p, args: jnp.stack([-q[1], q[0]]))], [None]
    )
    sol = kepler(50, 2, observe={"L": dvi.MaxDrift(kept)})
    assert float(sol.observed["L"]) < 1e-13
