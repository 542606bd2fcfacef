"""Discovery of adiabatic invariants on the map that is iterated."""

import functools
import re
import subprocess
import sys

import faults
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi
from dvi_jax import systems
from dvi_jax.base.files import publish_npz, read_npz
from dvi_jax.discover.functions.basis import bind_basis
from dvi_jax.discover.functions.sampling import SamplePoints, as_samples
from dvi_jax.discover.invariants import changes
from dvi_jax.discover.symmetries import conditions
from dvi_jax.methods.step import Equations

H_D = systems.oscillator().system.H_D
OSCILLATOR = dvi.System(H_D)
SPRING = dvi.System(H_D, force=lambda t0, t1, q, p, args: -q)
CUBIC = dvi.System(H_D, force=lambda t0, t1, q, p, args: -(q**3))
VAN_DER_POL = dvi.System(H_D, force=lambda t0, t1, q, p, args: (1 - q**2) * p)


def box(n, count, seed=0, low=-1.0, high=1.0):
    rng = np.random.default_rng(seed)
    return rng.uniform(low, high, (count, n)), rng.uniform(low, high, (count, n))


def discover(system, degree, order=0, samples=None, **more):
    """In polynomials of a degree, or in another basis, at h = 0.1."""
    basis = dvi.Polynomials(degree) if isinstance(degree, int) else degree
    samples = box(1, 60) if samples is None else samples
    return dvi.discover_invariants(system, basis, order, **{"h": 0.1, "samples": samples, **more})


@functools.cache
def found(name, degree, order, representative="least"):
    system = {"spring": SPRING, "cubic": CUBIC, "van_der_pol": VAN_DER_POL}[name]
    return discover(system, degree, order, box(1, 300), representative=representative)


def of(series, m=0):
    """The coefficients of order m by the names of the functions."""
    return dict(zip(series.basis.names, np.asarray(series.coefficients[m]), strict=True))


@pytest.mark.parametrize(
    ("order", "slope", "within", "smallest"),
    [
        (0, 1.0, 0.02, 1e-3),
        pytest.param(1, 2.0, 0.02, 1e-3, marks=pytest.mark.slow),
        pytest.param(2, 3.0, 0.03, 1e-3, marks=pytest.mark.slow),
        # Where ε⁴ is above round-off.
        pytest.param(3, 4.0, 0.4, 2e-3, marks=pytest.mark.slow),
    ],
)
def test_drift_has_the_order_promised(order, slope, within, smallest):
    d = found("cubic", 8, order)
    assert np.max(d.residuals) < 1e-11
    epsilons = smallest * 2.0 ** np.arange(6)
    run = {"epsilons": epsilons, "h": 0.1, "num_steps": 20_000}
    measured = dvi.drift_order(CUBIC, d.invariants[0], [0.4], [0.3], **run)
    assert measured.used.sum() >= 3
    assert abs(measured.slope - slope) < within
    assert measured.successful.all()


def test_the_least_and_the_simplest_corrections_differ_by_what_is_kept():
    """And the simplest ones, which happen to be nearly exact here, drift far less."""
    least, simplest = found("cubic", 4, 1), found("cubic", 4, 1, "simplest")
    np.testing.assert_allclose(least.coefficients[0, 0], simplest.coefficients[0, 0], atol=1e-12)
    difference = np.asarray(least.coefficients[0, 1] - simplest.coefficients[0, 1])
    q, p = box(1, 50, seed=7)
    series = dvi.InvariantSeries(least.basis, jnp.asarray(difference)[None])
    q1, p1 = q + 0.1 * (p - 0.1 * q), p - 0.1 * q  # the unperturbed map
    values = jax.vmap(lambda q, p: series.evaluate(q, p, 0.0))
    np.testing.assert_allclose(values(q1, p1), values(q, p), atol=1e-13)
    assert np.std(values(q, p)) > 1e-2


@pytest.mark.slow
def test_exact_invariant_of_the_disturbed_spring():
    """(p² + (1+ε)q² − h(1+ε)qp)/2, ε included and at every order after the first nothing."""
    d = found("spring", 4, 2)
    assert str(d.invariants[0]) == "0.5 q² − 0.05 q p + 0.5 p² + ε (0.5 q² − 0.05 q p)"
    assert "exact at every ε tried" in str(d)
    assert (d.exact, found("cubic", 8, 1).exact) == ((True,), (False,))
    run = {"epsilons": [0.01, 0.1, 0.3], "h": 0.1, "num_steps": 2000}
    assert np.max(dvi.drift_order(SPRING, d.invariants[0], [0.4], [0.3], **run).drifts) < 1e-14


