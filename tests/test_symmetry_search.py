"""The library of generators, conformal factors, and symmetries found as a null space."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compilation import programs_of_xla

import dvi_jax as dvi
from dvi_jax import generators as library, systems

KEPLER = systems.kepler()
H_D = systems.oscillator().system.H_D
OSCILLATOR = dvi.System(H_D)
SPRING = systems.oscillator().system  # perturbed by −εq
QUARTIC = dvi.System(H_D, perturbation=lambda t0, t1, q, p, args: jnp.sum(q**4) / 4)
FREE = dvi.System(lambda t0, t1, q, p, args: jnp.sum(p**2) / 2)
HENON_HEILES = dvi.System(
    lambda t0, t1, q, p, args: (p @ p + q @ q) / 2 + q[0] ** 2 * q[1] - q[1] ** 3 / 3
)
MASSES = jnp.array([1.0, 2.0])
TWO_BODIES = dvi.System(
    lambda t0, t1, q, p, args: (
        jnp.sum(jnp.sum(p**2, axis=1) / MASSES) / 2 - 2 / jnp.linalg.norm(q[0] - q[1])
    )
)
LINEAR = dvi.Polynomials(1, constant=True)
TIMED = dvi.Polynomials(1, ("q", "p", "t"), constant=True)
ROUND_OFF = 1e-11


def box(n, count=100, seed=0, times=False):
    rng = np.random.default_rng(seed)
    shape = (count, n) if isinstance(n, int) else (count, *n)
    q, p = rng.uniform(-1, 1, shape), rng.uniform(-1, 1, shape)
    return (q, p, rng.uniform(0, 3, count)) if times else (q, p)


def ring(count=120, seed=0, times=False):
    """Points of the plane off the origin."""
    q, p, t = box(2, count, seed, times=True)
    q = q + 0.5 * np.sign(q)
    return (q, p, t) if times else (q, p)


@eqx.filter_jit
def largest_residual(system, generators, first, second, **given):
    residual = jax.vmap(lambda a, b: dvi.determining_residual(system, generators, a, b, **given))
    return jnp.max(jnp.abs(residual(first, second)))


def on_solutions(system, generators, samples, epsilon=0.0, args=None):
    """Largest |pr X(F)| on solutions."""
    given = {"epsilon": jnp.asarray(epsilon), "args": args}
    pairs = dvi.solution_pairs(system, h=0.1, samples=samples, **given)
    return float(largest_residual(system, generators, *pairs, **given))


def find(system, basis, order=0, samples=None, **more):
    """At h = 0.1, without ξ0."""
    given = {"h": 0.1, "samples": box(1) if samples is None else samples, "time": False, **more}
    return dvi.find_symmetries(system, basis, order, **given)


BODIES = box((2, 2), times=True)
SHIFTED = library.space_translation([1.0, 2.0]) - 3 * library.rotation(1, 0)
FLOW = library.hamiltonian_flow(lambda t, q, p, args: (q @ q + p @ p - 0.1 * q @ p) ** 2)


@pytest.mark.parametrize(
    ("generator", "system", "samples", "args"),
    [
        (library.time_translation(), KEPLER.system, ring(), KEPLER.args),
        (library.rotation(0, 1), KEPLER.system, ring(), KEPLER.args),
        # Kepler's third law
        (library.scaling(q=1.0, p=-0.5, t=1.5), KEPLER.system, ring(times=True), KEPLER.args),
        (library.boost([0.3, -0.2]), FREE, box(2, times=True), None),
        (SHIFTED, TWO_BODIES, BODIES, None),
        (library.boost([1.0, -0.5], MASSES), TWO_BODIES, BODIES, None),
        (FLOW, OSCILLATOR, box(1), None),
    ],
)
def test_library_generators_are_symmetries_where_they_should(generator, system, samples, args):
    assert on_solutions(system, generator, samples, args=args) < 1e-10


@pytest.mark.parametrize(
    ("generator", "system", "samples"),
    [
        (library.rotation(0, 1), HENON_HEILES, box(2)),
        (library.boost([1.0, 0.0]), OSCILLATOR, box(2, times=True)),
        (library.boost([1.0, -0.5]), TWO_BODIES, BODIES),  # masses forgotten
    ],
)
def test_library_generators_are_no_symmetries_where_they_should_not(generator, system, samples):
    assert on_solutions(system, generator, samples) > 1e-2


def test_generators_form_a_vector_space():
    point = dvi.LatticePoint(0.7, np.array([0.3, -0.4]), np.array([1.1, 0.2]))
    x, y = library.rotation(0, 1), library.boost([1.0, 2.0])
    for total, a, b in (
        (x + y, 1, 1),
        (x - y, 1, -1),
        (2 * x + y * np.float64(0.5), 2, 0.5),
        (-x, -1, 0),
        (np.float64(3.0) * x, 3, 0),
        (jnp.asarray(3.0) * x, 3, 0),
    ):
        for part, u, v in zip(total(point), x(point), y(point), strict=True):
            np.testing.assert_allclose(part, a * u + b * v, rtol=1e-15)
    assert (x + y).xi0 is None
    assert (2 * library.time_translation()).xi is None
    for bad in (lambda: x + 1, lambda: x * y, lambda: x * np.ones(2), lambda: x - 1.0):
        with pytest.raises(TypeError):
            bad()


def test_brackets_close_the_algebra():
    """[rotation, ∂1] = −∂2, and the time shift of a boost is a translation."""
    point = dvi.LatticePoint(0.7, np.array([0.3, -0.4]), np.array([1.1, 0.2]))

    def same(a, b):
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-15), a(point), b(point))

    along, across = library.space_translation([1.0, 0.0]), library.space_translation([0.0, 1.0])
    same(library.bracket(library.rotation(0, 1), along), -across)
    same(library.bracket(library.time_translation(), library.boost([1.0, 0.0])), along)
    same(library.bracket(along, along), 0.0 * along)
    with pytest.raises(TypeError, match="second must be a Generator"):
        library.bracket(along, 1.0)


def test_library_refuses_what_does_not_fit():
    point = dvi.LatticePoint(0.0, np.ones(2), np.ones(2))
    for make, message in (
        (lambda: library.space_translation([0.0, 0.0]), "component that is not zero"),
        (lambda: library.space_translation([np.nan, 1.0]), "finite"),
        (lambda: library.rotation(1, 1), "two different axes"),
        (lambda: library.rotation(-1, 0), "at least 0"),
        (lambda: library.scaling(0.0, 0.0, 0.0), "all are 0"),
        (lambda: library.scaling(t=[1.0, 2.0]), "must be one finite number"),
        (lambda: library.boost([1.0, 0.0], mass=-1.0), "positive"),
        (lambda: library.rotation(0, 2)(point), "at least 3 components"),
        (lambda: library.space_translation([1.0, 0.0, 0.0])(point), r"direction must .*\(2,\)"),
        (lambda: library.boost([1.0, 0.0], [1.0, 2.0, 3.0])(point), "mass must be a number"),
    ):
        with pytest.raises(ValueError, match=message):
            make()


@pytest.mark.slow
def test_pointwise_factor_is_the_constant_one_where_there_is_one():
    samples = box(2)
    pairs = dvi.random_pairs(h=0.1, samples=samples)
    generator = library.scaling() + library.rotation(0, 1)
    constant = dvi.conformal_factor(OSCILLATOR, generator, *pairs)
    pointwise = dvi.conformal_factor(OSCILLATOR, generator, *pairs, pointwise=True)
    assert constant.is_conformal
    assert pointwise.is_conformal
    assert pointwise.factor.shape == (100, 4, 4)
    assert max(constant.residual, pointwise.residual) < 1e-13
    np.testing.assert_allclose(
        pointwise.factor, np.broadcast_to(constant.factor, (100, 4, 4)), atol=1e-12
    )


@pytest.mark.slow
def test_some_factors_are_pointwise_only():
    """The flow of an invariant's square turns each ellipse at its own speed."""
    generator, system, samples = FLOW, OSCILLATOR, box(1)
    pairs = dvi.random_pairs(h=0.1, samples=samples)
    constant = dvi.conformal_factor(system, generator, *pairs)
    pointwise = dvi.conformal_factor(system, generator, *pairs, pointwise=True)
    assert not constant.is_conformal
    assert constant.residual > 1e-3
    assert pointwise.is_conformal
    assert pointwise.residual < 1e-13
    # First order off the solutions: pr X(F) − ΛF is of second order in F.
    first, second = dvi.solution_pairs(system, h=0.1, samples=samples)
    factors = dvi.conformal_factor(system, generator, first, second, pointwise=True).factor

    @jax.jit
    def left(size):
        moved = second._replace(q=second.q + size)
        residual = jax.vmap(lambda a, b, c: dvi.determining_residual(system, generator, a, b, c))
        return jnp.max(jnp.abs(residual(first, moved, factors)))

    assert left(1e-3) / left(1e-4) == pytest.approx(100, rel=0.05)


