"""Noise: Brownian paths from keys, methods for noise, and what they sample."""

import importlib.util
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import dvi_jax as dvi
import lanewise

FILE = Path(__file__).parent.parent / "benchmarks" / "noise.py"


@pytest.fixture(scope="module")
def bench():
    spec = importlib.util.spec_from_file_location("noise_benchmark", FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def H_D(t0, t1, q0, p1, args):
    return jnp.sum(p1**2) / 2 + args["k"] * jnp.sum(q0**4) / 4


def spring_energy(t0, t1, q0, p1, args):
    return p1 @ p1 / 2 + q0 @ q0 / 2


ARGS = {"k": 1.1, "g": 0.3, "T": 0.2}
THERMAL = dvi.System(H_D, noise=dvi.Langevin(lambda args: args["g"], lambda args: args["T"]))
TWISTED = dvi.System(
    H_D,
    noise=dvi.NoiseHamiltonians(lambda t, q, p, args: args["T"] * jnp.array([q[0] * p[0]])),
)
FREE = dvi.System(lambda t0, t1, q0, p1, args: p1 @ p1 / 2, noise=lambda t, q, p, args: 0 * q + 1)
RUN = {"h": 0.1, "num_steps": 60, "args": ARGS, "method": dvi.BAOAB()}


def thermal(path, system=THERMAL, **more):
    return dvi.integrate(system, [1.0], [0.2], path=path, **{**RUN, **more})


def momenta(path, h=0.1, num_steps=8, **more):
    """Of a free particle with unit noise: B itself."""
    run = {"method": dvi.StochasticEuler(), "h": h, "num_steps": num_steps, **more}
    return np.asarray(dvi.integrate(FREE, [0.0], [0.0], path=path, **run).ps[:, 0])


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_increments_are_the_numbers_of_jax(dtype):
    key = jax.random.key(3)
    path = dvi.Brownian(jax.random.key_data(key), first_step=5)
    h = jnp.asarray(0.25, dtype)
    found = path.increments(jnp.int32(2), dvi.Interval(h, h + h, h), 1, 4)
    expected = 0.5 * jax.random.normal(jax.random.fold_in(key, 7), (4,), dtype)
    np.testing.assert_allclose(found[0], expected, rtol=4 * np.finfo(dtype).eps)


def test_increments_in_generated_code_are_the_same_numbers():
    B = momenta(dvi.Brownian(jax.random.key(1)), num_steps=200)
    z = [jax.random.normal(jax.random.fold_in(jax.random.key(1), k), (1,))[0] for k in range(200)]
    np.testing.assert_allclose(np.diff(B), np.sqrt(0.1) * np.array(z), atol=1e-12)
    other = momenta(dvi.Brownian(jax.random.key(2)), num_steps=200)
    assert abs(np.corrcoef(np.diff(B), np.diff(other))[0, 1]) < 0.3


def test_a_run_with_noise_is_machine_code():
    def f(key):
        return thermal(dvi.Brownian(key), save=dvi.Save(final=True)).qs[-1]

    parts = lanewise.explain(f, jax.random.key_data(jax.random.key(0))).parts
    assert [part.ir is not None for part in parts] == [True]


def test_substeps_refine_the_same_path():
    coarse = momenta(dvi.Brownian(5, substeps=4), h=0.1)
    fine = momenta(dvi.Brownian(5), h=0.025, num_steps=32)
    np.testing.assert_allclose(coarse, fine[::4], atol=1e-14)
    assert np.abs(momenta(dvi.Brownian(5), h=0.1) - coarse).max() > 0.1
    halves = thermal(7, method=dvi.OBABO(), h=0.01, num_steps=400)
    whole = thermal(dvi.Brownian(7, substeps=2), h=0.01, num_steps=400)
    assert np.abs(halves.qs - whole.qs).max() < 0.01


def test_seeds_and_keys_are_the_same_paths():
    expected = momenta(jax.random.key(9))
    for path in (9, dvi.Brownian(9), dvi.Brownian(jax.random.key(9)), jax.random.PRNGKey(9)):
        np.testing.assert_array_equal(momenta(path), expected)


@pytest.fixture
def diffrax():
    return pytest.importorskip("diffrax")


@pytest.fixture
def tree(diffrax):
    """A path as a function of time, and the same for diffrax."""

    class Tree(dvi.BrownianPath):
        tree: diffrax.VirtualBrownianTree

        def increments(self, k, interval, parts, count):
            return self.tree.evaluate(interval.t0, interval.t1)[None]

    made = diffrax.VirtualBrownianTree(0.0, 1.0, 1e-4, (1,), jax.random.key(0))
    return Tree(made), made


@pytest.mark.slow
@pytest.mark.parametrize("ito", [False, True])
def test_the_solution_of_diffrax(diffrax, tree, ito):
    """The same Stratonovich equation, dp = … + ½ √(1 + p²) ∘ dB, by Heun's method; that of Itô, by
    Euler's, is another one."""

    def sigma(t, q, p, args):
        return 0.5 * jnp.sqrt(1 + p**2)

    noisy = dvi.System(H_D, noise=sigma)
    sol = dvi.integrate(noisy, [1.0], [0.2], h=1 / 512, num_steps=512, args=ARGS, path=tree[0],
                        method=dvi.StochasticMidpoint())  # fmt: skip
    drift = diffrax.ODETerm(lambda t, z, _: jnp.array([z[1], -1.1 * z[0] ** 3]))
    along = diffrax.ControlTerm(
        lambda t, z, _: jnp.array([[0.0], [1.0]]) * sigma(t, z[0], z[1], None), tree[1]
    )
    other = diffrax.diffeqsolve(
        diffrax.MultiTerm(drift, along), diffrax.Euler() if ito else diffrax.Heun(), 0.0, 1.0,
        1 / 512, jnp.array([1.0, 0.2]),
    )  # fmt: skip
    distance = np.abs(np.concatenate([sol.qs[-1], sol.ps[-1]]) - other.ys[-1]).max()
    assert distance > 0.02 if ito else distance < 2e-3


@pytest.mark.slow
def test_a_path_of_diffrax(tree):
    tree, made = tree
    coarse = momenta(tree, h=0.125, num_steps=8)
    fine = momenta(tree, h=0.03125, num_steps=32)
    np.testing.assert_allclose(coarse, fine[::4], atol=1e-12)
    np.testing.assert_allclose(coarse[-1], made.evaluate(0.0, 1.0)[0], atol=1e-12)


def test_equal_bits_alone_in_batches_and_after_a_resume():
    keys = jax.random.split(jax.random.key(0), 70)
    many = jax.vmap(lambda key: thermal(dvi.Brownian(key)).qs)
    batch = np.asarray(many(keys))
    np.testing.assert_array_equal(batch[:3], many(keys[:3]))
    alone = thermal(dvi.Brownian(keys[2]))
    np.testing.assert_array_equal(batch[2], alone.qs)
    rest = dvi.integrate(
        THERMAL, alone.qs[40], alone.ps[40], path=dvi.Brownian(keys[2], first_step=40),
        t0=alone.ts[40], **{**RUN, "num_steps": 20},
    )  # fmt: skip
    np.testing.assert_array_equal(rest.qs, alone.qs[40:])
    # A wrong number of the first step is another path.
    assert np.abs(thermal(dvi.Brownian(keys[2], first_step=1)).qs - alone.qs).max() > 0.01


def test_equal_bits_with_progress_and_in_a_sweep():
    alone = thermal(4)
    pieces = thermal(4, progress=lambda done, total: None)
    np.testing.assert_array_equal(pieces.qs, alone.qs)
    final = {**RUN, "save": dvi.Save(final=True)}
    seeds = dvi.Axis("seed", np.arange(20))
    for path in (seeds, dvi.Brownian(seeds)):
        found = dvi.sweep(THERMAL, [1.0], [0.2], path=path, **final, lanes_per_task=8)
        assert dict(found.to_xarray().q.sizes)["seed"] == 20
        np.testing.assert_array_equal(found.to_xarray().q.sel(seed=4)[-1], alone.qs[-1])


@pytest.mark.slow
def test_a_sweep_resumes_with_its_own_seeds_only(tmp_path):
    final, seeds = {**RUN, "save": dvi.Save(final=True)}, dvi.Axis("seed", np.arange(20))
    store = {"store": tmp_path / "paths", "lanes_per_task": 8, **final}
    first = dvi.sweep(THERMAL, [1.0], [0.2], path=seeds, **store)
    again = dvi.sweep(THERMAL, [1.0], [0.2], path=seeds, **store)
    np.testing.assert_array_equal(first.to_xarray().q, again.to_xarray().q)
    with pytest.raises(dvi.StoreMismatch, match="path"):
        dvi.sweep(THERMAL, [1.0], [0.2], path=dvi.Axis("seed", np.arange(20) + 1), **store)


OF_ALL = {
    f"{'Langevin' if system is THERMAL else 'Hamiltonian'} {name}": (system, name)
    for name in ("BAOAB", "OBABO", "StochasticEuler", "StochasticMidpoint")
    for system in (THERMAL, TWISTED)[: 1 + name.startswith("S")]
}


def each(*quick):
    marks = {True: [], False: pytest.mark.slow}
    return [pytest.param(*x, id=i, marks=marks[i in quick]) for i, x in OF_ALL.items()]


def derivatives(system, method, adjoint):
    def loss(v, q0):
        args = {"k": v[0], "g": v[1], "T": v[2]}
        sol = dvi.integrate(
            system, q0, [0.2], h=v[3], num_steps=40, args=args, method=method, adjoint=adjoint,
            path=3, save=dvi.Save(every=20), observe=dvi.Mean(lambda q, p: q[0] ** 2),
        )  # fmt: skip
        return jnp.sum(sol.qs * jnp.cos(sol.ps)) + sol.observed

    return loss


@pytest.mark.parametrize(("system", "name"), each("Langevin BAOAB"))
def test_gradients_along_a_path(system, name):
    """Of states rebuilt backwards, and of differences with the same noise."""
    method, v, q0 = getattr(dvi, name)(), jnp.array([1.1, 0.3, 0.2, 0.05]), jnp.array([0.7])
    loss = derivatives(system, method, dvi.Reversible(checkpoint_every=10))
    found = jax.jit(jax.grad(loss, (0, 1)))(v, q0)
    plain = jax.jit(derivatives(system, method, dvi.Direct()))
    step = np.diag([1e-4] * 4) * np.maximum(v, 0.1)
    for i, d in enumerate(step):
        ends = [float(plain(v + x * d, q0)) for x in (-2, -1, 1, 2)]
        slope = np.dot([1, -8, 8, -1], ends) / (12 * d[i])
        assert float(found[0][i]) == pytest.approx(slope, rel=1e-8, abs=1e-9)
    slope = (plain(v, q0 + 1e-5) - plain(v, q0 - 1e-5)) / 2e-5
    assert float(found[1][0]) == pytest.approx(float(slope), rel=1e-7)


def one_step(system, method, back=False):
    """The map of a step along one increment, on z = (q, p)."""
    equations = dvi.Equations(
        system, jnp.asarray(0.0), ARGS, increments=jnp.full((method.increments, 1), 0.21)
    )
    interval = dvi.Interval(*map(jnp.asarray, (0.0, 0.1, 0.1)))

    def step(z):
        q, p, _ = (method.inverse if back else method.step)(equations, interval, z[:1], z[1:])
        return jnp.concatenate([q, p])

    return step


@pytest.mark.parametrize(("system", "name"), each("Langevin BAOAB", "Hamiltonian StochasticEuler"))
def test_inverse_and_area_of_a_step(system, name):
    """Noise Hamiltonians conserve areas, and friction contracts them; splittings by e^{−γh}."""
    method, z = getattr(dvi, name)(), jnp.array([0.7, -0.4])
    forwards = jax.jit(one_step(system, method))
    np.testing.assert_allclose(one_step(system, method, back=True)(forwards(z)), z, atol=1e-13)
    area = jnp.linalg.det(jax.jacfwd(forwards)(z))
    if system is TWISTED:
        assert float(area) == pytest.approx(1.0, abs=1e-13)
    elif isinstance(method, dvi.BAOAB | dvi.OBABO):
        assert float(area) == pytest.approx(np.exp(-0.3 * 0.1), abs=1e-14)
    else:
        assert float(area) == pytest.approx(np.exp(-0.3 * 0.1), abs=1e-3)
        assert abs(float(area) - np.exp(-0.3 * 0.1)) > 1e-6


@pytest.mark.slow
def test_without_noise_the_methods_are_those_for_ordinary_systems():
    quiet = dvi.System(H_D)
    for noisy, plain in (
        (dvi.BAOAB(), dvi.Strang()),
        (dvi.OBABO(), dvi.Strang()),
        (dvi.StochasticEuler(), dvi.TypeII()),
        (dvi.StochasticMidpoint(), dvi.GaussLegendre(1)),
    ):
        run = [thermal(None, quiet, method=m).qs for m in (noisy, plain)]
        np.testing.assert_allclose(*run, atol=1e-15)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["StochasticEuler", "StochasticMidpoint"])
