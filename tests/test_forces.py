"""Perturbing forces against other formulas, REBOUNDx and rates of the literature."""

import ctypes
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import lpmv

import dvi_jax as dvi
from dvi_jax import elements, forces, systems
from dvi_jax.systems.forces._base import bodies_of

MASSES = np.array([1.0, 1e-3, 3e-4])
ARGS = {"masses": MASSES, "G": 0.9}
MU, LIGHT = 1.7, 30.0


def state_of(masses, second=2.0):
    orbits = elements.Keplerian(
        [1.0, second], [0.1, 0.2], [0.3, 0.2], [1.0, 2.0], [0.5, 0.1], [0.7, 2.7]
    )
    return elements.to_bodies(orbits, masses, ARGS["G"])


@pytest.fixture(scope="module")
def state():
    return state_of(MASSES)


def force_on(force, state, args=ARGS):
    return np.asarray(jax.jit(lambda *x: force(0.3, 0.4, *x))(*state, args))


def at(r, v, force, args=None, t=0.0):
    """The acceleration of a satellite."""
    one = jax.jit(lambda *x: force(t, t, *x))  # one program is compiled faster than many
    return np.asarray(one(jnp.asarray(r), jnp.asarray(v), {"mu": MU, **(args or {})}))


R, V = np.array([0.8, -0.5, 0.6]), np.array([0.3, 0.9, -0.2])

EVERY = {
    "harmonics": forces.Harmonics(0.3, {2: 0.1, 4: -0.03}),
    "relativity": forces.Relativity(LIGHT),
    "all bodies": forces.PostNewtonian(LIGHT),
    "rotation": forces.LenseThirring(np.array([0.1, 0.2, 0.3]), LIGHT),
    "tides": forces.Tides(30.0, 0.2, 0.4, (0.0, 0.0, 0.7)),
    "radiation": forces.Radiation(np.array([0.1, 0.3]), LIGHT),
    "damping": forces.Damping(*np.array([[-3.0, 5.0], [-2.0, -4.0], [-1.0, -8.0]])),
    "third body": forces.ThirdBody(lambda t, args: jnp.array([5.0, 1.0, 2.0 + t]), 0.4),
    "disk": forces.GalacticTide(0.2, (0.0, 1.0, 1.0)),
    "mass loss": forces.MassLoss(-40.0),
    "outgassing": forces.Outgassing(0.1, 0.2, 0.3),
    "drag": forces.Drag(lambda r, args: jnp.exp(-r @ r), 2.0, rate=0.3),
}  # fmt: skip


@pytest.mark.parametrize("name", EVERY)
def test_a_satellite_is_a_body_without_mass(name, state):
    """The same acceleration as in a system of bodies, with the parameters of the first of them."""
    q, p = jnp.stack([jnp.zeros(3), R, 2 * R]), jnp.stack([jnp.zeros(3), V, V])
    of_bodies = jax.jit(lambda *x: EVERY[name](0.5, 0.5, *x))(q, p, {"masses": np.array([MU])})
    alone = EVERY[name]
    for kind in (forces.Radiation, forces.Damping):
        if isinstance(alone, kind):
            alone = jax.tree.map(lambda x: x[:1] if np.ndim(x) else x, alone)
    np.testing.assert_allclose(at(R, V, alone, t=0.5), of_bodies[1], rtol=1e-14)


@pytest.mark.parametrize("name", EVERY)
def test_recoils(name, state):
    """Total momentum is conserved by forces between bodies, and by no other."""
    total = force_on(EVERY[name], state).sum(axis=0)
    size = np.abs(force_on(EVERY[name], state)).max()
    conserved = np.abs(total).max() < 1e-14 * size
    assert conserved == (name in ("harmonics", "tides", "damping"))


def test_harmonics_are_those_of_the_oblate_planet():
    """Another formula: J2 in the library."""
    oblate = systems.oblate_kepler()
    q = jnp.asarray(oblate.q0) + jnp.array([10.0, 500.0, 900.0])
    gradient = jax.grad(oblate.system.H_D, argnums=2)
    zero = {**oblate.args, "J2": 0.0}
    difference = [gradient(0.0, 1.0, q, 0 * q, args) for args in (zero, oblate.args)]
    force = forces.Harmonics(oblate.args["R"], {2: lambda args: args["J2"]})
    ours = force(0.0, 1.0, q, 0 * q, oblate.args)
    np.testing.assert_allclose(ours, difference[0] - difference[1], rtol=1e-9)


