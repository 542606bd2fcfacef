"""Poincaré sections of many orbits, return maps, bifurcation diagrams."""

import functools
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import central_difference
from scipy.integrate import solve_ivp

import dvi_jax as dvi
from dvi_jax import systems
from dvi_jax.systems.henon_heiles import hamiltonian

HENON = systems.henon_heiles()
ENERGY = 1 / 12


def plane(t, q, p, args):
    """x = 0."""
    return q[0]


def starts(count, energy=ENERGY, py=0.0):
    """Points of the plane x = 0 on an energy shell."""
    y = np.linspace(-0.25, 0.3, count)
    px = np.sqrt(2 * energy - py**2 - y**2 + 2 * y**3 / 3)
    return np.stack([0 * y, y], 1), np.stack([px, 0 * y + py], 1)


def energy_of(q, p):
    return hamiltonian(0.0, 0.0, q, p, None)


@functools.cache
def portrait(count, crossings, num_steps, h=0.05):
    return dvi.poincare_section(
        HENON.system, *starts(count), plane, h=h, num_steps=num_steps, crossings=crossings,
        method=dvi.Strang(),
    )  # fmt: skip


@pytest.mark.slow
def test_many_orbits_at_once():
    """Every crossing lies in the plane to round-off, upwards, on its energy shell."""
    found = portrait(8, 50, 8000)
    assert found.qs.shape == (8, 50, 2)
    assert list(found.status) == ["successful"] * 8
    assert np.max(np.abs(found.qs[..., 0])) < 1e-12
    assert np.min(found.ps[..., 0]) > 0
    assert np.min(np.diff(found.ts, axis=1)) > 4
    # That of the method: O(h²), for a leapfrog of h = 0.05.
    shells = np.asarray(jax.vmap(jax.vmap(energy_of))(found.qs, found.ps))
    assert np.max(np.abs(shells - ENERGY)) < 1e-4
    # Two orbits have nothing in common, not even the times.
    assert np.abs(found.ts[0] - found.ts[4]).max() > 1e-2


@pytest.mark.slow
def test_one_orbit_is_that_of_integrate():
    q, p = starts(8)
    alone = dvi.integrate(
        HENON.system, q[3], p[3], h=0.05, num_steps=8000, method=dvi.Strang(),
        observe=dvi.Section(plane, 1, 50), save=dvi.Save(final=True),
    ).observed  # fmt: skip
    assert np.max(np.abs(alone.qs - portrait(8, 50, 8000).qs[3])) < 1e-9


def test_crossings_are_those_of_the_flow():
    """SciPy's events on equations by hand, to 1e-11; a leapfrog's are off by its error."""
    q, p = starts(2)

    def field(t, z):
        x, y, px, py = z
        return [px, py, -x - 2 * x * y, -y - x * x + y * y]

    def event(t, z):
        return z[0]

    event.direction = 1
    for method, fine in ((dvi.GaussLegendre(4), True), (dvi.Strang(), False)):
        found = dvi.poincare_section(
            HENON.system, q, p, plane, h=0.1, num_steps=700, crossings=8, method=method
        )
        for i in range(2):
            exact = solve_ivp(
                field, (0, 70), [*q[i], *p[i]], method="DOP853", rtol=1e-13, atol=1e-15,
                events=event,
            )  # fmt: skip
            times = exact.t_events[0]
            states = exact.y_events[0][times > 0.1][:8]
            times = times[times > 0.1][:8]
            miss = max(
                np.max(np.abs(found.ts[i] - times)), np.max(np.abs(found.qs[i] - states[:, :2])),
                np.max(np.abs(found.ps[i] - states[:, 2:])),
            )  # fmt: skip
            assert miss < 1e-10 if fine else miss > 1e-4


@pytest.mark.slow
def test_ten_thousand_crossings_of_64_orbits():
    found = portrait(64, 10_000, 1_600_000)
    assert set(found.status) == {"successful"}
    assert found.qs.shape == (64, 10_000, 2)
    assert np.max(np.abs(found.qs[..., 0])) < 1e-12
    shells = np.asarray(jax.vmap(jax.vmap(energy_of))(found.qs, found.ps))
    assert np.max(np.abs(shells - ENERGY)) < 1e-4


@pytest.mark.slow
def test_crossings_that_are_skipped():
    q, p = starts(8)
    later = dvi.poincare_section(
        HENON.system, q, p, plane, h=0.05, num_steps=8000, crossings=20, skip=30,
        method=dvi.Strang(),
    )  # fmt: skip
    whole = portrait(8, 50, 8000)
    assert np.max(np.abs(later.qs - whole.qs[:, 30:])) < 1e-9
    assert np.array_equal(later.count, whole.count - 30)