def test_a_noisy_frequency(name):
    """Kubo's oscillator, H = E and h = sE, turns by the angle t + sB(t)."""

    def E(t, q, p, args):
        return (p @ p + q @ q) / 2

    system = dvi.System(
        dvi.discretise(E, order=1), noise=dvi.NoiseHamiltonians(lambda *at: 0.3 * E(*at)[None])
    )
    errors = []
    for n in (100, 400):
        sol = dvi.integrate(
            system, [1.0], [0.0], h=2.0 / n, num_steps=n, path=dvi.Brownian(2, substeps=400 // n),
            method=getattr(dvi, name)(),
        )  # fmt: skip
        angle = 2.0 + 0.3 * momenta(dvi.Brownian(2), h=2.0 / 400, num_steps=400)[-1]
        errors.append(np.hypot(sol.qs[-1, 0] - np.cos(angle), sol.ps[-1, 0] + np.sin(angle)))
    assert errors[1] < 0.5 * errors[0] < 0.02
    if name == "StochasticMidpoint":
        np.testing.assert_allclose(sol.qs**2 + sol.ps**2, 1.0, atol=1e-13)


def test_common_noise_and_units():
    """One Brownian motion pushes two particles; its factor is a column."""
    two = dvi.System(FREE.H_D, noise=lambda t, q, p, args: jnp.array([[1.0], [-2.0]]))
    sol = dvi.integrate(
        two, jnp.zeros(2), jnp.zeros(2), h=0.1, num_steps=8, path=5, method=dvi.StochasticEuler()
    )
    np.testing.assert_allclose(sol.ps[:, 0], momenta(5), atol=1e-15)
    np.testing.assert_allclose(sol.ps[:, 1], -2 * sol.ps[:, 0], atol=1e-15)


def test_gradients_at_zero_temperature_are_finite():
    def last(args):
        equations = dvi.Equations(
            THERMAL, jnp.asarray(0.0), args, increments=jnp.full((1, 1), 0.21)
        )
        interval = dvi.Interval(*map(jnp.asarray, (0.0, 0.1, 0.1)))
        q, _, _ = dvi.BAOAB().step(equations, interval, jnp.ones(1), jnp.ones(1))
        return q[0]

    args = {"k": jnp.asarray(1.1), "g": jnp.asarray(0.3), "T": jnp.asarray(0.0)}
    ends = [float(last({**args, "g": jnp.asarray(g)})) for g in (0.3 - 1e-5, 0.3 + 1e-5)]
    slope = jax.grad(last)(args)["g"]
    assert float(slope) == pytest.approx((ends[1] - ends[0]) / 2e-5, rel=1e-8)


OSCILLATOR = dvi.System(
    lambda t0, t1, q0, p1, args: p1 @ p1 / (2 * args["m"]) + args["k"] * (q0 @ q0) / 2,
    noise=dvi.Langevin(lambda args: args["g"], lambda args: args["T"], lambda args: args["m"]),
)
METHODS_FOR_NOISE = [dvi.BAOAB(), dvi.OBABO(), dvi.StochasticMidpoint(), dvi.StochasticEuler()]


@pytest.mark.parametrize("method", METHODS_FOR_NOISE)
def test_invalid_parameters_of_a_bath_are_not_zero_noise(method):
    """A NaN or a wrong sign gives a status, alone and next to good trajectories of a batch."""
    nan, good = np.nan, (0.5, 1.0, 1.0)
    invalid = [(0.5, nan, 1.0), (0.5, -1.0, 1.0), (-0.5, 1.0, 1.0), (-0.5, -1.0, 1.0),
               (0.5, 1.0, nan), (-0.5, 0.0, 1.0), (0.5, -1e-300, 1.0), (nan, 0.0, 1.0)]  # fmt: skip
    rows = np.array([good, *invalid, (0.5, 0.0, 1.0), (0.0, 1.0, 1.0), (0.0, 0.0, 2.0)])
    columns = dict(zip("gTm", rows.T, strict=True), k=np.ones(len(rows)))
    sol = jax.vmap(
        lambda args: dvi.integrate(OSCILLATOR, [1.0], [0.0], h=0.1, num_steps=20, args=args, path=3,
                                   method=method, throw=False)
    )(columns)  # fmt: skip
    is_valid = sol.result == dvi.RESULTS.successful
    assert is_valid.tolist() == [True] + [False] * len(invalid) + [True] * 3
    assert np.isnan(np.asarray(sol.qs)[1 : len(invalid) + 1, -1]).all()


def test_noise_in_units_of_atoms_and_single_precision():
    """m T underflows in float32. The same run in units of the system has the same noise."""
    argon = {"m": 6.63e-26, "T": 4.14e-21, "k": 1.0, "g": 1e12}
    electron = {"m": 9.11e-31, "T": 4.14e-21, "k": 1e-3, "g": 1e13}
    cold = {"m": 1.4e-25, "T": 1.38e-29, "k": 1e-14, "g": 1e4}

    def last(args, h, method):
        sol = dvi.integrate(OSCILLATOR, jnp.zeros(1, "float32"), jnp.zeros(1, "float32"), h=h,
                            num_steps=300, args=args, path=1, method=method,
                            save=dvi.Save(final=True))  # fmt: skip
        return sol.qs[-1, 0]

    for method in (dvi.BAOAB(), dvi.StochasticEuler()):
        end, own = [], []
        for args in (argon, electron, cold):
            period = np.sqrt(args["m"] / args["k"])
            unit = {"m": 1.0, "T": 1.0, "k": 1.0, "g": args["g"] * period}
            end.append(({n: jnp.float32(x) for n, x in args.items()}, jnp.float32(0.02 * period)))
            own.append(({n: jnp.float32(x) for n, x in unit.items()}, jnp.float32(0.02)))
        run = jax.vmap(lambda args, h, method=method: last(args, h, method))
        ends, expected = (run(*jax.tree.map(lambda *x: jnp.stack(x), *runs)) for runs in (end, own))
        thermal_sizes = [np.sqrt(args["T"] / args["k"]) for args in (argon, electron, cold)]
        np.testing.assert_allclose(ends / np.array(thermal_sizes), expected, rtol=1e-3, atol=1e-3)
        assert np.abs(expected).min() > 0.01


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ((-1.0, 0.5), "friction .* must be zero or positive, got -1.0"),
        ((1.0, -0.5), "temperature .* must be zero or positive, got -0.5"),
        ((1.0, 0.5, -1.0), "mass .* must be positive, got -1.0"),
        ((1.0, 0.5, 0), "mass .* must be positive, got 0"),
        ((1.0, jnp.array([0.5, -2.0])), "temperature .* got -2.0"),
    ],
)
def test_negative_parameters_of_a_bath_are_refused(parameters, message):
    with pytest.raises(ValueError, match=message):
        dvi.Langevin(*parameters)


