"""Lattices, fields and many bodies: solitons, dispersion, test particles, forces of a fluid."""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import symplectic_defect

import dvi_jax as dvi
from dvi_jax import systems
from dvi_jax.systems._fields import places
from dvi_jax.systems.klein_gordon import frequency
from dvi_jax.systems.lennard_jones import pair_energy
from dvi_jax.systems.n_body import centre_of_mass
from dvi_jax.systems.nls_lattice import lattice_momentum, soliton
from dvi_jax.systems.phi4 import kink as phi4_kink
from dvi_jax.systems.sine_gordon import breather, breather_action, kink

sine_gordon, phi4, lennard_jones = systems.sine_gordon, systems.phi4, systems.lennard_jones
slow = pytest.mark.slow
ARRAYS = dvi.Layout(form="arrays")
"""Compiled by XLA as arrays: the first call is shorter for the sizes of these tests."""


def run(problem, duration, h=None, **options):
    h = problem.h if h is None else h
    options = {"method": dvi.Strang(), "layout": ARRAYS, "save": dvi.Save(final=True)} | options
    options["root_finder"] = dvi.Picard()  # of implicit steps; its compilation is short
    return dvi.integrate(problem, h=h, num_steps=round(duration / h), **options)


def rates(problem, q, p):
    """dq/dt and dp/dt by automatic differentiation of H_D."""
    H = functools.partial(problem.system.H_D, 0.0, 0.0, args=problem.args)
    fall, rate = jax.jit(jax.grad(H, argnums=(0, 1)))(jnp.asarray(q), jnp.asarray(p))
    return np.asarray(rate), -np.asarray(fall)


def energy(problem, q, p):
    return float(problem.system.H_D(0.0, 0.0, jnp.asarray(q), jnp.asarray(p), problem.args))


# Solitons

MOVING_BREATHER = functools.partial(breather, frequency=0.6, velocity=0.3)
SOLITONS = {
    "breather": (sine_gordon, {"start": "breather", "frequency": 0.6}, MOVING_BREATHER),
    "kink on a ring": (sine_gordon, {"start": "kink"}, functools.partial(kink, velocity=0.3)),
    "kink between walls": (phi4, {}, functools.partial(phi4_kink, velocity=0.3)),
}


@pytest.mark.parametrize(
    "name", ["breather", *(pytest.param(n, marks=slow) for n in list(SOLITONS)[1:])]
)
def test_solitons_move_as_the_solutions_of_the_field_equations(name):
    """With an error of order 2 in dx; the control is another time."""
    make, options, solution = SOLITONS[name]
    off = []
    for n, dx in ((96, 0.4), (96, 0.2)):  # one program: a length of 19 suffices for the tails
        problem = make(n, dx, velocity=0.3, **options)
        sol, x = run(problem, 8.0, h=0.04), places(n, dx)
        u, rate = solution(8.0, x)
        off.append([np.max(np.abs(sol.qs[-1] - u)), np.max(np.abs(sol.ps[-1] / dx - rate))])
        other = np.max(np.abs(sol.qs[-1] - solution(8.5, x)[0]))
    coarse, fine = np.array(off)
    assert np.all(fine < 0.05)
    assert np.all(np.abs(np.log2(coarse / fine) - 2) < 0.3)
    assert other > 0.1


def test_energies_and_momenta_of_solitons():
    """Those of the field: 8γ, 8γv; 16sγ, 16sγv; γ√8/3; action 16 arccos ω."""
    v, gamma = 0.6, 1.25
    for make, options, mass in (
        (sine_gordon, {"start": "kink"}, 8.0),
        (sine_gordon, {"start": "breather", "frequency": 0.8}, 16 * 0.6),
        (phi4, {}, 8**0.5 / 3),
    ):
        problem = make(800, 0.05, velocity=v, **options)
        q, p = jnp.asarray(problem.q0), jnp.asarray(problem.p0)
        observed = [problem.observables[k](0.0, q, p, problem.args)
                    for k in ("energy", "field_momentum")]  # fmt: skip
        np.testing.assert_allclose(observed, [mass * gamma, mass * gamma * v], rtol=2e-3)
        if options.get("frequency"):
            assert float(breather_action(*observed)) == pytest.approx(16 * np.arccos(0.8), rel=2e-3)
    assert np.isnan(breather_action(17.0))