@pytest.mark.parametrize("normalised", [False, True])
def test_harmonics_of_every_order(normalised):
    """Against associated Legendre functions in spherical coordinates on turned axes."""
    rng = np.random.default_rng(2)
    C, S = rng.normal(size=(2, 5, 5))
    pole, angle, rate, t, radius = np.array([0.2, -0.5, 0.7]), 0.4, 0.3, 1.5, 0.6
    keys = [(n, m) for n in range(2, 5) for m in range(1, n + 1)]
    force = forces.Harmonics(
        radius, {n: -C[n, 0] for n in range(2, 5)}, {k: (C[k], S[k]) for k in keys},
        pole, rate, angle, normalised,
    )  # fmt: skip
    z = pole / np.linalg.norm(pole)
    node = np.cross([0, 0, 1], z) / np.linalg.norm(np.cross([0, 0, 1], z))
    other = np.cross(z, node)

    def potential(r):
        a, b, c = node @ r, other @ r, z @ r
        distance = np.linalg.norm(r)
        longitude = np.arctan2(b, a) - angle - rate * t
        total = 0.0
        for n in range(2, 5):
            for m in range(n + 1):
                # Without the phase (−1)^m of SciPy.
                P = (-1) ** m * lpmv(m, n, c / distance)
                if normalised:
                    ratio = np.prod([1.0 / k for k in range(n - m + 1, n + m + 1)])
                    P *= np.sqrt((1 + (m > 0)) * (2 * n + 1) * ratio)
                wave = C[n, m] * np.cos(m * longitude) + (m > 0) * S[n, m] * np.sin(m * longitude)
                total -= MU / distance * (radius / distance) ** n * P * wave
        return total

    step = 1e-5
    wanted = [(potential(R - d) - potential(R + d)) / (2 * step) for d in step * np.eye(3)]
    np.testing.assert_allclose(at(R, V, force, t=t), wanted, atol=2e-9)


def test_the_energy_of_harmonics(state):
    """The force is minus its derivative, on all bodies."""
    force = EVERY["harmonics"]
    gradient = jax.jit(jax.grad(force.energy, argnums=2))(0.0, 0.1, *state, ARGS)
    np.testing.assert_allclose(force_on(force, state), -gradient, rtol=1e-12, atol=1e-18)


def test_a_third_body_far_away_keeps_its_digits():
    """Against the difference of two attractions in longdouble; at 1e6 it has 10 digits less."""
    for distance in (3.0, 1e6):
        d = np.array([1.0, 0.5, 0.2], np.longdouble) * distance
        force = forces.ThirdBody(lambda t, args, d=d: jnp.asarray(d, float), distance**3)
        r = R.astype(np.longdouble)
        apart = d - r
        wanted = distance**3 * (apart / (apart @ apart) ** 1.5 - d / (d @ d) ** 1.5)
        np.testing.assert_allclose(
            at(R, V, force), wanted.astype(float), rtol=1e-12 if distance < 9 else 1e-7
        )


def circle(a):
    return np.array([a, 0.0, 0.0]), np.array([0.0, np.sqrt(MU / a), 0.0])


def rate_of_a(force, a=1.3):
    """da/dt of a circular orbit: 2 a² v·F/μ."""
    r, v = circle(a)
    return 2 * a**2 / MU * v @ at(r, v, force)


def test_rates_of_circular_orbits():
    a, n = 1.3, np.sqrt(MU / 1.3**3)
    beta = 0.2
    drag = rate_of_a(forces.Radiation(beta, LIGHT))
    assert drag == pytest.approx(-2 * beta * MU / (LIGHT * a), rel=1e-12)  # Burns et al., (47)
    assert rate_of_a(forces.Outgassing(A2=0.01, r0=a)) == pytest.approx(2 * 0.01 / n, rel=1e-12)
    assert rate_of_a(forces.Damping(tau_a=-7.0)) == pytest.approx(-a / 7, rel=1e-12)
    rho = 0.03
    air = forces.Drag(lambda r, args: rho, 2.0)
    assert rate_of_a(air) == pytest.approx(-2.0 * rho * np.sqrt(MU * a), rel=1e-12)
    turning = forces.Drag(lambda r, args: rho, 2.0, rate=n)  # the air moves with the satellite
    assert abs(rate_of_a(turning)) < 1e-15
    for force in (EVERY["relativity"], EVERY["mass loss"], EVERY["third body"]):
        assert np.isfinite(rate_of_a(force))


