"""Constraints: RATTLE, consistent initial states, forces of constraint, runs over long times.

The long tests print what they measure: ``pytest tests/test_constraints.py -m slow -s``.
"""

import functools
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import dvi_jax as dvi
import lanewise
from dvi_jax import systems

slow = pytest.mark.slow
FOURTH, EIGHTH = dvi.Yoshida(4, base=dvi.Rattle()), dvi.KahanLi(8, base=dvi.Rattle())
SPHERE = systems.spherical_pendulum()
Q, P = jnp.asarray(SPHERE.q0), jnp.asarray(SPHERE.p0)


def run(made, num_steps, h=None, q0=None, p0=None, args=None, **options):
    """A run of a problem of the library, of which the end is saved."""
    q0, p0 = (made.q0 if q0 is None else q0), (made.p0 if p0 is None else p0)
    args, h = (made.args if args is None else args), (made.h if h is None else h)
    options = {"save": dvi.Save(final=True), **options}
    return dvi.integrate(made.system, q0, p0, args=args, h=h, num_steps=num_steps, **options)


def end(sol):
    return np.concatenate([sol.qs[-1].ravel(), sol.ps[-1].ravel()])


def unit_sphere(q, args):
    return (q @ q - 1)[None] / 2


def coupled(t0, t1, q0, p1, args):
    """Not separable: the mass depends on the position."""
    return (1 + 0.3 * q0[0] ** 2) * (p1 @ p1) / 2 + args * q0[2]


def relativistic(t0, t1, q0, p1, args):
    """Separable, with a velocity that is not linear in p."""
    return jnp.sqrt(1 + p1 @ p1) + args * q0[2]


def curved(t, q, p, args):
    return coupled(t, t, q, p, args)


OTHERS = {
    "not separable": dvi.System(coupled, constraint=unit_sphere),
    "nonlinear velocity": dvi.System(relativistic, constraint=unit_sphere),
    "H_D of order 2": dvi.System(dvi.discretise(curved, order=2), constraint=unit_sphere),
}
NAMED = ["not separable", *(pytest.param(name, marks=slow) for name in list(OTHERS)[1:])]
START = np.array([0.6, 0.0, -0.8]), np.array([0.4, 0.5, 0.3])


@functools.cache
def one_step(name, method=dvi.Rattle()):
    """Compiled (q, p, h) → (q1, p1) of a step, with its status."""
    system, args = (SPHERE.system, SPHERE.args) if name == "sphere" else (OTHERS[name], 1.3)

    @jax.jit
    def step(q, p, h):
        equations = dvi.Equations(system, jnp.zeros(()), jax.tree.map(jnp.asarray, args))
        return method.step(equations, dvi.Interval(0 * h, h, h), q, p)

    return step


@functools.cache
def flow(name, method):
    """Compiled (q, p, h, n) → (q, p) after n steps, n of which is traced."""
    step = one_step(name, method)

    @jax.jit
    def advance(q, p, h, n):
        return jax.lax.fori_loop(0, n, lambda _, state: step(*state, h)[:2], (q, p))

    return lambda q, p, h, n: np.concatenate(advance(q, p, jnp.asarray(h), jnp.asarray(n)))


@functools.cache
def exact_end(time):
    return np.concatenate([np.ravel(x) for x in jax.jit(SPHERE.exact)(time, Q, P, SPHERE.args)])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "order"), [(dvi.Rattle(), 2), pytest.param(FOURTH, 4, marks=slow)]
)
def test_it_converges_to_the_exact_solution_with_its_order(method, order):
    ends = [flow("sphere", method)(Q, P, 0.8 / n, n) for n in (20, 40, 80)]
    errors = np.max(np.abs(np.array(ends) - exact_end(0.8)), axis=1)
    assert errors[0] > 1e-6
    assert np.allclose(np.log2(errors[:-1]) - np.log2(errors[1:]), order, atol=0.15)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMED)
def test_other_hamiltonians_have_order_2_too(name):
    a, b, c = (flow(name, dvi.Rattle())(*map(jnp.asarray, START), 0.4 / n, n) for n in (4, 8, 16))
    ratio = np.max(np.abs(a - b)) / np.max(np.abs(b - c))
    assert abs(np.log2(ratio) - 2) < 0.15
    q, p = c[:3], c[3:]
    assert abs(q @ q - 1) < 1e-15
    assert abs(q @ p) < 1e-15  # each velocity is parallel to p


