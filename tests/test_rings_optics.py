"""Optics and nonlinear analysis of rings, against formulas, finite differences and pyAT."""

import itertools
import math
import os
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compilation import programs_of_xla

from dvi_jax.systems import rings


def cell(k=0.6, b2=0.0, b3=0.0, skew=0.0, angle=0.0, voltage=0.0):
    """A FODO cell with a thin multipole; with bends and a cavity if they are not zero."""
    bends = [rings.bend("B", 1.5, angle, edge_in=angle / 2, edge_out=angle / 2)] if angle else []
    cavities = [rings.cavity("C", 0.0, voltage, 5e8)] if voltage else []
    between = [rings.drift("D", 2.0 - 1.5 * len(bends)), *bends]
    return rings.Ring(
        [
            rings.quadrupole("QF", 0.5, k, slices=8),
            *between,
            rings.multipole("M", 0.0, (0.0, 0.0, b2, b3), (0.0, skew)),
            rings.quadrupole("QD", 0.5, -0.9 * k, slices=8),
            *between,
            *cavities,
        ]
    )


def thick(k, length):
    """The matrix of a quadrupole in x, px."""
    w = np.sqrt(complex(k))
    c, s = np.cos(w * length), np.sin(w * length)
    return np.array([[c, s / w], [-w * s, c]]).real


def close(a, b, error):
    a, b = np.asarray(a), np.asarray(b)
    assert np.max(np.abs(a - b)) <= error * np.max(np.abs(b)), (a, b)


@pytest.mark.slow
def test_fodo_cell_has_the_tunes_and_beta_functions_of_its_matrix():
    found = rings.optics(cell())
    for plane, sign in ((0, 1), (1, -1)):
        drift = np.array([[1, 2], [0, 1]])
        M = drift @ thick(-sign * 0.54, 0.5) @ drift @ thick(sign * 0.6, 0.5)
        mu = math.acos(np.trace(M) / 2)
        # The fourth-order slices of the magnets differ from the exact matrix.
        close(found.tune[plane], mu / (2 * np.pi), 1e-6)
        close(found.beta[0, plane], M[0, 1] / math.sin(mu), 1e-6)
        close(found.beta[-1], found.beta[0], 1e-13)
        close(found.alpha[0, plane], (M[0, 0] - M[1, 1]) / 2 / math.sin(mu), 1e-6)
    assert not np.any(found.dispersion)
    close(found.gamma, np.ones(6), 1e-13)


@pytest.mark.slow
def test_derivatives_are_those_of_finite_differences():
    def numbers(k, dp=0.002, ring=None):
        found = rings.optics(cell(b2=3.0, angle=0.2).set("QF", b1=k), dp)
        return jnp.concatenate(
            [found.tune, found.chromaticity, found.beta[2], found.orbit[2, :2], found.mu[3]]
        )

    def fourth_order(f, h):
        return (8 * (f(h) - f(-h)) - f(2 * h) + f(-2 * h)) / (12 * h)

    close(jax.jacfwd(numbers)(0.6), fourth_order(lambda h: numbers(0.6 + h), 3e-4), 1e-9)
    by_dp = fourth_order(lambda h: numbers(0.6, 0.002 + h)[:2], 2e-5)
    close(numbers(0.6)[2:4], by_dp, 1e-9)
    # A control: the chromaticity of the ring without the sextupole is another one.
    assert np.abs(rings.optics(cell(angle=0.2), 0.002).chromaticity - by_dp).max() > 1e-2


@pytest.mark.slow
def test_reverse_mode_and_second_derivatives():
    def tune(k):
        return rings.optics(cell(b2=3.0, angle=0.2).set("QF", b1=k), 0.002, chromatic=False).tune[0]

    close(jax.grad(tune)(0.6), jax.jacfwd(tune)(0.6), 1e-12)
    slope = jax.jacfwd(tune)
    close(jax.jacfwd(slope)(0.6), (slope(0.6001) - slope(0.5999)) / 2e-4, 1e-5)


