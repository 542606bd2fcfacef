"""The library's systems against equations by hand, and what each of them keeps."""

import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import symplectic_defect
from scipy.integrate import solve_ivp

import dvi_jax as dvi
from dvi_jax import systems
from dvi_jax.run import run_file
from dvi_jax.systems.figure_eight import PERIOD
from dvi_jax.systems.fput import frequencies
from dvi_jax.systems.henon_heiles import ESCAPE_ENERGY
from dvi_jax.systems.magnetic_mirror import magnetic_field, vector_potential
from dvi_jax.systems.toda import lax_matrix, lax_traces

# The equations by hand, in NumPy: functions (t, q, p) → (∂H/∂q, ∂H/∂p)


def henon_heiles(t, q, p):
    x, y = q
    return np.array([x + 2 * x * y, y + x * x - y * y]), p


def toda(t, q, p):
    n = len(q)
    pull = [np.exp(q[i] - q[(i + 1) % n]) for i in range(n)]
    return np.array([pull[i] - pull[i - 1] for i in range(n)]), p


ALPHA, BETA = 0.25, 0.3


def fput(t, q, p):
    d = np.diff([0.0, *q, 0.0])
    tension = d + ALPHA * d**2 + BETA * d**3
    return tension[:-1] - tension[1:], p


OMEGA = 50.0


def stiff_fput(t, q, p):
    (x, y), m = q, q.shape[1]
    fall = np.zeros_like(q)
    fall[1] = OMEGA**2 * y
    for i in range(m + 1):
        right = x[i] - y[i] if i < m else 0.0
        left = x[i - 1] + y[i - 1] if i > 0 else 0.0
        cube = (right - left) ** 3
        if i < m:
            fall[0, i] += cube
            fall[1, i] -= cube
        if i > 0:
            fall[0, i - 1] -= cube
            fall[1, i - 1] -= cube
    return fall, p


EPSILON = 0.3


def perturbed_pendulum(t, q, p):
    return np.sin(q) - EPSILON * p * np.sin(t), p - EPSILON * q * np.sin(t)


MIRROR = {"charge": 1.3, "mass": 0.7, "B0": 1.1, "length": 15.0}


def magnetic_mirror(t, q, p):
    e, m, B0, length = MIRROR.values()
    x, y, z = q
    g, slope = B0 / 2 * (1 + z**2 / length**2), B0 * z / length**2
    v = (p - e * g * np.array([-y, x, 0.0])) / m
    return -e * np.array([g * v[1], -g * v[0], slope * (x * v[1] - y * v[0])]), v


def figure_eight(t, q, p):
    fall = np.zeros_like(q)
    for i in range(3):
        for j in range(3):
            if i != j:
                fall[i] += (q[i] - q[j]) / np.linalg.norm(q[i] - q[j]) ** 3
    return fall, p


CASES = {
    "henon_heiles": (systems.henon_heiles(), henon_heiles, 0.0),
    "toda": (systems.toda(), toda, 0.0),
    "fput": (systems.fput(12, ALPHA, BETA), fput, 0.0),
    "stiff_fput": (systems.stiff_fput(omega=OMEGA), stiff_fput, 0.0),
    "perturbed_pendulum": (systems.perturbed_pendulum(), perturbed_pendulum, EPSILON),
    "magnetic_mirror": (systems.magnetic_mirror(), magnetic_mirror, 0.0),
    "figure_eight": (systems.figure_eight(), figure_eight, 0.0),
}
ARGS = {name: problem.args for name, (problem, *_) in CASES.items()} | {"magnetic_mirror": MIRROR}


# Two methods by hand, solved by iteration from the last state until nothing changes


def fixed_point(improved, x, sweeps=200):
    for _ in range(sweeps):
        new = improved(x)
        if np.max(np.abs(new - x)) <= 1e-16 * np.max(np.abs(new)):
            return new
        x = new
    assert np.max(np.abs(improved(x) - x)) < 1e-14  # it goes round in the last digit
    return x


def type_ii_by_hand(gradient, t, q, p, h):
    """(12)–(13): H_D = H(t0, q0, p1)."""
    p1 = fixed_point(lambda p1: p - h * gradient(t, q, p1)[0], p)
    return q + h * gradient(t, q, p1)[1], p1