def test_conformal_factor_of_a_translation_is_zero_and_well_conditioned():
    pairs = dvi.random_pairs(h=0.1, samples=box(2))
    found = dvi.conformal_factor(FREE, library.space_translation([1.0, 0.3]), *pairs)
    assert np.max(np.abs(found.factor)) < 1e-12
    assert found.condition < 100
    assert found.is_conformal


@pytest.mark.slow
def test_samples_that_determine_no_factor_are_not_conformal():
    on = dvi.solution_pairs(OSCILLATOR, h=0.1, samples=box(1))
    found = dvi.conformal_factor(OSCILLATOR, library.scaling(), *on)
    assert found.condition > 1e10  # on the solutions F is zero, and every factor does
    assert not found.is_conformal
    bad = dvi.random_pairs(h=0.1, samples=box(2))
    singular = dvi.Generator(xi=lambda t, q, p, args: q / (0 * q))
    assert not dvi.conformal_factor(OSCILLATOR, singular, *bad).is_conformal
    assert not dvi.conformal_factor(
        HENON_HEILES, library.scaling(), *bad, pointwise=True
    ).is_conformal


def test_pairs_of_points():
    q, p = box(2, 7)
    first, second = dvi.random_pairs(h=0.1, samples=(q, p), seed=3)
    assert not np.any(np.all(first.q == second.q, axis=1))
    np.testing.assert_allclose(np.sort(second.q, axis=0), np.sort(q, axis=0))
    np.testing.assert_allclose(second.t - first.t, 0.1)
    first, second = dvi.solution_pairs(SPRING, h=0.1, samples=(q, p), epsilon=0.2)
    F = jax.vmap(lambda a, b: dvi.discrete_equations(SPRING, a, b, 0.2))(first, second)
    assert max(np.max(np.abs(x)) for x in F) < 1e-13
    with pytest.raises(ValueError, match="at least two"):
        dvi.random_pairs(h=0.1, samples=(q[:1], p[:1]))
    with pytest.raises(ValueError, match="step fails"):
        dvi.solution_pairs(KEPLER.system, h=0.1, samples=(0 * q, p), args=KEPLER.args)