@pytest.mark.slow
def test_van_der_pol_loses_the_amplitude_and_says_how():
    """Averaged: D(A) = εh(A − A²/2)-like in A = |z|²/2, so the limit cycle has amplitude 2."""
    d = found("van_der_pol", 6, 2)
    assert (d.survivors, d.count) == ((3, 0, 0), 0)
    law = d.obstructions[0]
    assert (law.order, law.kind) == (1, "dissipation")
    assert law.leading == "0.5 q² − 0.05 q p + 0.5 p²"
    assert law.residual < 1e-10
    at = dict(zip(d.basis.names, law.coefficients, strict=True))
    # on a circle of radius r: r²·0.05 − r⁴·0.0125 = 0 at r = 2, up to O(h²)
    assert np.sqrt(-at["p²"] / at["p⁴"]) == pytest.approx(2.0, abs=0.01)
    assert "lost at order 1 (dissipation)" in str(d)
    # as a law of I = (p² + q² − hqp)/2 itself: I is at rest at 2, up to O(h²)
    np.testing.assert_allclose(law.powers, [0, 0.1, -0.05], atol=2e-4)
    np.testing.assert_allclose(law.rest, [2.0], atol=0.01)


@pytest.mark.parametrize("start", [0.5, 3.0])
@pytest.mark.slow
def test_van_der_pol_settles_where_its_law_is_at_rest(start):
    """Negative control of the same law: a start elsewhere does not stay."""
    d = found("van_der_pol", 6, 2)
    law = d.obstructions[0]
    form = dvi.InvariantSeries(d.basis, jnp.asarray(law.leading_coefficients)[None])
    run = {"h": 0.1, "num_steps": 20_000, "epsilon": 0.02, "observe": {"I": form}}
    found_form = dvi.integrate(VAN_DER_POL, [start], [0.0], **run).observed["I"]
    assert found_form[-1] == pytest.approx(law.rest[0], rel=0.02)
    assert abs(found_form[0] / law.rest[0] - 1) > 0.5


@functools.cache
def bound_orbits(count=400, seed=0):
    """Kepler orbits with 0.9 < a < 1.2, e < 0.4, either way round, at any anomaly."""
    rng = np.random.default_rng(seed)
    a, e = rng.uniform(0.9, 1.2, count), rng.uniform(0.05, 0.4, count)
    E, turn = rng.uniform(0, 2 * np.pi, (2, count))
    b, n = a * np.sqrt(1 - e**2), a**-1.5
    z = a * (np.cos(E) - e) + 1j * b * np.sin(E)
    v = (-a * np.sin(E) + 1j * b * np.cos(E)) * n / (1 - e * np.cos(E))
    z, v = z * np.exp(1j * turn), v * np.exp(1j * turn)
    way = rng.choice([-1, 1], count)
    return np.stack([z.real, way * z.imag], 1), np.stack([v.real, way * v.imag], 1)


WITH_RADIUS = dvi.Polynomials(3) + (
    dvi.Polynomials(1, variables=["q1", "q2"], constant=True) * dvi.Radial()
)


@functools.cache
def kepler_nearly(method, h):
    k = systems.kepler()
    how = {"h": h, "args": k.args, "method": method, "tolerance": 1e-2}
    return discover(k.system, WITH_RADIUS, samples=bound_orbits(), **how)


@pytest.mark.parametrize("method", [dvi.TypeII(), dvi.Strang()])
@pytest.mark.slow
def test_energy_and_lrl_vector_are_approximate_with_residuals_of_the_methods_order(method):
    coarse, fine = kepler_nearly(method, 0.04), kepler_nearly(method, 0.02)
    for d in (coarse, fine):
        assert d.survivors == (4,)
        leading = [
            str(s.formula(3, 0.03)).split(" + …")[0]
            for s in (*d.invariants, *d.dependent_invariants)
        ]
        assert leading[0] in ("0.5 q1 p2 − 0.5 q2 p1", "−0.5 q1 p2 + 0.5 q2 p1")
        text = " ".join(leading)
        assert all(name in text for name in ("p1²", " 1/r", "q1 1/r", "q2 1/r"))
    # what is zero only up to O(h^r): singular values, and changes relative to those of functions
    np.testing.assert_array_less(coarse.singular_values[-1], 1e-14)
    rate = coarse.singular_values[-4:-1] / fine.singular_values[-4:-1]
    np.testing.assert_allclose(np.log2(rate), method.order, atol=0.25)
    residual = np.max(coarse.residuals[1:]) / np.max(fine.residuals[1:])
    assert np.log2(residual) == pytest.approx(method.order, abs=0.6)
    assert coarse.residuals[0] < 1e-12