class Spike(dvi.BrownianPath):
    """The increment `size` in step 2, and 0 in the others."""

    size: float

    def increments(self, k, interval, parts, count):
        return jnp.where(k == 2, self.size, 0.0) * jnp.ones((parts, count))


@pytest.mark.parametrize("method", METHODS_FOR_NOISE)
def test_increments_of_a_user_are_used_as_they_are(method):
    p = momenta(Spike(100.0), method=method)
    assert p[-1] == pytest.approx(100.0 * method.increments)
    for size in (np.inf, -np.inf, np.nan):
        with pytest.raises(dvi.IntegrationError, match="NaN or infinite"):
            momenta(Spike(size), method=method)


def test_compensated_summation_sees_the_whole_momentum():
    plain = thermal(3, h=0.01, num_steps=300)
    other = thermal(3, h=0.01, num_steps=300, arithmetic=dvi.Compensated())
    np.testing.assert_allclose(other.qs, plain.qs, atol=1e-12)


ON_CIRCLE = dvi.System(
    H_D, noise=dvi.Langevin(1.0, 0.5), constraint=lambda q, args: jnp.array([q @ q - 1])
)
SIGMA_OF_P = dvi.System(H_D, noise=lambda t, q, p, args: p)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"path": None}, "path must be given"),
        ({"path": None, "method": dvi.StrongSplitting()}, "path must be given"),
        ({"system": dvi.System(H_D)}, "path has no effect"),
        ({"method": dvi.Strang()}, r"Strang.* is not a method for systems with noise.*BAOAB"),
        ({"method": dvi.Strang(base=dvi.BAOAB())}, "is not a method for systems with noise"),
        ({"system": TWISTED}, "OBABO.* require noise on the momenta.*StochasticMidpoint"),
        ({"system": SIGMA_OF_P}, r"BAOAB\(\) requires noise that does not depend on p"),
        ({"lattice": dvi.TimeTransformed(lambda t, q, p, args: 1.0)}, "steps depend on the state"),
        ({"arithmetic": dvi.DoubleDouble()}, "cannot be used with noise.*Compensated"),
        ({"h": -0.1}, "h must be positive.*got h=-0.1"),
        ({"path": 1.5}, "must be an integer, or one key.*got 1.5"),
        ({"path": jax.random.split(jax.random.key(0), 3)}, "use jax.vmap"),
        ({"path": jax.random.key(0, impl="rbg")}, "generator threefry2x32"),
        ({"path": dvi.Brownian(0, first_step=-1)}, "first_step must be an integer from 0"),
        ({"path": dvi.Brownian(0, first_step=1.5)}, "first_step must be an integer, got"),
        ({"path": dvi.Brownian(0, first_step=True)}, "first_step must be an integer, got"),
        ({"path": dvi.Brownian(0, first_step=np.nan)}, "first_step must be an integer, got"),
        ({"path": dvi.Brownian(0, first_step=np.arange(2))}, "first_step must be an integer, got"),
        ({"system": dvi.System(H_D, noise=lambda t, q, p, args: jnp.ones(3))}, r"got shape \(3,\)"),
        ({"system": dvi.System(H_D, noise=dvi.Langevin(jnp.ones(2)))}, r"must broadcast with q0"),
        *(
            ({"system": ON_CIRCLE, "method": method}, "is not a method for systems with noise")
            for method in (None, dvi.Rattle(), dvi.Yoshida(4, base=dvi.Rattle()))
        ),
    ],
)
def test_what_does_not_fit_is_refused(more, message):
    with pytest.raises(ValueError, match=f"(?s){message}"):
        thermal(**{"path": 0, **more})