@functools.cache
def found(name):
    match name:
        case "oscillator":
            return find(OSCILLATOR, LINEAR, time=True)
        case "cubic":
            return find(OSCILLATOR, dvi.Polynomials(3, constant=True))
        case "spring":
            return find(SPRING, LINEAR, 1)
        case "quartic":
            return find(QUARTIC, dvi.Polynomials(3), 1, box(1, 150))
        case "kepler":
            basis = dvi.Polynomials(1, ("q1", "q2", "p1", "p2", "t"), constant=True)
            samples = ring(150, times=True)
            return find(KEPLER.system, basis, samples=samples, time=True, args=KEPLER.args)
        case "free":
            return find(FREE, TIMED, samples=box(1, times=True), time=True)
        case "henon":
            return find(HENON_HEILES, LINEAR, samples=box(2))


FORMULAS = {
    "oscillator": (["ξ0 = 1", "ξ_q = −0.05 q + p, η_p = −q + 0.05 p"], ["ξ_q = q, η_p = p"]),
    "spring": (
        ["ξ_q = −0.05 q + p + ε (−0.05 q), η_p = −q + 0.05 p + ε (−q + 0.05 p)"],
        ["ξ_q = q, η_p = p"],
    ),
    "kepler": (
        ["ξ0 = 1", "ξ_q1 = q2, ξ_q2 = −q1, η_p1 = p2, η_p2 = −p1"],
        [
            "ξ0 = t, ξ_q1 = 0.666667 q1, ξ_q2 = 0.666667 q2, η_p1 = −0.333333 p1, "
            "η_p2 = −0.333333 p2"
        ],
    ),
    "free": (
        ["ξ0 = 1", "ξ_q = 1", "ξ_q = p", "ξ_q = t, η_p = 1", "ξ0 = t, ξ_q = 0.5 q, η_p = −0.5 p"],
        ["ξ0 = p", "ξ_q = q, η_p = p"],
    ),
    "henon": ([], []),
}