@pytest.mark.slow
def test_lrl_vector_turns_as_perturbation_theory_says():
    """W = −q: averaged over the ellipse the perihelion moves at −(3/2)√(1 − e²)/n per ε.

    (From H1 = |q|²/2 with mean a²(1 + 3e²/2)/2 and dϖ/dt = √(1−e²)/(n a² e) · (−∂⟨H1⟩/∂e).)
    The vector is the discovered one.
    """
    k = systems.kepler()
    d = kepler_nearly(dvi.Strang(), 0.02)
    x, y = (
        next(s for s in (*d.invariants, *d.dependent_invariants) if name in s.formula(3, 0.03))
        for name in ("q1 1/r", "q2 1/r")
    )
    # scaled to unit coefficient of q/r, pointing to the perihelion: (−) p × L + q/r
    scale = [
        -2 * s.coefficients[0, d.basis.names.index(n)] for s, n in ((x, "q1 1/r"), (y, "q2 1/r"))
    ]

    def angle(t0, t1, q0, p0, q1, p1, args):
        A = [s.evaluate(q1, p1, 0.0) / c for s, c in ((x, scale[0]), (y, scale[1]))]
        return jnp.arctan2(A[1], A[0])

    e, h = 0.3, 0.02
    turn = {}
    start = [1 - e, 0.0], [0.0, np.sqrt((1 + e) / (1 - e))]
    run = {"h": h, "num_steps": 60_000, "args": k.args, "method": dvi.Strang()}
    for epsilon in (0.0, 1e-4):
        sol = dvi.integrate(k.system, *start, epsilon=epsilon, observe=dvi.Trend(angle), **run)
        turn[epsilon] = float(sol.observed)
    measured = (turn[1e-4] - turn[0.0]) / 1e-4
    assert measured == pytest.approx(-1.5 * np.sqrt(1 - e**2), rel=0.01)


OMEGA = dvi.System(
    lambda t0, t1, q, p, args: (p @ p + (1 + 0.3 * jnp.sin(t0)) ** 2 * (q @ q)) / 2, slow_time=True
)
QUADRATICS = dvi.Basis(
    {"q²": lambda q, p: q[0] ** 2, "q p": lambda q, p: q[0] * p[0], "p²": lambda q, p: p[0] ** 2}
)


@functools.cache
def slow_oscillator(tolerance=1e-5):
    tau = np.random.default_rng(5).uniform(0, 2 * np.pi, 600)
    samples = (*box(1, 600), tau)
    basis = QUADRATICS * dvi.Chebyshev(24, "τ", domain=(0, 2 * np.pi))
    return samples, discover(OMEGA, basis, 2, samples, tolerance=tolerance)


def distance(values, reference):
    """Relative distance of two functions on the samples, up to a factor."""
    factor = values @ reference / (values @ values)
    return np.linalg.norm(factor * values - reference) / np.linalg.norm(reference)


@pytest.mark.parametrize("tolerance", [1e-6, 1e-4])
@pytest.mark.slow
def test_slowly_varying_oscillator_keeps_its_discrete_action_alone(tolerance):
    (q, p, tau), d = slow_oscillator(tolerance)
    assert d.survivors[1:] == (1, 1)
    assert d.survivors[0] > 10
    assert d.count == 1
    leading = dvi.InvariantSeries(d.basis, d.coefficients[0, :1], True)
    values = np.asarray(jax.vmap(lambda q, p, t: leading.evaluate(q, p, 0.0, t))(q, p, tau))
    q, p, h, w = q[:, 0], p[:, 0], 0.1, 1 + 0.3 * np.sin(tau)
    twice_energy = p**2 + w**2 * q**2 - h * w**2 * q * p
    assert distance(values, twice_energy / (w * np.sqrt(1 - h**2 * w**2 / 4))) < 1e-5
    assert 3e-4 < distance(values, twice_energy / w) < 3e-3
    assert all(law.kind == "slow time" for law in d.obstructions)
    assert len(d.obstructions) > 10


@pytest.mark.slow
def test_action_drifts_less_the_higher_its_order():
    """As an observable of the run: bound to the slow time there.

    Slopes 1 and 2; at order 2 what 24 Chebyshev polynomials leave out of ω(τ) takes over.
    """
    d, run = slow_oscillator()[1], {"h": 0.1, "num_steps": 500}

    def drift(order, epsilon):
        series = dvi.InvariantSeries(d.basis, d.coefficients[0, : order + 1], True)
        observe = dvi.MaxDrift(series)
        return dvi.integrate(OMEGA, [0.4], [0.3], epsilon=epsilon, observe=observe, **run).observed

    slopes = [np.log2(drift(m, 0.04) / drift(m, 0.02)) for m in (0, 1)]
    np.testing.assert_allclose(slopes, [1, 2], atol=0.1)
    assert drift(2, 0.02) < drift(1, 0.02) / 2


def vector_potential(q):
    """B = 1 + εx: A = A0 + εA1 + O(ε²)."""
    return jnp.stack([-q[1], q[0]]) / 2, jnp.stack([-q[0] * q[1], q[0] ** 2]) / 3


