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

    x = jnp.round(jnp.stack(elements), 6)  # the same point, whatever the round-off of `from_state`
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
    with pytest.raises(ValueError, match="beyond the asymptotes"):
        beyond.state(1.0)
    assert np.isnan(jax.jit(lambda x: jnp.stack(x.state(1.0)))(beyond)).all()


MASSES = np.array([1.0, 1e-3, 3e-4, 5e-5])


def planets(tests=1):
    rng = np.random.default_rng(5)
    count = len(MASSES) - 1 + tests
    a, e, inc = 1.7 ** np.arange(count), rng.uniform(0, 0.4, count), rng.uniform(0, 0.5, count)
    return Keplerian(a, e, inc, *rng.uniform(-3, 3, (3, count)))


@pytest.mark.parametrize(
    "frame",
    ["heliocentric", *(pytest.param(x, marks=pytest.mark.slow) for x in ("jacobi", "barycentric"))],
)
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
    pytest.param(dvi.WisdomHolman("democratic"), marks=pytest.mark.slow),
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
    x, v = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    for wrong, text in [
        (lambda: of_bodies(q, p, MASSES, frame="solar"), "frame must be one of 'jacobi'"),
        (lambda: of_bodies(q, p, MASSES, kind="Kepler"), "kind must be one of 'Keplerian'"),
        (lambda: of_bodies(q, p, np.ones(5)), "number of masses must be"),
        (lambda: of_bodies(q, p[:2], MASSES), "p must be"),
        (lambda: of_bodies(x, v, MASSES), "number of axes of q"),
        (lambda: of_bodies(q[:1], p[:1], MASSES[:1]), "the number of bodies must be .* at least 2"),
        (lambda: of_bodies(q, p, [1.0, -1e-3]), "masses must be between 0"),
        (lambda: of_bodies(q, p, [0.0, 1e-3]), "mass of body 0 must be positive"),
        (lambda: of_bodies(q, p, [1.0, np.nan]), "masses must be between 0"),
        (lambda: of_bodies(q, p, MASSES, -1.0), "G must be a positive"),
        (lambda: of_bodies(q, p, MASSES, np.ones(3)), "G must be a real scalar"),
        (lambda: Keplerian.from_state(q[0, :1], p[0, :1], 1.0), "last axis of q"),
        (lambda: Keplerian.from_state(x, v, -1.0), "mu must be positive and finite, got -1.0"),
        (lambda: Equinoctial.from_state(x, v, np.ones(3)), "mu must be a real scalar"),
        (lambda: planets(0).state(1.0, dim=4), "dim must be one of 2, 3"),
        (lambda: planets(0).state(1.0, dim=2), "inclination must be 0 or π"),
        (lambda: planets(0)._replace(e=np.ones(2)).state(1.0), "e of elements.Keplerian must be"),
        (lambda: planets(0).state(np.ones(2)), "mu must be a real array of shape"),
        (lambda: Elements(frame="solar"), "frame must be one of"),
        (lambda: Elements(mu=-1.0), "mu of elements.Elements must be a positive"),
    ]:
        with pytest.raises(ValueError, match=text):
            wrong()
    for wrong, text in [
        (lambda: to_bodies((1.0, 0.1), MASSES), "elements, such as"),
        (lambda: to_bodies(planets(0), None), "masses must be an array of real numbers"),
        (lambda: of_bodies(q, p, MASSES, None), "G must be an array of real numbers"),
        (lambda: Keplerian.from_state(x + 0j, v, 1.0), "q must be an array of real numbers"),
        (lambda: Keplerian.from_state(x, "abc", 1.0), "v must be an array of real numbers"),
        (lambda: Poincare.from_state(x, v, None), "mu must be an array of real numbers"),
        (lambda: planets(0)._replace(a="1").state(1.0), "a of elements.Keplerian must be an"),
        (lambda: Elements(frame="jacobi", mu=1.0), "only one of frame and mu"),
        (lambda: Elements()(0.0, x, v, {"G": 1.0}), r"requires args\['mu'\]"),
        (lambda: Elements(frame="jacobi")(0.0, q, p, None), r"requires args\['masses'\]"),
    ]:
        with pytest.raises(TypeError, match=text):
            wrong()
    sol = dvi.integrate(systems.kepler(), num_steps=2)
    with pytest.raises(TypeError, match="masses or mu"):
        sol.elements()