@pytest.mark.parametrize(("spin", "sign"), [(0.5, -1), (1.0, 0), (2.0, 1)])
def test_tides_pull_towards_the_rotation(spin, sign):
    """Outside of the synchronous orbit a satellite gains angular momentum, inside it loses."""
    masses = np.array([1.0, 0.01])
    q, p = elements.to_bodies(elements.Keplerian([1.0], [0.0], [0.0], [0.0], [0.0], [0.0]), masses)
    n = np.sqrt(1.01)
    force = forces.Tides(0.3, 0.1, 0.5, (0.0, 0.0, spin * n))
    W = force_on(force, (q, p), {"masses": masses})
    torque = np.cross(q, W).sum(axis=0)[2]
    if sign:
        wanted = 3 * 0.01**2 * 0.3 * 0.1 * 0.5**5 * (spin - 1) * n  # Hut 1981, (11) for e = 0
        assert torque == pytest.approx(wanted, rel=1e-12)
    else:
        assert abs(torque) < 1e-18


def test_mass_loss_keeps_the_product_of_mass_and_axis():
    """Adiabatic: a m is constant for a slow loss."""
    q, p = (jnp.asarray(x) for x in circle(1.0))
    tau = -2000.0
    force = forces.MassLoss(lambda args: args["tau"])
    system = dvi.System(systems.n_body().system.H_D, force=force, epsilon=1.0)
    masses = np.array([MU, 1e-12])
    state = jnp.stack([0 * q, q]), jnp.stack([0 * p, masses[1] * p])
    run = {"h": 0.02, "num_steps": 10_000, "method": dvi.Strang(), "save": dvi.Save(final=True)}
    sol = dvi.integrate(system, *state, args={"masses": masses, "tau": tau}, **run)
    now = MU * np.exp(200 / tau)
    # The osculating axis for the mass of that time.
    r, v = sol.qs[-1, 1] - sol.qs[-1, 0], sol.ps[-1, 1] / masses[1] - sol.ps[-1, 0] / MU
    a = elements.Keplerian.from_state(r, v, now).a
    assert float(a) * now / MU == pytest.approx(1.0, abs=5e-4)
    assert float(a) > 1.1


def test_sums_factors_and_problems(state):
    sum_of_two = EVERY["harmonics"] + 2.0 * EVERY["tides"]
    wanted = force_on(EVERY["harmonics"], state) + 2 * force_on(EVERY["tides"], state)
    np.testing.assert_allclose(force_on(sum_of_two, state), wanted, rtol=1e-14)
    args = ARGS | {"epsilon": 3.0}
    of_args = (lambda args: args["epsilon"]) * EVERY["harmonics"]
    wanted = 3 * force_on(EVERY["harmonics"], state)
    np.testing.assert_allclose(force_on(of_args, state, args), wanted, rtol=1e-14)
    # With test particles, which have a force of their own.
    masses = np.append(MASSES, 0.0)
    q, p = (
        jnp.concatenate([x, 2 * x[-1:] / (1 if i == 0 else MASSES[-1])])
        for i, x in enumerate(state)
    )
    problem = systems.n_body(masses, q, p, G=0.9)
    step = 0.0, 0.1, q, p, problem.args
    perturbed = EVERY["harmonics"].add_to(problem).system
    both = jax.jit(lambda *x: perturbed.force(*x) + 0.0)(*step)
    wanted = jax.jit(lambda *x: problem.system.force(*x) + EVERY["harmonics"](*x))(*step)
    np.testing.assert_allclose(both, wanted, rtol=1e-14)
    with pytest.raises(TypeError, match="a problem of dvi_jax"):
        EVERY["tides"].add_to(problem.system)
    with pytest.raises(TypeError):
        EVERY["tides"] + 1.0
    wanted = force_on(EVERY["harmonics"], state) + 2 * force_on(EVERY["tides"], state)
    for two in (2.0, np.float64(2.0), np.array(2.0), jnp.array(2.0)):
        for product in (two * EVERY["tides"], EVERY["tides"] * two):
            same = sum([EVERY["harmonics"], product])
            np.testing.assert_allclose(force_on(same, state), wanted, rtol=1e-14)