def test_a_section_and_a_bifurcation_are_drawn():
    """As many points as there are crossings; that there were more than asked for is no news."""
    plot = pytest.importorskip("dvi_jax.plot")
    found = portrait(8, 50, 8000)
    axis = plot.section(found)
    drawn = sum(len(c.get_offsets()) for c in axis.collections)
    assert drawn == 8 * 50
    texts = [t.get_text() for of in (axis.get_legend(), *axis.figure.legends) if of
             for t in of.get_texts()]  # fmt: skip
    assert not any("more than" in t for t in texts)
    axis = plot.bifurcation(np.arange(8.0), found)
    assert sum(len(c.get_offsets()) for c in axis.collections) == 8 * 50
    plot.plt.close("all")


def circle(t, q, p, args):
    """|q|² = 0.05: no plane, and rounding decides on which side of it a point lies."""
    return jnp.sum(q**2) - 0.05


@pytest.mark.slow
def test_points_of_a_section_as_starts():
    """They are no crossings, whatever side of the surface rounding has left them on."""
    settings = {"h": 0.01, "num_steps": 3000, "crossings": 4}
    q, p = starts(1)
    first = dvi.poincare_section(HENON.system, q, p, circle, h=0.01, num_steps=9000, crossings=10)
    again = dvi.poincare_section(HENON.system, first.qs[0], first.ps[0], circle, **settings)
    assert np.min(again.ts[:, 0]) > 0.1
    assert np.max(np.abs(again.ts[:-1, 0] - np.diff(first.ts[0]))) < 1e-3
    sides = np.asarray(jax.vmap(lambda q: circle(0.0, q, q, None))(first.qs[0]))
    assert np.any(sides < 0) or np.any(sides > 0)


@pytest.mark.slow
def test_a_section_does_not_depend_on_the_sense_of_the_run():
    """Backwards from where a run has come to, its own crossings, in reverse."""
    settings = {"h": 0.05, "num_steps": 1200, "crossings": 6, "method": dvi.Strang()}
    q, p = starts(1)
    there = dvi.poincare_section(HENON.system, q, p, plane, **settings)
    end = dvi.integrate(
        HENON.system, q[0], p[0], h=0.05, num_steps=850, method=dvi.Strang(),
        save=dvi.Save(final=True),
    )  # fmt: skip
    passed = int(np.sum(there.ts[0] < end.ts[-1]))
    back = dvi.poincare_section(
        HENON.system, end.qs[-1:], end.ps[-1:], plane, h=-0.05, num_steps=850, t0=end.ts[-1],
        crossings=passed, method=dvi.Strang(),
    )  # fmt: skip
    assert passed > 3
    assert np.min(back.ps[..., 0]) > 0  # upwards in x, with time
    assert np.max(np.abs(back.qs[0, ::-1] - there.qs[0, :passed])) < 1e-4
    spring = systems.oscillator().system
    for h in (0.01, -0.01):
        flashes = dvi.poincare_section(
            spring, np.ones((1, 1)), np.zeros((1, 1)), dvi.stroboscope(1.0, 0.3), h=h,
            num_steps=500, crossings=4,
        ).ts[0]  # fmt: skip
        assert np.max(np.abs(flashes - 0.3 - np.round(flashes - 0.3))) < 1e-9


@pytest.mark.slow
def test_epsilon_that_is_traced():
    epsilon = jnp.array([0.0, 0.3])
    options = {"h": 0.05, "num_steps": 500, "crossings": 2, "throw": False}
    spring = systems.oscillator().system
    q, p = np.ones((2, 1)), np.zeros((2, 1))

    def of(epsilon):
        return dvi.poincare_section(spring, q, p, plane, epsilon=epsilon, **options).ts

    assert np.max(np.abs(jax.jit(of)(epsilon) - of(epsilon))) < 1e-12
    slope = jax.jacfwd(of)(epsilon)
    exact = -np.pi / (1 + epsilon) ** 1.5 * 0.75  # of the first upward crossing, t = 3π/2ω
    assert np.max(np.abs(np.einsum("iki->ik", slope)[:, 0] - exact)) < 1e-2
    assert np.max(np.abs(slope[0, :, 1])) == 0


# Statuses


def wanting(**options):
    q, p = starts(3)
    settings = {"h": 0.05, "num_steps": 1000, "crossings": 5} | options
    return dvi.poincare_section(HENON.system, q, p, settings.pop("g", plane), **settings)


