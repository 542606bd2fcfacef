"""Rings that radiate: energy loss, damping, equilibrium, noise and lifetime."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dvi_jax.systems import rings
from dvi_jax.systems.rings._envelope import _moments
from dvi_jax.systems.rings._maps import Particle
from dvi_jax.systems.rings._optics import maps
from dvi_jax.systems.rings._readers import ORDER, to_at
from dvi_jax.systems.rings._turn import Passage

SIZES = np.array([1e-3, 1e-4, 1e-3, 1e-4, 1e-2, 1e-3])
SINGLE = rings.Ring([rings.bend("B", 2.0, 0.1)], energy=3e9)


def particles(count=20, seed=0):
    return np.random.default_rng(seed).normal(size=(count, 6)) * SIZES


def close(ours, theirs, **tolerance):
    return np.asarray(ours) == pytest.approx(np.asarray(theirs), **tolerance)


def cell_of(energy=1e9, voltage=2e-3):
    """A cell with sextupoles, a cavity and a phase that compensates the loss."""
    bend = rings.bend("B", 1.5, np.pi / 16, edge_in=np.pi / 32, edge_out=np.pi / 32)
    d = rings.drift("D", 0.2)
    elements = [
        rings.quadrupole("QF", 0.4, k1=1.3), d, rings.sextupole("SF", 0.2, b2=3.0), d, bend, d,
        rings.quadrupole("QD", 0.4, k1=-1.3), d, rings.sextupole("SD", 0.2, b2=-4.0), d, bend, d,
        rings.cavity("RF", 0.0, voltage, 5e8),
    ]  # fmt: skip
    return rings.Ring(elements, energy=energy)


@functools.cache
def radiating_cell():
    return rings.in_phase(rings.radiating(cell_of(2.8e9, 3e-5)))


@functools.cache
def equilibrium_of_cell():
    return rings.equilibrium(radiating_cell())


def test_loss_in_a_bend_is_that_of_the_formula():
    """U = C_γ E⁴ h² L/(2π) on the orbit of a bend, with C_γ = 8.846e-5 m/GeV³, less the change of
    the loss with the energy that is lost before."""
    loss = -3e9 * rings.one_turn(rings.radiating(SINGLE), jnp.zeros(6))[5]
    formula = 8.8462738e-5 * 3**4 * 0.1**2 / 2.0 / (2 * np.pi) * 1e9
    assert close(loss, formula, rel=3e-6)
    assert rings.one_turn(rings.radiating(SINGLE, None), jnp.zeros(6))[5] == 0
    # A proton of this energy loses (m_e/m_p)⁴ of it.
    protons = rings.one_turn(rings.radiating(SINGLE, mass=938.272e6), jnp.zeros(6))[5]
    assert -3e9 * protons / formula == pytest.approx(1836.15**-4, rel=1e-4)


@pytest.mark.parametrize("name", [
    "bend",
    *(pytest.param(n, marks=pytest.mark.slow) for n in ("multipole", "exact bend", "second order")),
])  # fmt: skip
def test_the_inverse_restores_the_particle(name):
    field = {"b": (1e-3, -0.5, 2.0), "a": (1e-3, 0.2, 1.0)}
    bend = functools.partial(rings.bend, "B", 1.1, 0.2, **field, edge_in=0.1, slices=3)
    ring = rings.Ring([{
        "bend": bend(),
        "multipole": rings.multipole("M", 0.4, **field, slices=3, scheme=6),
        "exact bend": bend(model="exact"),
        "second order": bend(),
    }[name]], energy=2e10)  # fmt: skip
    if name == "second order":
        part = ring.program.parts[0]._replace(name="second_order_bend", order=2, slices=3)
        ring = rings.Ring([rings.Element("B", "bend", (part,), bend().values)], energy=2e10)
    passage = Passage.from_ring(rings.radiating(ring))

    @jax.jit
    @jax.vmap
    def there_and_back(z):
        end = passage.image(Particle(*z), 0, 0.0)
        return jnp.stack(end), jnp.stack(passage.image(end, 0, 0.0, -1))

    z = jnp.asarray(particles())
    end, back = there_and_back(z)
    assert jnp.max(jnp.abs(back - z)) < 1e-15
    assert jnp.min(z[:, 5] - end[:, 5]) > 1e-9


def test_a_system_has_no_radiation():
    with pytest.raises(ValueError, match="loss of the magnets must be between 0 and 0"):
        rings.problem(rings.radiating(SINGLE))
    rings.problem(rings.radiating(rings.radiating(SINGLE), None))


def test_wrong_rings_have_an_error():
    with pytest.raises(TypeError, match=r"requires magnets that radiate\. Use rings.radiating"):
        rings.equilibrium(cell_of())
    no_cavity = r"requires a cavity with a voltage\. .* whose voltage is not zero"
    with pytest.raises(TypeError, match=no_cavity):
        rings.equilibrium(rings.radiating(SINGLE))
    with pytest.raises(TypeError, match=no_cavity):
        rings.equilibrium(rings.radiating(cell_of(voltage=0.0)))
    with pytest.raises(ValueError, match="number of magnets that radiate must be between 1"):
        rings.radiating(cell_of(), "D")
    tilted = rings.Ring([rings.bend("B", 2.0, 0.1).placed(tilt=np.pi / 2)], energy=3e9)
    with pytest.raises(ValueError, match="roll of a bend must be between"):
        rings.radiation_integrals(tilted)


@pytest.mark.slow
def test_the_loss_cannot_exceed_the_voltage():
    with pytest.raises(ValueError, match="loss of a turn over the voltage"):
        rings.in_phase(rings.radiating(cell_of(2.8e9, 1e-6)))


@pytest.mark.slow
def test_damping_and_integrals_agree():
    """Eigenvalues of the matrix and radiation integrals, whose formulas are the limit of small
    losses and slow synchrotron motion."""
    ring, found = radiating_cell(), equilibrium_of_cell()
    _, i2, i3, i4, i5 = map(float, rings.radiation_integrals(ring))
    loss = 8.8462738e-5 * 2.8**4 * i2 / (2 * np.pi) * 1e9
    assert found.loss == pytest.approx(float(loss), rel=2e-4)
    partition = np.array([1 - i4 / i2, 1, 2 + i4 / i2])
    assert close(found.partition, partition, rel=1e-4)
    # Robinson: the sum of the rates is twice the relative loss; exactly, −log det M / 2.
    assert -jnp.log(jnp.linalg.det(found.matrix)) / 2 == pytest.approx(
        float(jnp.sum(ring.period / found.damping_time)), rel=1e-10
    )
    c_q, gamma = 3.8319387e-13, 2.8e9 / 510998.95
    assert close(found.emittance[0], c_q * gamma**2 * i5 / (i2 - i4), rel=1e-3)
    spread = gamma * np.sqrt(c_q * i3 / (2 * i2 + i4))
    assert found.energy_spread == pytest.approx(float(spread), rel=5e-4)
    assert found.emittance[1] < 1e-30
    # The covariances are those of the next turn, too.
    assert close(found.sigma[-1], found.sigma[0], rel=1e-8, abs=1e-24)


@pytest.mark.slow
def test_diffusion_of_a_bend_with_few_slices():
    """The growth of the horizontal action against I₅, where bends are not symmetric about their
    middle. With the noise at the end of each kick it is 7e-3 and 2e-4 off, and the covariance of
    x is negative."""
    for slices, error in ((3, 4e-4), (10, 5e-6)):
        bend = rings.bend("B", 1.5, 0.2, edge_in=0.1, edge_out=0.1, slices=slices)
        d = rings.drift("D", 0.6)
        cell = [rings.quadrupole("QF", 0.4, 1.3), d, bend, d, rings.quadrupole("QD", 0.4, -1.3), d]
        ring = rings.radiating(rings.Ring(cell), "B")
        o = rings.optics(ring, 0.0, chromatic=False)
        B = jax.jit(lambda ring, z: _moments(ring, z)[2][-1])(ring, o.orbit[0])
        about = jnp.eye(6).at[:4, 5].set(-o.dispersion[0])
        assert jnp.diag(B).min() >= 0
        (xx, xp), (_, pp) = (about @ B @ about.T)[:2, :2]
        beta, alpha = o.beta[0, 0], o.alpha[0, 0]
        growth = ((1 + alpha**2) / beta * xx + 2 * alpha * xp + beta * pp) / 2
        expected = rings.radiation_integrals(ring)[4] * ring.get("B", "excitation")[0] ** 2 / 2
        assert growth == pytest.approx(float(expected), rel=error)


@pytest.mark.slow
def test_gradient_of_the_emittance_agrees_with_differences():
    """In a ring with fast damping: the matrix has the damping as a difference from 1, so that
    differences of a ring with slow damping have a large error of rounding."""

    def emittances(k):
        found = rings.equilibrium(fast_ring().set("QF", b1=k))
        return jnp.stack([found.emittance[0], found.energy_spread, found.damping_time[0]])

    _, gradient = jax.jvp(emittances, (1.4,), (1.0,))
    step = 1e-4
    difference = (emittances(1.4 + step) - emittances(1.4 - step)) / (2 * step)
    assert close(gradient, difference, rel=1e-5)
    assert abs(gradient[0]) > 1e-10


@pytest.fixture
def at():
    return pytest.importorskip("at")


def at_ring(at, name="hmba.mat", slices=None):
    """A lattice of pyAT with radiation, and our ring."""
    data = pytest.importorskip("machine_data")
    lattice = at.load_lattice(f"{data.__path__[0]}/{name}")
    if slices:
        magnets = lattice.get_bool_index(at.Multipole)
        lattice.set_value_refpts(magnets, "NumIntSteps", slices)
    lattice.enable_6d()
    lattice.set_cavity_phase()
    return lattice, rings.from_at(lattice)


BENDING = {"EntranceAngle": 0.05, "ExitAngle": 0.04, "FullGap": 0.05, "FringeInt1": 0.5}
FIELDS = [1e-3, 0.2, 3.0], [2e-3, -0.3, 8.0]


@pytest.mark.parametrize("method", [
    "BndMPoleSymplectic4RadPass",
    *(pytest.param(f"{n}RadPass", marks=pytest.mark.slow)
      for n in ("StrMPoleSymplectic4", "ExactMultipole", "ExactSectorBend")),
])  # fmt: skip
def test_elements_agree_with_pyat(at, method):
    if "Str" in method or "Multi" in method:
        element = at.Multipole("M", 0.5, *FIELDS, PassMethod=method)
    elif "Exact" in method:
        element = at.Dipole("B", 1.5, 0.1, -0.3, PassMethod=method)
    else:
        b = {"PolynomA": FIELDS[0], "PolynomB": FIELDS[1], "MaxOrder": 2, **BENDING}
        element = at.Dipole("B", 1.5, 0.1, PassMethod=method, **b)
    ring = rings.from_at(at.Lattice([element], energy=6e9))
    z = particles()
    theirs = to_at(z)
    element.track(theirs, in_place=True, energy=6e9)
    ours = to_at(rings.one_turn(ring, z))
    # The relative loss is 2e-5 in the bends and 3e-8 in the multipole.
    assert np.max(np.abs(ours - theirs)) < 1e-13
    off = to_at(rings.one_turn(rings.radiating(ring, None), z))
    assert np.max(np.abs(off - theirs)) > 1e-8


@pytest.mark.slow
def test_equilibrium_agrees_with_pyat(at):
    """Rates to the errors of pyAT's differences; its covariances, which are not damped between the
    kicks of an element, to 2e-6, and to 1e-8 with its diffusion of each element. The photons of a
    kick are at its end there: an error of the emittance in proportion to the length of a slice."""
    lattice, ring = at_ring(at)
    found = rings.equilibrium(ring)
    coarse, (fine, fine_ring) = at_ring(at, slices=40)[0], at_ring(at, slices=80)
    steps = at.DConstant.XYStep, at.DConstant.DPStep
    at.DConstant.XYStep, at.DConstant.DPStep = 1e-9, 1e-5
    try:
        start, modes, _ = lattice.ohmi_envelope()
        (_, coarse_modes, _), (fine_start, fine_modes, _) = map(at.ohmi_envelope, (coarse, fine))
        integrals = lattice.disable_6d(copy=True).get_radiation_integrals()
    finally:
        at.DConstant.XYStep, at.DConstant.DPStep = steps
    rates = ring.period / found.damping_time
    assert close(rates, modes.damping_rates, rel=1e-8)
    assert close(found.orbit[0], ORDER @ start.orbit6, abs=3e-12)
    fine_found = rings.equilibrium(fine_ring)
    limit = 2 * fine_modes.mode_emittances - coarse_modes.mode_emittances
    assert close(fine_found.emittance[::2], limit[::2], rel=3e-6)
    assert close(found.emittance[0], limit[0], rel=2e-5)
    assert modes.mode_emittances[0] / limit[0] > 1 + 3e-3
    for beam, envelope in ((found, start), (fine_found, fine_start)):
        sizes = jnp.stack([beam.energy_spread, beam.bunch_length])
        assert close(sizes, np.sqrt(np.diag(envelope.r66)[[4, 5]]), rel=2e-6)
    assert close(rings.radiation_integrals(ring), integrals, rel=5e-9)
    # pyAT's diffusion matrices in our equation.
    _, matrices, _ = jax.jit(lambda ring, z: _moments(ring, z)[:3])(ring, found.orbit[0])
    elements = np.asarray([element for _, element in ring.program.rows])[maps(ring)[2]]
    index = np.searchsorted(elements, np.arange(len(ring) + 1))
    matrices, B = np.asarray(matrices)[index], np.zeros((6, 6))
    for i, element in enumerate(lattice):
        m = matrices[i + 1] @ np.linalg.inv(matrices[i])
        B = m @ B @ m.T
        if element.PassMethod.endswith("RadPass"):
            orbit = to_at(found.orbit[i])
            b = at.tracking.diffusion_matrix(element, orbit, energy=lattice.energy)
            B += ORDER @ b @ ORDER.T
    M = matrices[-1]
    sigma = np.linalg.solve(np.eye(36) - np.kron(M, M), B.ravel()).reshape(6, 6)
    theirs = ORDER @ start.r66 @ ORDER.T
    assert np.max(np.abs(sigma - theirs)) < 1e-8 * np.max(np.abs(theirs))
    assert sigma[0, 0] == pytest.approx(theirs[0, 0], rel=1e-8)


@functools.cache
def fast_ring():
    """Damping in 60 turns: losses and excitation of 200 times those of 4 GeV."""
    bend = rings.bend("B", 1.5, np.pi / 8, edge_in=np.pi / 16, edge_out=np.pi / 16, slices=12)
    d = rings.drift("D", 0.4)
    q = functools.partial(rings.quadrupole, slices=3)
    cell = [q("QF", 0.4, k1=1.4), d, bend, d, q("QD", 0.4, k1=-1.2), d, bend, d]
    ring = rings.radiating(rings.Ring([*cell, rings.cavity("RF", 0.0, 0.08, 1e7)], energy=4e9), "B")
    loss, excitation = (ring.get("B", name) for name in ("loss", "excitation"))
    return rings.in_phase(ring.set("B", loss=200 * loss, excitation=excitation))


@pytest.mark.slow
def test_tracking_with_noise_reaches_the_equilibrium():
    """Covariances of 6000 particles, within four standard errors; those of one particle do not
    depend on the batch, and other keys give other particles."""
    ring, count = fast_ring(), 6000
    found = rings.equilibrium(ring)
    turns = int(4 / np.min(ring.period / found.damping_time))
    z = jnp.broadcast_to(found.orbit[0], (count, 6))
    out = rings.track(ring, z, turns, key=1)
    assert not out.lost.any()
    covariance, expected = np.cov(out.z.T), np.asarray(found.sigma[0])
    size = np.sqrt(np.maximum(np.diag(expected), 1e-30))
    error = np.sqrt(2 / count)
    assert np.max(np.abs(covariance - expected) / np.outer(size, size)) < 4 * error
    variances = np.diag(covariance)[[0, 1, 4, 5]] / np.diag(expected)[[0, 1, 4, 5]]
    assert np.max(np.abs(variances - 1)) < 4 * error
    # Particle i has the noise of fold_in(key, i), in every batch; turns continue.
    few = rings.track(ring, z[:7], turns, key=1)
    assert np.array_equal(few.z, out.z[:7])
    begin = rings.track(ring, z[:7], turns - 100, key=1).z
    again = rings.track(ring, begin, 100, key=1, first_turn=turns - 100).z
    assert np.array_equal(again, few.z)
    other = rings.track(ring, z[:7], turns, key=jax.random.key(2)).z
    assert np.min(np.abs(other - few.z)[:, 5]) > 1e-8
    assert np.max(np.abs(other[0] - other[1])) > 1e-6


def test_noise_requires_radiation():
    with pytest.raises(TypeError, match=r"rings.track\(key=...\) requires loss"):
        rings.track(SINGLE, np.zeros(6), key=1)


@pytest.mark.slow
def test_noise_of_a_bend_has_the_variance_of_the_formula():
    """σ² = 55 ƛ r γ⁵ h³ L/(24 √3) of δ, from 4·10⁵ particles; px and δ change together."""
    ring = rings.radiating(SINGLE)
    out = rings.track(ring, np.zeros((400000, 6)), key=3).z
    gamma = 3e9 / 510998.95069
    expected = 55 / 24 / np.sqrt(3) * 3.8615926796e-13 * 2.8179403205e-15 * gamma**5
    expected *= 0.05**3 * 2.0
    assert np.var(out[:, 5]) / expected == pytest.approx(1, abs=4 * np.sqrt(2 / 400000))
    assert np.mean(out[:, 5]) == pytest.approx(
        float(rings.one_turn(ring, np.zeros(6))[5]), abs=4 * np.sqrt(expected / 400000)
    )


@pytest.mark.slow
def test_gradient_of_damped_tracking_agrees_with_differences():
    """By the exact inverse of the map, which anti-damps."""
    ring = fast_ring()
    begin = rings.closed_orbit(ring) + jnp.array([1e-3, 0.0, 1e-3, 0.0, 0.0, 1e-4])

    def end(k):
        return rings.track(ring.set("QF", b1=k), begin, 100).z[jnp.array([0, 5])] @ jnp.ones(2)

    difference = (end(1.4 + 1e-6) - end(1.4 - 1e-6)) / 2e-6
    assert close(jax.grad(end)(1.4), difference, rel=1e-6)


@pytest.mark.slow
def test_tapered_magnets_restore_the_orbit():
    """The horizontal orbit with a cavity at one place, without and with tapering. The loss within
    each magnet remains, which bends the orbit inwards and shifts all momenta alike."""
    cell = cell_of(8e9, 0.01).program
    ring = rings.in_phase(rings.radiating(cell_of(8e9, 0.01)))
    orbit = jnp.max(jnp.abs(rings.optics(ring, chromatic=False).orbit[:, 0]))
    tapered = rings.tapered(ring)
    found = rings.optics(tapered, chromatic=False).orbit
    assert len(tapered.program.rows) == len(cell.rows) + 2 * 6
    assert orbit > 1e-6
    assert jnp.max(jnp.abs(found[:, 0])) < 0.2 * orbit
    again = rings.tapered(tapered)
    assert again.program.rows == tapered.program.rows
    shift = (again.columns["scale"] - tapered.columns["scale"])[tapered.columns["scale"] != 1]
    assert jnp.ptp(shift) < 5e-3 * jnp.abs(shift).max() < 1e-6


@pytest.mark.slow
def test_tapering_agrees_with_pyat(at):
    lattice, ring = at_ring(at)
    loss = ring.columns["loss"]
    for names in ((at.Dipole,), (at.Quadrupole,)):
        numbers = [i for i, e in enumerate(lattice) if isinstance(e, names)]
        ring = rings.tapered(ring, numbers)
    lattice.tapering(multipoles=False)
    _, orbit = lattice.find_orbit(range(len(lattice) + 1))
    quadrupoles = lattice.get_bool_index(at.Quadrupole)
    scale = 1 + (orbit[:-1, 4] + orbit[1:, 4]) / 2
    lattice.set_value_refpts(quadrupoles, "FieldScaling", scale[quadrupoles[:-1]])
    # pyAT does not scale the loss with the energy of the reference particle in a magnet.
    ring = ring.set(np.flatnonzero(loss), loss=loss[loss > 0])
    _, theirs = lattice.find_orbit(range(len(lattice) + 1))
    ours = rings.optics(ring, chromatic=False).orbit @ ORDER
    assert np.max(np.abs(ours - theirs)) < 1e-9


@pytest.mark.slow
def test_touschek_lifetime_agrees_with_pyat(at):
    """pyAT replaces I₀(x) by its asymptotic form for x > 500, which it reaches in flat beams."""
    data = pytest.importorskip("machine_data")
    lattice = at.load_lattice(f"{data.__path__[0]}/hmba.mat")
    lattice.disable_6d()
    ring, n = rings.from_at(lattice), len(lattice)
    aperture = np.random.default_rng(0).uniform(0.03, 0.05, (n, 2)) * np.array([-1, 1])
    sizes = {"energy_spread": 9e-4, "bunch_length": 3e-3}
    count = 1e-3 / lattice.revolution_frequency / 1.602176634e-19
    for vertical, tolerance in ((1e-10, 1e-8), (1e-11, 3e-6)):
        ours = rings.touschek_lifetime(
            ring, aperture, count, emittance=(1.3e-10, vertical), **sizes
        )
        theirs, *_ = lattice.get_lifetime(
            vertical, 1e-3, emitx=1.3e-10, sigs=3e-3, sigp=9e-4, momap=aperture, refpts=range(n)
        )
        assert close(ours, theirs, rel=tolerance)
    sparse = rings.touschek_lifetime(
        ring, aperture[::4], count, emittance=(1.3e-10, 1e-11), where=np.arange(0, n, 4), **sizes
    )
    assert close(sparse, ours, rel=0.3)