@pytest.mark.slow
def test_six_dimensions_synchrotron_tune_and_compaction():
    voltage = 1e-4
    ring = cell(angle=0.2, voltage=voltage)
    four, six = rings.optics(ring, dp=0.0), rings.optics(ring)
    k = float(ring.get("C", "wave_number")[0])
    half = math.asin(math.sqrt(float(four.compaction) * float(ring.places[-1]) * voltage * k) / 2)
    close(six.tune[2], half / np.pi, 5e-3)
    close(six.compaction, four.compaction, 1e-3)
    close(six.chromaticity[:2], four.chromaticity, 1e-2)
    close(six.tune[:2], four.tune, 2e-3)
    # The normal modes of the one-turn matrix are eigenvectors.
    turned = np.asarray(six.matrix[-1] @ six.modes[0].T)
    close(turned / np.exp(2j * np.pi * np.asarray(six.tune) * [1, 1, -1]), six.modes[0].T, 1e-10)


@pytest.mark.slow
def test_one_turn_agrees_with_tracking_and_with_the_matrix():
    ring = cell(b2=3.0, angle=0.2)
    z = jnp.asarray([[1e-3, 0, 1e-3, 0, 0, 1e-3], [0, 1e-4, 0, 1e-4, 0, 0]])
    close(rings.one_turn(ring, z), rings.track(ring, z).z, 1e-14)
    orbit = rings.closed_orbit(ring, 0.002)
    M, end = jax.jit(jax.jacfwd(lambda z: (rings.one_turn(ring, z),) * 2, has_aux=True))(orbit)
    close(end[:4], orbit[:4], 1e-13)
    close(rings.matrix(ring, 0.002), M, 1e-12)


@pytest.mark.slow
def test_unstable_motion_and_missing_orbits_are_errors():
    ring = cell(k=2.5)
    with pytest.raises(ValueError, match=r"unstable: half of the trace .* in x, y"):
        rings.optics(ring, chromatic=False)
    assert abs(np.trace(rings.matrix(ring)[:2, :2])) > 2
    tune = jax.jit(lambda k: rings.optics(cell().set("Q*", b1=k), chromatic=False).tune)
    assert np.isnan(tune(2.5)).all()
    lost = cell(b2=-400.0, angle=0.2)
    for make, kind, message in (
        (lambda: rings.optics(lost, dp=0.4, chromatic=False), ValueError, "no closed orbit"),
        (lambda: rings.optics(ring, guess=jnp.zeros(4)), ValueError, "guess must have 6 coord"),
        (lambda: rings.optics([rings.drift("D", 1.0)]), TypeError, r"must be a rings\.Ring"),
    ):
        with pytest.raises(kind, match=message):
            make()


def test_a_ring_of_the_same_parts_compiles_nothing():
    """Another number and order of elements, other slices and strengths."""
    first = cell(b2=3.0)
    rings.optics(first, chromatic=False)
    drift, magnet = rings.drift("d", 1.5), rings.quadrupole("q", 0.4, 0.7, slices=16)
    lens, other = rings.multipole("m", 0.0, (0.0, 0.0, 1.0, 5.0)), rings.quadrupole("p", 0.4, -0.7)
    second = rings.Ring([magnet, drift, lens, drift, other, drift, lens, drift])
    with programs_of_xla() as programs:
        found = rings.optics(second, chromatic=False)
        changed = rings.optics(second.set("q", b1=0.72), dp=1e-3, chromatic=False)
    assert not programs
    for plane, sign in ((0, 1), (1, -1)):
        space = np.array([[1, 3], [0, 1]])
        M = space @ thick(-0.7 * sign, 0.4) @ space @ thick(0.7 * sign, 0.4)
        close(2 * np.pi * found.tune[plane], math.acos(np.trace(M) / 2), 1e-5)
    # Within a function that is compiled, JAX computes the same.
    one = jax.jit(lambda k: rings.optics(second.set("q", b1=k), 1e-3, chromatic=False))
    with programs_of_xla() as programs:
        compiled = one(0.72)
    assert programs
    for one, two in zip(changed[:-2], compiled[:-2], strict=True):
        close(one, two, 1e-12)