@pytest.mark.parametrize(
    ("options", "status", "message"),
    [
        ({"g": lambda t, q, p, args: q[0] - 9}, "never_crossed", "g.*has one sign"),
        ({"skip": 100}, "never_crossed", "a smaller skip"),
        ({"crossings": 50}, "too_few_crossings", "with [0-9]+ crossings.*Take more steps"),
    ],
)
@pytest.mark.slow
def test_a_section_that_is_crossed_too_rarely(options, status, message):
    found = wanting(**options, throw=False)
    assert list(found.status) == [status] * 3
    assert np.isnan(found.qs[:, -1]).all()
    with pytest.raises(dvi.SectionError, match=message) as error:
        wanting(**options)
    assert list(error.value.found.status) == [status] * 3
    assert list(wanting().status) == ["successful"] * 3


@pytest.mark.slow
def test_an_orbit_that_escapes():
    """It has a status of its own, and its neighbours their crossings."""
    q, p = starts(3)
    p[1] = [0.0, 2.0]
    options = {"h": 0.05, "num_steps": 1000, "crossings": 5, "throw": False}
    found = dvi.poincare_section(HENON.system, q, p, plane, **options)
    assert list(found.status) == ["successful", "failed", "successful"]
    assert np.isnan(found.qs[1]).any()
    assert np.isfinite(found.qs[[0, 2], :]).all() if isinstance(found.qs, np.ndarray) else True
    for i in (0, 2):
        assert (
            np.array_equal(found.qs[i], wanting().qs[i])
            or np.max(np.abs(found.qs[i] - wanting().qs[i])) < 1e-12
        )
    escape = dvi.Stop(lambda t, q, p, args: jnp.sum(q**2) - 4)
    stopped = dvi.poincare_section(HENON.system, q, p, plane, **options, stop=escape)
    assert list(stopped.status) == ["successful", "stopped", "successful"]
    with pytest.raises(
        dvi.SectionError, match=r"1 of 3 orbits .* orbit 1, .* failed .run: not_fin"
    ):
        dvi.poincare_section(HENON.system, q, p, plane, **(options | {"throw": True}))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda q, p: dvi.poincare_section(HENON.system, q, p[:2], plane, h=0.1, num_steps=9),
         r"one shape, got q0 \(3, 2\) and p0 \(2, 2\)"),
        (lambda q, p: dvi.poincare_section(HENON.system, q, p, plane, h=0.1, num_steps=0),
         "num_steps must be a whole number from 1 on, got 0"),
        (lambda q, p: dvi.poincare_section(
            HENON.system, q, p, plane, h=0.1, num_steps=9, epsilon=[0.0, 0.1]),
         "one for each of the 3 orbits, got 2"),
        (lambda q, p: dvi.poincare_section(
            HENON.system, q, p, plane, h=0.1, num_steps=9, skip=-1), "skip must be a whole"),
        (lambda q, p: dvi.bifurcation(
            HENON.system, q[0], p[0], plane, epsilon=0.1, h=0.1, num_steps=9),
         "needs something that varies"),
        (lambda q, p: dvi.poincare_section(
            HENON.system, q, p, plane, h=0.1, num_steps=9, crossings=0),
         "crossings must be a whole number from 1 on, got 0"),
        (lambda q, p: dvi.poincare_section(HENON, q, p, plane, h=0.1, num_steps=9),
         "must be a dvi.System, got Problem.*problem.system"),
        (lambda q, p: dvi.ReturnMap(HENON, plane, h=0.1, num_steps=9), "problem.system"),
        (lambda q, p: dvi.bifurcation(
            HENON.system, q[0], p[0], plane, epsilon=[0.0, np.nan], h=0.1, num_steps=9),
         "epsilon must be finite, got .* nan"),
        (lambda q, p: dvi.stroboscope(1.0, np.nan), "phase of a stroboscope must be a finite"),
        (lambda q, p: dvi.stroboscope(0.0), "period of a stroboscope must be a positive"),
        (lambda q, p: dvi.ReturnMap(HENON.system, plane, h=0.1, num_steps=9, returns=0),
         "returns must be a whole number"),
    ],
)  # fmt: skip
def test_sections_that_cannot_be_meant(make, message):
    with pytest.raises((ValueError, TypeError), match=message):
        make(*starts(3))


def test_a_single_start_is_told_how_it_is_given():
    with pytest.raises(TypeError) as error:
        dvi.poincare_section(HENON.system, HENON.q0, HENON.p0, plane, h=0.1, num_steps=9)
    assert "Give a single start as q0[None], p0[None]" in "".join(error.value.__notes__)


