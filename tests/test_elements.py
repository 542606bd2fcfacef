"""Orbital elements of one body and of many: conversions, derivatives, canonical pairs."""

from functools import partial

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from dvi_jax.elements import (
    Delaunay,
    Elements,
    Equinoctial,
    Keplerian,
    ModifiedEquinoctial,
    Poincare,
    of_bodies,
    to_bodies,
)
from helpers import symplectic_defect

import dvi_jax as dvi
from dvi_jax import systems

MU = 0.7
KINDS = Keplerian, Equinoctial, ModifiedEquinoctial, Delaunay, Poincare


def orbits(e, count=400, low=0.0, high=3.1):
    """Orbits of one eccentricity with random directions and places; no circles have a direction."""
    rng = np.random.default_rng(round(100 * e))
    Omega, omega, M = rng.uniform(-np.pi, np.pi, (3, count))
    inc = rng.uniform(low, high, count)
    a = np.full(count, 1.3 if e < 1 else -1.3)
    return Keplerian(a, np.full(count, e), inc, Omega, omega, M)


def apart(x, y):
    """Largest distance of two vectors relative to their length."""
    return float(np.max(np.linalg.norm(x - y, axis=-1) / np.linalg.norm(y, axis=-1)))


there = {kind: jax.jit(lambda q, v, kind=kind: kind.from_state(q, v, MU)) for kind in KINDS}
back = jax.jit(lambda elements: elements.state(MU))


@pytest.mark.parametrize("e", [0.0, 1e-12, 0.09, 0.11, 0.51, 0.9, 0.99, 1.01, 1.5, 10.0])
def test_states_there_and_back(e):
    q, v = back(orbits(e))
    new = back(there[Keplerian](q, v))
    assert max(apart(new[0], q), apart(new[1], v)) < 1.2e-14
    # Longitudes that are counted from a fixed axis have the rounding of π: at a pericentre with
    # e = 0.99 that is a distance of 1e-13; likewise the axes near the inclination π, up to 3.1.
    for kind in (Equinoctial, ModifiedEquinoctial, *([Poincare] if e < 1 else [])):
        new = back(there[kind](q, v))
        assert max(apart(new[0], q), apart(new[1], v)) < (1e-13 if e < 0.95 else 1e-12), kind
    # L − G is e²/2 and has the rounding of L: digits of e are lost near the circle.
    if 0.05 < e < 1:
        new = back(there[Delaunay](q, v))
        assert max(apart(new[0], q), apart(new[1], v)) < 1e-12


@pytest.mark.parametrize("e", [0.2, 0.8, 1.3])
def test_elements_there_and_back(e):
    wanted = orbits(e, low=0.05)
    elements = there[Keplerian](*back(wanted))
    for name, x, y in zip(Keplerian._fields, elements, wanted, strict=True):
        off = np.asarray(x) - y
        if name in ("Omega", "omega", "M"):
            off = np.angle(np.exp(1j * off))
        assert np.max(np.abs(off)) < 3e-14, name


@partial(jax.jit, static_argnums=0)
def jacobian(kind, state, mu):
    """∂(elements)/∂(q, v)."""

    def elements(z):
        return jnp.stack(kind.from_state(z[:3], z[3:], mu))

    return jax.jacfwd(elements)(jnp.concatenate(state))


def textbook(q, v, kind):
    """Elements of one state in mpmath, by vectors and the anomalies of textbooks."""
    q, v, mu = mpmath.matrix(q), mpmath.matrix(v), mpmath.mpf(MU)

    def cross(a, b):
        pairs = (1, 2), (2, 0), (0, 1)
        return mpmath.matrix([a[i] * b[j] - a[j] * b[i] for i, j in pairs])

    def dot(a, b):
        return mpmath.fsum(x * y for x, y in zip(a, b, strict=True))

    r, L = mpmath.sqrt(dot(q, q)), cross(q, v)
    size, axis = mpmath.sqrt(dot(L, L)), cross(v, L) / mu - q / r
    e, a = mpmath.sqrt(dot(axis, axis)), 1 / (2 / r - dot(v, v) / mu)
    inc, node = mpmath.acos(L[2] / size), mpmath.atan2(L[0], -L[1])
    to_node = mpmath.matrix([mpmath.cos(node), mpmath.sin(node), 0])
    omega = mpmath.atan2(dot(cross(to_node, axis), L) / size, dot(to_node, axis))
    true = mpmath.atan2(dot(cross(axis, q), L) / size, dot(axis, q))
    half = mpmath.tan(true / 2)
    if e < 1:
        E = 2 * mpmath.atan(mpmath.sqrt((1 - e) / (1 + e)) * half)
        M = E - e * mpmath.sin(E)
    else:
        F = 2 * mpmath.atanh(mpmath.sqrt((e - 1) / (e + 1)) * half)
        M = e * mpmath.sinh(F) - F
    if kind is Keplerian:
        return [a, e, inc, node, omega, M]
    around, t = node + omega, mpmath.tan(inc / 2)
    ex, ey = e * mpmath.cos(around), e * mpmath.sin(around)
    tilt = [t * mpmath.cos(node), t * mpmath.sin(node)]
    if kind is ModifiedEquinoctial:
        return [a * (1 - e * e), ex, ey, *tilt, around + true]
    if kind is Equinoctial:
        return [a, ex, ey, *tilt, around + M]
    action, root = mpmath.sqrt(mu * a), mpmath.sqrt(1 - e * e)
    if kind is Delaunay:
        return [M, omega, node, action, action * root, action * root * mpmath.cos(inc)]
    xi, p = mpmath.sqrt(2 * action * (1 - root)), mpmath.sqrt(2 * action * root * (1 - L[2] / size))
    pairs = [[s * mpmath.cos(x), -s * mpmath.sin(x)] for s, x in ((xi, around), (p, node))]
    return [around + M, pairs[0][1], pairs[1][1], action, pairs[0][0], pairs[1][0]]