@pytest.mark.slow
def test_detuning_of_an_octupole_is_the_formula_and_scales_with_it():
    b3 = 50.0
    found = rings.detuning(cell(b3=b3), action=1e-9)
    bx, by = rings.optics(cell(), chromatic=False).beta[2]
    first = 3 * b3 / (8 * np.pi) * np.array([[bx**2, -2 * bx * by], [-2 * bx * by, by**2]])
    close(found, first, 1e-4)
    assert np.abs(found - rings.detuning(cell(b3=b3 / 2))).max() > 100


def test_driving_terms_of_thin_multipoles_are_the_formulas():
    ring = cell(b2=3.0, b3=7.0)
    o = rings.optics(ring, chromatic=False)
    (bx, by), (px, py) = np.asarray(o.beta[2]), np.exp(1j * np.asarray(o.mu[2]))
    terms = ("h21000", "h30000", "h10110", "h10020", "h10200", "h22000", "h11110")
    found = rings.resonance_driving_terms(ring, terms)
    rx = np.sqrt(bx)
    expected = {
        "h21000": 3 / 8 * rx * bx * px,
        "h30000": 3 / 24 * rx * bx * px**3,
        "h10110": -3 / 4 * rx * by * px,
        "h10020": -3 / 8 * rx * by * px / py**2,
        "h10200": -3 / 8 * rx * by * px * py**2,
        "h22000": 3 * 7 / 32 * bx**2,
        "h11110": -3 * 7 / 8 * bx * by,
    }
    for name in terms:
        close(found[name], expected[name], 1e-12)
    with pytest.raises(ValueError, match="names such as 'h21000'"):
        rings.resonance_driving_terms(ring, ("h2100",))


TERMS = ("h30000", "h10020", "h10200", "h20010", "h20100", "h00300")
"""Of order 3, each with other harmonics."""


def lattice_with(magnet, *more):
    """Coupled, with a vertical and a horizontal closed orbit where `more` has kicks."""
    return rings.Ring(
        [rings.quadrupole("QF", 0.5, 0.6), rings.drift("D", 2.0), magnet,
         rings.quadrupole("QD", 0.5, -0.5), rings.drift("D", 1.0), *more, rings.drift("D", 1.0)]
    )  # fmt: skip


KICKS = rings.corrector("C", 0.0, 2e-4, -1e-4), rings.multipole("K", 0.0, (0, 0), (0, 0.05))
ROLL, SHIFT = 0.4, 1e-3
SAME_MAPS = {
    "rolled": ({"roll": np.pi / 6, "b2": 2.0}, {"a2": -2.0}),
    "displaced": ({"dx": SHIFT, "b3": 100.0}, {"b0": -1e-7, "b1": 3e-4, "b2": -0.3, "b3": 100.0}),
    "rolled by any angle": (
        {"roll": ROLL, "b2": 2.0, "b3": 50.0},
        {"b2": 2.0 * np.cos(3 * ROLL), "b3": 50.0 * np.cos(4 * ROLL),
         "a2": -2.0 * np.sin(3 * ROLL), "a3": -50.0 * np.sin(4 * ROLL)},
    ),
}  # fmt: skip


@pytest.mark.slow
def test_driving_terms_are_those_of_the_same_map_described_otherwise():
    magnet = rings.multipole("M", 0.0, (0, 0, 0, 0)).placed()
    ring, z = lattice_with(magnet, *KICKS), jnp.array([1e-3, 2e-4, 5e-4, -1e-4, 0, 0])
    for case, values in SAME_MAPS.items():
        both = [ring.set("M", **v) for v in values]
        maps = [rings.one_turn(r, z) for r in both]
        np.testing.assert_allclose(*maps, rtol=0, atol=1e-17, err_msg=case)
        first, second = (rings.resonance_driving_terms(r, (*TERMS, "h21000")) for r in both)
        size = max(abs(complex(x)) for x in first.values())
        for name in first:
            np.testing.assert_allclose(first[name], second[name], rtol=0, atol=1e-10 * size)