# Return maps

RETURN = dvi.ReturnMap(HENON.system, plane, h=0.02, num_steps=400, method=dvi.Yoshida(4))


@pytest.mark.slow
def test_iterated_returns_are_the_section():
    """Each point is the return of the one before, though it lies on the section."""
    found = dvi.poincare_section(
        HENON.system, *starts(2), plane, h=0.02, num_steps=2500, crossings=6,
        method=dvi.Yoshida(4),
    )  # fmt: skip
    back = jax.jit(jax.vmap(lambda q, p: (lambda r: (r.t, r.q, r.p, r.result))(RETURN(q, p))))
    t, q, p, result = back(found.qs[0, :-1], found.ps[0, :-1])
    assert np.all(np.asarray(result == dvi.SECTION_RESULTS.successful))
    # Off its lattice points the map is not the same map: to its error, of order 4.
    assert np.max(np.abs(q - found.qs[0, 1:])) < 1e-6
    assert np.max(np.abs(p - found.ps[0, 1:])) < 1e-6
    assert np.max(np.abs(t - np.diff(found.ts[0]))) < 1e-6
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
    """Against differences; in (y, p_y) it keeps areas, which the whole tangent map shows not."""
    z = jnp.array([0.15, 0.05])
    D = jax.jacfwd(in_plane)(z)
    by_differences = np.stack([central_difference(in_plane, z, e) for e in np.eye(2)], axis=1)
    assert np.max(np.abs(D - by_differences)) < 1e-7
    assert abs(np.linalg.det(D) - 1) < 1e-6  # energy kept to the order of the method
    assert np.max(np.abs(D - np.eye(2))) > 0.1


@pytest.mark.slow
def test_a_periodic_orbit_by_newton():
    """A fixed point of the return map, and that its multipliers are a pair on the unit circle."""
    z = jnp.array([0.28, 0.0])
    for _ in range(6):
        z = z - jnp.linalg.solve(jax.jacfwd(in_plane)(z) - jnp.eye(2), in_plane(z) - z)
    assert np.max(np.abs(in_plane(z) - z)) < 1e-12
    multipliers = np.linalg.eigvals(jax.jacfwd(in_plane)(z))
    assert np.max(np.abs(np.abs(multipliers) - 1)) < 1e-6
    q, p = on_shell(*z)
    period = RETURN(q, p).t
    num_steps = 700
    M = dvi.tangent_map(
        HENON.system, q, p, h=period / num_steps, num_steps=num_steps, method=dvi.Yoshida(4)
    )
    J = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.eye(2), np.zeros((2, 2))]])
    assert np.max(np.abs(M.T @ J @ M - J)) < 1e-12
    # Twice 1, along the flow and across the shells, beside the multipliers.
    assert abs(np.trace(M) - 2 - np.sum(multipliers).real) < 1e-4


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_returns_to_a_surface_that_is_no_plane(dtype):
    """None of them is the start itself, in either precision."""
    back = dvi.ReturnMap(
        HENON.system, lambda t, q, p, args: p[1] + q[0] / 3 - 0.01, h=dtype(0.01), num_steps=1500
    )

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
    never = dvi.ReturnMap(HENON.system, lambda t, q, p, args: q[0] - 9, h=0.1, num_steps=20)
    back = never(HENON.q0, HENON.p0)
    assert back.status == "never_crossed"
    assert np.isnan(back.q).all()
    rarely = dvi.ReturnMap(HENON.system, plane, h=0.1, num_steps=100, returns=3)
    assert rarely(HENON.q0, HENON.p0).status == "too_few_crossings"


# What becomes of them as ε grows


@pytest.mark.slow
def test_bifurcation_of_a_linear_disturbance():
    """H = (p² + q²)/2 under −εq: periods 2π/√(1 + ε), each ε its own orbit."""
    problem = systems.oscillator()
    epsilon = np.linspace(0.0, 1.0, 5)
    found = dvi.bifurcation(
        problem.system, [1.0], [0.0], lambda t, q, p, args: q[0], epsilon=epsilon, h=0.02,
        num_steps=3000, crossings=4, skip=2, method=dvi.Yoshida(4),
    )  # fmt: skip
    assert found.ts.shape == (5, 4)
    periods = np.diff(np.asarray(found.ts), axis=1)
    assert np.max(np.abs(periods - 2 * np.pi / np.sqrt(1 + epsilon)[:, None])) < 1e-6
    assert np.array_equal(found.epsilon, epsilon)


