"""Poincaré sections of many orbits, return maps, bifurcation diagrams."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import central_difference
from scipy.integrate import solve_ivp

import dvi_jax as dvi
from dvi_jax import systems
from dvi_jax.systems.henon_heiles import hamiltonian

HENON, SPRING = systems.henon_heiles(), systems.oscillator().system
ENERGY = 1 / 12
STRANG = dvi.Strang()


def plane(t, q, p, args):
    """x = 0."""
    return q[0]


def starts(count):
    """Points of the plane x = 0 on an energy shell."""
    y = np.linspace(-0.25, 0.3, count)
    px = np.sqrt(2 * ENERGY - y**2 + 2 * y**3 / 3)
    return np.stack([0 * y, y], 1), np.stack([px, 0 * y], 1)


def section(q, p, g=plane, system=HENON.system, **options):
    options = {"h": 0.05, "num_steps": 1000, "crossings": 5, "method": STRANG} | options
    return dvi.poincare_section(system, q, p, g, **options)


def largest(x):
    return np.max(np.abs(x))


def deviation_from_shell(found):
    shells = jax.vmap(jax.vmap(lambda q, p: hamiltonian(0.0, 0.0, q, p, None)))(found.qs, found.ps)
    return largest(np.asarray(shells) - ENERGY)


@pytest.mark.slow
def test_crossings_of_many_orbits():
    """They lie in the plane to round-off, upwards, on their energy shell; each orbit is that of
    `integrate`; `skip` leaves out the first ones."""
    q, p = starts(8)
    found = section(q, p, num_steps=8000, crossings=50)
    assert found.qs.shape == (8, 50, 2)
    assert list(found.status) == ["successful"] * 8
    assert largest(found.qs[..., 0]) < 1e-12
    assert np.min(found.ps[..., 0]) > 0
    assert np.min(np.diff(found.ts, axis=1)) > 4
    assert deviation_from_shell(found) < 1e-4  # O(h²), for a leapfrog of h = 0.05
    assert largest(found.ts[0] - found.ts[4]) > 1e-2  # two orbits do not even have common times
    alone = dvi.integrate(
        HENON.system, q[3], p[3], h=0.05, num_steps=8000, method=STRANG,
        observe=dvi.Section(plane, 1, 50), save=dvi.Save(final=True),
    ).observed  # fmt: skip
    assert largest(alone.qs - found.qs[3]) < 1e-9
    later = section(q, p, num_steps=8000, crossings=20, skip=30)
    assert largest(later.qs - found.qs[:, 30:]) < 1e-9
    assert np.array_equal(later.count, found.count - 30)


@pytest.mark.parametrize("h", [0.1, -0.1])
def test_one_default_direction(h):
    """Increasing g, for a section, an observed one and a return map: against cos t, whose zeros
    are known."""
    q, p = jnp.array([1.0]), jnp.array([0.0])
    run = {"h": h, "num_steps": 200, "method": dvi.GaussLegendre(4)}
    known = (1.5 if h > 0 else -0.5) * np.pi + np.sign(h) * 2 * np.pi * np.arange(3)
    many = dvi.poincare_section(SPRING, q[None], p[None], plane, crossings=3, **run)
    one = dvi.integrate(SPRING, q, p, observe=dvi.Section(plane, max_crossings=3), **run).observed
    np.testing.assert_allclose(many.ts[0], known, rtol=1e-8)
    np.testing.assert_allclose(one.ts, known, rtol=1e-8)
    both = dvi.Section(plane, 0, max_crossings=6)
    assert int(dvi.integrate(SPRING, q, p, observe=both, **run).observed.count) > 5


@pytest.mark.slow
def test_crossings_are_those_of_the_flow():
    """SciPy's events on equations by hand, to 1e-11; a leapfrog's are off by its error."""
    q, p = starts(2)

    def field(t, z):
        x, y, px, py = z
        return [px, py, -x - 2 * x * y, -y - x * x + y * y]

    def event(t, z):
        return z[0]

    event.direction = 1
    options = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-15, "events": event}
    exact = [solve_ivp(field, (0, 70), [*q[i], *p[i]], **options) for i in range(2)]
    times = np.stack([e.t_events[0][e.t_events[0] > 0.1][:8] for e in exact])
    states = np.stack([e.y_events[0][e.t_events[0] > 0.1][:8] for e in exact])
    for method, is_fine in ((dvi.GaussLegendre(4), True), (STRANG, False)):
        found = section(q, p, h=0.1, num_steps=700, crossings=8, method=method)
        misses = np.abs(np.concatenate([found.qs, found.ps], axis=2) - states).max(axis=(1, 2))
        misses = np.maximum(misses, np.abs(found.ts - times).max(axis=1))
        assert np.max(misses) < 1e-10 if is_fine else np.min(misses) > 1e-4


@pytest.mark.slow
def test_points_of_a_section_as_initial_conditions():
    """They are not crossings, on whichever side of a curved surface round-off has left them."""

    def circle(t, q, p, args):
        return jnp.sum(q**2) - 0.05

    options = {"h": 0.01, "method": dvi.TypeII()}
    first = section(*starts(1), circle, num_steps=9000, crossings=10, **options)
    again = section(first.qs[0], first.ps[0], circle, num_steps=3000, crossings=4, **options)
    assert np.min(again.ts[:, 0]) > 0.1
    assert largest(again.ts[:-1, 0] - np.diff(first.ts[0])) < 1e-3
    assert np.any(jax.vmap(lambda q: circle(0.0, q, q, None))(first.qs[0]) != 0)


@pytest.mark.slow
def test_a_run_backwards_has_the_crossings_of_the_run_forwards():
    q, p = starts(1)
    there = section(q, p, num_steps=1200, crossings=6)
    end = dvi.integrate(HENON.system, q[0], p[0], h=0.05, num_steps=850, method=STRANG,
                        save=dvi.Save(final=True))  # fmt: skip
    passed = int(np.sum(there.ts[0] < end.ts[-1]))
    back = section(end.qs[-1:], end.ps[-1:], h=-0.05, num_steps=850, t0=end.ts[-1],
                   crossings=passed)  # fmt: skip
    assert passed > 3
    assert np.min(back.ps[..., 0]) > 0  # upwards in x, with time
    assert largest(back.qs[0, ::-1] - there.qs[0, :passed]) < 1e-4
    for h in (0.01, -0.01):
        flashes = section(np.ones((1, 1)), np.zeros((1, 1)), dvi.stroboscope(1.0, 0.3), SPRING,
                          h=h, num_steps=500, crossings=4).ts[0]  # fmt: skip
        assert largest(flashes - 0.3 - np.round(flashes - 0.3)) < 1e-9


@pytest.mark.slow
def test_epsilon_that_is_traced():
    epsilon, q, p = jnp.array([0.0, 0.3]), np.ones((2, 1)), np.zeros((2, 1))

    def of(epsilon):
        options = {"num_steps": 500, "crossings": 2, "throw": False, "method": dvi.TypeII()}
        return section(q, p, system=SPRING, epsilon=epsilon, **options).ts

    assert largest(jax.jit(of)(epsilon) - of(epsilon)) < 1e-12
    slope = jax.jacfwd(of)(epsilon)
    exact = -np.pi / (1 + epsilon) ** 1.5 * 0.75  # of the first upward crossing, t = 3π/2ω
    assert largest(np.einsum("iki->ik", slope)[:, 0] - exact) < 1e-2
    assert largest(slope[0, :, 1]) == 0


@pytest.mark.parametrize(
    ("options", "status", "message"),
    [
        ({"g": lambda t, q, p, args: q[0] - 9}, "never_crossed", "g.*has one sign"),
        ({"skip": 100}, "never_crossed", "a smaller skip"),
        ({"crossings": 50}, "too_few_crossings", "50 times .* [0-9]+ crossings, .*Take more steps"),
    ],
)
@pytest.mark.slow
def test_too_few_crossings(options, status, message):
    with pytest.raises(dvi.SectionError, match=message) as error:
        section(*starts(3), **options)
    found = error.value.found
    assert list(found.status) == [status] * 3
    assert np.isnan(found.qs[:, -1]).all()
    np.testing.assert_array_equal(section(*starts(3), **options, throw=False).qs, found.qs)


@pytest.mark.slow
def test_an_orbit_that_escapes_does_not_change_others():
    q, p = starts(3)
    regular = section(q, p)
    assert list(regular.status) == ["successful"] * 3
    p[1] = [0.0, 2.0]
    found = section(q, p, throw=False)
    assert list(found.status) == ["successful", "failed", "successful"]
    assert np.isnan(found.qs[1]).any()
    assert largest(found.qs[::2] - regular.qs[::2]) < 1e-12
    escape = dvi.Stop(lambda t, q, p, args: jnp.sum(q**2) - 4)
    stopped = section(q, p, throw=False, stop=escape)
    assert list(stopped.status) == ["successful", "stopped", "successful"]
    with pytest.raises(
        dvi.SectionError, match=r"1 of 3 orbits .* orbit 1: .* failed, .* run not_fi"
    ):
        section(q, p)


def return_map(system=HENON.system, g=plane, **options):
    return dvi.ReturnMap(system, g, **{"h": 0.1, "num_steps": 9, "method": STRANG} | options)


def diagram(q, p, **options):
    options = {"h": 0.1, "num_steps": 9, "method": STRANG} | options
    return dvi.bifurcation(HENON.system, q[0], p[0], plane, **options)


BAD = {
    r"the same shape, got \(3, 2\) and \(2, 2\)": lambda q, p: section(q, p[:2]),
    r"first axis.*got shape \(\)": lambda q, p: section(0.0, 0.0),
    "num_steps must be an integer of at least 1": lambda q, p: section(q, p, num_steps=0),
    "orbits in q0, got length 2": lambda q, p: section(q, p, epsilon=[0.0, 0.1]),
    "skip must be an integer": lambda q, p: section(q, p, skip=-1),
    "crossings must be an integer of at least 1": lambda q, p: section(q, p, crossings=0),
    "be a dvi.System, got .*Problem.*problem.system": lambda q, p: section(q, p, system=HENON),
    "section requires num_steps": lambda q, p: dvi.poincare_section(HENON.system, q, p, plane, h=1),
    "bifurcation requires num_steps": lambda q, p: dvi.bifurcation(HENON.system, q, p, plane, h=1),
    "requires an array for epsilon": lambda q, p: diagram(q, p, epsilon=0.1),
    "epsilon must be finite, got .*nan": lambda q, p: diagram(q, p, epsilon=[0.0, np.nan]),
    "1-D array, got shape": lambda q, p: diagram(q, p, epsilon=[[0.0]]),
    "system must be .* Problem": lambda q, p: return_map(HENON),
    "returns must be an integer": lambda q, p: return_map(returns=0),
    "phase of a stroboscope must be a finite": lambda q, p: dvi.stroboscope(1.0, np.nan),
    "period of a stroboscope must be a positive": lambda q, p: dvi.stroboscope(0.0),
}


@pytest.mark.parametrize("message", BAD)
def test_invalid_arguments(message):
    with pytest.raises((ValueError, TypeError), match=message):
        BAD[message](*starts(3))


def test_unknown_keywords_are_refused():
    for function in (dvi.poincare_section, dvi.bifurcation, dvi.tangent_map):
        with pytest.raises(TypeError, match="Did you mean 'method'"):
            function(HENON.system, HENON.q0, HENON.p0, methd=None)


RETURN = return_map(h=0.02, num_steps=400, method=dvi.Yoshida(4))


@pytest.mark.slow
def test_iterated_returns_are_the_section():
    """Each point is the return of the one before, though it lies on the section."""
    found = section(*starts(2), h=0.02, num_steps=2500, crossings=6, method=dvi.Yoshida(4))
    back = jax.jit(jax.vmap(lambda q, p: (lambda r: (r.t, r.q, r.p, r.result))(RETURN(q, p))))
    t, q, p, result = back(found.qs[0, :-1], found.ps[0, :-1])
    assert np.all(np.asarray(result == dvi.SECTION_RESULTS.successful))
    # From other points than those of the orbit the map differs by its error, of order 4.
    assert largest(q - found.qs[0, 1:]) < 1e-6
    assert largest(p - found.ps[0, 1:]) < 1e-6
    assert largest(t - np.diff(found.ts[0])) < 1e-6
    assert np.min(t) > 4


def on_shell(y, py):
    px = jnp.sqrt(2 * ENERGY - py**2 - y**2 + 2 * y**3 / 3)
    return jnp.stack([jnp.zeros_like(y), y]), jnp.stack([px, py])


def in_plane(z):
    """(y, p_y) → (y, p_y), on the energy shell."""
    back = RETURN(*on_shell(*z))
    return jnp.stack([back.q[1], back.p[1]])


@pytest.mark.slow
def test_derivative_of_the_return_map():
    """It agrees with differences, and conserves areas in (y, p_y)."""
    z = jnp.array([0.15, 0.05])
    D = jax.jacfwd(in_plane)(z)
    by_differences = np.stack([central_difference(in_plane, z, e) for e in np.eye(2)], axis=1)
    assert largest(D - by_differences) < 1e-7
    assert abs(np.linalg.det(D) - 1) < 1e-6  # energy is conserved to the order of the method
    assert largest(D - np.eye(2)) > 0.1


@pytest.mark.slow
def test_a_periodic_orbit_by_newton():
    """A fixed point of the return map, whose multipliers are a pair on the unit circle."""
    z = jnp.array([0.28, 0.0])
    for _ in range(6):
        z = z - jnp.linalg.solve(jax.jacfwd(in_plane)(z) - jnp.eye(2), in_plane(z) - z)
    assert largest(in_plane(z) - z) < 1e-12
    multipliers = np.linalg.eigvals(jax.jacfwd(in_plane)(z))
    assert largest(np.abs(multipliers) - 1) < 1e-6
    q, p = on_shell(*z)
    M = dvi.tangent_map(HENON.system, q, p, h=RETURN(q, p).t / 700, num_steps=700,
                        method=dvi.Yoshida(4))  # fmt: skip
    J = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.eye(2), np.zeros((2, 2))]])
    assert largest(M.T @ J @ M - J) < 1e-12
    # Twice 1, along the flow and across the shells, in addition to the multipliers.
    assert abs(np.trace(M) - 2 - np.sum(multipliers).real) < 1e-4


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_returns_to_a_tilted_plane(dtype):
    """No return is the initial point itself, in either precision."""
    back = return_map(g=lambda t, q, p, args: p[1] + q[0] / 3 - 0.01, h=dtype(0.01), num_steps=1500,
                      method=dvi.TypeII())  # fmt: skip

    def one(state, _):
        found = back(*state)
        return (found.q, found.p), found.t

    start = jnp.array([0.0, 0.1], dtype), jnp.array([0.3, 0.2], dtype)
    _, times = jax.lax.scan(one, start, None, 12)
    assert times.dtype == dtype
    assert np.min(times) > 3
    assert np.max(times) < 9


@pytest.mark.slow
def test_a_map_that_does_not_return():
    back = return_map(g=lambda t, q, p, args: q[0] - 9, num_steps=20)(HENON.q0, HENON.p0)
    assert back.status == "never_crossed"
    assert np.isnan(back.q).all()
    rarely = return_map(num_steps=100, returns=3)
    assert rarely(HENON.q0, HENON.p0).status == "too_few_crossings"


@pytest.mark.slow
def test_bifurcation_of_a_linear_perturbation():
    """H = (p² + q²)/2 under −εq: periods 2π/√(1 + ε), each ε its own orbit."""
    epsilon = np.linspace(0.0, 1.0, 5)
    found = dvi.bifurcation(SPRING, [1.0], [0.0], plane, epsilon=epsilon, h=0.02, num_steps=3000,
                            crossings=4, skip=2, method=dvi.Yoshida(4))  # fmt: skip
    assert found.ts.shape == (5, 4)
    periods = np.diff(np.asarray(found.ts), axis=1)
    assert largest(periods - 2 * np.pi / np.sqrt(1 + epsilon)[:, None]) < 1e-6
    assert np.array_equal(found.epsilon, epsilon)


@pytest.mark.slow
def test_period_doubling_of_a_driven_duffing_oscillator():
    """x'' + 0.3 x' − x + x³ = γ cos 1.2t: as many points as published, 1, 2, 4, 5, chaos, 2.

    Jordan & Smith 2007, *Nonlinear Ordinary Differential Equations*, section 13.2.
    """
    duffing = dvi.System(
        lambda t0, t1, q0, p1, args: jnp.sum(p1**2 / 2 - q0**2 / 2 + q0**4 / 4),
        force=lambda t0, t1, q0, p1, args: args["gamma"] * jnp.cos(1.2 * t0) - 0.3 * p1,
    )
    period, gammas = 2 * np.pi / 1.2, np.array([0.20, 0.28, 0.29, 0.37, 0.50, 0.65])
    found = dvi.bifurcation(
        duffing, [1.0], [0.0], dvi.stroboscope(period), epsilon=1.0,
        args={"gamma": dvi.Axis("gamma", gammas)}, h=period / 200, num_steps=200 * 420, skip=300,
        crossings=100, method=STRANG,
    )  # fmt: skip
    points = [len(np.unique(np.round(x, 4))) for x in np.asarray(found.qs)[..., 0]]
    assert points[:4] == [1, 2, 4, 5]
    assert points[4] > 90
    assert points[5] == 2


@pytest.mark.slow
def test_branches_are_followed():
    """With follow=True each ε begins with the final state of the one before."""
    system = dvi.System(
        lambda t0, t1, q0, p1, args: jnp.sum(p1**2 + q0**2) / 2 + jnp.sum(q0**4) / 4,
        force=lambda t0, t1, q0, p1, args: jnp.cos(1.6 * t0) * jnp.ones_like(q0),
    )
    strengths, period = np.linspace(0.05, 0.6, 6), 2 * np.pi / 1.6

    def branch(strengths, follow):
        return dvi.bifurcation(
            system, [0.0], [0.0], dvi.stroboscope(period), epsilon=strengths, h=period / 64,
            num_steps=64 * 20, crossings=3, skip=15, follow=follow, method=dvi.TypeII(),
        )  # fmt: skip

    up, apart = branch(strengths, True), branch(strengths, False)
    assert largest(up.qs[:3] - branch(strengths[:3], True).qs) < 1e-9
    assert largest(apart.qs[0] - up.qs[0]) < 1e-9  # both from the initial condition
    assert largest(apart.qs[1:] - up.qs[1:]) > 1e-2
    turns = np.asarray(up.ts) / period
    assert largest(turns - np.round(turns)) < 1e-9  # of the stroboscope


def test_a_branch_continues_after_an_orbit_that_escapes():
    system = dvi.System(
        lambda t0, t1, q0, p1, args: jnp.sum(p1**2) / 2 + jnp.sum(q0**2) / 2,
        force=lambda t0, t1, q0, p1, args: q0**3,
    )
    found = dvi.bifurcation(system, [1.0], [0.0], plane, epsilon=[0.0, 40.0, 0.1], h=0.05,
                            num_steps=800, crossings=2, skip=1, follow=True, throw=False,
                            method=dvi.TypeII())  # fmt: skip
    assert list(found.status) == ["successful", "failed", "successful"]
    assert np.isfinite(found.qs[2]).all()