@pytest.mark.slow
def test_driving_terms_are_the_harmonics_of_the_potential_on_the_motion():
    """About the closed orbit, in coupled motion: the potential at the magnet, as a function of the
    phases of both modes and of a factor of the amplitudes."""
    b2, b3, shift = 2.0, 50.0, 3e-4 + 2e-4j
    magnet = rings.multipole("M", 0.0, (0, 0, b2, b3)).placed(shift.real, shift.imag)
    ring = lattice_with(magnet, *KICKS)
    found = rings.resonance_driving_terms(ring, TERMS)
    o, n = rings.optics(ring, chromatic=False), 16
    assert np.abs(o.orbit[2, :3:2]).min() > 1e-5
    assert np.abs(o.gamma - 1).max() > 1e-3
    phases = np.exp(2j * np.pi * np.arange(n) / n)
    factors = 1e-3 * np.arange(-3, 4)
    A, B, factor = np.meshgrid(phases, phases, factors, indexing="ij")
    x, y = (np.real(o.modes[2, 0, i] * A + o.modes[2, 1, i] * B) * factor for i in (0, 2))
    w = complex(o.orbit[2, 0], o.orbit[2, 2]) - shift + x + 1j * y
    potential = np.real(b2 * w**3 / 3 + b3 * w**4 / 4)
    harmonics = np.fft.fft2(potential, axes=(0, 1)).reshape(n * n, -1) / n**2
    cubic = np.polynomial.polynomial.polyfit(factors / 1e-3, harmonics.T, 4)[3].reshape(n, n) / 1e-9
    for name in TERMS:
        j, k, m, q = map(int, name[1:5])
        np.testing.assert_allclose(found[name], cubic[(j - k) % n, (m - q) % n], rtol=1e-6)


def test_driving_terms_of_a_lens_are_refused():
    ring = lattice_with(rings.lens("L", lambda x, y, par: x**3))
    with pytest.raises(ValueError, match="must not contain a lens"):
        rings.resonance_driving_terms(ring)


def weak_focusing(pieces, turns=1, n=0.1):
    angle = 2 * np.pi * turns / pieces
    return rings.Ring(
        [rings.bend("B", angle, angle, (0, -n), slices=64 * turns // pieces)] * pieces
    )


def solenoids(pieces):
    sol = rings.solenoid("S", 8.0 / pieces, 1.6)
    return rings.Ring([rings.quadrupole("QF", 0.3, 0.6), *[sol] * pieces, rings.drift("D", 1.0),
                       rings.quadrupole("QD", 0.3, -0.5)])  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "tunes"),
    [
        (weak_focusing, [np.sqrt(0.9), np.sqrt(0.1)]),
        (lambda pieces: weak_focusing(2 * pieces, 2, 0.04), [2 * np.sqrt(0.96), 0.4]),
        pytest.param(solenoids, None, marks=pytest.mark.slow),
    ],
)
def test_tunes_have_their_whole_part_also_where_one_magnet_turns_the_phase_more_than_once(
    make, tunes
):
    one, many = (rings.optics(make(pieces)) for pieces in (1, 8))
    np.testing.assert_allclose(one.tune, many.tune, atol=1e-5)
    np.testing.assert_allclose(one.chromaticity, many.chromaticity, atol=1e-3)
    if tunes is not None:
        np.testing.assert_allclose(one.tune, tunes, atol=1e-4)


def with_defocusing(magnet, drift=2.0, k=0.6):
    return rings.Ring([rings.quadrupole("QF", 0.5, k), rings.drift("D", drift),
                       *[magnet, rings.drift("D", drift)]])  # fmt: skip