CASES = [(kind, e) for kind in (Equinoctial, ModifiedEquinoctial) for e in (1e-12, 0.99, 1.01)]
CASES += [(Poincare, 1e-12), (Poincare, 0.99), (Delaunay, 0.99), (Keplerian, 0.99)]
CASES += [(Keplerian, 1.01), (Keplerian, 0.3), (Delaunay, 0.3)]


@pytest.mark.parametrize(("kind", "e"), CASES)
def test_derivatives_are_those_of_fifty_digits(kind, e):
    orbit = Keplerian(1.3 if e < 1 else -1.3, e, 0.4, 1.1, 0.6, 0.9)
    q, v = map(np.asarray, orbit.state(MU))
    derivative = jacobian(kind, (q, v), MU)
    with mpmath.workdps(60):
        z = [mpmath.mpf(float(x)) for x in (*q, *v)]

        def at(i, step):
            moved = [x + step * (j == i) for j, x in enumerate(z)]
            return textbook(moved[:3], moved[3:], kind)

        step = mpmath.mpf(10) ** -25
        wanted = np.array(
            [
                [
                    float((x - y) / (2 * step))
                    for x, y in zip(at(i, step), at(i, -step), strict=True)
                ]
                for i in range(6)
            ]
        ).T
    scale = np.max(np.abs(wanted), axis=1, keepdims=True)
    # 1/(1 − e) is the factor by which rounding of the state changes the elements themselves.
    assert np.max(np.abs(derivative - wanted) / scale) < (1e-13 if e < 0.9 else 3e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_derivatives_of_states_are_the_inverse(kind):
    """∂(elements)/∂(state) ∂(state)/∂(elements) = 1, and the second derivatives are finite."""
    elements = kind.from_state(*Keplerian(1.3, 0.3, 0.4, 1.1, 0.6, 0.9).state(MU), MU)

    def state(x):
        return jnp.concatenate(kind(*x).state(MU))

    def of(z):
        return jnp.stack(kind.from_state(z[:3], z[3:], MU))

    x = jnp.stack(elements)
    product = jax.jit(lambda x: jax.jacfwd(of)(state(x)) @ jax.jacrev(state)(x))(x)
    np.testing.assert_allclose(product, np.eye(6), atol=2e-14)


def test_regular_elements_have_derivatives_on_a_circle_in_the_plane():
    circle = jnp.array([1.0, 0.0, 0.0]), jnp.array([0.0, 1.0, 0.0])

    def derivative(kind):
        return jacobian(kind, circle, 1.0)

    for kind in (Equinoctial, ModifiedEquinoctial, Poincare):
        there = derivative(kind)

        def state(x, kind=kind):
            return jnp.concatenate(kind(*x).state(1.0))

        again = jax.jacfwd(state)(jnp.stack(kind.from_state(*circle, 1.0)))
        np.testing.assert_allclose(there @ again, np.eye(6), atol=1e-13)
    # Angles that do not exist have no derivative, and say so.
    assert np.isnan(derivative(Keplerian)).any(axis=1).tolist() == [0, 1, 1, 1, 1, 1]


@pytest.mark.parametrize(
    ("kind", "canonical"),
    [(Delaunay, True), (Poincare, True), (Equinoctial, False), (Keplerian, False)],
)
def test_canonical_elements(kind, canonical):
    q, v = Keplerian(1.3, 0.3, 0.4, 1.1, 0.6, 0.9).state(MU)
    assert (symplectic_defect(jacobian(kind, (q, v), MU)) < 1e-13) == canonical


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_orbits_in_a_plane(direction):
    kepler = systems.kepler()
    q, v = jnp.asarray(kepler.q0), direction * jnp.asarray(kepler.p0)
    elements = Keplerian.from_state(q, v, 1.0)
    assert float(elements.inc) == (0.0 if direction > 0 else np.pi)
    again = elements.state(1.0, dim=2)
    assert max(apart(again[0], q), apart(again[1], v)) < 1e-15
    # In the plane the direction of the pericentre has a derivative. A turn by δ changes it by δ.
    turn = jnp.array([[0.0, -1.0], [1.0, 0.0]])
    change = jax.jvp(lambda q, v: Keplerian.from_state(q, v, 1.0), (q, v), (turn @ q, turn @ v))[1]
    np.testing.assert_allclose(jnp.stack(change), [0, 0, 0, 0, direction, 0], atol=1e-14)


def test_a_parabola():
    q, v = jnp.array([1.0, 0.0, 0.0]), jnp.array([0.0, np.sqrt(2.0), 0.0])
    elements = ModifiedEquinoctial.from_state(q, v, 1.0)
    np.testing.assert_allclose(elements, [2, 1, 0, 0, 0, 0], atol=1e-15)
    moved = elements._replace(longitude=2.0).state(1.0)
    assert abs(float(jnp.sum(moved[1] ** 2) / 2 - 1 / jnp.linalg.norm(moved[0]))) < 1e-15
    assert np.isnan(Delaunay.from_state(q, 1.1 * v, 1.0).L)
    assert np.isnan(Poincare.from_state(q, 1.1 * v, 1.0).Lambda)
    beyond = ModifiedEquinoctial.from_state(q, 1.1 * v, 1.0)._replace(longitude=3.0)
    assert np.isnan(beyond.state(1.0)[0]).all()


MASSES = np.array([1.0, 1e-3, 3e-4, 5e-5])


def planets(tests=1):
    rng = np.random.default_rng(5)
    count = len(MASSES) - 1 + tests
    a, e, inc = 1.7 ** np.arange(count), rng.uniform(0, 0.4, count), rng.uniform(0, 0.5, count)
    return Keplerian(a, e, inc, *rng.uniform(-3, 3, (3, count)))


@pytest.mark.parametrize("frame", ["jacobi", "heliocentric", "barycentric"])
def test_elements_of_bodies_there_and_back(frame):
    elements = planets()
    q, p = to_bodies(elements, MASSES, MU, frame=frame)
    np.testing.assert_allclose(jnp.sum(p[:4], axis=0), 0, atol=1e-18)
    np.testing.assert_allclose(MASSES @ np.asarray(q[:4]), 0, atol=1e-15)
    times = jnp.stack([q, q]), jnp.stack([p, p])
    for kind in KINDS:
        states = of_bodies(*times, MASSES, MU, frame=frame, kind=kind)
        assert states[0].shape == (2, 4)
        again = to_bodies(kind(*(x[1] for x in states)), MASSES, MU, frame=frame)
        np.testing.assert_allclose(again, (q, p), atol=1e-13)
    np.testing.assert_allclose(of_bodies(q, p, MASSES, MU, frame=frame), elements, atol=1e-13)


def test_elements_of_bodies_are_those_of_rebound():
    rebound = pytest.importorskip("rebound")
    simulation = rebound.Simulation()
    simulation.G = MU
    for mass, *elements in zip([*MASSES[1:], 0.0], *planets(), strict=True):
        if not simulation.N:
            simulation.add(m=MASSES[0])
        names = dict(zip(("a", "e", "inc", "Omega", "omega", "M"), elements, strict=True))
        simulation.add(m=mass, **names)
    simulation.move_to_com()
    bodies = simulation.particles
    q, v = (np.array([getattr(b, name) for b in bodies]) for name in ("xyz", "vxyz"))
    p = v * np.array([*MASSES, 1.0])[:, None]
    np.testing.assert_allclose(to_bodies(planets(), MASSES, MU), (q, p), atol=1e-14)
    for frame, primary in (("jacobi", None), ("heliocentric", bodies[0])):
        theirs = simulation.orbits(primary=primary)
        ours = of_bodies(q, p, MASSES, MU, frame=frame)
        for name in ("a", "e", "inc", "Omega", "omega", "M"):
            off = np.asarray(getattr(ours, name)) - [getattr(o, name) for o in theirs]
            off = off if name in ("a", "e", "inc") else np.angle(np.exp(1j * off))
            np.testing.assert_allclose(off, 0, atol=2e-13, err_msg=f"{frame} {name}")


def test_elements_of_a_solution_and_as_observables():
    system, q, p = systems.kepler().system, jnp.array([0.7, 0.0]), jnp.array([0.0, np.sqrt(13 / 7)])
    observe = Elements(kind="Equinoctial", mu=lambda args: args["K"] ** 2)
    options = {"h": 0.05, "num_steps": 20, "method": dvi.Yoshida(4), "args": {"K": 1.0}}
    sol = dvi.integrate(system, q, p, observe=observe, **options)
    assert sol.observed.shape == (21, 6)
    np.testing.assert_allclose(sol.observed[:, :3], np.tile([1.0, 0.3, 0.0], (21, 1)), atol=4e-5)
    longitude = np.asarray(sol.observed[:, 5])
    np.testing.assert_allclose(longitude - longitude[0], sol.ts, atol=1e-4)
    momenta = jnp.stack([p, 1.1 * p])
    batch = jax.vmap(lambda p: dvi.integrate(system, q, p, **options))(momenta)
    elements = batch.elements(mu=1.0, kind=Equinoctial)
    assert elements.a.shape == (2, 21)
    np.testing.assert_allclose(jnp.stack(elements, -1)[0], sol.observed, atol=1e-12)


def test_elements_of_a_solution_of_bodies():
    q, p = to_bodies(planets(), MASSES)
    problem = systems.n_body([*MASSES, 0.0], q, p, h=0.02)
    sol = dvi.integrate(
        problem, num_steps=50, observe=Elements(frame="jacobi"), method=dvi.Strang()
    )
    elements = sol.elements(MASSES)
    assert elements.e.shape == (51, 4)
    np.testing.assert_allclose(jnp.stack(elements, -1), sol.observed, atol=1e-12)
    np.testing.assert_allclose(elements.a, np.tile(planets().a, (51, 1)), rtol=5e-3)


@pytest.mark.parametrize("method", [
    pytest.param(dvi.WisdomHolman(), marks=pytest.mark.slow),
    pytest.param(dvi.WisdomHolman(corrector=5), marks=pytest.mark.slow),
    dvi.WisdomHolman("democratic"),
])  # fmt: skip
def test_test_particles_in_wisdom_holman(method):
    """The massive bodies move as without them, and they as in another method, with its order."""
    q, p = map(np.asarray, to_bodies(planets(tests=2), MASSES))
    problem = systems.n_body([*MASSES, 0.0, 0.0], q, p)
    options = {"args": problem.args, "save": dvi.Save(final=True), "epsilon": 1.0}

    def end(method, h):
        steps = {"h": h, "num_steps": round(2 / h)}
        return np.asarray(
            dvi.integrate(problem.system, q, p, method=method, **steps, **options).qs[-1]
        )

    exact = end(dvi.KahanLi(8), 0.01)
    errors = [np.abs(end(method, h) - exact)[4:].max() for h in (0.1, 0.05)]
    assert errors[1] < 3e-6
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.15)
    alone = systems.n_body(MASSES, q[:4], p[:4])
    sol = dvi.integrate(alone, h=0.05, num_steps=40, method=method, save=options["save"])
    np.testing.assert_allclose(sol.qs[-1], end(method, 0.05)[:4], atol=2e-15)