def test_only_some_bodies(state):
    force = forces.Radiation(0.1, LIGHT, on_bodies=(2,))
    W = force_on(force, state)
    assert np.all(W[:2] == 0)
    assert np.any(W[2] != 0)
    for i in (0, 3):
        with pytest.raises(ValueError, match="each of on_bodies must be one of 1, 2"):
            force_on(forces.Radiation(0.1, LIGHT, on_bodies=(i,)), state)
    np.testing.assert_array_equal(
        W, force_on(forces.Radiation(0.1, LIGHT, on_bodies=[2, 2]), state)
    )
    assert np.all(force_on(forces.Radiation(0.1, LIGHT, on_bodies=()), state) == 0)
    plane = tuple(x[:, :2] for x in state)
    for name, text in {
        "harmonics": "pole of forces.Harm",
        "rotation": "positions with forces.LenseThirring",
        "disk": "pole of forces.Gal",
    }.items():
        with pytest.raises(ValueError, match=text):
            force_on(EVERY[name], plane)
    for name in ("tides", "radiation", "damping", "outgassing", "all bodies"):
        assert force_on(EVERY[name], plane).shape == (3, 2)
    # A pole in the plane: as the same motion in space.
    force = forces.Harmonics(0.3, {2: 0.1, 3: 0.04}, pole=(3.0, -4.0))
    flat = tuple(x.at[:, 2].set(0.0) for x in state)
    in_space = force_on(forces.Harmonics(0.3, {2: 0.1, 3: 0.04}, pole=(0.6, -0.8, 0.0)), flat)
    np.testing.assert_allclose(force_on(force, plane), in_space[:, :2], rtol=1e-13)
    assert np.all(in_space[:, 2] == 0)


def of_args(value):
    return lambda args: value


