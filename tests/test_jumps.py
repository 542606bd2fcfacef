"""Jumps of the state: their points, order, statuses, and derivatives."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import central_difference

import dvi_jax as dvi
from dvi_jax import systems

FREE = dvi.System(lambda t0, t1, q, p, args: p @ p / 2)
BALL = dvi.System(lambda t0, t1, q, p, args: p @ p / 2 + q[0])
FLOOR = dvi.Jump(lambda q, p: -q[0], lambda t, q, p, r: (q, -r * p))
slow = pytest.mark.slow


def run(system, q0, p0, **options):
    given = {"h": 0.1, "num_steps": 60, "method": "strang", "throw": False, **options}
    return dvi.integrate(system, q0, p0, **given)


def drop(r, **options):
    """A ball from height 1 with coefficient of restitution r, unit gravity."""
    return run(BALL, [1.0], [0.0], **{"args": r, "jump": FLOOR, "h": 0.07, **options})


def bounces(r, count):
    """Times, and speeds before each."""
    speeds = np.sqrt(2) * r ** np.arange(count)
    return np.sqrt(2) + np.append(0, 2 * np.cumsum(speeds[1:])), speeds


def height(t, r):
    times, speeds = bounces(r, 40)
    k = np.searchsorted(times, t)
    since = t - times[np.maximum(k - 1, 0)]
    return np.where(k == 0, 1 - t**2 / 2, r * speeds[k - 1] * since - since**2 / 2)


@pytest.mark.parametrize("r", [pytest.param(1.0, marks=slow), 0.8])
def test_bounces_of_a_ball_are_those_of_the_formula(r):
    sol = drop(r, num_steps=120)
    count = int(sol.jumps.count)
    assert sol.status == "successful"
    assert count == np.sum(bounces(r, 40)[0] < 8.4)
    times, speeds = bounces(r, count)
    np.testing.assert_allclose(sol.jumps.ts[:count], times, atol=1e-13)
    np.testing.assert_allclose(sol.jumps.ps_before[:count, 0], -speeds, atol=1e-13)
    np.testing.assert_allclose(sol.jumps.ps_after[:count, 0], r * speeds, atol=1e-13)
    np.testing.assert_allclose(sol.qs[:, 0], height(np.asarray(sol.ts), r), atol=1e-13)
    assert np.isnan(sol.jumps.ts[count:]).all()
    assert (np.asarray(sol.jumps.index[count:]) == -1).all()
    # The balance: all of the loss of energy is that of the jumps.
    loss = 0.5 * np.sum(np.asarray(sol.jumps.ps_after**2 - sol.jumps.ps_before**2)[:count])
    np.testing.assert_allclose(sol.ps[-1, 0] ** 2 / 2 + sol.qs[-1, 0] - 1, loss, atol=1e-13)


def wall(axis, side, **options):
    def turned(q, p):
        return q, p.at[axis].multiply(-1)

    return dvi.Jump(lambda q, p: side * q[axis] - 1, turned, **options)


BOX = [wall(axis, side) for axis in (0, 1) for side in (1, -1)]


def in_box(q, p, h, num_steps):
    """The error of a run between four walls, and its solution."""
    q, p = np.array(q), np.array(p)
    sol = run(FREE, q, p, jump=BOX, h=h, num_steps=num_steps)
    y = (q + np.asarray(sol.ts)[:, None] * p + 1) % 4  # the motion without walls
    return np.max(np.abs(sol.qs - np.where(y < 2, y - 1, 3 - y))), sol


def test_a_box():
    """Several jumps in a step, in their order; at one time in a corner; at grid points."""
    for start in (
        ([0.1, -0.3], [1.3, 0.77], 0.7, 40),
        ([0.1, -0.3], [1.3, 0.77], -0.7, 40),
        ([0.1, -0.3], [3.9, 2.3], 1.0, 40),
        ([0.0, 0.0], [1.0, 1.0], 0.3, 40),
        ([1 / 3, 1 / 3], [0.9, 0.9], 0.3, 40),
        ([0.1, -0.1], [0.7, -0.7], 0.3, 40),
        ([0.0, 0.0], [1.0, 0.3], 0.25, 40),
    ):
        error, sol = in_box(*start)
        count = int(sol.jumps.count)
        assert sol.status == "successful"
        assert error < 1e-13
        assert count > 5
        ts, index = np.asarray(sol.jumps.ts[:count]), np.asarray(sol.jumps.index[:count])
        assert (np.diff(ts) * np.sign(start[2]) >= 0).all()
        states = np.asarray(sol.jumps.qs_before[:count])
        sides = np.where(index % 2 == 0, 1, -1)
        np.testing.assert_allclose(states[np.arange(count), index // 2], sides, atol=1e-13)
    _, sol = in_box([0.1, -0.3], [16.0, 13.0], 1.0, 4)
    assert (sol.status, int(sol.stats["failed_step"])) == ("too_many_jumps", 0)


@slow
def test_more_jumps_than_are_stored_are_counted():
    few = run(FREE, [0.0], [1.0], jump=[wall(0, 1, max_jumps=2), wall(0, -1, max_jumps=1)])
    assert few.jumps.ts.shape == (3,)
    np.testing.assert_allclose(few.jumps.ts, [1, 3, 5], atol=1e-13)
    none = run(FREE, [0.0], [1.0], jump=[wall(0, side, max_jumps=0) for side in (1, -1)])
    assert int(few.jumps.count) == int(none.jumps.count) == 3
    assert none.jumps.qs_after.shape == (0, 1)
    np.testing.assert_array_equal(none.qs, few.qs)
    hidden = run(FREE, [0.0], [1.0], jump=[wall(0, 1, max_jumps=1), wall(0, -1, max_jumps=0)])
    assert (int(hidden.jumps.count), hidden.jumps.ts.shape) == (3, (1,))


# --- statuses -------------------------------------------------------------------------------------


def test_runs_that_do_not_come_back():
    """Rest on the floor, a start below it, a map that does not turn; and too many bounces."""
    for r, q0, step in ((0.0, 1.0, 20), (-1.0, 1.0, 20), (0.8, -0.1, 0), (0.8, 0.0, 0)):
        sol = run(BALL, [q0], [0.0], args=r, jump=FLOOR, h=0.07)
        assert (sol.status, int(sol.stats["failed_step"])) == ("not_returned", step)
        assert np.isfinite(sol.qs[: step + 1]).all()
        assert np.isnan(sol.qs[step + 1 :]).all()
    assert run(BALL, [0.0], [1.0], args=0.8, jump=FLOOR, num_steps=15).status == "successful"
    sol = drop(0.5, num_steps=100)
    assert sol.status == "too_many_jumps"
    end = np.sqrt(2) * (1 + 2 * 0.5 / (1 - 0.5))  # all bounces have happened
    assert int(sol.stats["failed_step"]) == int(end / 0.07)
    with pytest.raises(dvi.IntegrationError, match="bounces of a ball"):
        drop(0.5, num_steps=100, throw=True)


@slow
def test_a_surface_that_is_touched():
    """q = sin t touches 1 from below: no jump; a little below it there are two points."""
    oscillator = dvi.System(lambda t0, t1, q, p, args: (p @ p + q @ q) / 2)

    def touch(level, h=0.1):
        kick = dvi.Jump(lambda q, p: q[0] - level, lambda q, p: (q, -p))
        return run(oscillator, [0.0], [1.0], jump=kick, h=h, num_steps=30, method="KahanLi8")

    assert int(touch(1.001).jumps.count) == 0
    sol = touch(0.999)
    np.testing.assert_allclose(sol.jumps.ts[0], np.arcsin(0.999), atol=1e-9)
    np.testing.assert_allclose(sol.qs[-1, 0], np.sin(2 * np.arcsin(0.999) - 3.0), atol=1e-8)


def test_short_parts_beyond_a_surface():
    """g of a disc is positive within a step only: found by dg/dt at its ends."""

    def turned(q, p):
        normal = q / jnp.sqrt(q @ q)
        return q, p - 2 * (p @ normal) * normal

    disc = dvi.Jump(lambda q, p: 0.25 - q @ q, turned)
    impact = jnp.linspace(0.005, 0.525, 53)

    def one(b):
        return run(FREE, jnp.stack([-2.0, b]), jnp.array([1.0, 0.0]), jump=disc, h=0.9, num_steps=5)

    sol = jax.jit(jax.vmap(one))(impact)
    b = np.asarray(impact)[np.asarray(impact) < 0.5]
    np.testing.assert_array_equal(sol.jumps.count, impact < 0.5)
    np.testing.assert_allclose(sol.jumps.ts[: len(b), 0], 2 - np.sqrt(0.25 - b**2), atol=1e-14)
    assert set(sol.status) == {"successful"}


@slow
def test_an_event_or_a_map_that_is_nan():
    g = dvi.Jump(lambda q, p: jnp.sqrt(0.5 - q[0]) - 1, lambda q, p: (q, p), returns=False)
    sol = run(FREE, [0.0], [1.0], jump=g, num_steps=10)
    assert (sol.status, int(sol.stats["failed_step"])) == ("event_not_finite", 5)
    g = dvi.Jump(lambda q, p: q[0] - 0.45, lambda q, p: (q / 0, p))
    sol = run(FREE, [0.0], [1.0], jump=g, num_steps=10)
    assert (sol.status, int(sol.stats["failed_step"])) == ("not_finite", 4)


# --- kicks, stages, stops -------------------------------------------------------------------------


@pytest.mark.parametrize("h", [*(pytest.param(h, marks=slow) for h in (0.1, 0.3, 0.37)), 0.25])
def test_a_kick_happens_once(h):
    """Also where its time is a grid point up to rounding."""
    kick = dvi.Jump(lambda t, q, p, args: t - 1.5, lambda q, p: (q, p + 1), returns=False)
    sol = run(FREE, [0.0], [1.0], jump=kick, h=h, num_steps=20)
    assert int(sol.jumps.count) == 1
    np.testing.assert_allclose(sol.jumps.ts[0], 1.5, rtol=1e-15)
    np.testing.assert_allclose(sol.qs[-1, 0], 20 * h + 20 * h - 1.5, rtol=1e-14)
    wrong = dvi.Jump(kick.g, kick.map)  # the default refuses a surface that is passed
    assert run(FREE, [0.0], [1.0], jump=wrong, h=h, num_steps=20).status == "not_returned"


@slow
def test_stages_of_a_rocket():
    """Constant thrust F; at q = 1 half of the mass is dropped at the same velocity."""
    rocket = dvi.System(lambda t0, t1, q, p, a: p @ p / (2 * a["m"]) - a["F"] * q[0])

    def drop_stage(t, q, p, a):
        return q, p / 2, {**a, "m": a["m"] / 2}

    stage = dvi.Jump(lambda q, p: q[0] - 1, drop_stage, returns=False)
    given = {"jump": stage, "args": {"m": 1.0, "F": 0.5}}
    speed = lambda t, q, p, a: p[0] / a["m"]  # noqa: E731
    sol = run(rocket, [0.0], [0.0], num_steps=30, observe=speed, **given)
    np.testing.assert_allclose(sol.jumps.ts[0], 2.0, rtol=1e-14)
    np.testing.assert_allclose(sol.qs[-1, 0], 1 + 1 + 0.5, rtol=1e-13)
    np.testing.assert_allclose(np.asarray(sol.observed)[[20, -1]], [1.0, 2.0], rtol=1e-13)
    fast = dvi.Stop(lambda t, q, p, a: speed(t, q, p, a) - 1.5)
    sol = run(rocket, [0.0], [0.0], stop=fast, **given)
    np.testing.assert_allclose(sol.stop.t, 2.5, rtol=1e-13)
    with pytest.raises(ValueError, match="changes args"):
        run(rocket, [0.0], [0.0], observe=dvi.Section(lambda q, p: q[0]), **given)


@slow
def test_a_merger_conserves_momentum():
    """Two bodies with masses (1, 3) in args, which become one."""
    system = dvi.System(lambda t0, t1, q, p, m: jnp.sum(p**2 / m) / 2)

    def merge(t, q, p, m):
        total = jnp.sum(m)
        return jnp.full(2, m @ q / total), m * jnp.sum(p) / total

    close = dvi.Jump(lambda q, p: 0.1 - jnp.abs(q[0] - q[1]), merge, returns=False)
    sol = run(system, [0.0, 1.0], [2.0, -1.0], args=jnp.array([1.0, 3.0]), jump=close)
    np.testing.assert_allclose(sol.jumps.ts[0], 0.9 / (2 + 1 / 3), rtol=1e-14)
    np.testing.assert_allclose(jnp.sum(sol.ps, axis=1), 1.0, rtol=1e-14)
    np.testing.assert_allclose(sol.qs[-1, 0], sol.qs[-1, 1], rtol=1e-15)


@slow
@pytest.mark.parametrize("h", [0.3, 0.07])
def test_points_between_the_steps(h):
    """Requested times, sections and stops with jumps in the same steps."""
    ts = np.linspace(0, 4, 57)[1:-1]
    sections = {
        "low": dvi.Section(lambda q, p: q[0] - 0.3, 0),
        "top": dvi.Section(lambda q, p: p[0], 0),
    }
    run_of = functools.partial(drop, 0.8, h=h, num_steps=round(4.2 / h))
    sol = run_of(save=dvi.Save(ts=ts), observe=sections)
    np.testing.assert_allclose(sol.qs[:, 0], height(ts, 0.8), atol=1e-13)
    low, top = sol.observed["low"], sol.observed["top"]
    # The turn of the velocity at a bounce is no crossing of p = 0.
    assert (int(low.count), int(top.count)) == (4, 1)
    np.testing.assert_allclose(height(np.asarray(low.ts[:4]), 0.8), 0.3, atol=1e-13)
    np.testing.assert_allclose(top.ts[0], np.sqrt(2) * 1.8, atol=1e-13)
    for g, t, jumps in (
        (lambda t, q, p, args: 0.02 - q[0], np.sqrt(1.96), 0),  # in the part before a jump
        (lambda t, q, p, args: p[0] - 0.9, np.sqrt(2), 1),  # by the jump
        (lambda t, q, p, args: t - 1.43, 1.43, 1),  # in the part after it
    ):
        sol = run_of(stop=dvi.Stop(g))
        assert (sol.status, int(sol.jumps.count)) == ("stopped", jumps)
        np.testing.assert_allclose(sol.stop.t, t, rtol=1e-13)
        np.testing.assert_allclose(sol.stop.q[0], height(sol.stop.t, 0.8), atol=1e-13)


@slow
def test_fictitious_time_and_given_times():
    slow_low = dvi.TimeTransformed(lambda q, p: 0.3 + jnp.abs(q[0]))
    sol = drop(0.8, lattice=slow_low, method="GaussLegendre2", h=0.05, num_steps=120)
    times, _ = bounces(0.8, 2)
    np.testing.assert_allclose(sol.jumps.ts[:2], times, atol=1e-7)
    np.testing.assert_allclose(sol.qs[:, 0], height(np.asarray(sol.ts), 0.8), atol=1e-6)
    ts = np.cumsum(np.linspace(0.01, 0.1, 60))
    sol = run(
        BALL,
        [1.0],
        [0.0],
        args=0.8,
        jump=FLOOR,
        lattice=dvi.Given(ts - ts[0]),
        h=None,
        num_steps=None,
    )
    np.testing.assert_allclose(sol.qs[:, 0], height(np.asarray(sol.ts), 0.8), atol=1e-13)


def test_a_trajectory_in_a_batch_has_the_bits_that_it_has_alone():
    """One of them ends with a status, which the others do not see."""
    heights = jnp.linspace(0.2, 2.0, 5)
    one = jax.jit(lambda q: run(BALL, q[None], jnp.zeros(1), args=0.7, jump=FLOOR, num_steps=40))
    batch = jax.jit(jax.vmap(one))(heights)
    assert set(batch.status) == {"successful", "too_many_jumps"}
    for i, q in enumerate(heights):
        alone = one(q)
        for name in ("qs", "ps", "jumps"):
            pairs = zip(
                *map(jax.tree.leaves, (getattr(alone, name), getattr(batch, name))), strict=True
            )
            for x, y in pairs:
                np.testing.assert_array_equal(x, y[i])


def test_what_jumps_are_refused_with():
    step = lambda t0, t1, q0, p0, q1, p1, args: q1[0] - q0[0]  # noqa: E731
    for error, text, options in (
        (ValueError, "FloatingPoint", {"arithmetic": dvi.Compensated()}),
        (ValueError, "those before", {"lattice": dvi.AdaptiveReversible(lambda q, p: 1.0)}),
        (ValueError, "of a step", {"observe": step}),
        (ValueError, "of a step", {"observe": dvi.Range(step)}),
        (ValueError, "shape", {"jump": dvi.Jump(FLOOR.g, lambda q, p: (q, jnp.zeros(2)))}),
        (ValueError, "number of values", {"jump": dvi.Jump(FLOOR.g, lambda q, p: (q,))}),
        (TypeError, "must be a function with a tuple", {"jump": dvi.Jump(FLOOR.g, lambda q, p: q)}),
        (TypeError, "jump must be", {"jump": FLOOR.g}),
        (ValueError, "shapes of args", {"jump": dvi.Jump(FLOOR.g, lambda t, q, p, a: (q, p, [a]))}),
    ):
        with pytest.raises(error, match=text):
            drop(0.8, **options)


# --- derivatives ----------------------------------------------------------------------------------


def final(height, r, adjoint, num_steps=60):
    """A number from the last state, the time and the state of the second bounce."""
    sol = run(
        BALL, height[None], jnp.zeros(1), args=r, jump=FLOOR, adjoint=adjoint, num_steps=num_steps,
        save=dvi.Save(final=True),
    )  # fmt: skip
    jumps = sol.jumps
    return sol.qs[-1, 0] + 2 * sol.ps[-1, 0] + 3 * jumps.ts[1] - jumps.ps_after[1, 0]


def formula(height, r, end=6.0):
    """The same after three bounces."""
    first = jnp.sqrt(2 * height)
    t = first * (1 + 2 * r + 2 * r**2)
    v, since = first * r**3, end - t
    value = v * since - since**2 / 2 + 2 * (v - since)
    return value + 3 * first * (1 + 2 * r) - first * r**2


def without_saltation(height, r):
    """The control: the derivative where the times of the bounces are constants."""
    first = jax.lax.stop_gradient(jnp.sqrt(2 * height))
    q, p, left = height - first**2 / 2, -first, 6.0
    left = left - first
    for _ in range(2):
        flight = jax.lax.stop_gradient(-2 * r * p)
        q, p = q - r * p * flight - flight**2 / 2, -r * p - flight
        left = left - flight
    return q - r * p * left - left**2 / 2


@slow
@pytest.mark.parametrize("adjoint", [dvi.Direct(), dvi.Checkpointed(), dvi.Reversible()], ids=str)
def test_gradients_contain_the_change_of_the_times(adjoint):
    point = jnp.array(1.0), jnp.array(0.8)
    function = jax.jit(functools.partial(final, adjoint=adjoint))
    np.testing.assert_allclose(function(*point), formula(*point), rtol=1e-12)
    exact = jax.grad(formula, (0, 1))(*point)
    np.testing.assert_allclose(jax.jit(jax.grad(function, (0, 1)))(*point), exact, rtol=1e-10)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(function, (0, 1)))(*point), exact, rtol=1e-10)
    moved = central_difference(lambda r: function(point[0], r), 0.8, 1.0)
    np.testing.assert_allclose(moved, exact[1], rtol=1e-8)
    wrong = jax.grad(without_saltation, 1)(*point)
    right = jax.grad(lambda h, r: formula(h, r) - 0, 1)(*point)
    assert abs(wrong - right) > 0.1


@slow
def test_gradients_of_a_batch_in_which_one_fails():
    heights = jnp.array([1.0, 0.01, 1.3])

    def loss(r):
        def one(q):
            return run(BALL, q[None], jnp.zeros(1), args=r, jump=FLOOR, num_steps=40,
                       save=dvi.Save(final=True), adjoint=dvi.Checkpointed())  # fmt: skip

        sol = jax.vmap(one)(heights)
        good = sol.result == dvi.RESULTS.successful
        times = sol.jumps.ts[:, 0]  # also of the trajectory that fails later
        return jnp.sum(jnp.where(good, sol.qs[:, -1, 0], 0.0)) + jnp.sum(times * r), good

    _, good = jax.jit(loss)(0.7)
    assert np.asarray(good).tolist() == [True, False, True]
    slope = jax.jit(jax.grad(lambda r: loss(r)[0]))(0.7)
    np.testing.assert_allclose(slope, central_difference(lambda r: loss(r)[0], 0.7, 1.0), rtol=1e-8)


@slow
def test_deviation_vectors_contain_the_change_of_the_times():
    """The tangent map of a run is the derivative of its last state, that of the formula."""
    sol = drop(0.8, observe=dvi.TangentMap(), num_steps=30)

    def last(q, p):
        fall = p + jnp.sqrt(p**2 + 2 * q)  # the time of the first bounce
        v, since = -0.8 * (p - fall), 2.1 - fall
        return jnp.stack([v * since - since**2 / 2, v - since])

    exact = jnp.stack(jax.jacobian(last, (0, 1))(1.0, 0.0), axis=1)
    np.testing.assert_allclose(sol.observed, exact, atol=1e-12)
    assert abs(np.linalg.det(exact) - 0.64) < 1e-12  # r²: one factor r by p, one by the saltation


# --- systems of the library -----------------------------------------------------------------------


def growth(jumps, count, focus):
    """Σ ln |stretching| of a displacement and an angle along the recorded reflections: a free
    flight adds angle × time to the displacement, a wall changes the angle by `focus`."""
    shift, angle, t, total = 1.0, 0.3, 0.0, 0.0
    rows = (jumps.ts, jumps.index, jumps.qs_before, jumps.ps_before)
    for time, i, q, p in zip(*(np.asarray(x[:count]) for x in rows), strict=True):
        shift += angle * (time - t)
        angle += focus(i, q, p) * shift
        size, t = np.hypot(shift, angle), time
        total += np.log(size)
        shift, angle = shift / size, angle / size
    return total / t


def at_disc(i, q, p):
    return 2 / -(q @ p) if i == 0 else 0.0  # 2/(R cos φ)


def at_caps(i, q, p):
    return -2 / (p @ (q - [np.sign(q[0]), 0])) if abs(q[0]) > 1 else 0.0


@slow
@pytest.mark.parametrize(("name", "focus"), [("sinai_billiard", at_disc), ("stadium", at_caps)])
def test_lyapunov_exponents_of_billiards_are_those_of_their_geometry(name, focus):
    """Sinai's formula, with curvatures by hand; the control has no curvature at the walls."""
    made = getattr(systems, name)(max_jumps=10_000)
    observe = dvi.LyapunovSpectrum(4)
    sol = dvi.integrate(made, num_steps=10_000, observe=observe, save=dvi.Save(final=True))
    count = int(sol.jumps.count)
    first = growth(sol.jumps, count, focus)
    np.testing.assert_allclose(sol.observed[0], first, atol=1e-3)
    np.testing.assert_allclose(sol.observed[:2], -sol.observed[::-1][:2], atol=1e-3)
    assert abs(sol.observed[0] - growth(sol.jumps, count, lambda *_: 0.0)) > 0.3
    np.testing.assert_allclose(np.sum(np.asarray(sol.p_final) ** 2), 1.0, rtol=1e-11)
    # Within the table: no reflection was missed.
    assert np.max(np.abs(sol.jumps.qs_before[:count])) < 2 + 1e-12


