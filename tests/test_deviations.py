"""Deviation vectors: the tangent map, Lyapunov spectra, MEGNO, SALI and GALI."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compilation import AS_FOR_USERS
from helpers import ARGS, SYSTEMS, central_difference, covering, flow, state, symplectic_defect
from scipy.integrate import solve_ivp

import dvi_jax as dvi
from dvi_jax import systems

HENON = systems.henon_heiles()
REGULAR = (HENON.q0, HENON.p0)
CHAOTIC = ([0.0, -0.25], [0.42, 0.0])
"""Skokos, Bountis & Antonopoulos 2007: a chaotic orbit of energy 0.125, λ_1 = 0.047."""


DAMPED = [1.0, 0.3], [0.0, 0.2]


def run(system, q0, p0, observe, **options):
    settings = {"h": 0.05, "method": dvi.Strang(), "save": dvi.Save(final=True)}
    settings["adjoint"] = dvi.Direct()  # compiled soonest
    return dvi.integrate(system, q0, p0, observe=observe, **(settings | options))


def seen(*args, **options):
    return run(*args, **options).observed


@functools.cache
def observed(start, num_steps, every=None):
    """All indicators along an orbit of Hénon and Heiles."""
    kinds = {
        "lyapunov": dvi.LyapunovSpectrum(),
        "megno": dvi.MEGNO(),
        "sali": dvi.SALI(log10=True),
        "gali": dvi.GALI(4, log10=True),
    }
    save = dvi.Save(final=True)
    if every is not None:
        kinds, save = {n: dvi.Running(kind) for n, kind in kinds.items()}, dvi.Save(every=every)
    of = {"regular": REGULAR, "chaotic": CHAOTIC}[start]
    found = seen(HENON.system, *of, kinds, num_steps=num_steps, save=save)
    return {name: np.asarray(value) for name, value in found.items()}


KINDS = {
    "TypeII": dvi.TypeII(),
    "Adjoint": dvi.Adjoint(),
    "Strang": dvi.Strang(),
    "Yoshida4": dvi.Yoshida(4),
    "GaussLegendre2": dvi.GaussLegendre(2),
}


@functools.cache
def tangent(name, method, num_steps=5, **options):
    """The tangent map as a compiled function of epsilon."""
    given = {"h": 0.1, "num_steps": num_steps, "args": ARGS, "method": method, **options}
    of = jax.jit(lambda epsilon: seen(*SYSTEMS[name], dvi.TangentMap(), epsilon=epsilon, **given))
    return lambda epsilon: np.asarray(of(epsilon))


def cases(quick, names):
    """Each method on one of the systems, all but the quick ones marked slow."""
    return [
        pytest.param(n, m, marks=[] if (n, m) in quick else [pytest.mark.slow])
        for n, m in covering(names, KINDS)
    ]


@pytest.mark.parametrize(
    ("name", "method"),
    cases([("double_pendulum", "TypeII"), ("kepler", "Adjoint")], ["double_pendulum", "kepler"]),
)
@pytest.mark.slow
def test_tangent_map_is_the_derivative_of_the_run(name, method):
    """Against differences of runs, with a force; without the force it is another one."""
    of = jax.jit(flow(SYSTEMS[name][0], KINDS[method], 0.1, num_steps=5, epsilon=0.3))
    z = state(name)
    by_differences = np.stack(
        [central_difference(of, z, e) for e in np.eye(len(z))], axis=1
    )  # step 1e-5, extrapolated: 1e-10 or so
    found = tangent(name, KINDS[method])(0.3)
    assert np.max(np.abs(found - by_differences)) < 1e-9
    assert np.max(np.abs(found - tangent(name, KINDS[method])(0.0))) > 1e-3


@pytest.mark.parametrize(
    ("name", "method"),
    cases(
        [("double_pendulum", "Adjoint"), ("non_separable", "TypeII")],
        ["non_separable", "double_pendulum"],
    ),
)
def test_tangent_map_is_symplectic(name, method):
    one, many = (tangent(name, KINDS[method], num_steps=n) for n in (1, 20))
    assert symplectic_defect(one(0.0)) < 1e-13
    assert symplectic_defect(many(0.0)) < 1e-12
    assert symplectic_defect(one(0.3)) > 1e-3  # damped


def test_tangent_map_of_a_perturbation_is_symplectic():
    """A Hamiltonian perturbation; Runge–Kutta 4 as the control."""
    problem = systems.perturbed_pendulum()
    start, given = (problem.q0, problem.p0), {"h": 0.3, "num_steps": 1, "epsilon": 0.3}
    for method, fine in ((dvi.TypeII(), True), (dvi.RungeKutta4(), False)):
        M = seen(problem.system, *start, dvi.TangentMap(), method=method, **given)
        defect = symplectic_defect(np.asarray(M))
        assert defect < 1e-13 if fine else defect > 1e-7


@pytest.mark.slow
def test_tangent_maps_as_functions_and_of_bodies_in_space():
    """One step by default; all of those of a lattice of given times."""
    system, q, p = SYSTEMS["kepler"]
    options, times = {"epsilon": 0.3, "args": ARGS, "method": dvi.Strang()}, np.arange(6) * 0.1
    one = dvi.tangent_map(system, q, p, h=0.1, **options)
    assert np.max(np.abs(one - tangent("kepler", dvi.Strang(), num_steps=1)(0.3))) < 1e-15
    plain = tangent("kepler", dvi.Strang())(0.3)
    for found in (
        dvi.tangent_map(system, q, p, lattice=dvi.Given(times), **options),
        tangent("kepler", dvi.Strang(), arithmetic=dvi.Compensated())(0.3),
    ):
        assert np.max(np.abs(found - plain)) < 1e-13
    bad = dvi.tangent_map(system, [0.0, 0.0], p, h=0.1, throw=False, **options)
    assert np.isnan(bad).all()
    # A state of shape (3, 2): the order of the components is that of ravel.
    eight = systems.figure_eight()
    given = {"h": 0.01, "num_steps": 10, "args": eight.args}
    M = seen(eight.system, eight.q0, eight.p0, dvi.TangentMap(), **given)
    assert M.shape == (12, 12)
    assert symplectic_defect(np.asarray(M)) < 1e-13
    # A translation of all bodies is mapped to itself.
    shift = np.concatenate([np.tile([1.0, 0.0], 3), np.zeros(6)])
    assert np.max(np.abs(M @ shift - shift)) < 1e-13


def linear(t0, t1, q0, p1, args):
    return jnp.sum(p1**2) / 2 + jnp.sum(jnp.array([1.0, 2.3]) * q0**2) / 2


def damping(t0, t1, q0, p1, args):
    return -p1


@pytest.mark.slow
def test_lyapunov_exponents_of_damped_linear_systems():
    """Those of its map: logarithms of the eigenvalues' sizes; their sum is that of its volume."""
    system = dvi.System(linear, force=damping)
    options = {"h": 0.1, "epsilon": 0.2}
    found = seen(system, *DAMPED, dvi.LyapunovSpectrum(), num_steps=3000, **options)
    M = seen(system, *DAMPED, dvi.TangentMap(), num_steps=1, **options)
    exact = np.sort(np.log(np.abs(np.linalg.eigvals(M))) / 0.1)[::-1]
    assert np.max(np.abs(found - exact)) < 2e-3  # O(1/t), t = 300
    assert abs(np.sum(found) - np.log(np.linalg.det(M)) / 0.1) < 1e-13
    assert abs(np.sum(exact) + 2 * 0.2) < 1e-3  # −ε for each degree of freedom, and O(h²)
    # Of a damped system: what shrank grows, and ⟨Y⟩ with it.
    system, kinds = dvi.System(linear, force=damping), (dvi.LyapunovSpectrum(), dvi.MEGNO())
    (ahead, y), (back, x) = (
        seen(system, *DAMPED, kinds, h=h, epsilon=0.2, num_steps=1000) for h in (0.1, -0.1)
    )
    assert np.max(np.abs(ahead + back[::-1])) < 5e-3
    assert np.all(np.asarray(back) > 0.09)
    assert y < -1
    assert x > 1