@pytest.mark.parametrize(
    "errors",
    [
        {"roll": np.pi / 2},
        *(
            pytest.param(errors, marks=pytest.mark.slow)
            for errors in (
                {"roll": 3 * np.pi / 2, "ds": 1e-9},
                {"tilt": -np.pi / 2},
                {"roll": np.pi / 4, "tilt": np.pi / 4},
            )
        ),
    ],
)
def test_the_tune_of_a_rolled_magnet_is_that_of_the_same_magnet_described_otherwise(errors):
    """By 5 or 1 larger where the phase is that of the component of a mode in the rolled frame."""
    wanted = rings.optics(with_defocusing(rings.quadrupole("QD", 0.5, -0.5)))
    rolled = rings.optics(with_defocusing(rings.quadrupole("QD", 0.5, 0.5).placed(**errors)))
    for name in ("tune", "chromaticity", "mu", "beta", "alpha"):
        np.testing.assert_allclose(getattr(rolled, name), getattr(wanted, name), atol=1e-8)


@pytest.mark.slow
def test_the_tunes_of_a_ring_with_vertical_bends():
    """A bend without focusing by its field is a quadrupole in its own plane."""
    at = pytest.importorskip("at")
    bend = rings.bend("B", 1.0, 0.9, (0, -0.3))  # it focuses in both planes

    def tunes(bend, k):
        return rings.optics(with_defocusing(bend, 0.5, k)).tune

    upright = tunes(bend, 0.1)
    np.testing.assert_allclose(tunes(bend.placed(tilt=np.pi / 2), -0.1), upright[::-1], atol=1e-12)
    theirs = at.Dipole("B", 1.0, 0.9, -0.3)
    at.tilt_elem(theirs, np.pi / 2)
    line = [at.Quadrupole("QF", 0.5, -0.1), at.Drift("D", 0.5), theirs, at.Drift("D", 0.5)]
    loaded = rings.from_at(at.Lattice(line, energy=1e9, periodicity=1))
    np.testing.assert_allclose(rings.optics(loaded).tune, upright[::-1], atol=1e-2)


@pytest.mark.slow
def test_what_is_perturbed_is_part_of_each_result_at_epsilon():
    """The voltage decides whether the motion is 6D, the lengths give s and the compaction."""
    ring = cell(angle=0.1, voltage=1e-3)
    found = rings.optics(ring.perturbed("C", "voltage"), epsilon=1.0)
    np.testing.assert_allclose(found.tune, rings.optics(ring).tune, rtol=0, atol=1e-14)
    assert rings.matrix(ring.perturbed("C", "voltage"), dp=0.0, epsilon=1.0)[5, 4] == 0
    perturbed = ring.perturbed("D", "length")
    for name in ("s", "compaction", "tune"):
        one, other = (getattr(rings.optics(r, dp=0.0, epsilon=e), name)
                      for r, e in ((ring, 0.0), (perturbed, 1.0)))  # fmt: skip
        np.testing.assert_allclose(one, other, rtol=1e-13, err_msg=name)
    assert perturbed.at(0.5).places[-1] == ring.places[-1] - ring.get("D", "length").sum() / 2


@pytest.mark.slow
def test_driving_terms_include_the_sextupoles_of_exact_bends_of_pyat():
    at = pytest.importorskip("at")
    line = [at.Quadrupole("QF", 0.5, 0.6), at.Drift("D", 2.0),
            at.Dipole("B", 1.0, 0.01, PolynomB=[0.0, -0.3, 2.0], PassMethod="ExactSectorBendPass"),
            at.Drift("D", 2.0)]  # fmt: skip
    lattice = at.Lattice(line, energy=1e9, periodicity=1)
    exact, paraxial = (rings.from_at(lattice, model=m) for m in (None, "paraxial"))
    terms = [rings.resonance_driving_terms(r)["h21000"] for r in (exact, paraxial)]
    assert abs(terms[1]) > 0.1
    np.testing.assert_allclose(*terms, rtol=1e-2)