def midpoint_by_hand(gradient, t, q, p, h):
    """z1 = z0 + h J∇H(t0 + h/2, (z0 + z1)/2)."""
    start = np.stack([q, p])

    def improved(end):
        fall, rate = gradient(t + h / 2, *((start + end) / 2))
        return start + h * np.stack([rate, -fall])

    return tuple(fixed_point(improved, start))


METHODS = {
    "type_ii": (dvi.TypeII(), type_ii_by_hand),
    "midpoint": (dvi.GaussLegendre(1), midpoint_by_hand),
}
STEPS = 1000


@functools.cache
def by_package(name, method):
    problem, _, epsilon = CASES[name]
    sol = dvi.integrate(
        problem.system,
        problem.q0,
        problem.p0,
        h=problem.h,
        num_steps=STEPS,
        epsilon=epsilon,
        args=ARGS[name],
        method=METHODS[method][0],
    )
    return np.stack([sol.qs, sol.ps], axis=1)


@functools.cache
def by_hand(name, method):
    problem, gradient, _ = CASES[name]
    step = METHODS[method][1]
    states = [(np.array(problem.q0, float), np.array(problem.p0, float))]
    for k in range(STEPS):
        states.append(step(gradient, k * problem.h, *states[-1], problem.h))
    return np.array(states)


def difference(a, b):
    """Largest over all steps, of q and of p, each relative to its largest value."""
    axes = tuple(i for i in range(a.ndim) if i != 1)
    return np.max(np.max(np.abs(a - b), axis=axes) / np.max(np.abs(b), axis=axes))


def some_slow(quick, cases):
    """The cases, all but the quick ones marked slow."""
    return [
        pytest.param(*case, marks=[] if case in quick else [pytest.mark.slow]) for case in cases
    ]


SEPARABLE = ("henon_heiles", "toda", "fput", "stiff_fput", "figure_eight")
IN_EVERY_RUN = [(name, "type_ii") for name in SEPARABLE] + [
    ("perturbed_pendulum", "type_ii"),
    ("magnetic_mirror", "midpoint"),
]


@pytest.mark.parametrize(
    ("name", "method"), some_slow(IN_EVERY_RUN, [(n, m) for n in CASES for m in METHODS])
)
@pytest.mark.slow
def test_two_formulations_of_one_method_agree(name, method):
    """Autodiff and Newton's method against derivatives by hand and fixed-point iteration."""
    ours, theirs = by_package(name, method), by_hand(name, method)
    assert difference(ours, theirs) <= 1e-11
    other = by_hand(name, "midpoint" if method == "type_ii" else "type_ii")
    assert difference(ours, other) > 1e-4


@pytest.mark.parametrize("name", CASES)
def test_a_ninth_digit_of_the_start_is_seen(name):
    """Agreement to 1e-11 says something: 1e-9 more momentum makes 1e-10 and more."""
    problem, gradient, _ = CASES[name]
    q, p = np.array(problem.q0, float), np.array(problem.p0, float)
    if not p.any():
        q = q * (1 + 1e-9)
    p = p * (1 + 1e-9)
    states = [(q, p)]
    for k in range(50):
        states.append(midpoint_by_hand(gradient, k * problem.h, *states[-1], problem.h))
    assert difference(np.array(states), by_hand(name, "midpoint")[:51]) > 1e-10