def test_winding_and_charge_of_kinks():
    """The charge at free ends; a kink moved by one site on a ring has the same energy."""
    free = sine_gordon(160, 0.2, "free", "kink")
    q, p = jnp.asarray(free.q0), jnp.asarray(free.p0)
    assert float(free.observables["topological_charge"](0.0, q, p, free.args)) == pytest.approx(
        1, abs=1e-4
    )
    wall = phi4((40, 4), 0.4, ("free", "periodic"))
    q, p = jnp.asarray(wall.q0), jnp.asarray(wall.p0)
    assert float(wall.observables["topological_charge"](0.0, q, p, wall.args)) == pytest.approx(
        1, abs=1e-4
    )
    # A wall of width 1.6 that moves along the first axis
    P = wall.observables["field_momentum"](0.0, q, p, wall.args)
    momentum = 1.6 * 8**0.5 / 3 * 0.3 / np.sqrt(1 - 0.3**2)
    np.testing.assert_allclose(P, [momentum, 0.0], rtol=0.02, atol=1e-14)
    ring = sine_gordon(64, 0.4, start="kink", velocity=0.3)
    moved = np.append(ring.q0[1:], ring.q0[0] + 2 * np.pi), np.roll(ring.p0, -1)
    assert energy(ring, *moved) == pytest.approx(energy(ring, ring.q0, ring.p0), rel=1e-14)
    assert energy(ring, np.roll(ring.q0, -1), moved[1]) > 10 * energy(ring, *moved)  # the control
    q, p = jnp.asarray(ring.q0), jnp.asarray(ring.p0)
    speed = ring.observables["kink_velocity"](0.0, q, p, ring.args)
    assert float(speed) == pytest.approx(0.3, abs=1e-3)


@slow
def test_a_driven_kink_follows_the_law_of_mclaughlin_and_scott():
    """dv/dt = −ε [α v (1 − v²) + (πf/4) (1 − v²)^{3/2}], the error of which falls as ε."""
    from scipy.integrate import solve_ivp

    damping, drive = 1.0, -1.5
    off = []
    for epsilon in (0.1, 0.05):
        made = sine_gordon(128, 0.2, start="kink", velocity=0.0, damping=damping, drive=drive)
        q0 = made.q0 + np.arcsin(epsilon * drive)
        sol = run(made, 3 / epsilon, q0=q0, epsilon=epsilon, save=dvi.Save(every=5),
                  observe=made.observables["kink_velocity"])  # fmt: skip

        def law(t, v, epsilon=epsilon):
            force = damping * v * (1 - v**2) + np.pi * drive / 4 * (1 - v**2) ** 1.5
            return -epsilon * force

        t = np.asarray(sol.ts)
        v = solve_ivp(law, (0, t[-1]), [0.0], t_eval=t, rtol=1e-9, atol=1e-9).y[0]
        off.append(np.max(np.abs(np.asarray(sol.observed) - v)))
        assert sol.observed[-1] > 0.7
        assert np.max(np.abs(np.asarray(sol.observed) - np.tanh(epsilon * t))) > 0.05
    assert off[1] < 0.02
    assert off[0] / off[1] > 1.6


@slow
def test_the_action_of_a_damped_breather_decays_exponentially():
    """J e^{εt} is an adiabatic invariant; the energy decays by another law."""
    ranges = []
    for epsilon in (0.04, 0.02):
        made = sine_gordon(128, 0.2, velocity=0.0, damping=1.0)
        sol = run(made, 1 / epsilon, epsilon=epsilon, save=dvi.Save(every=5),
                  observe=made.observables["energy"])  # fmt: skip
        E, growth = np.asarray(sol.observed), np.exp(epsilon * np.asarray(sol.ts))
        J = np.asarray(breather_action(E))
        ranges.append([np.ptp(x * growth / x[0]) for x in (J, E)])
    (first, energy_first), (second, energy_second) = ranges
    assert second < 0.6 * first < 0.1
    assert min(energy_first, energy_second) > 0.1


# The nonlinear Schrödinger lattice


