"""Runs from quantities of astropy to quantities of astropy."""

import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi
from dvi_jax import interop, systems

u = pytest.importorskip("astropy.units")


def H(t, q, p, args):
    """One planet of mass m about a Sun of GM = mu."""
    return jnp.sum(p**2) / (2 * args["m"]) - args["mu"] * args["m"] / jnp.sqrt(jnp.sum(q**2))


SYSTEM = dvi.System(dvi.discretise(H))
KINDS = {"mu": u.km**3 / u.s**2, "m": u.g}
ARGS = {"mu": 1.32712440018e20 * u.m**3 / u.s**2, "m": 5.97e24 * u.kg}
Q0, P0 = [1, 0] * u.au, [0, 29.78 * 5.97e24] * (u.kg * u.km / u.s)
SI = interop.UnitSystem(u.m, u.s, u.kg, args=KINDS)
SOLAR = interop.UnitSystem(length="au", time=u.day, mass=u.Msun, args=KINDS)


def run(units, **changes):
    given = {"q0": Q0, "p0": P0, "h": 1 * u.day, "num_steps": 100, "args": ARGS}
    return interop.integrate(SYSTEM, units=units, **{**given, "method": dvi.KahanLi(8), **changes})


def test_orbits_and_observables_are_the_same_in_other_units():
    a, b = run(SOLAR), run(SI)
    assert (a.qs.unit, b.qs.unit) == (u.au, u.m)
    assert a.ps.unit == u.Msun * u.au / u.day
    assert a.status == "successful"
    for x, y in ((a.qs, b.qs), (a.ps, b.ps), (a.ts, b.ts), (a.hs, b.hs)):
        difference = ((x - y) / np.abs(y).max()).to_value(u.one)
        np.testing.assert_allclose(difference, 0, rtol=0, atol=2e-13)
    # The numbers of the two runs are far apart.
    assert np.asarray(b.solution.qs).max() > 1e11 * np.asarray(a.solution.qs).max()
    other = run(SOLAR, h=2 * u.day, num_steps=50, method=dvi.Strang())
    assert np.abs((other.qs[-1] - a.qs[-1]).to_value(u.au)).max() > 1e-7

    def energy(t0, t1, q0, p0, q1, p1, args):
        return H(t1, q1, p1, args)

    a, b = (run(units, observe={"E": energy}) for units in (SOLAR, SI))
    joule = [(x.observed["E"] * x.units.energy).to_value(u.J) for x in (a, b)]
    np.testing.assert_allclose(*joule, rtol=1e-13)
    np.testing.assert_allclose(joule[0][-1], joule[0][0], rtol=1e-11)
    assert a.units.energy.is_equivalent(u.J)


@pytest.mark.slow
def test_arguments_in_other_units_of_the_same_kind():
    a = run(SOLAR)
    args = {"mu": 398600.435507 * 332946.0487 * u.km**3 / u.s**2, "m": 5.97e27 * u.g}
    b = run(SOLAR, q0=[149597870.7 * u.km, 0 * u.m], h=24 * u.hour, args=args)
    np.testing.assert_allclose(b.qs.value, a.qs.value, rtol=0, atol=1e-8)  # two values of GM☉
    at = run(SOLAR, ts=[0, 12, 36] * u.hour)
    np.testing.assert_allclose(at.ts.to_value(u.hour), [0, 12, 36], rtol=1e-15)
    np.testing.assert_allclose(at.solution.ts, [0, 0.5, 1.5], rtol=1e-15)


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"h": 1 * u.m}, ValueError, r"h is in m \(length\).*time"),
        ({"h": 1.0}, TypeError, "no unit"),
        ({"q0": np.array([1.0, 0.0])}, TypeError, "q0 .*no unit"),
        ({"q0": [1 * u.au, 0.1]}, TypeError, "all entries of q0 must"),
        ({"q0": [1 * u.au, 0 * u.s]}, TypeError, "all entries of q0 must"),
        ({"q0": None}, TypeError, "q0 is missing"),
        ({"p0": [0, 29.78] * u.km / u.s}, ValueError, "speed.*momentum"),
        ({"t0": 1 * u.kg}, ValueError, "mass.*time"),
        ({"args": {**ARGS, "m": 1.0}}, TypeError, "m .*no unit"),
        ({"args": {**ARGS, "mu": 1 * u.m}}, ValueError, "args mu is in m"),
        ({"args": {**ARGS, "J": 1 * u.m}}, TypeError, "units has no unit for J"),
        ({"epsilon": 1 * u.m}, ValueError, "epsilon"),
        ({"ts": [1, 2] * u.m}, ValueError, "ts is in m"),
        ({"save": dvi.Save(ts=[1.0])}, TypeError, "have no unit"),
        ({"lattice": dvi.Given([0.0, 1.0])}, TypeError, "have no unit"),
        ({"ts": [1] * u.day, "save": dvi.Save()}, TypeError, "leave save out"),
        ({"units": {"length": "m"}}, TypeError, "UnitSystem"),
    ],
    ids=lambda x: "",
)
def test_wrong_units(changes, error, words):
    with pytest.raises(error, match=words):
        run(changes.pop("units", SI), **changes)