@pytest.mark.parametrize(("kind", "text", "wrong"), [
    (ValueError, "c of forces.Relativity must be a positive and finite number, got 'c'",
     lambda: forces.Relativity("c")),
    (ValueError, "c of forces.PostNewtonian must be a positive", lambda: forces.PostNewtonian(0.0)),
    (ValueError, "c of forces.LenseThirring must be", lambda: forces.LenseThirring(V, np.inf)),
    (ValueError, "momentum of forces.LenseThirring must be a finite",
     lambda: forces.LenseThirring((0.0, np.nan, 1.0), 1.0)),
    (ValueError, "beta of forces.Radiation must be zero or a positive finite number, got None",
     lambda: forces.Radiation(None, LIGHT)),
    (ValueError, "beta of forces.Radiation must be zero", lambda: forces.Radiation([0.1, -1], 1)),
    (TypeError, "function of .args., got <class 'float'>", lambda: forces.Radiation(float, LIGHT)),
    (ValueError, "k2 of forces.Tides", lambda: forces.Tides(-1.0, 0.1, 0.3)),
    (ValueError, "lag of forces.Tides", lambda: forces.Tides(1.0, True, 0.3)),
    (ValueError, "radius of forces.Tides", lambda: forces.Tides(1.0, 0.1, 0.0)),
    (ValueError, "spin of forces.Tides", lambda: forces.Tides(1.0, 0.1, 0.3, None)),
    (ValueError, "tau_e of forces.Damping must not be zero", lambda: forces.Damping(tau_e=0.0)),
    (ValueError, "tau_a of forces.Damping", lambda: forces.Damping([np.inf, np.nan])),
    (ValueError, "timescale of forces.MassLoss", lambda: forces.MassLoss(0)),
    (ValueError, "r0 of forces.Outgassing", lambda: forces.Outgassing(r0=-1.0)),
    (ValueError, "A1 of forces.Outgassing", lambda: forces.Outgassing(1j)),
    (ValueError, "ballistic of forces.Drag", lambda: forces.Drag(lambda r, args: 1.0, -2.0)),
    (TypeError, "density of Drag must take", lambda: forces.Drag(lambda r: 1.0, 2.0)),
    (TypeError, "path", lambda: forces.ThirdBody(np.ones(3), 1.0)),
    (TypeError, "path of ThirdBody must take", lambda: forces.ThirdBody(lambda t: R, 1.0)),
    (ValueError, "mu of forces.ThirdBody", lambda: forces.ThirdBody(lambda t, args: R, -1.0)),
    (ValueError, "strength of forces.GalacticTide", lambda: forces.GalacticTide(-1.0)),
    (ValueError, "length of pole", lambda: forces.GalacticTide(1.0, (0.0, 0.0, 0.0))),
    (ValueError, "length of pole", lambda: forces.Harmonics(1.0, {2: 0.1}, pole=(0, 0, 0))),
    (TypeError, "pole of forces.Harmonics", lambda: forces.Harmonics(1.0, {2: 0.1}, pole=None)),
    (ValueError, "radius of forces.Harmonics", lambda: forces.Harmonics(-1.0, {2: 0.1})),
    (TypeError, "zonal must be a dict", lambda: forces.Harmonics(1.0, [0.1])),
    (TypeError, "tesseral must be a dict", lambda: forces.Harmonics(1.0, {}, None)),
    (ValueError, "each key .n, m. of tesseral", lambda: forces.Harmonics(1.0, {}, {2: (0.1, 0.1)})),
    (ValueError, "harmonic 2 must be a finite", lambda: forces.Harmonics(1.0, {2: np.nan})),
    (ValueError, "degree", lambda: forces.Harmonics(1.0, {1: 0.1})),
    (ValueError, "order", lambda: forces.Harmonics(1.0, {}, {(2, 3): (0.1, 0.1)})),
    (ValueError, "each of on_bodies must be", lambda: forces.Relativity(1.0, on_bodies=(1.0,))),
    (ValueError, "strength of forces.Multiple", lambda: "a" * EVERY["tides"]),
    (TypeError, "unsupported", lambda: EVERY["tides"] * EVERY["disk"]),
    # In a run: shapes, and values of functions of args.
    (ValueError, "mu", lambda: EVERY["relativity"](0.0, 0.1, R, V, {})),
    (ValueError, "last axis of q", lambda: at(R[:1], V[:1], EVERY["tides"])),
    (ValueError, r"c of forces.Relativity must be a real scalar", lambda: at(
        R, V, forces.Relativity([1.0, 2.0]))),
    (ValueError, r"beta of forces.Radiation .* \(1,\).* got shape \(3,\)", lambda: at(
        R, V, forces.Radiation(of_args(np.ones(3)), LIGHT))),
    (ValueError, "harmonic 2 must be a real scalar", lambda: at(
        R, V, forces.Harmonics(1.0, {2: np.ones(2)}))),
    (ValueError, r"harmonic \(2, 2\) must be a real array of shape \(2,\)", lambda: at(
        R, V, forces.Harmonics(1.0, {}, {(2, 2): 0.1}))),
    (ValueError, "positions with tesseral", lambda: at(
        R[:2], V[:2], forces.Harmonics(1.0, {}, {(2, 2): (0.1, 0.0)}, pole=(0.0, 1.0)))),
    (ValueError, "density of Drag must return", lambda: at(
        R, V, forces.Drag(lambda r, args: r, 2.0))),
    (ValueError, "path of ThirdBody must return", lambda: at(
        R, V, forces.ThirdBody(lambda t, args: 1.0, 2.0))),
    (ValueError, "positions must be", lambda: EVERY["all bodies"].energy(0.0, 1.0, R, V, {
        "masses": MASSES, "mu": MU})),
])  # fmt: skip
def test_bad_input(kind, text, wrong):
    with pytest.raises(kind, match=text):
        wrong()


def test_parameters_that_are_traced_are_not_checked():
    """Their values are NaN or infinite, in one element of a batch only."""
    values = jnp.array([LIGHT, 0.0, 2 * LIGHT])
    batch = jax.vmap(lambda c: forces.Relativity(c)(0.0, 1.0, R, V, {"mu": MU}))(values)
    assert np.isfinite(batch).all(axis=1).tolist() == [1, 0, 1]
    np.testing.assert_allclose(batch[0], 4 * batch[2], rtol=1e-14)


@pytest.mark.slow
def test_orders_and_gradients_with_wisdom_holman(state):
    """Forces of positions and of velocities in its kicks: order two, and the derivative by args."""
    three = EVERY["harmonics"] + EVERY["tides"] + EVERY["radiation"]
    problem = ((lambda args: args["factor"]) * three).add_to(systems.n_body(MASSES, *state, G=0.9))

    def end(h, factor=1.0, method=dvi.WisdomHolman()):
        args = problem.args | {"factor": factor}
        sol = dvi.integrate(problem.system, *state, args=args, h=h, num_steps=round(2 / h),
                            method=method, save=dvi.Save(final=True))  # fmt: skip
        return sol.qs[-1]

    exact = end(0.01, method=dvi.GaussLegendre(4))
    errors = [float(np.abs(end(h) - exact).max()) for h in (0.1, 0.05)]
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.2)
    derivative = jax.grad(lambda factor: end(0.1, factor)[1, 0])(1.0)
    slope = (end(0.1, 1.001)[1, 0] - end(0.1, 0.999)[1, 0]) / 0.002
    assert float(derivative) == pytest.approx(float(slope), rel=1e-5)
    assert float(jnp.abs(end(0.1, 0.0) - end(0.1)).max()) > 1e-5