DUFFING = dvi.System(
    lambda t0, t1, q0, p1, args: jnp.sum(p1**2 / 2 - q0**2 / 2 + q0**4 / 4),
    force=lambda t0, t1, q0, p1, args: args["gamma"] * jnp.cos(1.2 * t0) - 0.3 * p1,
)
"""x'' + 0.3 x' − x + x³ = γ cos 1.2t at ε = 1."""


@pytest.mark.slow
def test_period_doubling_of_a_driven_duffing_oscillator():
    """How many points there are in the stroboscope, as published: 1, 2, 4, 5, chaos, 2.

    Jordan & Smith 2007, *Nonlinear Ordinary Differential Equations*, section 13.2.
    """
    period = 2 * np.pi / 1.2
    gammas = np.array([0.20, 0.28, 0.29, 0.37, 0.50, 0.65])
    found = dvi.bifurcation(
        DUFFING, [1.0], [0.0], dvi.stroboscope(period), epsilon=1.0,
        args={"gamma": dvi.Axis("gamma", gammas)}, h=period / 200, num_steps=200 * 420, skip=300,
        crossings=100, method=dvi.Strang(),
    )  # fmt: skip
    points = [len(np.unique(np.round(x, 4))) for x in np.asarray(found.qs)[..., 0]]
    assert points[:4] == [1, 2, 4, 5]
    assert points[4] > 90
    assert points[5] == 2


@pytest.mark.slow
def test_branches_are_followed():
    """Each ε goes on from the state of the one before."""

    def force(t0, t1, q0, p1, args):
        return jnp.cos(1.6 * t0) * jnp.ones_like(q0)

    system = dvi.System(
        lambda t0, t1, q0, p1, args: jnp.sum(p1**2 + q0**2) / 2 + jnp.sum(q0**4) / 4, force=force
    )
    strengths = np.linspace(0.05, 0.6, 6)
    options = {
        "h": 2 * np.pi / 1.6 / 64, "num_steps": 64 * 20, "crossings": 3, "skip": 15,
        "follow": True,
    }  # fmt: skip
    g = dvi.stroboscope(2 * np.pi / 1.6)
    up = dvi.bifurcation(system, [0.0], [0.0], g, epsilon=strengths, **options)
    again = dvi.bifurcation(system, [0.0], [0.0], g, epsilon=strengths[:3], **options)
    assert np.max(np.abs(up.qs[:3] - again.qs)) < 1e-9
    apart = dvi.bifurcation(
        system, [0.0], [0.0], g, epsilon=strengths, **(options | {"follow": False})
    )
    assert np.max(np.abs(apart.qs[0] - up.qs[0])) < 1e-9  # both from the start
    assert np.max(np.abs(apart.qs[1:] - up.qs[1:])) > 1e-2  # then one goes on where it was
    # The stroboscope flashes at whole periods.
    turns = np.asarray(up.ts) / (2 * np.pi / 1.6)
    assert np.max(np.abs(turns - np.round(turns))) < 1e-9


def test_a_branch_goes_on_after_an_orbit_that_escapes():
    system = dvi.System(
        lambda t0, t1, q0, p1, args: jnp.sum(p1**2) / 2 + jnp.sum(q0**2) / 2,
        force=lambda t0, t1, q0, p1, args: q0**3,
    )
    found = dvi.bifurcation(
        system, [1.0], [0.0], lambda t, q, p, args: q[0], epsilon=np.array([0.0, 40.0, 0.1]),
        h=0.05, num_steps=800, crossings=2, skip=1, follow=True, throw=False,
    )  # fmt: skip
    assert list(found.status) == ["successful", "failed", "successful"]
    assert np.isfinite(found.qs[2]).all()


def test_a_changed_default_method_gives_a_warning():
    q, p = starts(2)
    settings = {"h": 0.1, "num_steps": 80}
    with pytest.warns(FutureWarning, match=r"used Strang\(\) by default"):
        dvi.poincare_section(HENON.system, q, p, plane, **settings, throw=False)
    with pytest.warns(FutureWarning, match=r"dvi\.Strang\(\) for the results of earlier"):
        dvi.ReturnMap(HENON.system, plane, **settings)
    made = dvi.System(dvi.discretise(lambda t, q, p, args: hamiltonian(t, t, q, p, args), order=1))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        dvi.poincare_section(
            HENON.system, q, p, plane, **settings, method=dvi.TypeII(), throw=False
        )
        dvi.ReturnMap(made, plane, **settings)