def by_scipy(start, first, t):
    """ln |w(t)| and ⟨Y⟩(t) of Hénon and Heiles' flow, variational equations by hand."""

    def field(t, z):
        x, y, px, py, dx, dy, dpx, dpy, _, _ = z
        size = dx * dx + dy * dy + dpx * dpx + dpy * dpy
        fx, fy = -(1 + 2 * y) * dx - 2 * x * dy, -2 * x * dx - (1 - 2 * y) * dy
        growth = (dx * dpx + dy * dpy + dpx * fx + dpy * fy) / size
        Y = 2 * z[8] / t if t > 0 else 0.0
        return [px, py, -x - 2 * x * y, -y - x * x + y * y, dpx, dpy, fx, fy, growth * t, Y]

    z = np.concatenate([*start, first, [0.0, 0.0]])
    end = solve_ivp(field, (0, t), z, method="DOP853", rtol=1e-12, atol=1e-14).y[:, -1]
    return np.log(np.linalg.norm(end[4:8])), end[9] / t


@pytest.mark.parametrize("start", [REGULAR, CHAOTIC], ids=["regular", "chaotic"])
@pytest.mark.slow
def test_growth_and_megno_are_those_of_the_variational_equations(start):
    """SciPy on equations by hand, the same first vector: the same logarithm and ⟨Y⟩."""
    first = np.asarray(dvi.MEGNO().start(jnp.zeros(4))[0][0])
    errors = []
    kinds, growth_and_megno = (dvi.LyapunovSpectrum(1), dvi.MEGNO()), by_scipy(start, first, 50.0)
    for n in (500, 1000):
        given = {"h": 50 / n, "num_steps": n, "method": dvi.GaussLegendre(3)}
        found = seen(HENON.system, *start, kinds, **given)
        assert abs(found[0][0] * 50 - growth_and_megno[0]) < 1e-8
        errors.append(abs(found[1] - growth_and_megno[1]))
    assert errors[1] < 1e-3
    assert 1.7 < np.log2(errors[0] / errors[1]) < 2.3  # its integrals are midpoint sums