def test_a_system_needs_units_and_a_problem_has_them():
    with pytest.raises(TypeError, match="UnitSystem"):
        run(None)
    problem = systems.oblate_kepler()
    units = interop.UnitSystem.of(problem)
    assert (units.q, units.t, units.energy) == (u.km, u.s, (u.km / u.s) ** 2)
    assert units.args == {"mu": u.km**3 / u.s**2, "R": u.km}
    sol = interop.integrate(problem, h=10 * u.s, num_steps=10)
    run_ = {"h": 10.0, "num_steps": 10, "args": problem.args}
    ours = dvi.integrate(problem.system, problem.q0, problem.p0, **run_)
    assert np.array_equal(sol.qs.to_value(u.km), ours.qs)
    args = {"mu": 3.986e14 * u.m**3 / u.s**2}
    steps = {"h": 10 * u.s, "num_steps": 10}
    higher = interop.integrate(problem, problem.q0 * u.km, args=args, **steps)
    off = np.abs((higher.qs - sol.qs).to_value(u.m)).max()
    assert 1e-3 < off < 10  # μ in the seventh digit
    with pytest.raises(ValueError, match=r"hill measures q in"):
        interop.UnitSystem.of(systems.hill())
    with pytest.raises(ValueError, match="h is in s"):  # it is dimensionless
        interop.integrate(systems.kepler(), h=1 * u.s, num_steps=3)


def test_kinds_of_units():
    with pytest.raises(ValueError, match=r"time must be a unit of time.*\(length\)"):
        interop.UnitSystem(u.m, u.m, u.kg)
    with pytest.raises(ValueError, match="q must be a unit of astropy"):
        interop.UnitSystem(u.m, u.s, u.kg, q="longitude")
    made = interop.UnitSystem(u.m, u.s, u.kg, args={"mu": u.au**3 / u.yr**2})
    assert made.args["mu"] == u.m**3 / u.s**2
    problem = systems.double_pendulum()
    a = interop.integrate(problem, np.rad2deg(problem.q0) * u.deg, h=1e-3 * u.s, num_steps=5)
    b = interop.integrate(problem, h=1 * u.ms, num_steps=5)
    np.testing.assert_allclose(a.qs.value, b.qs.value, rtol=0, atol=1e-15)
    assert a.qs.unit == u.rad
    made = interop.UnitSystem("km", "s", "kg", q="angle", p="angular momentum")
    assert made.p == u.kg * u.km**2 / u.s
    assert made.p != problem.units["p"]


SPRING = dvi.System(lambda t0, t1, q0, p1, args: (p1 @ p1 + args["k"] * (q0 @ q0)) / 2)
RUN = {"q0": np.ones(1), "p0": np.zeros(1), "h": 0.1, "num_steps": 2, "args": {"k": 1.0}}


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("q0", {"q0": np.ones(1) * u.m}),
        ("p0", {"p0": np.ones(1) * u.dimensionless_unscaled}),
        ("h", {"h": 0.1 * u.s}),
        ("epsilon", {"epsilon": 0.1 * u.percent}),
        ("args", {"args": {"k": 1.0 * u.N / u.m}}),
    ],
)
def test_integrate_rejects_quantities(name, change):
    """It would drop their unit."""
    with pytest.raises(TypeError, match=rf"^{name} has the unit .*interop.integrate"):
        dvi.integrate(SPRING, **{**RUN, **change})