@pytest.mark.parametrize("name", ["sphere", *NAMED])
def test_a_step_back_undoes_a_step(name):
    q, p = (Q, P) if name == "sphere" else map(jnp.asarray, START)
    step = one_step(name)
    q1, p1, info = step(q, p, jnp.asarray(0.1))
    assert info.result == dvi.RESULTS.successful
    assert np.max(np.abs(q1 - q)) > 0.01
    q2, p2, _ = step(q1, p1, jnp.asarray(-0.1))
    assert np.max(np.abs(jnp.stack([q2 - q, p2 - p]))) < 1e-14
    still = step(q, p, jnp.asarray(0.0))  # as at the end of a curve between two states
    assert np.max(np.abs(jnp.stack([still[0] - q, still[1] - p]))) < 1e-15


def two_form(x):
    half = len(x) // 2
    J = np.block([[np.zeros((half, half)), np.eye(half)], [-np.eye(half), np.zeros((half, half))]])
    return x.T @ J @ x


def defect_of_two_form(system, args, step, q, p):
    """|Φ*(dq∧dp) − dq∧dp| on tangent vectors of the manifold."""
    z = jnp.concatenate([q.ravel(), p.ravel()])
    n = q.size

    def conditions(z):
        q1, p1 = z[:n].reshape(q.shape), z[n:].reshape(q.shape)
        velocity = jax.grad(lambda p: system.H_D(0.0, 0.0, q1, p, args))(p1)
        g, rate = jax.jvp(lambda q: system.constraint(q, args), (q1,), (velocity,))
        return jnp.concatenate([g, rate])

    @jax.jit
    def linearised(z):
        def mapped(z):
            q1, p1 = step(z[:n].reshape(q.shape), z[n:].reshape(q.shape))
            return (z1 := jnp.concatenate([q1.ravel(), p1.ravel()])), z1

        J, z1 = jax.jacfwd(mapped, has_aux=True)(z)
        return jax.jacfwd(conditions)(z), jax.jacfwd(conditions)(z1), J

    at_start, at_end, J = map(np.asarray, linearised(z))
    _, sizes, V = np.linalg.svd(at_start)
    before = V[np.sum(sizes > 1e-9) :].T  # a basis of the tangent space
    after = J @ before
    assert np.max(np.abs(at_end @ after)) < 1e-12  # tangent there, too
    return np.max(np.abs(two_form(after) - two_form(before)))


def not_symplectic(q, p, h=0.1):
    """RK4 for the equations with the force of constraint, and a projection."""
    force = dvi.ConstraintForce().bind(SPHERE.system, 0.0)
    g, t = SPHERE.args["g"], jnp.zeros(())

    def rates(q, p):
        pull = jnp.array([0.0, 0.0, g]) - force(t, t, q, p, q, p, SPHERE.args)
        return p, -pull

    a = rates(q, p)
    b = rates(q + h / 2 * a[0], p + h / 2 * a[1])
    c = rates(q + h / 2 * b[0], p + h / 2 * b[1])
    d = rates(q + h * c[0], p + h * c[1])
    q, p = (
        x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        for x, k1, k2, k3, k4 in zip((q, p), a, b, c, d, strict=True)
    )
    q = q / jnp.sqrt(q @ q)
    return q, p - q * (q @ p)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sphere", pytest.param("not separable", marks=slow)])
def test_the_map_is_symplectic_on_the_manifold(name):
    step = one_step(name)

    def rattle(q, p):
        return step(q, p, jnp.asarray(0.1))[:2]

    if name == "sphere":
        sphere = SPHERE.system, SPHERE.args
        assert defect_of_two_form(*sphere, rattle, Q, P) < 1e-13
        assert defect_of_two_form(*sphere, not_symplectic, Q, P) > 1e-6  # the control
    else:
        start = map(jnp.asarray, START)
        assert defect_of_two_form(OTHERS[name], 1.3, rattle, *start) < 1e-13


APART = np.array([0.7, 0.1, -0.9]), np.array([0.1, 1.0, 0.3])
"""A state that does not satisfy the constraint."""


@pytest.mark.slow
def test_a_projection_is_the_nearest_consistent_state():
    (q0, p0), found = APART, dvi.project(SPHERE, *APART)
    nearest = q0 / np.linalg.norm(q0)
    assert np.max(np.abs(found.q - nearest)) < 1e-15
    assert np.max(np.abs(found.p - (p0 - nearest * (nearest @ p0)))) < 1e-15
    assert abs(found.distance - abs(np.linalg.norm(q0) - 1)) < 1e-15


@slow
def test_a_projection_is_differentiable():
    q0, p0 = APART
    nearest = q0 / np.linalg.norm(q0)
    slope = jax.jit(jax.jacfwd(lambda q: dvi.project(SPHERE, q, p0).q))(q0)
    length = np.linalg.norm(q0)
    assert np.max(np.abs(slope - (np.eye(3) - np.outer(nearest, nearest)) / length)) < 1e-14