@functools.cache
def neighbours(energy, num_steps, orbits, apart):
    """Spectra of orbits that start side by side in the chaotic sea, x = 0, y = −0.25, p_y = 0."""
    y = -0.25 + apart * np.arange(orbits)
    px = np.sqrt(2 * energy - y**2 + 2 * y**3 / 3)
    q, p = np.stack([0 * y, y], 1), np.stack([px, 0 * y], 1)
    kind, n = dvi.LyapunovSpectrum(), num_steps
    return np.asarray(jax.vmap(lambda q, p: seen(HENON.system, q, p, kind, num_steps=n))(q, p))


@pytest.mark.slow
def test_lyapunov_spectrum_at_the_published_start():
    """The mean over 512 copies, 1e-12 apart, after t = 4000; single ones scatter by 0.011."""
    energy = 0.42**2 / 2 + 0.25**2 / 2 + 0.25**3 / 3
    spectra = neighbours(energy, 80_000, 512, 1e-12)
    assert np.max(np.abs(spectra.mean(0) - [0.052, 0, 0, -0.052])) < 0.003
    assert np.max(np.abs(spectra + spectra[:, ::-1])) < 5e-3  # pairs ±λ
    regular = observed("regular", 400_000)["lyapunov"]
    assert np.max(np.abs(regular)) < 6e-4  # ln t / t


@pytest.mark.slow
@pytest.mark.parametrize(("energy", "exponent"), [(0.125, 0.0455), (0.1275, 0.0515), (0.14, 0.072)])
def test_lyapunov_spectrum_over_long_times(energy, exponent):
    """After t = 200 000 the exponent of the sea; it grows with the energy.

    At 0.125 it is below that of t = 4000, for orbits come to stick to islands: published are 0.045
    to 0.047 for single ones.
    """
    spectra = neighbours(energy, 4_000_000, 64, 1e-6)  # standard error 0.0006
    assert np.max(np.abs(spectra.mean(0) - [exponent, 0, 0, -exponent])) < 0.003


@pytest.mark.slow
def test_many_deviation_vectors():
    """All 28 of a chain of 14: the first 12 as alone, the volume kept, and gradients."""
    chain = systems.fput(14, beta=0.3)
    given = {"h": 0.1, "num_steps": 300, "args": chain.args}

    def spectrum(count, size=1.0):
        q0 = size * jnp.asarray(chain.q0)
        return seen(chain.system, q0, chain.p0, dvi.LyapunovSpectrum(count), **given)

    whole = spectrum(28)
    assert np.max(np.abs(whole[:12] - spectrum(12))) < 1e-11
    assert abs(np.sum(whole)) < 1e-12
    assert np.max(np.abs(whole)) > 5e-3
    slope = jax.jvp(lambda size: spectrum(28, size), (1.0,), (1.0,))[1]
    by_differences = central_difference(lambda size: spectrum(28, size), 1.0, 1.0)
    assert np.max(np.abs(slope - by_differences)) < 1e-7
    assert np.max(np.abs(slope)) > 1e-3