def test_the_soliton_solves_the_schroedinger_lattice_to_second_order():
    """The residual of the equations, relative to the change of the phase, against the width."""
    off = []
    for n, amplitude, velocity in ((80, 0.4, 0.2), (160, 0.2, 0.1)):
        made = systems.nls_lattice(n, kappa=0.7, gamma=1.3)
        wave = functools.partial(soliton, n=n, amplitude=amplitude, velocity=velocity)
        step = 1e-4 / amplitude**2
        later, earlier = (np.array(wave(t, args=made.args)) for t in (step, -step))
        slope = (later - earlier) / (2 * step)
        residual = np.array(rates(made, *wave(0.0, args=made.args))) - slope
        off.append(np.max(np.abs(residual)) / np.max(np.abs(slope)))
    assert off[1] < 0.03
    assert abs(np.log2(off[0] / off[1]) - 2) < 0.2


@slow
def test_a_soliton_crosses_the_schroedinger_lattice():
    n, args = 64, {"kappa": 1.0, "gamma": 1.0}
    made = systems.nls_lattice(n)
    q0, p0 = soliton(0.0, n, 0.3, 0.2, args)
    observe = {"momentum": lattice_momentum, "norm": made.observables["norm"]}
    sol = run(made, 60.0, h=0.15, q0=q0, p0=p0, method=dvi.GaussLegendre(2), observe=observe)
    density = np.asarray(sol.qs[-1] ** 2 + sol.ps[-1] ** 2)
    place = np.sum(density * (np.arange(n) - n / 2)) / np.sum(density)
    assert place == pytest.approx(12.0, abs=0.4)
    assert np.ptp(sol.observed["norm"]) < 1e-11
    assert np.ptp(sol.observed["momentum"]) < 1e-3 * abs(sol.observed["momentum"][0])


# Fields in more dimensions


def by_loops(problem, potential, ends, q, p):
    """The energy of a field as a sum over pairs of neighbours, one by one."""
    dx, args = problem.args["dx"], problem.args
    cell, total = dx**q.ndim, 0.0
    for site in np.ndindex(q.shape):
        total += p[site] ** 2 / (2 * cell) + cell * potential(q[site])
        for axis, end in enumerate(ends):
            place, n = list(site), q.shape[axis]
            place[axis] += 1
            if place[axis] < n or end == "periodic":
                place[axis] %= n
                total += cell * (q[tuple(place)] - q[site]) ** 2 / (2 * dx**2)
            if end == "fixed" and site[axis] == 0:
                total += cell * (q[site] - args["left"]) ** 2 / (2 * dx**2)
            if end == "fixed" and site[axis] == n - 1:
                total += cell * (args["right"] - q[site]) ** 2 / (2 * dx**2)
    return total


@pytest.mark.parametrize(
    ("make", "potential"),
    [(phi4, lambda u: (u**2 - 1) ** 2 / 4), (systems.klein_gordon, lambda u: u**2 / 2)],
)
def test_energies_and_momenta_with_every_kind_of_ends(make, potential):
    random = np.random.default_rng(3)
    for ends in ("free",), ("fixed", "periodic"), ("periodic", "free", "fixed"):
        shape = (4, 3, 5)[: len(ends)]
        options = {"start": "thermal"} if make is phi4 else {}
        problem = make(shape, 0.3, ends, **options)
        sides = {name: 0.4 for name in problem.args if name == "right"}  # not that of the left
        problem = dataclasses.replace(problem, args=problem.args | sides)
        q, p = random.normal(size=(2, *shape))
        slopes = []
        for axis, end in enumerate(ends):
            widths = [(1, 1) if i == axis else (0, 0) for i in range(q.ndim)]
            walls = [problem.args.get(name, 0.0) for name in ("left", "right")]
            values = {"constant_values": walls} if end == "fixed" else {}
            mode = {"periodic": "wrap", "free": "edge", "fixed": "constant"}[end]
            u = np.moveaxis(np.pad(q, widths, mode, **values), axis, 0)
            slopes.append(np.moveaxis(u[2:] - u[:-2], 0, axis) / 0.6)
        momentum = problem.observables["field_momentum"](0.0, jnp.asarray(q), p, problem.args)
        np.testing.assert_allclose(np.ravel(momentum), [-np.sum(p * x) for x in slopes], rtol=1e-12)
        wanted = by_loops(problem, potential, ends, q, p)
        assert energy(problem, q, p) == pytest.approx(wanted, rel=1e-13)