def magnetic():
    def H_D(t0, t1, q, p, args):
        return jnp.sum((p - vector_potential(q)[0]) ** 2) / 2

    def first_order(t0, t1, q, p, args):
        A0, A1 = vector_potential(q)
        return -jnp.sum((p - A0) * A1)

    return dvi.System(H_D, perturbation=first_order)


def in_span(columns, target):
    """How far the target (samples,) is outside of the span of the columns (samples, k)."""
    rest = target - columns @ np.linalg.lstsq(columns, target, rcond=None)[0]
    return np.linalg.norm(rest) / np.linalg.norm(target)


@pytest.mark.slow
def test_magnetic_moment_survives_order_one_and_the_guiding_centre_drifts():
    """v²/2 is among the invariants; across grad B the centre moves at v²/2, the textbook drift."""
    system, h = magnetic(), 0.05
    samples = box(2, 300)
    d = discover(system, 3, 1, samples, h=h)
    assert d.survivors == (12, 3)
    assert np.max(d.residuals) < 1e-12
    values = np.asarray(jax.vmap(d.basis)(*samples))
    q, p = samples
    A0 = np.stack([-q[:, 1], q[:, 0]], 1) / 2
    v2 = np.sum((p - A0) ** 2, axis=1)
    kept = values @ d.leading_parts.T
    assert in_span(kept, v2) < 1e-10  # the implicit map keeps it as it is, at any h
    assert in_span(kept, p[:, 0] - q[:, 1] / 2) > 0.5
    law = next(o for o in d.obstructions if o.leading == "−0.25 q2 + 0.5 p1")
    assert law.kind == "resonance"
    # that is 0.5 (p1 − q2/2) = −Y/2: dY/dt = −ε v²/2 for B = 1 + εx and charge 1
    np.testing.assert_allclose(values @ law.coefficients, -h * v2 / 4, rtol=0.01)


@pytest.mark.slow
def test_first_correction_of_the_magnetic_moment():
    """μ = v²/2 B at the guiding centre: −v·A1 + functions of what order 0 conserves, as h → 0."""
    samples = box(2, 400)
    q, p = samples
    A0, A1 = (np.asarray(a) for a in jax.vmap(vector_potential)(q))
    H1 = -np.sum((p - A0) * A1, axis=1)
    off = []
    for h in (0.02, 0.01):
        d = discover(magnetic(), 4, 2, samples, h=h)
        assert d.survivors == (21, 5, 1)
        undisturbed = discover(magnetic(), 3, 0, samples, h=h)
        values = np.asarray(jax.vmap(d.basis)(*samples))
        leading, first = np.asarray(d.coefficients[0, :2])
        unit = 2 * leading[d.basis.names.index("p1²")]
        leading, first = leading / unit, first / unit
        v2 = np.sum((p - A0) ** 2, axis=1)
        np.testing.assert_allclose(values @ leading, v2 / 2, atol=1e-9)
        few = np.asarray(jax.vmap(undisturbed.basis)(*samples))
        kept = np.column_stack([few @ undisturbed.leading_parts.T, np.ones(len(q))])
        off.append(in_span(np.column_stack([kept, values @ first]), H1))
    assert off[1] < 0.02
    assert off[0] / off[1] == pytest.approx(2.0, abs=0.2)


@pytest.mark.slow
def test_an_invariant_leads_back_to_a_symmetry():
    """The symplectic gradient satisfies the determining equations where the map is symplectic."""
    d = found("cubic", 8, 2)
    series = d.invariants[0]
    q, p = jnp.array([0.4]), jnp.array([0.3])

    def residual(series, epsilon):
        p1 = p - 0.1 * (q + epsilon * q**3)
        q1 = q + 0.1 * p1
        pair = (0.0, q, p), (0.1, q1, p1)
        left = dvi.determining_residual(CUBIC, series.generators, *pair, epsilon=epsilon)
        return np.max(np.abs(left))

    left = [residual(series, e) for e in (0.02, 0.04)]
    assert left[1] < 1e-4
    assert np.log2(left[1] / left[0]) == pytest.approx(3, abs=0.1)
    wrong = dvi.InvariantSeries(series.basis, series.coefficients.at[1].mul(1.1))
    assert np.log2(residual(wrong, 0.04) / residual(wrong, 0.02)) == pytest.approx(1, abs=0.2)
    d = slow_oscillator()[1]
    slow = dvi.InvariantSeries(d.basis, d.coefficients[0], True)
    with pytest.raises(ValueError, match="slow time"):
        _ = slow.generators