TWICE = dvi.System(SPHERE.system.H_D, constraint=lambda q, args: jnp.stack([q @ q - 1, 1 - q @ q]))
"""The same constraint two times."""


def test_inconsistent_starts_are_refused():
    with pytest.raises(ValueError, match=r"the constraint must be 0 to round-off, .* is 0\.0672"):
        run(SPHERE, 1, q0=np.array([0.88, 0.0, -0.6]))
    with pytest.raises(ValueError, match=r"rate of change .* is 0\.01\. Use dvi\.project"):
        run(SPHERE, 1, p0=SPHERE.p0 + np.array([0.0125, 0.0, 0.0]))


@slow
def test_redundant_constraints_and_those_without_a_solution_are_refused():
    q, p = SPHERE.q0, SPHERE.p0
    with pytest.raises(ValueError, match=r"rank .* must be 2, .* got 1: 1 of them"):
        dvi.integrate(TWICE, q, p, h=0.1, num_steps=1, args=SPHERE.args)
    with pytest.raises(ValueError, match="redundant"):
        dvi.project(TWICE, q, p, SPHERE.args)
    nowhere = dvi.System(SPHERE.system.H_D, constraint=lambda q, args: q[:1] ** 2 + 1)
    with pytest.raises(ValueError, match="no state with g = 0"):
        dvi.project(nowhere, q, p, SPHERE.args)


@slow
def test_a_batch_has_the_numbers_of_single_runs_and_a_status_for_each_start():
    starts = jnp.array([[0.8, 0.0, -0.6], [0.8, 0.0, -0.61], [0.8, jnp.nan, -0.6]])
    sol = jax.vmap(lambda q: run(SPHERE, 2, q0=q, throw=False))(starts)
    assert list(sol.status) == ["successful", "inconsistent", "not_finite"]
    assert np.isnan(sol.qs[1, -1]).all()
    assert not np.isnan(sol.qs[0]).any()
    how = {"h": 0.1, "num_steps": 1, "args": SPHERE.args, "throw": False}
    assert jax.jit(lambda q: dvi.integrate(TWICE, q, P, **how))(Q).status == "redundant"
    angles = jnp.array([0.2, 0.6, 1.0, 1.5])
    q = jnp.stack([jnp.sin(angles), 0 * angles, -jnp.cos(angles)], axis=1)
    p = jnp.stack([0 * angles, 1 + angles, 0 * angles], axis=1)
    together = jax.vmap(lambda q, p: run(SPHERE, 10, q0=q, p0=p).qs[-1])(q, p)
    for i in range(4):
        assert np.array_equal(together[i], run(SPHERE, 10, q0=q[i], p0=p[i]).qs[-1])


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"method": dvi.Strang()}, r"needs method=dvi\.Rattle\(\).*got Strang"),
        ({"method": dvi.GaussLegendre(2)}, r"needs method=dvi\.Rattle\(\).*got GaussLegendre"),
        *(({"lattice": lattice}, r"needs lattice=dvi\.Uniform") for lattice in
          (dvi.Variational(), dvi.TimeTransformed(lambda t, q, p, args: 1.0))),
        ({"arithmetic": dvi.DoubleDouble()}, r"needs arithmetic=dvi\.FloatingPoint"),
    ],
)  # fmt: skip
def test_options_that_do_not_fit_a_constraint_are_refused(options, said):
    with pytest.raises(ValueError, match=said):
        run(SPHERE, 1, **options)


def test_what_does_not_take_constraints_refuses_them():
    system, samples = SPHERE.system, (np.array([SPHERE.q0] * 9), np.array([SPHERE.p0] * 9))
    free = dvi.System(system.H_D)
    with pytest.raises(ValueError, match=r"Rattle\(\) needs a constraint"):
        dvi.integrate(free, Q, P, h=0.1, num_steps=1, args=SPHERE.args, method="rattle")
    with pytest.raises(ValueError, match="project requires a constraint"):
        dvi.project(free, Q, P)
    with pytest.raises(ValueError, match="ConstraintForce requires a constraint"):
        dvi.integrate(free, Q, P, h=0.1, num_steps=1, args=SPHERE.args,
                      observe=dvi.ConstraintForce())  # fmt: skip
    for function, rest in ((dvi.find_symmetries, [dvi.Polynomials(1)]), (dvi.solution_pairs, [])):
        with pytest.raises(ValueError, match=f"{function.__name__} requires a system without"):
            function(system, *rest, h=0.1, samples=samples, args=SPHERE.args)
    off = samples[0] * 1.01, samples[1]
    with pytest.raises(ValueError, match="samples must satisfy the constraint"):
        dvi.discover_invariants(system, dvi.Basis([lambda q, p: q[0]]), h=0.1, samples=off,
                                args=SPHERE.args)  # fmt: skip