def test_waves_have_the_frequencies_of_the_lattice():
    """dp/dt = −dx³ ω² u for a plane wave, and the exact solution in three dimensions."""
    shape, numbers = (6, 4, 5), np.array([1, 1, 2])
    problem = systems.klein_gordon(shape, 0.7, mass=0.4)
    k = 2 * np.pi * numbers / np.array(shape) / 0.7
    u = np.cos(np.tensordot(k * 0.7, np.indices(shape), axes=1) + 0.3)
    omega = float(frequency(k, problem.args))
    _, push = rates(problem, u, 0 * u)
    np.testing.assert_allclose(push, -(0.7**3) * omega**2 * u, atol=1e-14)
    assert abs(omega - np.sqrt(0.4**2 + k @ k)) > 0.1 * omega  # a wave in the continuum is faster
    q, p = problem.exact(2.0, u, 0 * u, problem.args)
    np.testing.assert_allclose(q, np.cos(omega * 2.0) * u, atol=1e-13)
    np.testing.assert_allclose(p, -(0.7**3) * omega * np.sin(omega * 2.0) * u, atol=1e-13)


def test_the_mean_of_a_wave_equation_without_mass_moves_freely():
    problem = systems.klein_gordon(8, mass=0.0)
    ones = np.ones(8)
    q, p = problem.exact(3.0, ones, 0.2 * 0.5 * ones, problem.args)
    np.testing.assert_allclose(q, 1.6, rtol=1e-13)
    np.testing.assert_allclose(p, 0.1, rtol=1e-13)


# Long chains


def test_long_chains_have_observables_of_low_cost():
    """Modes by a Fourier transform, equal to the matrix; no eigenvalues."""
    q, p = np.random.default_rng(0).normal(size=(2, 300))
    i = np.arange(1, 301)
    modes = np.sqrt(2 / 301) * np.sin(np.pi * np.outer(i, i) / 301)
    omega = 2 * np.sin(np.pi * i / 602)
    problem = systems.fput(300)
    state = 0.0, jnp.asarray(q), jnp.asarray(p), problem.args
    wanted = ((modes @ p) ** 2 + (omega * (modes @ q)) ** 2) / 2
    np.testing.assert_allclose(problem.observables["mode_energies"](*state), wanted, atol=1e-11)
    assert set(systems.toda(33).observables) == {"energy", "total_momentum", "cubic_integral"}
    assert "lax_traces" in systems.toda(32).observables


# Bodies

POSITIONS = np.array([[0.0, 0, 0], [1.0, 0, 0.1], [1.7, 0.3, 0], [0.2, -2.1, 0.3], [0, 1.4, 0.2]])
VELOCITIES = np.array([[0.0, -1e-3, 0], [0, 1.0, 0], [-0.1, 0.7, 0.1], [0.7, 0, 0], [-0.8, 0.1, 0]])
MASSES = np.array([1.0, 1e-2, 2e-3, 0.0, 0.0])


def with_test_particles(softening=0.1, count=2):
    """Three massive bodies and `count` test particles."""
    rows = slice(0, 3 + count)
    momenta = np.where(MASSES > 0, MASSES, 1)[:, None] * VELOCITIES
    return systems.n_body(MASSES[rows], POSITIONS[rows], momenta[rows], softening=softening)


def test_test_particles_move_as_those_of_rebound():
    rebound = pytest.importorskip("rebound")
    sim = rebound.Simulation()
    sim.softening = 0.1
    for m, (x, y, z), (vx, vy, vz) in zip(MASSES, POSITIONS, VELOCITIES, strict=True):
        sim.add(m=m, x=x, y=y, z=z, vx=vx, vy=vy, vz=vz)
    sim.N_active = 3
    sim.integrate(3.0)
    problem = with_test_particles()
    sol = run(problem, 3.0, h=0.02, method=dvi.KahanLi(8))
    theirs = np.array([[b.x, b.y, b.z, b.vx, b.vy, b.vz] for b in sim.particles])
    np.testing.assert_allclose(sol.qs[-1], theirs[:, :3], atol=1e-10)
    inertia = np.where(MASSES > 0, MASSES, 1)[:, None]
    np.testing.assert_allclose(sol.ps[-1], inertia * theirs[:, 3:], atol=1e-10)
    assert problem.system.epsilon == 1.0
    assert "boost_x" not in problem.symmetries
    alone = run(with_test_particles(count=0), 3.0, h=0.02, method=dvi.KahanLi(8))
    np.testing.assert_allclose(alone.qs[-1], sol.qs[-1][:3], rtol=0, atol=1e-14)
    # The controls: the bodies have moved, and a test particle was pulled.
    assert np.min(np.linalg.norm(sol.qs[-1] - POSITIONS, axis=1)[1:]) > 0.3
    assert np.max(np.abs(sol.qs[-1] - POSITIONS - 3.0 * VELOCITIES)) > 0.3