ORBIT = 1.0, 0.1, 0.2, 0.3, 0.4, 0.5


@pytest.mark.parametrize(("elements", "text"), [
    (Keplerian(*ORBIT)._replace(e=-0.1), "e of elements.Keplerian must be between 0 and inf"),
    (Keplerian(*ORBIT)._replace(e=1.0), "e = 1 is a ModifiedEquinoctial"),
    (Keplerian(*ORBIT)._replace(e=1.1), "hyperbolas e > 1 and a < 0"),
    (Keplerian(*ORBIT)._replace(a=-1.0), "Ellipses have e < 1 and a > 0"),
    (Equinoctial(*ORBIT)._replace(ex=1.2), "a .1 − e². of elements.Equinoctial"),
    (Equinoctial(*ORBIT)._replace(a=-1.0), "Ellipses have"),
    (ModifiedEquinoctial(*ORBIT)._replace(p=-1.0), "p of elements.ModifiedEquinoctial"),
    (Delaunay(0.0, 0.0, 0.0, 1.0, 1.1, 0.5), "G/L of elements.Delaunay must be between 0 and 1"),
    (Delaunay(0.0, 0.0, 0.0, 1.0, 0.9, -0.95), "H/G of elements.Delaunay"),
    (Delaunay(0.0, 0.0, 0.0, -1.0, 0.9, 0.5), "G/L of elements.Delaunay"),
    (Poincare(0.0, 2.0, 0.0, 1.0, 0.9, 0.5), "G = Λ − .ξ² . η²./2 of elements.Poincare"),
    (Poincare(0.0, 0.1, 1.5, 1.0, 0.1, 1.5), "4 G − p² − q² of"),
])  # fmt: skip
def test_elements_of_no_orbit(elements, text):
    """Known ones are an error; traced ones, and those of a batch with NaN, are NaN."""
    with pytest.raises(ValueError, match=text):
        elements.state(1.0)
    assert np.isnan(jax.jit(lambda x: jnp.stack(x.state(1.0)))(elements)).any()


def test_integers_are_numbers():
    q, v = np.array([1, 0, 0]), np.array([0, 1, 0])
    for kind in (Delaunay, Poincare):  # which use all others
        whole, real = kind.from_state(q, v, 1), kind.from_state(1.0 * q, 1.0 * v, 1.0)
        np.testing.assert_array_equal(whole, real)
    np.testing.assert_array_equal(of_bodies([q, 2 * q], [v, v], [1, 1]).e, of_bodies(
        1.0 * np.array([q, 2 * q]), 1.0 * np.array([v, v]), [1.0, 1.0]).e)  # fmt: skip
    single = Keplerian.from_state(q.astype("f4"), v.astype("f4"), 1.0)
    assert {x.dtype.name for x in single} == {"float32"}


def test_a_state_that_failed_does_not_affect_others():
    """NaN gives NaN, next to good orbits."""
    e = np.array([0.1, np.nan, 0.3])
    q, v = Keplerian(1.0, e, 0.1, 0.2, 0.3, 0.4).state(1.0)
    assert np.isnan(q).any(axis=1).tolist() == np.isnan(v).any(axis=1).tolist() == [0, 1, 0]
    again = Keplerian.from_state(q, v, 1.0)
    np.testing.assert_allclose(again.e[::2], e[::2], rtol=0, atol=1e-14)


def test_a_mass_of_zero_is_a_test_particle():
    """Its row of p is the velocity, as without an entry in the masses."""
    orbits = planets(tests=1)
    states = [to_bodies(orbits, masses) for masses in (MASSES, [*MASSES, 0.0])]
    np.testing.assert_array_equal(*states)
    elements = [of_bodies(*states[0], masses) for masses in (MASSES, [*MASSES, 0.0])]
    np.testing.assert_array_equal(*elements)
    np.testing.assert_allclose(elements[0], orbits, atol=1e-13)