@pytest.mark.parametrize("name", some_slow([("toda",)], [(name,) for name in CASES]))
@pytest.mark.slow
def test_the_flow_is_that_of_the_equations_by_hand(name):
    """GaussLegendre(3) against SciPy's DOP853 on the equations by hand."""
    problem, gradient, epsilon = CASES[name]
    t1, shape = 40 * problem.h, np.shape(problem.q0)
    if name == "figure_eight":
        t1 *= 10

    def field(t, z):
        fall, rate = gradient(t, *z.reshape(2, *shape))
        return np.concatenate([np.ravel(rate), -np.ravel(fall)])

    z = np.concatenate([np.ravel(problem.q0), np.ravel(problem.p0)])
    exact = solve_ivp(field, (0, t1), z, method="DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
    num_steps = 640
    sol = dvi.integrate(
        problem.system,
        problem.q0,
        problem.p0,
        h=t1 / num_steps,
        num_steps=num_steps,
        epsilon=epsilon,
        args=ARGS[name],
        method=dvi.GaussLegendre(3),
        save=dvi.Save(final=True),
    )
    end = np.stack([sol.qs[-1], sol.ps[-1]])
    scale = np.max(np.abs(exact))
    assert np.max(np.abs(end - exact.reshape(end.shape))) <= 1e-12 * scale
    assert np.max(np.abs(end.ravel() - z)) > 1e-2 * scale  # it did move


def drifts(problem, method, h, num_steps, **options):
    """Name → largest change over the steps."""
    return dvi.integrate(
        problem.system,
        problem.q0,
        problem.p0,
        h=h,
        num_steps=num_steps,
        args=problem.args,
        method=method,
        save=dvi.Save(final=True),
        observe={name: dvi.MaxDrift(f) for name, f in problem.observables.items()},
        **options,
    ).observed


# Hénon–Heiles


def test_henon_heiles_starts_below_the_energy_of_escape():
    problem = systems.henon_heiles()
    H = functools.partial(problem.system.H_D, 0.0, 0.0, args=None)
    q, p = jnp.asarray(problem.q0), jnp.asarray(problem.p0)
    assert float(H(q, p)) == pytest.approx(1 / 12, abs=1e-15)
    for saddle in ([0.0, 1.0], [3**0.5 / 2, -0.5], [-(3**0.5) / 2, -0.5]):
        saddle, rest = jnp.array(saddle), jnp.zeros(2)
        np.testing.assert_allclose(jax.grad(H)(saddle, rest), 0, atol=1e-15)
        assert float(H(saddle, rest)) == pytest.approx(ESCAPE_ENERGY, abs=1e-15)


@pytest.mark.slow
def test_the_energy_of_henon_heiles_is_bounded():
    problem = systems.henon_heiles()
    short, long = (float(drifts(problem, dvi.Strang(), 0.1, n)["energy"]) for n in (2000, 50_000))
    assert short <= long < 1.05 * short < 3e-4
    lost = [float(drifts(problem, dvi.RungeKutta4(), 0.3, n)["energy"]) for n in (2000, 8000)]
    assert lost[1] > 3 * lost[0]


# Toda


@pytest.mark.parametrize("n", some_slow([(3,)], [(3,), (5,)]))
def test_lax_traces_are_in_involution(n):
    """Poisson brackets of all pairs at a random state; with another function they are not zero."""
    q, p = jnp.asarray(np.random.default_rng(n).normal(size=(2, n)))

    @jax.jit
    def slopes(q, p):
        return jax.jacfwd(lambda q, p: lax_traces(0, 0, q, p, q, p, None), argnums=(0, 1))(q, p)

    dq, dp = map(np.asarray, slopes(q, p))
    brackets, terms = dq @ dp.T - dp @ dq.T, np.abs(dq) @ np.abs(dp).T
    assert np.max(np.abs(brackets)) < 1e-14 * np.max(terms)
    of_one = np.eye(n)[0]  # {q_1, tr L^k} = ∂ tr L^k/∂p_1
    assert np.max(np.abs(dp @ of_one)) > 0.1
    assert np.linalg.matrix_rank(np.hstack([dq, dp])) == n  # independent


def test_lax_observables_agree_with_one_another():
    problem = systems.toda()
    q, p = np.random.default_rng(1).normal(size=(2, 5))
    at = (0.0, 0.0, q, p, jnp.asarray(q), jnp.asarray(p), None)
    value = {name: np.asarray(f(*at)) for name, f in problem.observables.items()}
    np.testing.assert_allclose(value["lax_traces"][0], -value["total_momentum"] / 2, rtol=1e-13)
    np.testing.assert_allclose(value["lax_traces"][1], value["energy"] / 2, rtol=1e-13)
    spectrum = np.sort(np.linalg.eigvals(np.asarray(lax_matrix(*at[4:6]))).real)
    np.testing.assert_allclose(value["lax_eigenvalues"], spectrum, rtol=1e-12)
    powers = [np.sum(spectrum**k) for k in range(1, 6)]
    np.testing.assert_allclose(value["lax_traces"], powers, rtol=1e-12)


def lax_drifts(method, h, num_steps):
    """Largest changes of tr L, tr L², …, and of the eigenvalues."""
    observed = drifts(systems.toda(), method, h, num_steps)
    return np.asarray(observed["lax_traces"]), np.asarray(observed["lax_eigenvalues"])


STRANG, BLANES_MOAN = (dvi.Strang(), 2), (dvi.BlanesMoan(4), 4)


@pytest.mark.parametrize(("method", "order"), some_slow([STRANG], [STRANG, BLANES_MOAN]))
@pytest.mark.slow
def test_lax_integrals_waver_with_the_order_of_the_method(method, order):
    coarse, fine = (lax_drifts(method, h, round(100 / h)) for h in (0.1, 0.05))
    for a, b in ((coarse[0][1:], fine[0][1:]), (coarse[1], fine[1])):
        assert np.max(np.abs(np.log2(a / b) - order)) < 0.25
    assert max(coarse[0][0], fine[0][0]) < 1e-13  # tr L is linear in p: exact


@pytest.mark.slow
def test_lax_integrals_stay_bounded_and_runge_kutta_loses_them():
    for method, least, most in (
        (dvi.Strang(), 1, 1.1),
        (dvi.BlanesMoan(4), 1, 1.1),
        (dvi.RungeKutta4(), 1.8, 3.5),
    ):
        short, long = (lax_drifts(method, 0.1, n)[0] for n in (20_000, 60_000))
        growth = long[1:] / short[1:]
        assert least <= growth.min() <= growth.max() < most
        assert long[0] < 2e-13  # any Runge–Kutta method keeps what is linear


# FPUT


@pytest.mark.slow
def test_modes_of_the_linear_chain_are_kept():
    """α = β = 0: by the midpoint rule each to round-off, being quadratic; the cubic mixes them."""
    linear, cubic = systems.fput(6, alpha=0.0), systems.fput(6)
    start = np.random.default_rng(0).normal(size=(2, 6)) / 5
    for problem, least, most in ((linear, 0, 1e-13), (cubic, 1e-3, 1)):
        sol = dvi.integrate(
            problem.system,
            *start,
            h=0.2,
            num_steps=500,
            args=problem.args,
            method=dvi.GaussLegendre(1),
            observe=problem.observables,
        )
        modes = np.asarray(sol.observed["mode_energies"])
        assert least <= np.max(np.abs(modes - modes[0])) < most
    total = np.sum(modes, axis=1)
    assert np.max(np.abs(total - sol.observed["energy"])) < 0.05 * total[0]
    d = np.diff(np.pad(start[0], 1))
    quadratic = (np.sum(start[1] ** 2) + np.sum(d**2)) / 2
    q, p = jnp.asarray(start)
    modes = linear.observables["mode_energies"](0, 0, q, p, q, p, linear.args)
    assert float(jnp.sum(modes)) == pytest.approx(quadratic, rel=1e-14)
    chain = 2 * np.eye(6) - np.eye(6, k=1) - np.eye(6, k=-1)
    np.testing.assert_allclose(frequencies(6) ** 2, np.linalg.eigvalsh(chain), rtol=1e-13)


def test_energy_comes_back_to_the_first_mode():
    """The recurrence of 1955: most leaves the first mode, and at t ≈ 10 000 nearly all is back."""
    problem = systems.fput()
    sol = dvi.integrate(
        problem.system,
        problem.q0,
        problem.p0,
        h=0.2,
        num_steps=60_000,
        args=problem.args,
        method=dvi.Strang(),
        save=dvi.Save(every=100),
        observe=problem.observables,
    )
    share = np.asarray(sol.observed["mode_energies"])
    share = share / np.sum(share, axis=1, keepdims=True)
    t = np.asarray(sol.ts)[1:]
    assert share[:, 0].min() < 0.1
    back = np.argmax(np.where(t > 5000, share[:, 0], 0))
    assert share[back, 0] > 0.95
    assert 9000 < t[back] < 11_000
    assert share[:, 5:].max() < 0.3  # the short waves get little
    energy = np.asarray(sol.observed["energy"])
    assert np.ptp(energy) < 2e-3 * energy[0]


@pytest.mark.slow
def test_stiff_springs_share_their_energy_and_keep_the_sum():
    """I = Σ I_i wavers by O(1/ω) over a time in which the I_i change places; ω = 50 and 100."""
    ranges, single = {}, {}
    for omega in (50.0, 100.0):
        problem = systems.stiff_fput(omega=omega)
        observed = dvi.integrate(
            problem.system,
            problem.q0,
            problem.p0,
            h=0.1 / omega,
            num_steps=100_000,
            args=problem.args,
            method=dvi.Strang(),
            save=dvi.Save(every=25),
            observe=problem.observables,
        ).observed
        ranges[omega] = np.ptp(observed["oscillatory_energy"])
        single[omega] = np.asarray(observed["stiff_energies"])
    assert ranges[50.0] < 0.15
    assert 0.4 < ranges[100.0] / ranges[50.0] < 0.6
    assert single[50.0][:, 0].min() < 0.02  # all of it leaves the first spring
    assert single[50.0][:, 2].max() > 0.95  # and arrives at the third


# The perturbed pendulum


@pytest.mark.parametrize(
    "method", [dvi.TypeII(), pytest.param(dvi.GaussLegendre(1), marks=pytest.mark.slow)]
)
def test_a_hamiltonian_disturbance_leaves_the_map_symplectic(method):
    """At ε = 0.3 with the perturbation; as a force of the same kind it is not."""
    perturbed = systems.perturbed_pendulum().system
    forced = dvi.System(perturbed.H_D, force=lambda t0, t1, q0, p1, args: p1 * jnp.sin(t0))

    def defect(system, method):
        def of(z):
            sol = dvi.integrate(
                system, z[:1], z[1:], h=0.1, num_steps=1, t0=1.0, epsilon=EPSILON, method=method
            )
            return jnp.concatenate([sol.qs[-1], sol.ps[-1]])

        return symplectic_defect(np.asarray(jax.jit(jax.jacfwd(of))(jnp.array([0.5, 0.3]))))

    assert defect(perturbed, method) < 1e-15
    assert defect(forced, method) > 1e-2


# The magnetic mirror


def test_the_field_is_the_curl_of_the_potential_and_has_no_sources():
    q, args = jnp.array([1.5, -0.7, 4.0]), MIRROR
    J = np.asarray(jax.jacfwd(vector_potential)(q, args))
    curl = [J[2, 1] - J[1, 2], J[0, 2] - J[2, 0], J[1, 0] - J[0, 1]]
    np.testing.assert_allclose(magnetic_field(q, args), curl, rtol=1e-14)
    assert abs(np.trace(np.asarray(jax.jacfwd(magnetic_field)(q, args)))) < 1e-15


@pytest.mark.slow
def test_the_particle_bounces_and_its_moment_is_bounded():
    """It turns where |B| is E/μ of the axis; μ wavers by O(gyroradius/ℓ) and does not drift."""
    problem, waver = systems.magnetic_mirror(), []
    for length in (20.0, 40.0):
        sol = dvi.integrate(
            problem.system,
            problem.q0,
            problem.p0,
            h=0.1,
            num_steps=40_000,
            args=problem.args | {"length": length},
            method=dvi.GaussLegendre(2),
            save=dvi.Save(every=5),
            observe=problem.observables,
        )
        z, mu = np.asarray(sol.qs)[:, 2], np.asarray(sol.observed["magnetic_moment"])
        assert np.sum(np.diff(z > 0)) > 20  # bounces
        assert abs(z.max() / (0.8 * length) - 1) < 0.02
        assert abs(z.min() / z.max() + 1) < 1e-3
        quarters = np.array_split(mu, 4)
        spread, means = np.ptp(quarters, axis=1), np.mean(quarters, axis=1)
        assert spread.max() < 1.03 * spread.min()
        assert np.ptp(means) < 1e-4 * mu.mean()
        assert np.ptp(sol.observed["energy"]) < 1e-5
        waver.append(np.ptp(mu) / mu.mean())
    assert 0.005 < waver[0] < 0.02
    assert waver[1] < 0.6 * waver[0]


@pytest.mark.parametrize(
    "method",
    [dvi.TypeII(), dvi.GaussLegendre(1), dvi.Strang(), dvi.BlanesMoan(4), dvi.GaussLegendre(3)],
)
@pytest.mark.slow
def test_variational_maps_keep_canonical_angular_momentum(method):
    """Turns about the axis leave H_D as it is; the energy wavers, with the order of the method."""
    observed = drifts(systems.magnetic_mirror(), method, 0.1, 5000)
    assert float(observed["canonical_angular_momentum"]) < 1e-12
    assert float(observed["energy"]) > 1e-10


@pytest.mark.slow
def test_runge_kutta_loses_canonical_angular_momentum():
    observed = drifts(systems.magnetic_mirror(), dvi.RungeKutta4(), 0.1, 5000)
    assert float(observed["canonical_angular_momentum"]) > 1e-4


# The figure eight


def test_bodies_of_the_figure_eight_take_each_others_places():
    """After a third of the period each is where another was, with its momentum."""
    problem = systems.figure_eight()
    sol = dvi.integrate(
        problem.system,
        problem.q0,
        problem.p0,
        h=PERIOD / 900,
        num_steps=300,
        args=problem.args,
        method=dvi.BlanesMoan(6),
        save=dvi.Save(final=True),
    )
    q0, p0 = np.asarray(problem.q0), np.asarray(problem.p0)
    distance = np.linalg.norm(np.asarray(sol.qs[-1])[:, None] - q0[None], axis=-1)
    now_at = np.argmin(distance, axis=1)
    assert sorted(now_at) == [0, 1, 2]
    assert all(now_at != [0, 1, 2])
    np.testing.assert_allclose(sol.qs[-1], q0[now_at], rtol=0, atol=1e-7)  # digits as printed
    np.testing.assert_allclose(sol.ps[-1], p0[now_at], rtol=0, atol=1e-7)
    np.testing.assert_array_equal(systems.n_body().q0, q0)


# Starts that are refused, and runs from files


@pytest.mark.parametrize(
    ("name", "shape", "said"),
    [
        ("henon_heiles", (3,), r"in the plane.*got q0 of shape \(3,\)"),
        ("toda", (2,), r"at least three particles.*got q0 of shape \(2,\)"),
        ("toda", (3, 2), r"at least three particles"),
        ("fput", (2, 4), r"row of particles.*got q0 of shape \(2, 4\)"),
        ("stiff_fput", (3,), r"shape \(2, n\), n ≥ 1; got q0 of shape \(3,\)"),
        ("perturbed_pendulum", (2,), r"one pendulum.*got q0 of shape \(2,\)"),
        ("magnetic_mirror", (2,), r"one particle in space.*got q0 of shape \(2,\)"),
        ("figure_eight", (3,), r"shape \(bodies, 2\) or \(bodies, 3\)"),
    ],
)
def test_starts_of_another_shape_are_refused(name, shape, said):
    problem = CASES[name][0]
    problem.check(problem.q0, problem.p0, problem.args)
    with pytest.raises(ValueError, match=said):
        problem.check(np.ones(shape), np.ones(shape), problem.args)
    with pytest.raises(ValueError, match="shape"):
        problem.check(problem.q0, np.ones((7, 7)), problem.args)


def test_parameters_that_cannot_be_are_refused():
    mirror = systems.magnetic_mirror()
    for key in ("mass", "length"):
        with pytest.raises(ValueError, match=f"{key} must be a positive.*got -1.0"):
            mirror.check(mirror.q0, mirror.p0, mirror.args | {key: -1.0})
    with pytest.raises(ValueError, match="at least three particles"):
        systems.toda(2)
    with pytest.raises(ValueError, match="row of particles"):
        systems.fput(0)
    with pytest.raises(ValueError, match="m springs"):
        systems.stiff_fput(0)


@pytest.mark.parametrize("name", some_slow([("toda",)], [(name,) for name in CASES]))
@pytest.mark.slow
def test_a_run_file_names_them(name, tmp_path):
    assert systems.LIBRARY[name]().name == name
    path = tmp_path / "run.toml"
    text = f'system = "{name}"\nsteps = 20\nmethod = "Strang"\n[output]\nplots = false\n'
    path.write_text(text + f'dir = "{(tmp_path / "out").as_posix()}"\n', encoding="utf-8")
    report = json.loads((run_file(path).folder / "report.json").read_text(encoding="utf-8"))
    assert report["status"]["result"] == "successful"
    problem = systems.LIBRARY[name]()
    assert set(report["results"]) >= set(problem.observables)
    assert report["stats"]["num_steps"] == 20