@slow
def test_sinais_billiard_with_a_small_disc():
    """Dahlqvist's exponent of the map from disc to disc, −2 ln R + C + O(R ln²R) for a disc of the
    radius R in a unit square (arXiv:chao-dyn/9601007), by the mean time between reflections."""
    radius, random = 0.05, np.random.default_rng(1)
    table = systems.sinai_billiard(radius, max_jumps=0)
    q, angle = random.uniform(0.1, 1, (64, 2)), random.uniform(0, 2 * np.pi, 64)
    p = np.stack([np.cos(angle), np.sin(angle)], axis=1)

    def exponent(q, p):
        options = {"observe": dvi.LyapunovSpectrum(1), "save": dvi.Save(final=True)}
        return dvi.integrate(table, q, p, h=2.0, num_steps=20_000, **options).observed[0]

    between = (4 - np.pi * radius**2) / (2 * radius)  # π × area / boundary of the disc
    values = between * np.asarray(jax.jit(jax.vmap(exponent))(q, p))
    zeta = 1.2020569031595942  # ζ(3)
    limit = -2 * np.log(radius / 2) + 1 - 4 * np.log(2) + 27 * zeta / (2 * np.pi**2)
    error = np.std(values) / 8
    assert error < 0.06
    assert abs(np.mean(values) - limit) < 3 * error