def test_bodies_without_a_mass_that_attract_are_refused():
    """Fewer masses than bodies, in a system whose H_D attracts all of them."""
    q, p = to_bodies(planets(tests=0), MASSES)

    def H(t0, t1, q0, p1, args):
        return systems.n_body().system.H_D(t0, t1, q0, p1, {"masses": jnp.asarray(MASSES)})

    run = {"h": 0.05, "num_steps": 2, "method": dvi.WisdomHolman()}
    with pytest.raises(ValueError, match="after the first 3"):
        dvi.integrate(dvi.System(H), q, p, args={"masses": MASSES[:3]}, **run)
    assert dvi.integrate(dvi.System(H), q, p, args={}, **run).status == "successful"


def test_bad_input():
    q, p = to_bodies(planets(tests=0), MASSES)
    for wrong, text in [
        (lambda: of_bodies(q, p, MASSES, frame="solar"), "frame must be one of 'jacobi'"),
        (lambda: of_bodies(q, p, MASSES, kind="Kepler"), "kind must be one of 'Keplerian'"),
        (lambda: of_bodies(q, p, np.ones(5)), "number of masses must be"),
        (lambda: of_bodies(q, p[:2], MASSES), "p must be"),
        (lambda: Keplerian.from_state(q[0, :1], p[0, :1], 1.0), "last axis of q"),
        (lambda: planets(0).state(1.0, dim=4), "dim must be one of 2, 3"),
        (lambda: Elements(frame="solar"), "frame must be one of"),
    ]:
        with pytest.raises(ValueError, match=text):
            wrong()
    with pytest.raises(TypeError, match="elements, such as"):
        to_bodies((1.0, 0.1), MASSES)
    sol = dvi.integrate(systems.kepler(), num_steps=2)
    with pytest.raises(TypeError, match="masses or mu"):
        sol.elements()