@pytest.mark.slow
def test_a_discovery_is_saved_and_loaded(tmp_path, monkeypatch):
    for d, basis in (
        (found("van_der_pol", 6, 2), dvi.Polynomials(6)),
        (found("cubic", 8, 1), dvi.Polynomials(8)),
    ):
        path = tmp_path / "found.npz"
        d.save(path)
        back = dvi.Discovery.load(path, basis)
        assert str(back) == str(d)
        np.testing.assert_array_equal(back.coefficients, d.coefficients)
        at = np.array([0.3]), np.array([0.2]), 0.1
        np.testing.assert_array_equal(back.evaluate(*at), d.evaluate(*at))
    with pytest.raises(ValueError, match=r"of 44 functions, got 14 .*index 14, .*no function"):
        dvi.Discovery.load(path, dvi.Polynomials(4))
    named = dvi.Basis({"f": lambda q, p: q @ q + p @ p - 0.1 * (q @ p)})
    discover(OSCILLATOR, named, samples=box(1, 20)).save(path)
    with pytest.raises(ValueError, match="differ in the values of 'f'"):
        dvi.Discovery.load(path, dvi.Basis({"f": lambda q, p: q @ q}))
    before = path.read_bytes()
    again = dvi.Discovery.load(path, named)
    with monkeypatch.context() as patched:
        faults.in_write(patched, "full", 100)
        with pytest.raises(OSError, match="No space left"):
            again.save(path)
    assert path.read_bytes() == before
    np.save(path.with_suffix(".npy"), np.zeros(3))
    path.write_bytes(b"something else")
    for damaged in (path.with_suffix(".npy"), path):
        with pytest.raises(ValueError, match="damaged, or not the file of a discovery"):
            dvi.Discovery.load(damaged, named)
    with pytest.raises(FileNotFoundError, match=r"discovery: there is no file .*'.*"):
        dvi.Discovery.load(path.with_suffix(".none"), named)


def test_a_file_without_one_entry_is_named(tmp_path):
    path = tmp_path / "found.npz"
    found("cubic", 2, 1).save(path)
    whole = read_npz(path, 2, "discovery")
    for name in ("energy", "larger", "obstructions", "names", "errors", "probe_q"):
        header, arrays = ({k: v for k, v in x.items() if k != name} for x in whole)
        publish_npz(path, 2, header | {"holds": sorted(arrays)}, arrays)
        with pytest.raises(ValueError, match=f"file of Discovery.save, but .* has no '{name}'"):
            dvi.Discovery.load(path, dvi.Polynomials(2))


def test_series_are_differentiable_and_orders_beyond_the_basis_reported():
    d = found("cubic", 2, 1)
    assert (d.survivors, d.count) == ((1, 0), 0)
    assert d.obstructions[0].kind == "unexplained"
    assert "it may be too small" in str(d)
    series = found("cubic", 4, 1).invariants[0]
    q, p = jnp.array([0.4]), jnp.array([0.3])
    slope = jax.grad(series.evaluate, argnums=2)(q, p, 0.1)
    np.testing.assert_allclose(slope, series.coefficients[1] @ series.basis(q, p), rtol=1e-12)
    with pytest.raises(ValueError, match="has no value of ε"):
        series(0.0, 0.1, q, p, q, p, None)


def test_functions_of_one_another_are_kept_apart():
    d = found("cubic", 8, 0)
    assert len(d.dependent) == 3
    q, p = box(1, 40)
    form = jax.vmap(lambda q, p: d.invariants[0].evaluate(q, p, 0.0))(q, p)
    for k, power in enumerate(d.dependent_invariants, 2):
        values = np.asarray(jax.vmap(lambda q, p: power.evaluate(q, p, 0.0))(q, p))  # noqa: B023
        columns = np.stack([np.asarray(form) ** j for j in range(1, k + 1)], 1)
        assert in_span(columns, values) < 1e-10
        assert in_span(columns[:, :-1], values) > 1e-3
    np.testing.assert_array_less(d.dependent_residuals, 1e-9)


ROOT_OF_Q = dvi.System(lambda t0, t1, q, p, args: p @ p / 2 - jnp.sum(jnp.sqrt(q)))
BROADCAST = dvi.System(H_D, force=lambda t0, t1, q, p, args: jnp.sum(q))