def reboundx_case(name):
    """Sets the parameters of a force in REBOUNDx."""

    def set_up(sim, extras):
        star, *planets = (body.params for body in sim.particles)
        force = extras.load_force(name)
        match name:
            case "gravitational_harmonics":
                star["J2"], star["J4"], star["R_eq"] = 0.1, -0.03, 0.3
            case "radiation_forces":
                force.params["c"], star["radiation_source"] = LIGHT, 1
                planets[0]["beta"], planets[1]["beta"] = 0.1, 0.3
            case "tides_constant_time_lag":
                sim.particles[0].r = 0.4
                star["tctl_k2"], star["tctl_tau"], star["OmegaMag"] = 30.0, 0.2, 0.7
            case "modify_orbits_forces":
                import reboundx

                force.params["coordinates"] = reboundx.coordinates["PARTICLE"]
                star["primary"] = 1
                for planet, taus in zip(
                    planets, [(-3.0, -2.0, -1.0), (5.0, -4.0, -8.0)], strict=True
                ):
                    planet["tau_a"], planet["tau_e"], planet["tau_inc"] = taus
            case "gr":
                force.params["c"] = 1e5
            case "gr_full":
                force.params["c"] = LIGHT
        return force

    return set_up


def in_rebound(state, masses=MASSES):
    """A simulation of REBOUND, and a function that computes its accelerations."""
    rebound = pytest.importorskip("rebound")
    sim = rebound.Simulation()
    sim.G = ARGS["G"]
    for m, x, p in zip(masses, *map(np.asarray, state), strict=True):
        sim.add(m=m, **dict(zip(("x", "y", "z", "vx", "vy", "vz"), [*x, *(p / m)], strict=True)))

    def accelerations():
        rebound.clibrebound.reb_simulation_update_acceleration(ctypes.byref(sim))
        return np.array([[body.ax, body.ay, body.az] for body in sim.particles])

    return sim, accelerations


@pytest.mark.parametrize(("name", "force", "limit"), [
    ("gravitational_harmonics", EVERY["harmonics"], 1e-13),
    ("radiation_forces", EVERY["radiation"], 1e-13),
    ("tides_constant_time_lag", EVERY["tides"], 1e-12),
    ("modify_orbits_forces", EVERY["damping"], 1e-13),
    # To first order in 1/c² and in the masses.
    ("gr", forces.Relativity(1e5), 3e-3),
])  # fmt: skip
def test_accelerations_are_those_of_reboundx(name, force, limit, state):
    reboundx = pytest.importorskip("reboundx")
    sim, accelerations = in_rebound(state)
    before = accelerations()
    extras = reboundx.Extras(sim)
    extras.add_force(reboundx_case(name)(sim, extras))
    theirs = accelerations() - before
    ours = force_on(force, state) / MASSES[:, None]
    assert np.abs(theirs - ours).max() < limit * np.abs(theirs).max() + 4e-16 * np.abs(before).max()
    assert np.abs(theirs).max() > 0


HEAVY = np.array([1.0, 0.3, 0.1])


def newton(q):
    energy = partial(systems.n_body().system.H_D, 0.0, 0.0)
    return -jax.grad(energy)(q, 0 * q, {**ARGS, "masses": HEAVY}) / HEAVY[:, None]


def test_relativity_of_all_bodies_is_that_of_reboundx():
    """`gr_full` has its own accelerations on the right-hand side, where ours are Newton's. It takes
    velocities relative to the centre of mass, which is at rest here."""
    reboundx = pytest.importorskip("reboundx")
    q, p = state_of(HEAVY, 2.6)
    sim, accelerations = in_rebound((q, p), HEAVY)
    before = accelerations()
    extras = reboundx.Extras(sim)
    extras.add_force(reboundx_case("gr_full")(sim, extras))
    theirs = accelerations() - before
    force, args = EVERY["all bodies"], {**ARGS, "masses": HEAVY}
    total = newton(q)
    for _ in range(12):
        terms = force.corrections(bodies_of(q, p, args), total) / LIGHT**2
        total = newton(q) + terms
    size = np.abs(before).max()
    assert np.abs(theirs - terms).max() < 1e-15 * size
    # To first order: the difference is of the next order in 1/c².
    ours = force_on(force, (q, p), args) / HEAVY[:, None]
    assert 1e-4 < np.abs(theirs - ours).max() / np.abs(theirs).max() < 5 / LIGHT**2