def test_other_functions_and_arguments_are_refused():
    how = {"invariant": lambda q, p: q[0], "h": 0.1, "num_steps": 10, "args": ARGS}
    vector = lambda q, p: q  # noqa: E731
    for make, error, message in (
        (lambda: dvi.drift_order(THERMAL, q0=[1.0], p0=[0.0], epsilons=[0.1], **how), ValueError,
         "must not have noise"),
        (lambda: dvi.System(H_D, noise=lambda t, q: q), TypeError, "noise must take the arguments"),
        (lambda: dvi.Brownian(0, substeps=0), ValueError, "substeps must be .* at least 1, got 0"),
        (lambda: dvi.invariant_diffusion(dvi.System(H_D), [1.0], [0.0], **how), ValueError,
         "must have noise"),
        (lambda: dvi.invariant_diffusion(THERMAL, [1.0], [0.0], **how | {"invariant": vector}),
         ValueError, "invariant must return a real scalar"),
    ):  # fmt: skip
        with pytest.raises(error, match=message):
            make()


def test_harmonic_oscillator_in_equilibrium():
    """BAOAB has the exact distribution of q for a harmonic force: variance T/k for every h < 2."""
    spring = dvi.System(spring_energy, noise=dvi.Langevin(1.0, 0.5))

    def last(key):
        sol = dvi.integrate(spring, [0.0], [0.0], h=0.8, num_steps=60, method=dvi.BAOAB(),
                            path=dvi.Brownian(key), save=dvi.Save(final=True))  # fmt: skip
        return sol.qs[-1, 0]

    q = jax.vmap(last)(jax.random.split(jax.random.key(0), 20_000))
    assert stats.kstest(q, stats.norm(scale=np.sqrt(0.5)).cdf).pvalue > 0.01
    assert stats.kstest(q, stats.norm(scale=np.sqrt(0.6)).cdf).pvalue < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "name", "expected", "within"),
    [
        ("Langevin", "BAOAB", 1.0, 0.05),
        ("Langevin", "OBABO", 1.0, 0.05),
        ("σ(q)", "StochasticEuler", 1.0, 0.05),
        ("σ(q, p)", "StochasticMidpoint", 1.0, 0.05),
        ("h(q, p)", "StochasticEuler", 1.0, 0.1),
        ("h(q, p)", "StochasticMidpoint", 1.0, 0.1),
        ("h₁, h₂", "StochasticMidpoint", 0.5, 0.12),
    ],
)
def test_strong_order(bench, kind, name, expected, within):
    order, error = bench.strong_order(kind, name, 3000)
    assert order == pytest.approx(expected, abs=within + 2 * error)
    if (kind, name) == ("h(q, p)", "StochasticEuler"):  # a scheme for the equation of Itô
        assert bench.strong_order(kind, "Uncorrected", 3000)[0] < 0.5