def test_a_problem_with_jumps_is_run_with_them_or_refused():
    ball = systems.bouncing_ball(0.8)
    sol = dvi.integrate(ball, num_steps=60, method="strang")
    np.testing.assert_allclose(sol.jumps.ts[:3], bounces(0.8, 3)[0], atol=1e-13)
    assert dvi.integrate(ball, num_steps=60, method="strang", jump=[]).jumps is None
    for call in (
        lambda: dvi.explore(ball),
        lambda: dvi.interop.solve_ivp(ball, (0, 1), [1.0, 0.0], h=0.1),
    ):
        with pytest.raises(ValueError, match=r"only dvi\.integrate and dvi\.sweep make"):
            call()


def test_jumps_in_labelled_results_and_sweeps():
    """Those of single runs; a sweep has the states of jumps where it saves states."""
    rs, ball = jnp.array([0.5, 0.8, 0.9]), systems.bouncing_ball()
    options = {"h": 0.07, "num_steps": 60, "method": "strang"}

    def one(r):
        return drop(r, stop=dvi.Stop(lambda q, p: q[0] - 2), num_steps=60)

    sols = jax.vmap(one)(rs)
    data = sols.to_xarray(dims="r", components=["height"], units={"q": "m", "t": "s"})
    assert data["jumps.qs_after"].dims == ("r", "jumps_dim", "component")
    assert data["jumps.ts"].dims == ("r", "jumps_dim")
    assert data["jumps.count"].dims == ("r",)
    units = [data[f"jumps.{x}"].attrs["units"] for x in ("ts", "qs_before", "qs_after")]
    assert units == ["s", "m", "m"]
    single = sols.jumps.ts[1], jax.tree.map(lambda x: x[1], sols).to_xarray()["jumps.ts"]
    np.testing.assert_array_equal(*single)
    assert "jumps.ts" not in drop(0.8, jump=None).to_xarray()
    axis = {"args": {**ball.args, "restitution": dvi.Axis("r", np.asarray(rs))}, **options}
    observe = {"x": dvi.Last(lambda q, p: q)}
    full = dvi.sweep(ball, save=dvi.Save(every=20), **axis).to_xarray()
    for name, values in vars(sols.jumps).items():
        np.testing.assert_allclose(full[f"jumps.{name}"], values, rtol=1e-13)
    assert full["jumps.qs_after"].dims == ("r", "jumps_dim", "component")
    few = dvi.sweep(ball.system, ball.q0, ball.p0, jump=list(ball.jumps), observe=observe, **axis)
    few = few.to_xarray()
    assert [x for x in few if x.startswith("jumps")] == ["jumps.count"]
    np.testing.assert_array_equal(few["jumps.count"], sols.jumps.count)
    falls = dvi.sweep(ball, jump=[], observe=observe, **axis).to_xarray()
    assert "jumps.count" not in falls
    assert (falls.x < -7).all()
    with pytest.raises(ValueError, match="reserved name"):
        dvi.sweep(ball, observe={"jumps": observe["x"]}, **axis)


