"""States within a step with noise: requested times, sections and stops, on one Brownian path.

Variances are compared within three standard errors. The seeds are fixed.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import gradient_by_differences
from scipy import stats

import dvi_jax as dvi

slow = pytest.mark.slow
WORDS = jax.random.key_data(jax.random.key(0))
STEP = dvi.Interval(*map(jnp.asarray, (1.4, 2.1, 0.7)))


def within(path, fractions, parts=1, count=20_000):
    """Increments and areas of the first parts of step 2, of many motions."""
    part = jax.jit(lambda x: path.part(jnp.int32(2), STEP, x, parts, count))
    return [np.stack(part(jnp.asarray(x))) for x in fractions]


def check_product(a, b, mean):
    product = a * b
    assert abs(product.mean() - mean) < 3 * product.std() / np.sqrt(product.size)


@pytest.mark.parametrize("substeps", [1, pytest.param(3, marks=slow)])
def test_a_brownian_bridge_has_its_covariance(substeps):
    """⟨B(s) B(t)⟩ = min(s, t); given the end of the step the mean is B t/h, and the variance
    t (h − t)/h. The area has the variance t/12 and no covariance with the increment."""
    h, fractions = 0.7, (0.05, 0.4, 0.41, 0.9)
    path = dvi.Brownian(WORDS, substeps)
    dB = np.asarray(path.increments(jnp.int32(2), STEP, 1, 20_000)[0])
    points = within(path, fractions)
    for i, (x, (B, area)) in enumerate(zip(fractions, points, strict=True)):
        for y, (other, _) in zip(fractions[i:], points[i:], strict=True):
            check_product(B[0], other[0], x * h)
            assert y >= x
        bridge = B[0] - x * dB
        check_product(bridge, bridge, x * (1 - x) * h)
        check_product(bridge, dB, 0.0)
        check_product(area[0], area[0], x * h / 12)
        check_product(area[0], B[0], 0.0)
        # A straight line in place of the bridge has the variance x² h.
        line = (x * dB) ** 2
        assert abs(line.mean() - x * h) > 3 * line.std() / np.sqrt(line.size)
    assert stats.kstest(points[1][0][0] / np.sqrt(0.4 * h), stats.norm.cdf).pvalue > 0.003


@slow
def test_the_two_increments_of_a_part_are_those_of_one_path():
    whole = within(dvi.Brownian(WORDS, 2), (0.3, 0.6), count=50)
    halves = within(dvi.Brownian(WORDS, 1), (0.6,), parts=2, count=50)
    # Equal numbers of the substeps: the path of OBABO is that of BAOAB with two substeps.
    np.testing.assert_allclose(halves[0][0][0], whole[0][0][0], atol=1e-12)
    np.testing.assert_allclose(halves[0][0].sum(0), whole[1][0][0], atol=1e-12)
    np.testing.assert_allclose(halves[0][1][0], whole[0][1][0], atol=1e-12)


FREE = dvi.System(lambda t0, t1, q0, p1, args: 0.0 * p1[0], noise=lambda t, q, p, args: 0 * q + 1)
METHODS = [dvi.BAOAB(), dvi.OBABO(), dvi.StrongSplitting(), dvi.StochasticEuler(),
           dvi.StochasticMidpoint()]  # fmt: skip


def path_at(ts, method=dvi.BAOAB(), path=3, h=0.5, num_steps=4):
    """B at these times, from a run."""
    save = dvi.Save() if ts is None else dvi.Save(ts=ts)
    run = {"h": h, "num_steps": num_steps, "method": method, "path": path}
    return np.asarray(dvi.integrate(FREE, [0.0], [0.0], save=save, **run).ps[:, 0])


@slow
@pytest.mark.parametrize("method", METHODS)
def test_requested_times_are_points_of_one_path(method):
    grid, ts = path_at(None, method), [0.0, 0.2, 0.2, 0.5, 0.9, 1.5, 2.0]
    B = path_at(ts, method)
    np.testing.assert_allclose(B[[0, 3, 5, 6]], grid[[0, 1, 3, 4]], atol=1e-15)
    assert B[1] == B[2]
    # The same number if it is requested with others, on a finer grid of requests.
    assert path_at([0.1, 0.2, 0.3], method)[1] == B[1]
    assert abs(B[1] - 0.4 * grid[1]) > 0.01  # no interpolation


def test_substeps_are_points_of_the_path():
    """A point at the end of a substep is the state of a run with smaller steps."""
    fine = path_at(None, path=3, h=0.125, num_steps=16)
    coarse = path_at([0.125, 0.25, 0.375, 0.625], path=dvi.Brownian(3, 4))
    np.testing.assert_allclose(coarse, fine[[1, 2, 3, 5]], atol=1e-12)


BATH = dvi.System(lambda t0, t1, q0, p1, args: p1 @ p1 / 2,
                  noise=dvi.Langevin(lambda args: args["g"], lambda args: args["T"]))  # fmt: skip
WELL = dvi.System(lambda t0, t1, q0, p1, args: p1 @ p1 / 2 + args["k"] * jnp.sum(q0**4) / 4,
                  noise=BATH.noise)  # fmt: skip
ARGS = {"k": 1.1, "g": 0.8, "T": 0.5}


@slow
def test_the_distribution_at_a_requested_time():
    """A free particle: p(t) is normal with the mean p0 e^{−γt} and the variance T(1 − e^{−2γt})."""

    def at(key):
        sol = dvi.integrate(BATH, [0.0], [1.0], h=0.9, num_steps=2, args=ARGS, method=dvi.BAOAB(),
                            path=dvi.Brownian(key), save=dvi.Save(ts=[0.3, 1.3]))  # fmt: skip
        return sol.ps[:, 0]

    p = np.asarray(jax.vmap(at)(jax.random.split(jax.random.key(1), 20_000)))
    for i, t in enumerate((0.3, 1.3)):
        decay = np.exp(-0.8 * t)
        scaled = (p[:, i] - decay) / np.sqrt(0.5 * (1 - decay**2))
        assert stats.kstest(scaled, stats.norm.cdf).pvalue > 0.003
        assert stats.kstest(1.1 * scaled, stats.norm.cdf).pvalue < 1e-5


WALL = {"wall": dvi.Section(lambda q, p: q[0], direction=0, max_crossings=20)}


def run(args, path=3, method=dvi.BAOAB(), **more):
    options = {"h": 0.2, "num_steps": 100, "path": path, "method": method, **more}
    return dvi.integrate(WELL, [1.0], [0.2], args=args, **options)


@slow
@pytest.mark.parametrize("method", [METHODS[0], METHODS[2]])
def test_crossings_and_the_end_by_a_stop_are_states_at_their_times(method):
    grid = run(ARGS, method=method)
    plain = run(ARGS, method=method, observe=WALL, stop=dvi.Stop(lambda t, q, p, args: t - 15.1))
    crossed = plain.observed["wall"]
    n = int(crossed.count)
    signs = np.sign(grid.qs[:76, 0])
    assert n == np.sum(signs[1:] != signs[:-1]) > 2
    assert np.abs(crossed.qs[:n]).max() < 1e-11
    np.testing.assert_array_equal(plain.qs[:76], grid.qs[:76])
    assert float(plain.stop.t) == pytest.approx(15.1, abs=1e-12)
    # The points are those of the same path at these times.
    ts = np.concatenate([crossed.ts[:n], plain.stop.t[None]])
    found = run(ARGS, method=method, save=dvi.Save(ts=ts))
    np.testing.assert_allclose(found.ps[:-1], crossed.ps[:n], atol=1e-8)
    np.testing.assert_allclose(found.qs[-1], plain.stop.q, atol=1e-8)
    assert np.abs(run(ARGS, 4, method, save=dvi.Save(ts=ts)).ps[:-1] - crossed.ps[:n]).max() > 0.1


@slow
def test_a_batch_has_the_same_points():
    keys = jax.random.split(jax.random.key(2), 20)

    def points(key):
        return run(ARGS, dvi.Brownian(key), save=dvi.Save(ts=[0.05, 1.3, 7.77])).ps

    np.testing.assert_array_equal(jax.jit(jax.vmap(points))(keys)[7], points(keys[7]))


@slow
def test_gradients_at_requested_times_are_those_of_differences():
    def loss(v, adjoint):
        args = {"k": v[0], "g": v[1], "T": v[2]}
        sol = run(args, num_steps=20, adjoint=adjoint, save=dvi.Save(ts=[0.05, 1.3, 2.77]))
        return jnp.sum(sol.qs * jnp.cos(sol.ps))

    v = jnp.array([1.1, 0.8, 0.5])
    slopes = jax.jit(jax.grad(lambda v: loss(v, dvi.Reversible(checkpoint_every=5))))(v)
    differences = gradient_by_differences(jax.jit(lambda v: loss(v, dvi.Direct())), v)
    np.testing.assert_allclose(slopes, differences, rtol=1e-7)


@slow
def test_the_time_of_a_crossing_has_no_derivative():
    """The gradient is NaN if a loss uses a point at a random time, and is not changed otherwise."""

    def loss(k, uses):
        sol = run({**ARGS, "k": k}, num_steps=40, observe=WALL)
        crossed = sol.observed["wall"]
        return jnp.sum(sol.qs) + (crossed.ts[0] if uses else 0.0)

    def plain(k):
        return jnp.sum(run({**ARGS, "k": k}, num_steps=40).qs)

    assert np.isnan(jax.grad(loss)(1.1, True))
    assert float(jax.grad(loss)(1.1, False)) == pytest.approx(float(jax.grad(plain)(1.1)), rel=1e-9)
    assert np.isnan(jax.jvp(lambda k: loss(k, True), (1.1,), (1.0,))[1])


@slow
def test_points_on_a_constraint():
    sphere = dvi.System(lambda t0, t1, q0, p1, args: p1 @ p1 / 2 + q0[2],
                        noise=dvi.Langevin(1.0, 0.5),
                        constraint=lambda q, args: (q @ q - 1)[None] / 2)  # fmt: skip
    start = [0.6, 0.0, -0.8], [0.4, 0.5, 0.3]
    options = {"h": 0.1, "num_steps": 20, "path": 2, "method": dvi.BAOAB()}
    ts = np.array([0.05, 0.1, 0.77, 1.99])
    sol = dvi.integrate(sphere, *start, save=dvi.Save(ts=ts), **options)
    assert np.abs(np.sum(sol.qs**2, axis=1) - 1).max() < 1e-14
    assert np.abs(np.sum(sol.qs * sol.ps, axis=1)).max() < 1e-14
    grid = dvi.integrate(sphere, *start, **options)
    np.testing.assert_allclose(sol.qs[1], grid.qs[1], atol=1e-14)


class Line(dvi.BrownianPath):
    """No Brownian path: B = t."""

    def increments(self, k, interval, parts, count):
        return jnp.full((parts, count), interval.h / parts)


class LineInside(Line):
    def part(self, k, interval, fraction, parts, count):
        increments = jnp.full((parts, count), fraction * interval.h / parts)
        return increments, 0 * increments


def test_a_path_of_a_user_needs_its_parts():
    ts = [0.3, 0.8]
    for more in (
        {"save": dvi.Save(ts=ts)},
        {"observe": WALL},
        {"stop": dvi.Stop(lambda q, p: q[0])},
    ):
        with pytest.raises(ValueError, match=r"Line\(\) cannot be used with dvi.Save.*part"):
            run(ARGS, Line(), **more)
    np.testing.assert_allclose(path_at(ts, path=LineInside()), ts, atol=1e-14)