def test_the_wrong_methods_of_the_benchmark_are_other_maps(bench):
    """An override of a method that no longer exists would change nothing."""
    z = jnp.array([0.7, -0.4])
    right, wrong = (
        one_step(TWISTED, method)(z) for method in (dvi.StochasticEuler(), bench.Uncorrected())
    )
    assert 1e-6 < np.abs(right - wrong).max() < 0.1
    kicks = [
        noise(0.3, 0.2).kick(0.0, z[:1], z[1:], None, 0.1, jnp.array([0.21]))
        for noise in (dvi.Langevin, bench.Mistaken)
    ]
    assert abs(float(kicks[0][0] - kicks[1][0])) > 1e-4


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "name", "expected", "within"),
    [
        ("Langevin", "OBABO", 2.0, 0.25),
        ("σ(q)", "BAOAB", 2.0, 0.25),
        ("Langevin", "StochasticEuler", 1.0, 0.1),
        ("h(q, p)", "StochasticMidpoint", 1.0, 0.1),
    ],
)
def test_weak_order(bench, kind, name, expected, within):
    order, error = bench.weak_order(kind, name, 100_000)
    assert error < 0.15
    assert order == pytest.approx(expected, abs=within + 2 * error)


@pytest.mark.slow
@pytest.mark.parametrize(("measure", "paths"), [("canonical", 100_000), ("chain", 10_000)])
def test_canonical_distribution(bench, measure, paths):
    of_q, of_p, (temperature, error) = getattr(bench, measure)(paths)
    assert min(of_q, of_p) > 0.01
    assert error < 0.0007
    assert temperature == pytest.approx(0.5, rel=0.005)
    of_q, of_p, (temperature, _) = getattr(bench, measure)(paths, mistaken=True)
    assert max(of_q, of_p) < 1e-4
    assert abs(temperature / 0.5 - 1) > 0.05