@pytest.mark.parametrize("search", [dvi.discover_invariants, dvi.find_symmetries])
@pytest.mark.parametrize(
    ("change", "error", "match"),
    [
        ({"samples": box(1, 3)}, ValueError, "too few"),
        ({"samples": (np.ones((50, 1)), np.ones((50, 2)))}, ValueError, "the same shape"),
        ({"samples": (np.full((50, 1), np.nan), np.ones((50, 1)))}, ValueError, "must be finite"),
        ({"samples": (*box(1, 60), np.zeros(50))}, ValueError, r"shape \(60,\)"),
        ({"samples": (np.zeros((50, 1)), np.zeros((50, 1)))}, ValueError, "rank-deficient"),
        ({"samples": 100}, ValueError, "arrays .qs, ps."),
        *(({"h": h}, ValueError, "one finite step size") for h in (0.0, [0.1, 0.2], "x", None)),
        *(({"order": order}, ValueError, "order must be") for order in (-1, 0.5)),
        ({"tolerance": 2.0}, ValueError, "between 0 and 1"),
        ({"basis": dvi.Chebyshev(3, "t")}, ValueError, "depends on the time"),
        ({"basis": dvi.Polynomials(1) + dvi.Polynomials(1)}, ValueError, "rank-deficient"),
        ({"basis": dvi.Basis([lambda q, p: 1 / (0 * q[0])])}, ValueError, "'f1' is not finite"),
        ({"basis": dvi.Basis([lambda q, p: q**2])}, ValueError, r"a real scalar.*\(1,\)"),
        ({"basis": dvi.Basis([lambda q, p: 1j * q[0]])}, ValueError, "must return a real scalar"),
        *(({"basis": basis}, TypeError, "must be a basis") for basis in (dvi.Polynomials, [len])),
        ({"system": H_D}, TypeError, "must be a dvi.System"),
        ({"system": BROADCAST, "samples": box(2, 60)}, ValueError, r"array of shape \(2,\)"),
        ({"system": ROOT_OF_Q}, ValueError, "step fails at"),
        ({"root_finder": 5}, TypeError, "root_finder must be"),
    ],
)
def test_bad_input_is_named(search, change, error, match):
    given = {"system": SPRING, "basis": dvi.Polynomials(1), "h": 0.1, "samples": box(1, 60)}
    with pytest.raises(error, match=match):
        search(**(given | change))


def test_bad_input_of_a_search_for_invariants_is_named():
    with pytest.raises(ValueError, match="'least', 'simplest'"):
        found("cubic", 2, 0, "best")
    with pytest.raises(TypeError, match=r"method must be an instance of dvi.Method"):
        discover(SPRING, 2, method=5)
    with pytest.raises(ValueError, match=r"the shape \(1,\) of .* got q of shape \(2,\)"):
        found("cubic", 2, 1).evaluate([0.1, 0.2], [0.3, 0.4], 0.1)
    powers = dvi.Polynomials(16, variables=["q"])
    with pytest.raises(ValueError, match=r"functions 'q¹⁴'.* are 0 on .*smaller units"):
        discover(SPRING, powers, samples=box(1, 60, low=-1e-23, high=1e-23))


@pytest.mark.parametrize("strength", [1e-12, 1e-6, 1e10])
@pytest.mark.slow
def test_friction_is_recognised_however_weak_or_strong(strength):
    """In units in which it is as large as the rest; negative control: a spring is no friction."""
    for force, survives, kind in ((lambda q, p: p, 0, "dissipation"), (lambda q, p: q, 2, None)):
        system = dvi.System(H_D, force=lambda t0, t1, q, p, a, W=force: -strength * W(q, p))
        d = discover(system, 4, 1, box(1, 120))
        assert d.survivors == (2, survives)
        assert {law.kind for law in d.obstructions} == ({kind} if kind else set())
        if kind:
            np.testing.assert_allclose(d.obstructions[0].powers, [0, -0.1 * strength], rtol=1e-6)


@pytest.mark.slow
def test_a_map_that_depends_on_time_needs_samples_in_time():
    driven = dvi.System(H_D, force=lambda t0, t1, q, p, args: jnp.cos(t0) * jnp.ones_like(q))
    for system in (driven, OMEGA):
        with pytest.raises(ValueError, match="depends on the time"):
            discover(system, 2, 1)
    # t1 − t0 is no such dependence
    steps = dvi.System(lambda t0, t1, q, p, args: (1 + (t1 - t0) ** 2) * (p @ p + q @ q) / 2)
    assert discover(steps, 2).survivors == (1,)


@pytest.mark.slow
def test_what_fits_the_samples_by_chance_is_refused():
    """Beyond q = 1 the spring hardens; all points there are held out."""

    def hard(t0, t1, q, p, args):
        return H_D(t0, t1, q, p, args) + jnp.sum(jnp.where(q > 1, (q - 1) ** 4, 0.0))

    q, p = box(1, 80)
    q[SamplePoints(q, p, np.zeros(80)).held_out] += 2.5
    d = discover(dvi.System(hard), 2, samples=(q, p))
    assert (d.count, d.refused) == (0, 1)
    assert "held-out samples" in str(d)
    linear, how = dvi.Polynomials(1, constant=True), {"h": 0.1, "samples": (q, p), "time": False}
    symmetries = dvi.find_symmetries(dvi.System(hard), linear, **how)
    assert (len(symmetries), symmetries.refused) == (0, 2)
    assert "held-out samples" in str(symmetries)