TS, VALUES = np.linspace(0.1, 1, 4), np.ones((4, 1))


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: dvi.Observations(TS * u.s, VALUES, sigma=1.0), "ts has the unit 's'"),
        (lambda: dvi.Save(ts=TS * u.s), "ts has the unit 's'"),
        (lambda: dvi.Given(TS * u.s), "ts has the unit 's'"),
        (lambda: dvi.Observations(TS, VALUES, sigma=1.0 * u.km), "sigma has the unit 'km'"),
        (lambda: dvi.Axis("k", TS * u.N), "axis 'k' has the unit 'N'"),
        (lambda: dvi.frequencies(np.arange(100.0), np.ones(100) * u.m), "has the unit 'm'"),
    ],
    ids=lambda x: "",
)
def test_times_data_and_axes_reject_quantities(call, words):
    with pytest.raises(TypeError, match=words):
        call()
    assert dvi.integrate(SPRING, **RUN).qs.shape == (3, 1)  # the control: numbers


def weights(masses, k=1 * u.N / u.m, kinds=None):
    """A weight on each of two springs."""

    def energy(t, q, p, args):
        return jnp.sum(p**2 / jnp.asarray(args["masses"])) / 2 + args["k"] * jnp.sum(q**2) / 2

    kinds = {"masses": u.kg} | ({"k": u.N / u.m} if kinds is None else kinds)
    given = {"units": interop.UnitSystem(u.m, u.s, u.kg, args=kinds), "h": 0.1 * u.s}
    given |= {"args": {"masses": masses, "k": k}, "num_steps": 3}
    state = [1, 1] * u.m, [0, 0] * u.kg * u.m / u.s
    return interop.integrate(dvi.System(dvi.discretise(energy)), *state, **given).qs[-1].value


def test_units_of_parameters():
    wanted = weights([1, 2] * u.kg)
    np.testing.assert_array_equal(weights([1 * u.kg, 2000 * u.g]), wanted)
    assert np.abs(weights([1 * u.kg, 2 * u.g]) - wanted).max() > 1e-3
    with pytest.raises(TypeError, match=r"args masses.0 = 1.0 has no unit"):
        weights([1.0, 2.0])
    with pytest.raises(ValueError, match=r"units for 'kk', .* without a unit: 'k'\. "):
        weights([1, 2] * u.kg, k=5.0, kinds={"kk": u.N / u.m})
    with pytest.raises(ValueError, match=r"'J22', but oblate_kepler has no such.*mu, R, J2"):
        interop.integrate(systems.oblate_kepler(), h=10 * u.s, num_steps=1, args={"J22": 0.0})
    with pytest.raises(TypeError, match=r"mapping from name to value, got \[0\.0\]"):
        interop.integrate(systems.oblate_kepler(), h=10 * u.s, num_steps=1, args=[0.0])


def test_a_problem_of_the_library_in_other_units():
    problem = systems.oblate_kepler()
    own = interop.integrate(problem, h=10 * u.s, num_steps=20)
    kinds = {"mu": u.m**3 / u.s**2, "R": u.m}
    units = interop.UnitSystem(u.m, u.s, u.kg, p="velocity", args=kinds)
    for changed in ({}, {"q0": problem.q0 * u.km, "args": {"J2": problem.args["J2"]}}):
        si = interop.integrate(problem, h=10 * u.s, num_steps=20, units=units, **changed)
        assert si.qs.unit == u.m
        np.testing.assert_allclose(si.qs.to_value(u.km), own.qs.value, rtol=1e-13)


def test_masked_values_and_units_without_a_factor():
    masked = pytest.importorskip("astropy.utils.masked").Masked
    with pytest.raises(ValueError, match="q0 must not have masked values"):
        run(SOLAR, q0=masked([1, 0] * u.au, mask=[False, True]))
    for unit in (u.deg_C, u.mag, u.ABmag, u.photon / u.s):
        with pytest.raises(ValueError, match="the unit of T must"):
            interop.UnitSystem(u.m, u.s, u.kg, args={"T": unit})
    with pytest.raises(ValueError, match=r"Convert it: k\.to\(u\.K, u\.temperature"):
        weights([1, 2] * u.kg, k=5 * u.deg_C, kinds={"k": u.K})