@pytest.mark.parametrize("method", [dvi.Strang(), pytest.param(dvi.GaussLegendre(1), marks=slow)])
def test_test_particles_do_not_act_on_massive_bodies(method):
    """The maps of the massive and of the others are symplectic, and the map of all is not."""
    problem = with_test_particles(count=1)

    def end(z):
        q, p = z.reshape(2, 4, 3)
        sol = dvi.integrate(problem, q0=q, p0=p, num_steps=1, h=0.1, method=method)
        return jnp.concatenate([sol.qs[-1].ravel(), sol.ps[-1].ravel()])

    z = jnp.concatenate([jnp.ravel(problem.q0), jnp.ravel(problem.p0)])
    M = np.asarray(jax.jit(jax.jacfwd(end))(z))
    of_test, massive = np.r_[9:12, 21:24], np.r_[:9, 12:21]
    assert np.all(M[np.ix_(massive, of_test)] == 0)
    assert symplectic_defect(M[np.ix_(massive, massive)]) < 1e-14
    assert symplectic_defect(M[np.ix_(of_test, of_test)]) < 1e-14
    assert symplectic_defect(M) > 1e-4


def test_softening_and_masses_that_are_refused():
    with pytest.raises(ValueError, match=r"mass of body 1 must be positive.*test particles"):
        systems.n_body([1.0, 0.0, 1.0], POSITIONS[:3], VELOCITIES[:3])
    with pytest.raises(ValueError, match="softening must be a positive"):
        with_test_particles(-0.1)
    problem = with_test_particles()
    with pytest.raises(ValueError, match="softening must be zero or a positive"):
        problem.check(problem.q0, problem.p0, {**problem.args, "softening": -1.0})
    close = POSITIONS[:4].copy()
    close[3] = close[1]
    with pytest.raises(ValueError, match="body 1 and test particle 3 must have different"):
        systems.n_body(MASSES[:4], close, VELOCITIES[:4])
    assert systems.n_body(MASSES[:4], close, VELOCITIES[:4], softening=0.1).q0.shape == (4, 3)
    with pytest.raises(ValueError, match="more than 3 bodies"):
        problem.check(POSITIONS[:3], POSITIONS[:3], problem.args)
    at = jnp.asarray(POSITIONS[:3]), jnp.asarray(MASSES[:3, None] * VELOCITIES[:3])
    args = {"masses": MASSES[:3], "G": 1.0}
    centres = [
        centre_of_mass(t, t, *at, at[0] + t * VELOCITIES[:3], at[1], args) for t in (0.0, 2.0)
    ]
    np.testing.assert_allclose(centres[0], centres[1], atol=1e-15)


# Lennard-Jones


def pairs_by_loops(problem, q, p):
    """Energy and forces of all pairs with the nearest images, one by one."""
    args, push, total = problem.args, np.zeros_like(q), np.sum(p**2) / 2
    box, c = args.get("box"), args.get("cutoff", np.inf)

    def U(r):
        return 4 * (r**-12 - r**-6)

    def force(r):
        return 24 * (2 * r**-13 - r**-7)

    shift, slope = (U(c), force(c)) if np.isfinite(c) else (0.0, 0.0)
    for i, j in itertools.combinations(range(len(q)), 2):
        d = q[i] - q[j]
        if box is not None:
            d = (d + box / 2) % box - box / 2
        r = np.sqrt(d @ d)
        if r < c:
            total += U(r) - shift + (r - min(c, 1e9)) * slope
            push[i] += (force(r) - slope) * d / r
            push[j] -= (force(r) - slope) * d / r
    return total, push


@pytest.mark.parametrize("periodic", [True, False])
def test_forces_of_a_fluid_are_those_of_a_double_loop(periodic):
    problem = lennard_jones(14, periodic=periodic)
    random = np.random.default_rng(1)
    q = problem.q0 + 0.1 * random.normal(size=(14, 3))
    q[3] += 7 * problem.args.get("box", 0)  # a periodic image is the same particle
    total, push = pairs_by_loops(problem, q, problem.p0)
    rate, ours = rates(problem, q, problem.p0)
    np.testing.assert_allclose(ours, push, rtol=0, atol=1e-11 * np.max(np.abs(push)))
    np.testing.assert_array_equal(rate, problem.p0)
    assert energy(problem, q, problem.p0) == pytest.approx(total, rel=1e-12)
    assert np.max(np.abs(np.sum(ours, axis=0))) < 1e-12 * np.max(np.abs(push))
    kinetic = problem.observables["temperature"](0.0, jnp.asarray(q), problem.p0, problem.args)
    assert float(kinetic) == pytest.approx(1.0, rel=1e-13)