def test_what_rounding_hides_or_is_not_finite_is_named():
    q, p = box(1, 80)
    q[7] = p[7] = 0
    radius = dvi.Basis({"r": lambda q, p: jnp.sqrt(q[0] ** 2 + p[0] ** 2)})
    with pytest.raises(ValueError, match=r"order 1 in ε .* 'r' in a step is not finite at 1"):
        discover(SPRING, radius, 1, (q, p))
    root = dvi.Basis({"root": lambda q, p: jnp.sqrt(jnp.abs(q[0])), "E": lambda q, p: q @ q})
    with pytest.raises(ValueError, match=r"derivative of the basis function 'root' .* at 1 of 80"):
        discover(SPRING, root, samples=(q, p))
    # Functions given by the user are not expanded about another point.
    offset = 1e5
    q, p = box(1, 100)
    basis = dvi.Basis({"q": lambda q, p: q[0], "p": lambda q, p: p[0]}) + QUADRATICS
    d = discover(away(offset), basis, samples=(q + offset, p))
    assert d.count == 0
    assert d.undecided >= 1
    assert any("cannot be decided in this arithmetic" in text for text in d.warnings)
    assert all(text in str(d) for text in d.warnings)


@pytest.mark.slow
def test_near_resonance_shows_in_the_reach():
    """ω = (1, 2) and H1 = q1²q2: the map detunes the resonance by O(h²): corrections are 2/h²."""
    system = dvi.System(
        lambda t0, t1, q, p, args: (p @ p + q[0] ** 2 + 4 * q[1] ** 2) / 2,
        perturbation=lambda t0, t1, q, p, args: q[0] ** 2 * q[1],
    )
    d = discover(system, 3, 1, box(2, 200))
    assert d.survivors == (2, 2)
    assert np.all(d.reach < 0.05)
    assert "as large as the leading-order term" in str(d)
    assert found("cubic", 6, 1).reach[0] > 1


CENTRAL = dvi.System(lambda t0, t1, q, p, args: (p @ p + q @ q) / 2 + (q @ q) ** 2 / 4)

PAIR = dvi.System(
    lambda t0, t1, q, p, args: p @ p / 2 + ((q[0] - q[1]) ** 2) ** -6 - ((q[0] - q[1]) ** 2) ** -3
)
"""Lennard-Jones: some samples of a box are kicked by 1e40 and more."""


@pytest.mark.slow
def test_strong_kicks_make_no_symmetry():
    rng = np.random.default_rng(0)
    samples = rng.uniform(-2, 2, (150, 2)), rng.uniform(-1, 1, (150, 2))
    linear = dvi.Polynomials(1, constant=True)
    found = dvi.find_symmetries(PAIR, linear, h=0.01, samples=samples)
    assert len(found.found) == 5
    # relative to the terms of the same sample, which are small at samples with strong kicks
    assert max(np.max(s.residuals) for s in found.found) < 1e-9
    assert max(s.typical_residuals[0, 0] for s in found.found) < 1e-13
    assert sum(s.is_variational for s in found.found) == 3


@pytest.mark.parametrize(("stiffness", "h"), [(-50.0, 1.0), (1.0, 50.0)])
def test_an_invariant_of_steps_that_expand_has_its_digits(stiffness, h):
    """q² is (2500)⁴ times as large after the step: coefficients of round-off must not stay."""
    linear = dvi.System(lambda t0, t1, q, p, args: p @ p / 2 + stiffness * (q @ q) / 2)
    d = discover(linear, 4, samples=box(1, 200), h=h)
    assert d.count == 1
    c = of(d.invariants[0])
    expected = {"q²": stiffness, "q p": -h * stiffness, "p²": 1.0}
    for name, value in c.items():
        assert value / c["p²"] == pytest.approx(expected.get(name, 0.0), rel=1e-9, abs=1e-10)


def away(offset):
    """An oscillator about q = offset, and its energy."""
    return dvi.System(lambda t0, t1, q, p, args: (p @ p + (q - offset) @ (q - offset)) / 2)


@pytest.mark.parametrize("offset", [pytest.param(1e4, marks=pytest.mark.slow), 1e8])
def test_invariants_far_from_the_origin_are_found(offset, tmp_path):
    q, p = box(1, 100)
    d = discover(away(offset), 4, samples=(q + offset, p))
    assert (d.count, d.warnings) == (1, ())
    shifted = f"(q − {offset:.0f})"
    assert str(d.invariants[0]).startswith(f"0.5 {shifted}² − 0.05")
    energy = (q**2 + p**2 - 0.1 * q * p)[:, 0] / 2
    values = np.asarray(jax.vmap(d.invariants[0].evaluate, (0, 0, None))(q + offset, p, 0.0))
    np.testing.assert_allclose(values, energy, atol=1e-15 * offset)
    # In the user's functions: −offset q + q²/2 + h/2 (offset p − q p) + p²/2
    c = dict(zip(d.basis.names, np.asarray(d.coefficients[0, 0]), strict=True))
    assert c["q"] / offset == pytest.approx(-1, rel=1e-15 * offset)
    assert c["p"] / offset == pytest.approx(0.05, rel=1e-14 * offset)
    d.save(tmp_path / "far.npz")
    again = dvi.Discovery.load(tmp_path / "far.npz", dvi.Polynomials(4))
    np.testing.assert_array_equal(again.coefficients, d.coefficients)
    assert str(again) == str(d)