@pytest.mark.slow
def test_indicators_in_single_precision():
    """A running sum of 10⁶ steps is off by per cents in float32; these are not."""
    spring = dvi.System(
        lambda t0, t1, q0, p1, args: jnp.sum(p1**2 + q0**2) / 2,
        force=lambda t0, t1, q0, p1, args: -p1,
    )
    kinds = (dvi.LyapunovSpectrum(), dvi.MEGNO())
    start = np.array([1.0], np.float32), np.array([0.0], np.float32)
    spectrum, megno = seen(spring, *start, kinds, epsilon=0.02, num_steps=1_000_000)
    assert spectrum.dtype == jnp.float32
    assert np.max(np.abs(spectrum / -0.01 - 1)) < 2e-4
    assert abs(megno / (-0.02 * 50_000 / 4) - 1) < 2e-4
    assert abs(float(np.cumsum(np.full(1_000_000, 0.05, np.float32))[-1]) / 50_000 - 1) > 5e-3


@pytest.mark.slow
def test_megno_tells_order_from_chaos_in_any_units():
    regular, chaotic = (observed(s, 400_000, every=40_000) for s in ("regular", "chaotic"))
    away = np.abs(regular["megno"] - 2)
    assert np.all(np.diff(away) < 0)
    assert away[-1] < 0.01
    t = 0.05 * 400_000
    assert chaotic["megno"][-1] > 50
    exponent = chaotic["lyapunov"][-1, 0]
    assert 0.6 < chaotic["megno"][-1] / (exponent * t / 2) < 1.5
    kind = dvi.MEGNO(scale=(10.0, np.array([1.0, 3.0])))
    scaled = seen(HENON.system, *REGULAR, kind, num_steps=400_000)
    assert abs(scaled - observed("regular", 400_000)["megno"]) > 1e-6
    assert abs(scaled - 2) < 0.01


def drive(t0, t1, q0, p1, args):
    """A force that depends on time alone."""
    return jnp.cos(args["frequency"] * t0) * jnp.ones_like(q0)


def pendulum(t0, t1, q0, p1, args):
    return jnp.sum(p1**2) / 2 - jnp.sum(jnp.cos(q0))


@pytest.mark.slow
def test_megno_with_a_disturbing_force():
    """A pendulum near its separatrix, driven: torus at small ε, chaos at larger ones."""
    system, args = dvi.System(pendulum, force=drive), {"frequency": 1.1}
    kinds, given = (dvi.MEGNO(), dvi.LyapunovSpectrum()), {"args": args, "num_steps": 100_000}
    of = jax.vmap(lambda e, p: seen(system, jnp.zeros(1), p[None], kinds, epsilon=e, **given))
    megno, spectrum = of(jnp.array([0.0, 0.01, 0.5]), jnp.array([1.0, 1.0, 1.9]))
    assert np.max(np.abs(megno[:2] - 2)) < 0.03
    assert megno[2] > 50
    assert spectrum[2, 0] > 0.05
    assert abs(spectrum[2].sum()) < 1e-12  # a force without p keeps the volume


@pytest.mark.slow
def test_megno_of_three_bodies_is_that_of_rebound():
    """A planet next to Jupiter: 2 where it is stable, for both, and large where it is not."""
    rebound = pytest.importorskip("rebound")

    def of(a):
        sim = rebound.Simulation()
        sim.add(m=1.0)
        sim.add(m=1e-3, a=1.0, e=0.05)
        sim.add(m=1e-3, a=a, e=0.05, f=2.0)
        sim.move_to_com()
        q, v = (np.array([[*getattr(b, x)] for b in sim.particles]) for x in ("xyz", "vxyz"))
        m = np.array([b.m for b in sim.particles])
        sim.integrator, sim.dt = "whfast", 0.05
        sim.init_megno(seed=1)
        sim.integrate(5000.0)
        problem = systems.n_body(m, q, m[:, None] * v)
        given = {"h": 0.05, "num_steps": 100_000, "args": problem.args, "method": dvi.Yoshida(4)}
        kind = dvi.MEGNO(scale=(1.0, m[:, None] * np.ones(3)))
        return sim.megno(), float(seen(problem.system, q, m[:, None] * v, kind, **given))

    theirs, ours = of(1.9)
    assert abs(theirs - 2) < 0.1
    assert abs(ours - 2) < 0.1
    theirs, ours = of(1.3)
    assert min(theirs, ours) > 20