@pytest.mark.parametrize("name", FORMULAS)
@pytest.mark.slow
def test_known_symmetries_are_found_and_classified(name):
    symmetries = found(name)
    variational, conformal = FORMULAS[name]
    assert [str(s) for s in symmetries.variational] == variational
    assert [str(s) for s in symmetries.conformal] == conformal
    assert len(symmetries) == symmetries.survivors[-1] == len(variational) + len(conformal)
    for symmetry in symmetries:
        assert np.max(symmetry.residuals) < ROUND_OFF
        closed = np.max(symmetry.identity_residuals)
        assert closed < ROUND_OFF if symmetry.is_variational else closed > 1e-3
    if len(symmetries):
        assert symmetries.gap > 1e8
        assert str(symmetries[0]) in str(symmetries)


@pytest.mark.parametrize("name", ["kepler", "free", "quartic"])
@pytest.mark.slow
def test_found_generators_satisfy_the_equations_at_other_points(name):
    system, samples, args = {
        "kepler": (KEPLER.system, ring(40, 9, times=True), KEPLER.args),
        "free": (FREE, box(1, 40, 9, times=True), None),
        "quartic": (QUARTIC, box(1, 40, 9), None),
    }[name]
    for symmetry in found(name):
        series = list(symmetry.generators)
        if symmetry.order == 0:
            assert on_solutions(system, series, samples, args=args) < 1e-10
            continue
        left = [on_solutions(system, series, samples, epsilon) for epsilon in (1e-2, 1e-3)]
        assert np.log10(left[0] / left[1]) == pytest.approx(symmetry.order + 1, abs=0.1)


@pytest.mark.slow
def test_scaling_is_conformal_with_a_constant_factor():
    (scaling,) = found("oscillator").conformal
    pairs = dvi.random_pairs(h=0.1, samples=box(1))
    factor = dvi.conformal_factor(OSCILLATOR, scaling.generators[0], *pairs)
    np.testing.assert_allclose(factor.factor, np.eye(2), atol=1e-12)
    assert scaling.invariant is None
    assert scaling.gauges is None
    assert not scaling.is_symplectic


@pytest.mark.slow
def test_invariants_of_found_symmetries_drift_as_promised():
    quartic = found("quartic").variational[0]
    alone = dvi.AdiabaticInvariant([quartic.generators[0]], [quartic.gauges[0]])
    drifts = largest_drifts(QUARTIC, [quartic.invariant, alone], [0.02, 0.2])
    slopes = np.log10(drifts[:, 1] / drifts[:, 0])
    # negative control: the leading-order term alone
    np.testing.assert_allclose(slopes, [2, 1], atol=0.15)
    # The spring's series ends: it is an invariant at every ε.
    invariant = found("spring").variational[0].invariant
    assert np.max(largest_drifts(SPRING, [invariant], [0.02, 0.2])) < 1e-11


def largest_drifts(system, invariants, epsilons):
    """Shape (invariants, epsilons)."""

    run = {"h": 0.1, "num_steps": 2000, "save": dvi.Save(final=True)}
    observe = [dvi.MaxDrift(i) for i in invariants]

    def of(epsilon):
        sol = dvi.integrate(system, [0.4], [0.3], epsilon=epsilon, observe=observe, **run)
        return sol.observed

    return np.asarray(jax.vmap(of)(jnp.array(epsilons)))


@pytest.mark.slow
def test_gauge_and_identity_agree_with_noether_identity():
    symmetry = found("quartic").variational[0]
    generators, gauges = list(symmetry.generators), list(symmetry.gauges)

    @jax.jit
    def largest(first, second, epsilon):
        identity = jax.vmap(
            lambda a, b: sum(
                epsilon**m * dvi.noether_identity(QUARTIC, generators, gauges, m, a, b, epsilon)
                for m in range(2)
            )
        )
        return jnp.max(jnp.abs(identity(first, second)))

    def total(epsilon):
        pairs = dvi.solution_pairs(QUARTIC, h=0.1, samples=box(1, 40, 9), epsilon=epsilon)
        return largest(*pairs, epsilon)

    assert np.log10(total(1e-2) / total(1e-3)) == pytest.approx(2, abs=0.1)


@pytest.mark.slow
def test_multiples_by_invariants_are_marked_as_dependent():
    symmetries = found("cubic")
    assert [s.is_dependent for s in symmetries] == [False, True, False, True]
    assert [s.is_variational for s in symmetries] == [True, True, False, False]
    assert "2 of them depend on the others, with invariants" in str(symmetries)
    dependent = [s.is_dependent for s in found("free").variational]
    assert dependent == [False, False, True, False, False]  # p ∂q; the dilation is no such