@pytest.mark.slow
def test_more_invariants_than_a_map_that_moves_can_have_are_refused():
    steep = dvi.Basis({"cos 20q": lambda q, p: jnp.cos(20 * q[0])})
    d = discover(OSCILLATOR, dvi.Polynomials(1) + steep, samples=box(1, 100), tolerance=0.5)
    assert d.impossible
    assert (d.count, len(d.dependent)) == (0, 0)
    assert "impossible for a map that moves" in str(d)
    still = dvi.System(lambda t0, t1, q, p, args: 0.0 * (p @ q))
    d = discover(still, 1, samples=box(1, 40))
    assert (d.count, d.impossible) == (2, False)


@pytest.mark.slow
def test_expansions_that_are_cut_off_differ_from_invariants():
    """The Hénon map in a small box has a formal series; McMillan's map has an invariant."""
    henon = dvi.System(lambda t0, t1, q, p, args: jnp.sum(p**2 / 2 + 0.4 * q**2 + q**3 / 3))
    q, p = box(1, 200)
    d = discover(henon, 8, samples=(0.005 * q, 0.005 * p), h=1.0)
    assert d.count == 1
    assert d.powers[0] > 2
    assert "not exact: with the size of the samples" in str(d)
    assert "0 of them on samples" in d.warnings[0]
    mcmillan = dvi.System(
        lambda t0, t1, q, p, args: jnp.sum(p**2 / 2 + q**2 - 0.7 * jnp.log(1 + q**2))
    )
    d = discover(mcmillan, 4, samples=(q, p), h=1.0)
    assert (d.count, list(d.powers)) == (1, [0.0])
    assert "not exact" not in str(d)


@pytest.mark.parametrize(
    ("offset", "says"),
    [
        (1e8, "ξ_q1 = (q2 − 100000000), ξ_q2 = −(q1 − 100000000), η_p1 = p2, η_p2 = −p1\n"),
        pytest.param(1e11, "cannot be decided", marks=pytest.mark.slow),
    ],
)
def test_symmetries_far_from_the_origin(offset, says):
    q, p = box(2, 60)
    system = dvi.System(lambda t0, t1, q, p, args: CENTRAL.H_D(t0, t1, q - offset, p, args))
    found = dvi.find_symmetries(
        system, dvi.Polynomials(1, constant=True), h=0.1, samples=(q + offset, p), time=False
    )
    assert says in str(found)
    assert (len(found.warnings) > 0) == (says == "cannot be decided")


@pytest.mark.parametrize("order", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_searches_call_no_lapack_for_a_batch(order):
    """Such calls waited for one another for ever, on two cores and more."""
    samples = as_samples(box(3, 40))
    system = dvi.System(
        lambda t0, t1, q, p, args: (p @ p + q @ q) / 2 + (p @ q) ** 2,
        perturbation=lambda t0, t1, q, p, args: q[0] ** 2 * q[1],
    )
    equations, h = Equations(system, jnp.zeros(()), None, dvi.Newton()), np.asarray(0.1)
    basis = bind_basis(dvi.Polynomials(1), (3,))
    stepped = changes.StepMap(equations, h, dvi.GaussLegendre(2), basis)
    ours = equations, jnp.asarray(h), basis, basis, order, samples, np.ones(2)
    for lowered in (
        changes.batched_changes.lower(stepped, order, samples),
        conditions.at_samples.lower(*ours),
    ):
        assert not re.findall("getrf|trsm|lapack", lowered.as_text())


HANGING = """
import jax, numpy as np
jax.config.update("jax_enable_x64", True)
import dvi_jax as dvi
samples = tuple(np.random.default_rng(3).uniform(-1, 1, (2, 300, 2)))
system = dvi.System(lambda t0, t1, q, p, a: (p @ p + q @ q) / 2,
                    perturbation=lambda t0, t1, q, p, a: q[0] ** 2 * q[1] - q[1] ** 3 / 3)
for _ in range(10):
    SEARCH
"""


SEARCHES = [
    "dvi.find_symmetries(system, dvi.Polynomials(1), h=0.02, samples=samples)",
    "dvi.discover_invariants(system, dvi.Polynomials(4), 1, h=0.02, samples=samples, "
    "method=dvi.GaussLegendre(4))",
]


@pytest.mark.parametrize("search", SEARCHES, ids=["symmetries", "invariants"])
@pytest.mark.slow
def test_searches_end(search):
    """10 times in a child process."""
    text = HANGING.replace("SEARCH", search)
    subprocess.run([sys.executable, "-c", text], timeout=500, check=True)