def test_energy_and_force_vanish_at_the_cut_off():
    problem = lennard_jones(2, 6.0)
    assert problem.args["cutoff"] == 2.5
    p = np.zeros((2, 3))
    for r, size in ((2.5 - 1e-4, 1.2e-5), (2.5 + 1e-9, 0.0)):
        q = np.array([[0.0, 0, 0], [6.0 - r, 0, 0]])  # through the wall
        force = rates(problem, q, p)[1][0, 0]
        assert abs(force) == pytest.approx(size, rel=0.15)
        assert abs(energy(problem, q, p)) <= 1e-4 * size
    U = float(pair_energy(1.1, problem.args) - pair_energy(2.5, problem.args))
    inside = energy(problem, np.array([[0.0, 0, 0], [1.1, 0, 0]]), p)
    assert inside - U == pytest.approx(-1.4 * 24 * (2 * 2.5**-13 - 2.5**-7), rel=1e-12)


@pytest.mark.parametrize(
    ("options", "least", "apart"),
    [
        ({"n": 8, "box": 1.0}, 2.263, 0.354),
        ({"n": 32, "density": 4.0}, 2.263, 0.707),
        ({"n": 2, "box": 1.1}, 1.131, 0.778),
        ({"n": 33, "box": 3.3}, 3.394, 0.778),
    ],
)
def test_particles_that_overlap_are_refused(options, least, apart):
    with pytest.raises(ValueError, match=rf"box must be at least {least} .* {apart} σ apart\."):
        lennard_jones(**options)
    accepted = lennard_jones(options["n"], box=least + 0.001).q0
    distances = np.linalg.norm(accepted[:, None] - accepted[None], axis=-1)
    assert distances[~np.eye(len(accepted), dtype=bool)].min() > 0.8


@slow
def test_a_fluid_conserves_its_momentum_and_energy_to_the_order_of_the_method():
    problem = lennard_jones(32)
    off = []
    for h in (0.004, 0.002):
        observe = {k: dvi.MaxDrift(problem.observables[k]) for k in problem.invariants}
        drift = run(problem, 1.0, h=h, observe=observe).observed
        assert max(np.max(drift["linear_momentum"]), np.max(drift["centre_of_mass"])) < 1e-12
        off.append(float(drift["energy"]))
    assert abs(np.log2(off[0] / off[1]) - 2) < 0.3
    assert off[0] < 0.05


@pytest.mark.parametrize(
    ("make", "options", "message"),
    [
        (lennard_jones, {"n": 1}, "at least two particles"),
        (lennard_jones, {"box": 4.0, "cutoff": 2.5}, "cutoff must be .*half of the box"),
        (lennard_jones, {"box": 4.0, "periodic": False}, "periodic=False must be None, got 4.0"),
        (lennard_jones, {"temperature": -1.0}, "temperature must be zero or a positive"),
        (sine_gordon, {"start": "soliton"}, "start must be one of 'breather', 'kink'"),
        (sine_gordon, {"ends": "open"}, "ends must be one of 'periodic', 'fixed', 'free'"),
        (sine_gordon, {"velocity": 1.0}, "velocity must be between -1.0 and 1.0"),
        (sine_gordon, {"dx": 0.0}, "dx must be a positive"),
        (phi4, {"ends": "periodic"}, "start='kink' must be one of 'fixed', 'free', got 'pe"),
        (phi4, {"shape": (4, 4, 4, 4)}, "number of axes in shape must be one of 1, 2, 3, got 4"),
        (phi4, {"shape": (8, 2)}, "at least 3, got 2"),
        (phi4, {"shape": (8, 8), "ends": ("free",)}, "number of words in ends must be 2, got 1"),
        (systems.klein_gordon, {"mass": -1.0}, "mass must be zero or a positive"),
        (systems.nls_lattice, {"kappa": np.nan}, "kappa must be a finite"),
    ],
)
def test_invalid_arguments_are_refused(make, options, message):
    with pytest.raises(ValueError, match=message):
        make(**options)