@pytest.mark.parametrize(
    ("constraint", "said"),
    [
        (lambda q, args: q @ q - 1, r"shape \(m,\).*got shape \(\)"),
        (lambda q, args: jnp.eye(3), r"shape \(m,\).*got shape \(3, 3\)"),
        (lambda q, args: jnp.array([1]), r"real array of shape \(m,\).*int"),
        (lambda q, args: None, "must return"),
    ],
)
def test_a_constraint_of_another_shape_is_refused(constraint, said):
    with pytest.raises((ValueError, TypeError), match=said):
        dvi.integrate(dvi.System(SPHERE.system.H_D, constraint=constraint), Q, P, h=0.1,
                      num_steps=1, args=SPHERE.args)  # fmt: skip
    with pytest.raises(TypeError, match=r"constraint.*\(q, args\)"):
        dvi.System(SPHERE.system.H_D, constraint=lambda q: q)


@pytest.mark.slow
def test_forces_of_constraint_are_the_tension():
    watched = {"force": dvi.ConstraintForce(), "λ": dvi.ConstraintForce(multipliers=True)}
    sol = run(SPHERE, 10, h=0.05, observe=watched, save=dvi.Save())
    q, p = sol.qs[1:], sol.ps[1:]
    tension = np.sum(p**2, axis=1) - SPHERE.args["g"] * q[:, 2]  # for unit mass and length
    assert np.ptp(tension) > 1
    assert np.max(np.abs(sol.observed["λ"][:, 0] - tension)) < 1e-13
    assert np.max(np.abs(sol.observed["force"] + q * tension[:, None])) < 1e-13
    # also in the differential equations for other solvers
    field = jax.jit(dvi.interop.vector_field(SPHERE))
    velocity, force = field(0.0, (q[-1], p[-1]), SPHERE.args)
    assert np.array_equal(velocity, p[-1])
    fall = np.array([0.0, 0.0, -SPHERE.args["g"]])
    assert np.max(np.abs(force - fall + q[-1] * tension[-1])) < 1e-13


def loss(x, adjoint):
    """A function of the end, of an angle at the start, of p and of the parameters."""
    angle, push, args = x
    q = jnp.stack([jnp.sin(angle), 0 * angle, -jnp.cos(angle)])
    p = push * jnp.stack([jnp.cos(angle), 1.0, jnp.sin(angle)])
    sol = run(SPHERE, 20, q0=q, p0=p, args=args, adjoint=adjoint)
    return jnp.sum(jnp.sin(sol.qs[-1])) + sol.ps[-1] @ jnp.array([1.0, 2.0, 3.0])


@pytest.mark.slow
@pytest.mark.parametrize(
    "adjoint",
    [dvi.Reversible(), *(pytest.param(x(), marks=slow) for x in (dvi.Direct, dvi.Checkpointed))],
)
def test_gradients_are_those_of_differences(adjoint):
    x = jnp.asarray(0.9), jnp.asarray(0.7), dict(SPHERE.args)
    both = jax.jit(jax.value_and_grad(lambda x: loss(x, adjoint)))
    found = both(x)[1]
    for change in (
        (1.0, 0.0, {"m": 0.0, "l": 0.0, "g": 0.0}),
        (0.0, 1.0, {"m": 1.0, "l": 0.0, "g": 1.0}),
    ):

        def along(s, change=change):
            return both(jax.tree.map(lambda u, v: jnp.asarray(u + s * v, float), x, change))[0]

        d = 1e-3  # of order 4: an error of 1e-12 of the value, and rounding of 1e-13
        difference = (8 * (along(d) - along(-d)) - along(2 * d) + along(-2 * d)) / (12 * d)
        slope = sum(a * b for a, b in zip(*map(jax.tree.leaves, (found, change)), strict=True))
        assert abs(slope - difference) < 1e-9 * max(1, abs(difference))


@slow
def test_states_between_steps_lie_on_the_manifold():
    sol = run(SPHERE, 20, save=dvi.Save(ts=[0.0, 0.003, 0.1, 0.2]))
    assert sol.status == "successful"
    assert np.max(np.abs(np.sum(sol.qs**2, axis=1) - 1)) < 1e-14
    assert np.array_equal(sol.qs[0], Q)