def brute_force(start, num_steps):
    """GALI_2, 3, 4 and SALI from the product of all tangent maps, by singular values."""
    M = np.asarray(seen(HENON.system, *start, dvi.TangentMap(), num_steps=num_steps))
    w = np.asarray(dvi.GALI(4).start(jnp.zeros(4))[0]) @ M.T
    w /= np.linalg.norm(w, axis=1, keepdims=True)
    volumes = [np.prod(np.linalg.svd(w[:k], compute_uv=False)) for k in (2, 3, 4)]
    return volumes, min(np.linalg.norm(w[0] + w[1]), np.linalg.norm(w[0] - w[1]))


@pytest.mark.parametrize("start", ["regular", "chaotic"])
@pytest.mark.slow
def test_gali_and_sali_are_volumes_of_unit_vectors(start):
    for num_steps in (1, 100, 1000):
        found = observed(start, num_steps)
        volumes, sali = brute_force({"regular": REGULAR, "chaotic": CHAOTIC}[start], num_steps)
        assert np.max(np.abs(10 ** found["gali"] / volumes - 1)) < 1e-9
        assert abs(10 ** found["sali"] / sali - 1) < 1e-9
    plain = seen(HENON.system, *REGULAR, (dvi.GALI(2), dvi.SALI()), num_steps=100)
    assert abs(np.log10(plain[0][0]) - observed("regular", 100)["gali"][0]) < 1e-12
    assert abs(np.log10(plain[1]) - observed("regular", 100)["sali"]) < 1e-12


@pytest.mark.slow
def test_gali_falls_as_theory_says():
    """ln GALI_k(t) = −Σ (λ_1 − λ_i) t, far beyond round-off."""
    num_steps = 100_000
    found, t = observed("chaotic", num_steps), 0.05 * num_steps
    spectrum = found["lyapunov"]
    for k in (2, 3, 4):
        law = -np.sum(spectrum[0] - spectrum[:k]) * t / np.log(10)
        assert law < -20  # by how much is a matter of the last digits of the arithmetic
        assert abs(found["gali"][k - 2] - law) < 0.02 * abs(law) + 2
    assert abs(found["sali"] - found["gali"][0]) < 1e-9  # of a small angle
    # GALI_2 stays, GALI_3 ~ t⁻², GALI_4 ~ t⁻⁴.
    found = observed("regular", 400_000, every=40_000)["gali"]
    slopes = np.polyfit(np.log10(np.arange(1, 11)), found, 1)[0]
    assert np.max(np.abs(slopes - [0, -2, -4])) < 0.25
    kinds = (dvi.GALI(4), dvi.GALI(4, log10=True))
    found = seen(HENON.system, *CHAOTIC, kinds, num_steps=200_000)
    assert found[0][-1] == 0  # it underflows, and its logarithm does not
    assert found[1][-1] < -400


@pytest.mark.slow
def test_running_values():
    along = observed("chaotic", 2000, every=500)
    for i, n in enumerate((500, 1000, 1500, 2000)):
        for name, value in observed("chaotic", n).items():
            assert np.max(np.abs(along[name][i] - value)) < 1e-7, name
    # Cut into pieces for progress: the same numbers.
    calls, kinds = [], {"megno": dvi.Running(dvi.MEGNO())}
    options = {"num_steps": 2000, "save": dvi.Save(every=500)}
    progress = lambda done, of: calls.append(done)  # noqa: E731
    pieces = seen(HENON.system, *CHAOTIC, kinds, progress=progress, **options)
    assert calls
    assert np.max(np.abs(along["megno"] - pieces["megno"])) < 1e-7
    energy = HENON.observables["energy"]
    mean_energy, options = dvi.Mean(energy), {"num_steps": 1000, "save": dvi.Save(every=100)}

    def values(*observed):
        of = jax.jit(
            lambda q, p: seen(HENON.system, q, p, observed, **options),
            compiler_options=AS_FOR_USERS,
        )
        return of(*map(jnp.asarray, REGULAR))

    mean, alone, last, drift = values(
        dvi.Running(mean_energy), energy, mean_energy, dvi.Running(dvi.MaxDrift(energy))
    )
    assert mean.shape == drift.shape == (10,)
    assert alone.shape == (11,)  # a function of the state has a value at the initial one
    assert mean[-1] == last
    assert mean[0] != last
    assert np.all(np.diff(drift) >= 0)
    assert np.array_equal(alone, values(energy)[0])