OF_ENERGY = {"invariant": lambda q, p: (p @ p + q @ q) / 2, "h": 2 * np.pi / 100,
             "num_steps": 300, "method": dvi.BAOAB()}  # fmt: skip


def test_diffusion_of_the_energy_of_an_oscillator():
    """dE = (s²/2) dt + s p dB: A = s²/2, B = s² ⟨p²⟩ = s² E."""
    system = dvi.System(spring_energy, noise=lambda t, q, p, args: args["s"] * jnp.ones(1))
    found = dvi.invariant_diffusion(
        system, [1.0], [0.0], num_paths=4000, args={"s": 0.05}, **OF_ENERGY
    )
    assert float(found.predicted_drift) == pytest.approx(0.05**2 / 2, rel=1e-10)
    assert float(found.predicted_diffusion) == pytest.approx(0.05**2 / 2, rel=2e-3)
    assert abs(found.drift - found.predicted_drift) < 3 * found.drift_error
    assert abs(found.diffusion - found.predicted_diffusion) < 3 * found.diffusion_error
    assert float(found.drift_error) < 0.15 * float(found.drift)
    # Wrong by far: the coefficient of ordinary diffusion, half of it.
    assert abs(found.diffusion - found.predicted_diffusion / 2) > 10 * found.diffusion_error