@pytest.mark.slow
def test_apertures_of_a_ring_with_limits():
    limits = rings.aperture("A", rectangle=(-0.01, 0.02, -0.005, 0.005))
    bend = rings.bend("B", 1.5, 0.2, edge_in=0.1, edge_out=0.1)
    quadrupoles = (rings.quadrupole(n, 0.5, k, slices=8) for n, k in (("QF", 0.6), ("QD", -0.6)))
    half = [[q, rings.drift("D", 0.5), bend] for q in quadrupoles]
    line = rings.Ring([limits, *half[0], *half[1]])
    o = rings.optics(line, chromatic=False)
    found = rings.dynamic_aperture(line, 200, largest=(0.03, 0.03), angles=3, steps=40, rounds=2)
    # Without sextupoles an ellipse that fits between the limits is stable.
    x, y = np.array([0.01, 0.005]) / np.sqrt(1 + np.asarray(o.alpha[0]) ** 2)
    close(found, [[x, 0], [0, y], [-x, 0]], 2e-2)
    reached = []
    done = rings.momentum_aperture(line, 200, [0, 3], largest=0.004, progress=reached.append)
    D, beta = np.asarray(o.dispersion), np.asarray(o.beta)
    assert done.shape == (2, 2)
    assert reached[-1][0] == reached[-1][1]
    # It starts at x = 0, so that it oscillates about D δ and reaches D δ and the amplitude.
    v = o.modes[0, 0, :2]
    amplitude = np.abs(np.conj(v) @ np.array([[0, 1], [-1, 0]]) @ D[0, :2])
    largest = D[0, 0] + np.sqrt(beta[0, 0]) * amplitude
    close(done[0], np.array([-0.01, 0.02]) / largest, 5e-2)


@pytest.mark.slow
def test_frequency_map_has_the_linear_tunes_and_the_detuning():
    x, y = np.meshgrid([1e-4, 1e-3, 0.5], [1e-4, 2e-4])
    found = rings.frequency_map(cell(b3=50.0), x, y, 256)
    assert found.tune.shape == (2, 3, 2)
    assert np.isnan(found.diffusion[:, 2]).all()  # lost at x = 0.5 m
    o, slope = rings.optics(cell(), chromatic=False), rings.detuning(cell(b3=50.0))
    J = np.stack([x, y], -1)[:, :2] ** 2 / 2 * np.asarray((1 + o.alpha[0] ** 2) / o.beta[0])
    close(np.asarray(found.tune[:, :2]) - np.asarray(o.tune), J @ np.asarray(slope).T, 2e-2)
    assert (np.asarray(found.diffusion)[:, :2] < -8).all()


def lattice(name, six=False):
    at = pytest.importorskip("at")
    import machine_data

    with warnings.catch_warnings(action="ignore"):
        found = at.load_lattice(os.path.join(machine_data.__path__[0], name))
    found.enable_6d() if six else found.disable_6d()
    for e in found:
        e.PassMethod = e.PassMethod.replace("RadPass", "Pass")
    found.periodicity = 1
    return at, found


@pytest.mark.slow
@pytest.mark.parametrize("case", ["hmba.mat", "hmba.mat 6D", "dba.mat", "esrf.m", "esrf.m 6D"])
def test_optics_agree_with_pyat(case):
    at, theirs = lattice(case.removesuffix(" 6D"), six := case.endswith(" 6D"))
    ring = rings.from_at(theirs)
    found = rings.optics(ring)
    _, all_of, each = at.get_optics(
        theirs, refpts=range(len(theirs) + 1), method=at.linopt6, get_chrom=True
    )
    close(found.s, each.s_pos, 1e-13)
    close(found.beta, each.beta, 1e-8)
    close(found.alpha, each.alpha, 1e-8)
    close(found.mu[:, :2], each.mu[:, :2], 1e-10)
    close(found.dispersion, each.dispersion, 1e-8)
    close(found.tune % 1, all_of.tune, 1e-9)
    close(found.chromaticity, all_of.chromaticity, 1e-7)  # theirs: differences of round-off 1e-8
    assert np.abs(found.orbit[:, :4] - each.closed_orbit[:, :4]).max() < 1e-11
    if not six:
        close(found.compaction, at.get_mcf(theirs), 1e-8)