@pytest.mark.slow
def test_batches_layouts_and_sweeps():
    q, p = (np.array([a, b]) for a, b in zip(REGULAR, CHAOTIC, strict=True))
    kinds = (dvi.MEGNO(), dvi.LyapunovSpectrum(), dvi.GALI(3, log10=True))
    forms = [
        jax.vmap(
            lambda q, p, form=form: seen(
                HENON.system, q, p, kinds, num_steps=500, layout=dvi.Layout(form)
            )
        )(q, p)
        for form in ("arrays", "auto")
    ]
    for i, start in enumerate((REGULAR, CHAOTIC)):
        alone = seen(HENON.system, *start, kinds, num_steps=500)
        for form in forms:
            for a, b in zip(alone, form, strict=True):
                assert np.max(np.abs(a - b[i])) < 1e-8
    # Orbits and ε in a grid, each with a status; the same numbers as one by one.
    system = dvi.System(HENON.system.H_D, force=lambda t0, t1, q0, p1, args: -p1)
    result = dvi.sweep(
        system, HENON.q0, [HENON.p0[0], dvi.Axis("py", np.array([0.0, 0.2, 3.0]))],
        epsilon=np.array([0.0, 1e-3]), h=0.05, num_steps=1000, method=dvi.Strang(),
        observe={"megno": dvi.MEGNO(), "lyapunov": dvi.LyapunovSpectrum(2)},
    ).to_xarray()  # fmt: skip
    assert result.megno.dims == ("epsilon", "py")
    assert result.lyapunov.shape == (2, 3, 2)
    assert list(result.status.values[0]) == [0, 0, 2]  # the last one has energy to escape
    assert np.isnan(result.megno.values[:, 2]).all()
    alone = seen(system, HENON.q0, [HENON.p0[0], 0.2], dvi.MEGNO(), epsilon=1e-3, num_steps=1000)
    assert abs(result.megno.values[1, 1] - alone) < 1e-10


@pytest.mark.slow
def test_an_orbit_that_escapes_has_a_status_and_no_number():
    q = np.array([[0.0, 0.1], [0.0, 1.5], [0.0, 0.1]])
    p = np.array([[0.3, 0.2], [0.0, 1.0], [0.3, 0.2]])
    kinds = {"megno": dvi.MEGNO(), "gali": dvi.GALI(2), "along": dvi.Running(dvi.MEGNO())}
    options = {"num_steps": 2000, "throw": False}
    save = dvi.Save(every=200)
    sol = jax.vmap(lambda q, p: run(HENON.system, q, p, kinds, save=save, **options))(q, p)
    assert list(sol.status) == ["successful", "not_finite", "successful"]
    found = {name: np.asarray(value) for name, value in sol.observed.items()}
    for value in found.values():
        assert np.isnan(value[1]).any()
        assert np.isfinite(value[[0, 2]]).all()
    assert np.array_equal(found["megno"][0], found["megno"][2])
    # With a Stop the value is that of the steps before, and the status says why it ends.
    far = dvi.Stop(lambda t, q, p, args: jnp.sum(q**2) - 9)
    stopped = run(HENON.system, q[1], p[1], kinds, save=dvi.Save(every=10), stop=far, **options)
    assert stopped.status == "stopped"
    assert np.isfinite(stopped.observed["megno"])
    assert np.isnan(stopped.observed["along"][-1])