@pytest.mark.parametrize("light", [LIGHT, pytest.param(2 * LIGHT, marks=pytest.mark.slow)])
def test_the_two_forms_of_relativity_of_all_bodies(state, light):
    """The acceleration of Hamilton's equations is that of the force, up to O(1/c⁴)."""
    force, args = forces.PostNewtonian(light), {**ARGS, "masses": HEAVY}
    q, v = state[0], state[1] / MASSES[:, None]
    p = jax.jit(force.momenta)(q, v, args)

    def rates(q, p):
        def H(q, p):
            step = 0.0, 0.0, q, p, args
            return systems.n_body().system.H_D(*step) + force.energy(*step)

        dq, dp = jax.grad(H, argnums=(0, 1))(q, p)
        return dp, -dq

    (rate, pull), (a, _) = jax.jit(lambda *x: jax.jvp(rates, x, rates(*x)))(q, p)
    by_force = newton(q) + force_on(force, (q, HEAVY[:, None] * v), args) / HEAVY[:, None]
    np.testing.assert_allclose(rate, force.velocities(q, p, args), atol=1e-15)
    np.testing.assert_allclose(pull.sum(axis=0), 0, atol=1e-16)  # total momentum
    # The same multiple of 1/c⁴ for both c: 15.1 of the velocities.
    assert np.abs(rate - v).max() * light**4 == pytest.approx(15.06, abs=0.02)
    assert 0.1 < np.abs(a - by_force).max() * light**4 < 10
    one = forces.Relativity(light)
    relative = force_on(one, (q, HEAVY[:, None] * v), args) / HEAVY[:, None]
    assert np.abs(a - newton(q) - relative).max() * light**2 > 0.1  # negative control


@pytest.mark.slow
def test_conserved_quantities_of_the_relativity_of_all_bodies():
    """Energy and momentum of first order in a run with the force: constant up to O(1/c⁴)."""
    q, p = state_of(HEAVY, 2.6)
    problem = systems.n_body(HEAVY, q, p, G=ARGS["G"])
    force = forces.PostNewtonian(lambda args: args["c"])
    run = {"h": 0.02, "num_steps": 300, "method": dvi.GaussLegendre(3)}

    @jax.jit
    @jax.vmap
    def values(light):
        args = problem.args | {"c": light}
        sol = dvi.integrate(force.add_to(problem), args=args, **run)

        def quantities(q, p):
            canonical = force.momenta(q, p / HEAVY[:, None], args)
            step = 0.0, 0.0, q, canonical, args
            H = problem.system.H_D(*step)
            return jnp.array([H, H + force.energy(*step), *p.sum(axis=0), *canonical.sum(axis=0)])

        return jax.vmap(quantities)(sol.qs, sol.ps)

    computed = np.asarray(values(jnp.array([20.0, 40.0])))
    change = np.abs(computed - computed[:, :1]).max(axis=1)
    slow, fast = np.stack([change[:, 0], change[:, 1], *change[:, 2:].reshape(2, 2, 3).max(2).T]).T
    np.testing.assert_allclose(np.log2(slow / fast), [2, 4, 2, 4], atol=0.3)


def test_parameters_of_a_force_in_the_problem(state):
    """`add_to` stores them next to those of the problem, so that nothing else has to name them."""
    nb = systems.n_body(MASSES, *state, G=ARGS["G"])
    problem = forces.Relativity(lambda args: args["c"]).add_to(nb, args={"c": LIGHT})
    assert problem.args == {**nb.args, "c": LIGHT}
    assert "c" not in nb.args
    run = {"num_steps": 2, "method": dvi.GaussLegendre(2)}
    fixed = dvi.integrate(EVERY["relativity"].add_to(nb), **run)
    np.testing.assert_allclose(dvi.integrate(problem, **run).qs, fixed.qs, rtol=1e-14)
    with pytest.raises(TypeError, match="args must be a dict of parameters"):
        EVERY["relativity"].add_to(nb, args=3.0)