@pytest.mark.slow
def test_too_small_a_gauge_basis_is_suspected():
    """The flow of the oscillator needs the gauge (q² − p²)/2."""
    small = dvi.Basis({"q": lambda q, p: q[0]})
    symmetries = find(OSCILLATOR, dvi.Polynomials(1), gauges=small)
    flow, scaling = symmetries
    assert not flow.is_variational
    assert flow.is_symplectic
    assert not scaling.is_symplectic
    assert str(symmetries).count("gauge basis may be too small") == 1


@pytest.mark.slow
def test_no_symmetry_of_a_chaotic_system_and_of_an_order_the_basis_cannot_express():
    assert "0 symmetries" in str(found("henon"))
    assert found("henon").survivors == (0,)
    linear = find(QUARTIC, LINEAR, 1)
    assert linear.survivors == (2, 0)
    assert len(linear) == 0
    assert "does not go on" in str(linear)


@pytest.mark.slow
def test_equations_with_time_need_samples_in_time():
    driven = dvi.System(lambda t0, t1, q, p, args: p @ p / 2 - q[0] * jnp.cos(t0))
    with pytest.raises(ValueError, match="depends on the time"):
        find(driven, LINEAR, time=True)
    waves = dvi.Trigonometric(1, "t", constant=True) + dvi.Polynomials(1)
    symmetries = find(driven, waves, samples=box(1, times=True), gauges=waves)
    assert [s.is_variational for s in symmetries][:1] == [True]
    assert np.max([s.residuals for s in symmetries]) < ROUND_OFF


LOG = dvi.Basis({"log": lambda q, p: jnp.log(q[0])})
ROOT = {
    "basis": dvi.Basis({"root": lambda q, p: jnp.sqrt(q[0] + 1)}),
    "samples": (np.full((50, 1), -0.99), -np.linspace(0.5, 1, 50)[:, None]),
}
POLE = {
    "system": dvi.System(lambda t0, t1, q, p, args: p @ p / 2 + 1 / q[0]),
    "samples": (np.linspace(0, 1, 60)[:, None], box(1, 60)[1]),
}


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"basis": LOG}, ValueError, "'log' is not finite"),
        ({"gauges": LOG}, ValueError, "'log' is not finite"),
        (ROOT, ValueError, "the ends of their steps"),
        (POLE, ValueError, "step fails at 1 of 60"),
        ({"gauges": 3}, TypeError, "basis must be a basis"),
    ],
)
def test_bad_input_is_refused(change, error, message):
    """What both searches refuse: `test_bad_input_is_named` in `test_discovery.py`."""
    given = {"system": OSCILLATOR, "basis": LINEAR, "samples": box(1, 60), **change}
    with pytest.raises(error, match=message):
        find(given.pop("system"), given.pop("basis"), **given)


@pytest.mark.parametrize("strength", [1e-10, 1e10])
@pytest.mark.slow
def test_friction_of_any_strength_leaves_conformal_symmetries_only(strength):
    """The map contracts areas: what commutes with it is not a Hamiltonian flow."""
    system = dvi.System(H_D, force=lambda t0, t1, q, p, args: -strength * p)
    symmetries = find(system, LINEAR, 1)
    assert symmetries.survivors == (2, 2)
    assert not symmetries.variational
    assert np.max([s.residuals for s in symmetries]) < ROUND_OFF
    assert np.min([np.max(s.identity_residuals) for s in symmetries]) > 1e-3
    turning = next(str(s) for s in symmetries if "0.05" in str(s))
    assert f"ε ({strength / 2:.6g} q)" in turning


@pytest.mark.slow
def test_other_samples_compile_nothing():
    """What was compiled for one set of samples serves another, far from it."""
    rng = np.random.default_rng(0)
    basis = dvi.Polynomials(1, constant=True)
    for search, options in ((dvi.discover_invariants, {}), (dvi.find_symmetries, {"time": False})):
        counts = []
        for middle in (10.0, 20.0):
            samples = middle + rng.uniform(-1, 1, (2, 60, 2))
            with programs_of_xla() as programs:
                search(FREE, basis, h=0.1, samples=samples, **options)
            counts.append(len(programs))
        assert counts[0] > 0
        assert counts[1] == 0