@slow
def test_runs_of_a_chain_are_compiled_and_move_as_in_angles():
    chain = systems.chain(20)

    def f(q, p):
        return run(chain, 10, q0=q, p0=p).qs[-1]

    parts = str(lanewise.explain(f, jnp.asarray(chain.q0), jnp.asarray(chain.p0)))
    assert "machine code" in parts
    assert "XLA" not in parts
    made = systems.chain(20)
    sol = run(made, 1000, h=1e-3, method=EIGHTH)
    expected = chain_in_angles(np.full(20, 0.4), 1.0, made.args)
    off = np.max(np.abs(sol.qs[-1] - expected))
    print(f"chain of 20 links, 1 s: {off:.1e}")
    assert np.max(np.abs(expected - made.q0)) > 0.3
    assert off < 1e-9


def by_dop853(rates, y0, time):
    """The end of a solution of y' = rates(y) by SciPy, with a tolerance of 1e-13."""
    found = solve_ivp(lambda t, y: rates(y), (0, time), y0, "DOP853", rtol=1e-13, atol=1e-14)
    assert found.success
    return found.y[:, -1]


def chain_in_angles(angles, time, args):
    """Angles of the links from the downward vertical, from rest: Lagrange's equations."""
    n, length, g = len(angles), args["l"], args["g"]
    below = n - np.maximum.outer(np.arange(n), np.arange(n))  # masses that two links both move

    def rates(y):
        theta, turn = y[:n], y[n:]
        apart = theta[:, None] - theta
        pull = below * np.sin(apart) @ turn**2 + np.diag(below) * g / length * np.sin(theta)
        return np.concatenate([turn, np.linalg.solve(below * np.cos(apart), -pull)])

    y = by_dop853(rates, np.concatenate([angles, np.zeros(n)]), time)
    return length * np.cumsum(np.stack([np.sin(y[:n]), -np.cos(y[:n])], axis=1), axis=0)


def violation(made):
    """max |g| of a state."""

    def largest(t, q, p, args):
        return jnp.max(jnp.abs(made.system.constraint(q, args)))

    return largest


@slow
@pytest.mark.parametrize("name", ["spherical_pendulum", "slider_crank", "dumbbell", "heavy_top"])
def test_a_million_steps_stay_on_the_manifold_without_drift(name):
    made = systems.LIBRARY[name]()
    watched = {key: made.observables[key] for key in made.invariants}
    trends = {key: dvi.Trend(f) for key, f in watched.items()}
    ranges = {key: dvi.Range(f) for key, f in watched.items()}
    largest = dvi.MaxDrift(violation(made))
    count, duration = 10**6, 10**6 * made.h
    sol = run(made, count, observe=(largest, trends, ranges))
    assert sol.status == "successful"
    q = jnp.asarray(made.q0)
    away = float(sol.observed[0] + violation(made)(0.0, q, q, made.args))
    print(f"{name}: |g| ≤ {away:.1e}", end="")
    assert away < 1e-13
    first = {key: f(0.0, 0.0, *[made.q0, made.p0] * 2, made.args) for key, f in watched.items()}
    for key in watched:
        size = np.max(np.abs(first[key]))
        slope, width = (np.max(np.abs(x[key])) for x in sol.observed[1:])
        drift = slope * duration
        print(f"; {key}: width {width / size:.1e}, drift {drift / size:.1e}", end="")
        if key == "energy":
            assert drift < 0.02 * width  # it oscillates with h²
        else:
            assert width < 1e-11 * size
    print()


@slow
def test_a_step_takes_microseconds():
    """Processor time of one thread; one trajectory, and one of a batch of 256."""
    lanewise.set_threads(1)
    try:
        for name in ("spherical_pendulum", "slider_crank", "heavy_top", "chain"):
            made = systems.LIBRARY[name]()
            q, p = (jnp.broadcast_to(x, (256, *x.shape)) for x in (made.q0, made.p0))
            batch = jax.jit(jax.vmap(lambda q, p, made=made: run(made, 200, q0=q, p0=p).qs[-1]))
            alone, together = [], []
            for _ in range(3):  # the first time with compilation
                began = time.process_time()
                jax.block_until_ready(run(made, 20_000).qs)
                middle = time.process_time()
                jax.block_until_ready(batch(q, p))
                alone.append((middle - began) / 20_000 * 1e6)
                together.append((time.process_time() - middle) / 200 / 256 * 1e6)
            print(f"{name}: {min(alone):.2f} µs per step, {min(together):.3f} µs in a batch")
            assert min(together) < min(alone) < 20
    finally:
        lanewise.set_threads(0)