def test_forces_and_elements_with_units(state):
    """A problem with a force in units of astropy: the same orbit as in numbers."""
    u = pytest.importorskip("astropy.units")
    from dvi_jax import interop

    nb = systems.n_body(MASSES, *state, G=ARGS["G"])
    problem = forces.Relativity(lambda args: args["c"]).add_to(nb, args={"c": LIGHT})
    speed = u.au / u.day
    units = interop.UnitSystem(u.au, u.day, u.Msun, args={
        "masses": u.Msun, "G": u.au**3 / u.day**2 / u.Msun, "c": speed})  # fmt: skip
    args = {"masses": MASSES * u.Msun, "G": ARGS["G"] * units.args["G"]}
    args["c"] = (LIGHT * speed).to(u.km / u.s)
    observe = {"orbits": elements.Elements(frame="jacobi")}
    run = {"num_steps": 3, "method": dvi.GaussLegendre(2), "observe": observe}
    sol = interop.integrate(
        problem, nb.q0 * u.au, nb.p0 * u.Msun * speed, h=0.24 * u.h, args=args, units=units, **run
    )
    wanted = dvi.integrate(problem, h=0.01, **run)
    np.testing.assert_allclose(sol.observed["orbits"], wanted.observed["orbits"], rtol=1e-12)
    with pytest.raises(ValueError, match="args c is in"):
        interop.integrate(
            problem, nb.q0 * u.au, nb.p0 * u.Msun * speed, h=0.24 * u.h,
            args=args | {"c": 1.0 * u.km}, units=units, **run,
        )  # fmt: skip
    with pytest.raises(TypeError, match="q"):
        elements.Keplerian.from_state(state[0] * u.au, state[1] * speed, 1.0)


@pytest.mark.slow
def test_forces_in_other_questions():
    """Sweeps, batches, second derivatives, stops and the order of a drift, as single runs say."""
    q, v = elements.Keplerian(1.0, 0.2, 0.3, 0.4, 0.5, 0.6).state(1.0)

    def kepler(t0, t1, q0, p1, args):
        return p1 @ p1 / 2 - args["mu"] / jnp.sqrt(q0 @ q0)

    system = dvi.System(kepler, force=forces.Radiation(lambda args: args["beta"], LIGHT))
    run = {"epsilon": 1.0, "h": 0.05, "num_steps": 40}
    observe = elements.Elements()

    @jax.jit
    def end(beta):
        args = {"mu": 1.0, "beta": beta}
        sol = dvi.integrate(system, q, v, args=args, observe=observe, adjoint=dvi.Direct(), **run)
        return sol.observed[-1]

    betas = np.array([0.0, 0.1, 0.2])
    singles = np.array([end(beta) for beta in betas])
    np.testing.assert_allclose(jax.vmap(end)(jnp.asarray(betas)), singles, rtol=1e-12)
    axis = dvi.Axis("beta", betas)
    swept = dvi.sweep(system, q, v, args={"mu": 1.0, "beta": axis}, observe={"e": observe}, **run)
    np.testing.assert_allclose(np.asarray(swept["e"])[:, -1], singles, rtol=1e-12)
    second = jax.jacfwd(jax.jacfwd(end))(0.1)
    step = 1e-3
    differences = (end(0.1 + step) - 2 * end(0.1) + end(0.1 - step)) / step**2
    np.testing.assert_allclose(second, differences, rtol=1e-4, atol=1e-6)
    stop = dvi.Stop(lambda t, q, p, args: elements.Keplerian.from_state(q, p, args["mu"]).M - 1.0)
    stopped = dvi.integrate(system, q, v, args={"mu": 1.0, "beta": 0.0}, stop=stop, **run)
    assert stopped.status == "stopped"
    assert float(np.nanmax(np.where(np.isfinite(stopped.qs[:, 0]), stopped.ts, np.nan))) < 0.5

    def energy(t, q, p, args):
        return p @ p / 2 - args["mu"] / jnp.sqrt(q @ q)

    order = dvi.drift_order(
        system, energy, q, v, args={"mu": 1.0, "beta": 0.5}, h=0.02, num_steps=200,
        epsilons=[1e-3, 3e-3, 1e-2, 3e-2], method=dvi.KahanLi(8),
    )  # fmt: skip
    assert order.slope == pytest.approx(1, abs=0.05)