def test_a_failure_in_the_very_last_step_leaves_no_number():
    """And a count of vectors may be an integer of NumPy."""

    def bad(t0, t1, q0, p1, args):
        return jnp.sum(p1**2) / 2 + jnp.sum(jnp.where(t0 > 0.85, jnp.nan, 0.5) * q0**2)

    kinds = (dvi.MEGNO(), dvi.LyapunovSpectrum(np.int64(2)))
    options = {"h": 0.1, "num_steps": 10, "method": dvi.TypeII(), "throw": False}
    sol = run(dvi.System(bad), [1.0], [0.0], kinds, **options)
    assert sol.status == "not_finite"
    assert int(sol.stats["failed_step"]) == 9
    assert np.isnan(sol.observed[0])
    assert np.isnan(sol.observed[1]).all()
    assert sol.observed[1].shape == (2,)


@pytest.mark.slow
def test_gradients_of_an_indicator():
    """d⟨Y⟩/dε by reverse and forward mode against differences."""
    system, given = dvi.System(pendulum, force=drive), {"args": {"frequency": 1.1}}

    def megno(epsilon, adjoint=dvi.Reversible()):
        options = {"epsilon": epsilon, "num_steps": 200, "adjoint": adjoint, **given}
        return seen(system, [0.3], [0.5], dvi.MEGNO(), **options)

    by_differences = central_difference(jax.jit(megno), 0.1, 1.0)
    slope = jax.jit(jax.grad(megno), static_argnums=1)
    for adjoint in (dvi.Reversible(), dvi.Direct()):
        assert abs(slope(0.1, adjoint) / by_differences - 1) < 1e-7
    pushed = jax.jit(lambda epsilon: jax.jvp(megno, (epsilon,), (1.0,))[1])(0.1)
    assert abs(pushed / by_differences - 1) < 1e-7
    assert abs(by_differences) > 1e-3


@pytest.mark.slow
def test_memory_does_not_grow_with_the_steps():
    kinds = (dvi.MEGNO(), dvi.LyapunovSpectrum(), dvi.GALI(4))

    def size(num_steps):
        options = {"num_steps": num_steps, "adjoint": dvi.Reversible()}
        of = jax.jit(jax.vmap(lambda q, p: seen(HENON.system, q, p, kinds, **options)))
        q, p = np.tile(REGULAR[0], (8, 1)), np.tile(REGULAR[1], (8, 1))
        memory = of.lower(q, p).compile().memory_analysis()
        return memory.temp_size_in_bytes + memory.output_size_in_bytes

    assert size(128_000) < 1.1 * size(12_800) + 10_000
    energy = HENON.observables["energy"]
    options = {"num_steps": 128_000, "save": dvi.Save()}
    along = jax.jit(lambda q, p: seen(HENON.system, q, p, energy, **options))
    stored = along.lower(*map(jnp.asarray, REGULAR)).compile().memory_analysis()
    assert stored.output_size_in_bytes > 1_000_000  # the control: values saved at every step


class SumOfSquares(dvi.Reduction):
    """A reduction of a user; `pull` is not needed."""

    function: callable

    def start(self, value):
        return jnp.zeros_like(value)

    def update(self, memory, k, t, value):
        return memory + value**2

    def combine(self, memory, k, t, value):
        return memory + self.change(value**2)

    def finish(self, memory):
        return memory


class ByHand(SumOfSquares):
    """The same with a cotangent by hand, the only way of former versions."""

    def pull(self, memory, cotangent, k, t, value):
        return jnp.zeros_like(t), cotangent * 2 * value


class Without(SumOfSquares):
    """A reduction without `combine`."""

    combine = dvi.Reduction.combine


def test_a_users_reduction_has_a_reversible_gradient_by_combine():
    def total(kinds, adjoint):
        def of(q):
            each = [kind(lambda t0, t1, q0, p0, q1, p1, args: q1[0]) for kind in kinds]
            return jnp.stack(seen(HENON.system, q, REGULAR[1], each, num_steps=20, adjoint=adjoint))

        return np.asarray(jax.jit(jax.jacrev(of))(jnp.asarray(REGULAR[0])))

    (expected,) = total([SumOfSquares], dvi.Direct())
    for found in total([SumOfSquares, ByHand], dvi.Reversible()):
        np.testing.assert_allclose(found, expected, rtol=1e-12)
    said = r"Without has no method combine.*dvi\.Reversible"
    with pytest.raises(NotImplementedError, match=said):
        total([Without], dvi.Reversible())