def test_drift_of_an_energy_by_friction():
    """Langevin: A = γ (T − ⟨p²⟩), B = 2γT⟨p²⟩."""
    spring = dvi.System(spring_energy, noise=dvi.Langevin(1e-3, 0.7))
    found = dvi.invariant_diffusion(spring, [1.0], [0.0], num_paths=10, **OF_ENERGY)
    assert float(found.predicted_drift) == pytest.approx(1e-3 * 0.2, rel=5e-3)
    assert float(found.predicted_diffusion) == pytest.approx(2e-3 * 0.7 * 0.5, rel=2e-3)


@pytest.mark.slow
def test_diffusion_of_a_discovered_invariant_of_first_order():
    def quartic(t0, t1, q0, p1, args):
        return jnp.sum(q0**4) / 4

    samples = np.random.default_rng(0).uniform(-1, 1, (2, 200, 1))
    quiet = dvi.System(spring_energy, perturbation=quartic)
    known = dvi.discover_invariants(
        quiet, dvi.Polynomials(4), order=1, h=0.1, samples=samples, method=dvi.Strang()
    )
    cosine = lambda t, q, p, args: 0.02 * jnp.cos(q)  # noqa: E731
    noisy = dvi.System(spring_energy, perturbation=quartic, noise=cosine)
    found = dvi.invariant_diffusion(
        noisy, [1.0], [0.0], invariant=lambda q, p: known.evaluate(q, p, 0.2)[0], epsilon=0.2,
        h=0.1, num_steps=628, method=dvi.BAOAB(), num_paths=20_000,
    )  # fmt: skip
    assert abs(found.drift - found.predicted_drift) < 3 * found.drift_error
    assert abs(found.diffusion - found.predicted_diffusion) < 3 * found.diffusion_error
    assert float(found.diffusion_error) < 0.015 * float(found.diffusion)