@pytest.mark.slow
def test_coupled_optics_and_chromaticity_off_momentum_agree_with_pyat():
    at, theirs = lattice("hmba.mat")
    for e in theirs:
        if isinstance(e, at.Quadrupole):
            e.PolynomA = np.array([0.0, 0.04])
            break
    ring = rings.from_at(theirs)
    found = rings.optics(ring, 0.003)
    assert np.abs(found.gamma - 1).max() > 1e-4
    where = range(len(theirs) + 1)
    *_, each = at.get_optics(theirs, dp=0.003, refpts=where, method=at.linopt6)
    close(found.beta, each.beta, 1e-8)
    *_, each = at.get_optics(theirs, dp=0.003, refpts=where, method=at.linopt4)
    close(found.beta / found.gamma[:, None] ** 2, each.beta, 1e-8)
    close(found.orbit[:, :4], each.closed_orbit[:, :4], 1e-10)

    def slope(h):
        up, down = (at.get_optics(theirs, dp=0.003 + d)[1].tune for d in (h, -h))
        return (up - down) / (2 * h)

    once, twice = ((4 * slope(h / 2) - slope(h)) / 3 for h in (2e-3, 1e-3))
    close(found.chromaticity, (16 * twice - once) / 15, 1e-6)


@pytest.mark.slow
def test_nonlinear_quantities_agree_with_pyat():
    at, theirs = lattice("hmba.mat")
    ring = rings.from_at(theirs)
    close(rings.detuning(ring).T, at.detuning(theirs, xm=1e-4, ym=1e-4, nturns=1024)[1], 1e-3)

    # pyAT takes the mean β of a magnet and the phase at its middle; in slices it converges to ours.
    names = ("h21000", "h30000", "h10110", "h10020", "h10200")
    found, errors = rings.resonance_driving_terms(ring, names), []
    for n in (8, 16):
        parts = [e.divide([1 / n] * n) if isinstance(e, at.Sextupole) else [e] for e in theirs]
        sliced = at.Lattice(itertools.chain(*parts), energy=theirs.energy, periodicity=1)
        terms = at.get_rdts(sliced, 0, [at.RDTType.GEOMETRIC1])[0]
        errors.append([abs(complex(found[k]) / terms[k][0] - 1) for k in names])
    close(errors[1], np.asarray(errors[0]) / 4, 2e-2)
    assert np.max(errors[1]) < 1e-4

    turns, steps = 64, np.arange(1, 33) / 32
    found = rings.momentum_aperture(ring, turns, [60], largest=0.2, steps=32, rounds=1)[0]
    for side, limit in zip((-1, 1), found, strict=True):
        r = np.zeros((6, 32))
        r[[0, 2]], r[4] = 1e-6, side * 0.2 * steps
        theirs.track(r, nturns=1, start_elem=60, in_place=True, refpts=None)
        lost = theirs.track(r, nturns=turns, losses=True, in_place=True, refpts=None)[2]
        assert limit == pytest.approx(side * 0.2 * np.argmax(lost["loss_map"].islost) / 32)

    x, y = np.meshgrid([1e-4, 1e-3, 2e-3], [1e-4, 5e-4])
    found = rings.frequency_map(ring, x, y, 1024)
    r = np.zeros((6, 6), order="F")
    r[0], r[2] = x.ravel() + 1e-9, y.ravel() + 1e-9
    each = at.linopt4(theirs)[0]
    out = np.squeeze(theirs.track(r, nturns=512)[0])
    for k in (0, 1):
        signal = out[2 * k] - 1j * (each.alpha[k] * out[2 * k] + each.beta[k] * out[2 * k + 1])
        tunes = at.get_tunes_harmonic(signal - signal.mean(1, keepdims=True))
        assert np.abs(found.tune[..., k].ravel() - tunes).max() < 1e-6