def test_sections_and_tangent_maps_with_jumps():
    """Crossings of the middle of a stadium are on the chords between reflections."""
    table = systems.stadium()
    q0, p0 = np.asarray(table.q0), np.asarray(table.p0)
    steps = {"h": 0.5, "num_steps": 100, "jump": table.jumps, "args": table.args}
    middle = lambda t, q, p, args: q[0]  # noqa: E731
    found = dvi.poincare_section(table.system, q0[None], p0[None], middle, crossings=5, **steps)
    jumps = dvi.integrate(table, h=0.5, num_steps=100).jumps
    ends, speeds = np.asarray(jumps.qs_before), np.asarray(jumps.ps_before)
    heights, begin = [], q0
    for end, v in zip(ends[: int(jumps.count)], speeds, strict=False):
        if begin[0] < 0 < end[0]:
            heights.append(end[1] - v[1] / v[0] * end[0])
        begin = end
    np.testing.assert_allclose(found.qs[0, :, 1], heights[:5], atol=1e-12)
    back = dvi.ReturnMap(table.system, middle, 0.5, 50, jump=table.jumps)
    end = back(found.qs[0, 0], found.ps[0, 0], args=table.args)
    np.testing.assert_allclose(end.q, found.qs[0, 1], atol=1e-12)
    run_of = {"h": 0.07, "num_steps": 30, "method": "strang", "args": 0.8, "jump": FLOOR}
    M = dvi.tangent_map(BALL, [1.0], [0.0], **run_of)
    assert abs(np.linalg.det(M) - 0.8**2) < 1e-12


@slow
def test_a_solution_with_jumps_in_a_file(tmp_path):
    sol = drop(0.8)
    sol.save(tmp_path / "run.npz")
    same = dvi.Solution.load(tmp_path / "run.npz")
    for x, y in zip(*map(jax.tree.leaves, (sol.jumps, same.jumps)), strict=True):
        np.testing.assert_array_equal(x, y)


@slow
def test_single_precision_and_arrays_and_pieces():
    """A state in float32, XLA's loops, a run with progress reports."""
    sol = drop(0.8)
    ball = jnp.ones(1, jnp.float32), jnp.zeros(1, jnp.float32)
    single = run(BALL, *ball, args=0.8, jump=FLOOR)
    assert single.jumps.qs_after.dtype == single.qs.dtype == jnp.float32
    np.testing.assert_allclose(single.jumps.ts[:2], bounces(0.8, 2)[0], rtol=1e-6)
    arrays = drop(0.8, layout=dvi.Layout(form="arrays"))
    np.testing.assert_allclose(arrays.qs, sol.qs, atol=1e-14)
    pieces = drop(0.8, progress=lambda *steps: None)
    for x, y in zip(*map(jax.tree.leaves, (sol.jumps, pieces.jumps)), strict=True):
        np.testing.assert_array_equal(x, y)
