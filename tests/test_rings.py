"""Rings: elements and tracking against pyAT, symplecticity, losses, gradients, bad input."""

import json
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi
from dvi_jax.systems import rings

SIZES = np.array([1e-3, 1e-4, 1e-3, 1e-4, 1e-2, 1e-3])
S = np.kron(np.eye(3), [[0, 1], [-1, 0]])
FIELD = {"b": (1e-3, 1.2, 8.0, 50.0), "a": (2e-3, 0.3, 3.0)}

ELEMENTS = {
    "drift": rings.drift("D", 1.3),
    "exact drift": rings.drift("D", 1.3, model="exact"),
    "multipole": rings.multipole("M", 0.4, **FIELD, slices=3),
    "order 2": rings.multipole("M", 0.4, **FIELD, slices=3, scheme=2),
    "order 6": rings.multipole("M", 0.4, **FIELD, slices=1, scheme=6),
    "exact multipole": rings.multipole("M", 0.4, **FIELD, slices=3, model="exact"),
    "thin": rings.multipole("M", 0.0, **FIELD),
    "bend": rings.bend("B", 1.1, 0.2, (1e-3, -0.5, 2.0), edge_in=0.1, edge_out=0.07, slices=3),
    "bend with fringe": rings.bend("B", 1.1, 0.2, edge_in=0.1, fringe_in=0.02, fringe_out=0.01),
    "exact bend": rings.bend("B", 1.1, 0.2, (0, 0.4), edge_in=0.1, fringe=True, model="exact"),
    "corrector": rings.corrector("C", 0.3, 1e-3, -2e-3),
    "lens": rings.lens("L", lambda x, y, par: par["g"] * x**3 * y, g=3e3),
    "solenoid": rings.solenoid("S", 0.6, 0.8),
    "cavity": rings.cavity("RF", 0.4, 1e-3, 5e8, lag=0.05),
    "placed": rings.quadrupole("Q", 0.3, 1.1, slices=2).placed(1e-4, -2e-4, 0.05),
    "misaligned bend": rings.bend("B", 1.1, 0.2, (0, -0.5), edge_in=0.1, slices=3).placed(
        1e-4, -2e-4, 0.05, ds=1e-4, pitch=0.02, yaw=-0.03, anchor="middle", tilt=0.1
    ),
}


def ring_of(*elements):
    return rings.Ring(elements)


def particles(count=50, seed=0):
    return np.random.default_rng(seed).normal(size=(count, 6)) * SIZES


def asymmetry(ring, z):
    """max |Jᵀ S J − S| of the map at z."""
    J = np.asarray(jax.jacfwd(lambda z: rings.one_turn(ring, z))(z))
    return np.abs(J.T @ S @ J - S).max()


QUICK = "multipole", "bend", "solenoid", "placed"


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[] if n in QUICK else pytest.mark.slow) for n in ELEMENTS]
)
def test_maps_are_symplectic(name):
    assert asymmetry(ring_of(ELEMENTS[name]), particles()[0]) < 1e-13


@pytest.mark.slow
def test_inverse_and_derivative_backwards():
    """The reverse pass goes through the inverse of every element."""
    ring = ring_of(*ELEMENTS.values())
    z, weights = particles()[0] / 10, np.arange(1.0, 7.0) / SIZES
    forward = jax.jacfwd(lambda z: rings.one_turn(ring, z))(z).T @ weights
    backward = jax.grad(lambda z: rings.track(ring, z).z @ weights)(z)
    np.testing.assert_allclose(backward, forward, rtol=1e-9)


def test_a_truncated_fringe_is_not_symplectic():
    """The negative control of the tests above, whose error is of order 4 in x."""
    ring = ring_of(rings.quadrupole("Q", 0.4, 1.2, slices=3, fringe=True))
    small, large = (asymmetry(ring, np.array([x, 0, x, 0, 0, 0])) for x in (1e-3, 1e-2))
    assert small < 1e-13 < 1e-11 < large < 1e-9


def test_exact_and_paraxial_models_differ_by_the_cubes_of_the_angles():
    z = np.array([1e-3, 2e-3, 0, 1e-3, 0, 0])
    exact, paraxial = (rings.track(ring_of(ELEMENTS[n]), z).z for n in ("exact drift", "drift"))
    p = np.array([2e-3, 1e-3])
    wanted = 1.3 * p * (p @ p) / 2
    np.testing.assert_allclose((exact - paraxial)[:3:2], wanted, rtol=1e-5)


@pytest.mark.parametrize("scheme", [2, 4, 6])
def test_order_of_the_slices(scheme):
    z = np.array([0.01, 0.02, -0.02, 0.01, 0, 0.01])

    def after(slices, scheme=scheme):
        magnet = rings.multipole("M", 1.0, (0, 3.0, 9.0), slices=slices, scheme=scheme)
        return rings.track(ring_of(magnet), z).z

    reference = after(300, 6)
    few = {2: 8, 4: 8, 6: 4}[scheme]
    ratio = np.abs(after(few) - reference).max() / np.abs(after(2 * few) - reference).max()
    assert np.log2(ratio) == pytest.approx(scheme, abs=0.35)


@pytest.fixture(scope="module")
def cell():
    return rings.Ring(
        [
            rings.quadrupole("QF", 0.5, 0.6, slices=3, fringe=True),
            rings.drift("D1", 2.0),
            rings.bend("B", 1.0, np.pi / 16, (0, 0.01), edge_in=0.1, edge_out=0.1, slices=2),
            rings.sextupole("SF", 0.1, 3.0, slices=1),
            rings.quadrupole("QD", 0.5, -0.6, slices=3).placed(1e-4, 0, 1e-3),
            rings.solenoid("SOL", 0.2, 0.1),
            rings.corrector("C", 0.1, 1e-4, 0.0),
            rings.aperture("A", ellipse=(0.03, 0.03)),
            rings.drift("D2", 2.0, model="exact"),
            rings.cavity("RF", 0.0, 1e-3, 5e8),
        ]
    )


@pytest.mark.slow
def test_gradients_by_strengths_and_coordinates(cell):
    """Reverse mode along states that are tracked backwards, against differences and forward mode;
    a lost particle changes nothing."""
    z = particles(4) / 3
    z[3] = [0.02, 0.01, 0, 0, 0, 0]  # lost

    def loss(k, z, turns=40):
        ring = cell.set("Q*", b1=k[:2]).set("SF", b2=k[2]).set("B", h=k[3]).set("QD", dx=k[4])
        ring = ring.set("RF", voltage=k[5]).set("SOL", ks=k[6]).set("C", kick_x=k[7])
        out = rings.track(ring, z, turns, every=20).z
        weights = jnp.arange(1.0, 7.0) / SIZES
        out = jnp.where(jnp.isnan(out), 0.0, out)
        return jnp.sum(out * jnp.broadcast_to(weights, out.shape))

    k = jnp.array([0.6, -0.6, 3.0, np.pi / 16, 1e-4, 1e-3, 0.1, 1e-4])
    assert np.asarray(rings.track(cell, z, 40).lost).tolist() == [False] * 3 + [True]
    by_k, by_z = jax.grad(loss, (0, 1))(k, z)
    v = jnp.array([1.0, -1, 5, 0.1, 1e-3, 1e-3, 0.1, 1e-3])
    u = np.random.default_rng(1).normal(size=z.shape) * SIZES * 0.1
    forward = jax.jvp(loss, (k, z), (v, u))[1]
    assert by_k @ v + jnp.sum(by_z * u) == pytest.approx(float(forward), rel=1e-9)
    assert not by_z[3].any()
    steps = 1e-6 * np.asarray(v)
    central = (loss(k + steps, z) - loss(k - steps, z)) / 2e-6
    assert by_k @ v == pytest.approx(float(central), rel=1e-6)
    without = jax.grad(loss, 0)(k, z[:3])
    np.testing.assert_allclose(by_k, without, rtol=1e-12)


def test_gradient_by_epsilon_and_of_the_perturbed_strength():
    plain = ring_of(
        rings.quadrupole("QF", 0.5, 0.6, slices=3), rings.sextupole("SF", 0.1, 3.0, slices=1),
        rings.drift("D", 2.0), rings.quadrupole("QD", 0.5, -0.6, slices=3), rings.drift("D", 2.0),
    )  # fmt: skip
    ring, z = plain.perturbed("SF", "b2"), particles(3, seed=1) / 3

    def end(epsilon, b2):
        other = jax.tree_util.tree_map(lambda x: x, ring)
        object.__setattr__(other, "extra", {"b2": ring.extra["b2"].at[1].set(b2)})
        out = rings.track(other, z, 20, epsilon=epsilon).z
        return jnp.sum(out @ (1 / SIZES)), out

    both, at, b2 = jax.jit(jax.value_and_grad(end, (0, 1), has_aux=True)), 0.7, 3.0
    (_, out), (d_epsilon, d_b2) = both(at, b2)
    wanted = rings.track(plain.set("SF", b2=at * b2), z, 20).z
    np.testing.assert_allclose(out, wanted, rtol=1e-12, atol=1e-16)
    assert d_epsilon * at == pytest.approx(float(d_b2) * b2, rel=1e-9)
    (above, _), (below, _) = (both(at + d, b2)[0] for d in (1e-5, -1e-5))
    assert d_epsilon == pytest.approx(float(above - below) / 2e-5, rel=1e-6)


def test_one_turn_is_a_step_of_a_run(cell):
    problem = rings.problem(cell)
    z = particles(1)[0] / 3
    sol = dvi.integrate(problem, z[::2], z[1::2], num_steps=30, save=dvi.Save(every=10))
    out = rings.track(cell, z, 30, every=10)
    np.testing.assert_allclose(sol.qs[1:], out.z[:, ::2], rtol=0, atol=1e-17)
    np.testing.assert_allclose(sol.ps[1:], out.z[:, 1::2], rtol=0, atol=1e-17)
    lost = dvi.integrate(problem, [0.02, 0, 0], [0.01, 0, 0], num_steps=30, throw=False)
    out = rings.track(cell, [0.02, 0.01, 0, 0, 0, 0], 30)
    assert str(lost.status) == "lost"
    assert int(lost.stats["failed_step"]) == int(out.turn) >= 0


def test_the_hamiltonian_is_that_of_the_bodies():
    """Gauss' method in the fields along the ring, with steps that end at the edges."""
    ring = ring_of(
        rings.drift("D", 0.5),
        rings.multipole("M", 0.5, (0.01, 2.0, 5.0), (0.0, 0.3), slices=40, scheme=6),
        rings.bend("B", 0.5, 0.1, (0.0, 0.5), slices=40, scheme=6),
    )
    problem = rings.problem(ring)
    z = np.array([1e-2, 1e-3, 5e-3, -1e-3, 0, 2e-2])
    options = {"h": 1 / 48, "num_steps": 48, "method": dvi.GaussLegendre(3), "args": problem.args}
    sol = dvi.integrate(dvi.System(problem.system.H_D.value), z[::2], z[1::2], **options)
    out = rings.track(ring, z).z
    np.testing.assert_allclose(sol.qs[-1], out[::2], atol=1e-9)
    np.testing.assert_allclose(sol.ps[-1], out[1::2], atol=1e-9)


THIN = ring_of(
    rings.quadrupole("QF", 0.5, 0.6, slices=1), rings.multipole("S", 0.0, (0.0, 0.0, 40.0)),
    rings.drift("D", 2.0), rings.quadrupole("QD", 0.5, -0.5, slices=1), rings.drift("D", 2.0),
)  # fmt: skip
TURN = rings.problem(THIN, planes="x")


def turned(system=TURN.system, **options):
    options = {"h": 1.0, "num_steps": 3, "args": TURN.args, **options}
    return dvi.integrate(system, [3e-3], [0.0], **options)


@pytest.mark.parametrize("method", ["Strang", "TypeII", "GaussLegendre2", dvi.RungeKutta4()])
def test_other_methods_than_a_turn_are_refused(method):
    """Also compiled, by other steps, and where a function examines equations (12)-(13)."""
    message = "no equations of motion other than its one-turn map"
    for h in (1.0, 0.1):
        with pytest.raises(ValueError, match=message):
            turned(method=method, h=h)
    with pytest.raises(ValueError, match=message):
        jax.jit(lambda q: dvi.integrate(TURN.system, q, [0.0], h=1.0, num_steps=1, method=method,
                                        args=TURN.args).qs)(jnp.ones(1))  # fmt: skip
    with pytest.raises(ValueError, match=message):
        dvi.interop.vector_field(TURN.system)(0.0, (jnp.ones(1), jnp.ones(1)), TURN.args)


def test_a_turn_refuses_what_it_would_ignore():
    H_D = TURN.system.H_D
    force = {"force": lambda t0, t1, q, p, args: -p}
    others = (force, {"perturbation": lambda t0, t1, q, p, args: q @ q}, {"slow_time": True})
    for options in others:
        with pytest.raises(ValueError, match=f"as it is, got {next(iter(options))}"):
            turned(dvi.System(H_D, **options), epsilon=0.1)
    with pytest.raises(ValueError, match="as it is, got"):
        turned(lattice=dvi.TimeTransformed(lambda t, q, p, args: 2.0))


def test_parts_of_a_turn_do_not_exist():
    """Of the times of a grid, of requested times, and under `jit`: a status."""
    whole = turned().qs[:, 0]
    options = {"h": None, "num_steps": None, "throw": False}
    sol = turned(lattice=dvi.Given([0.0, 1.0, 1.5, 2.5]), **options)
    assert sol.status == "bad_step_size"
    np.testing.assert_array_equal(sol.qs[:2, 0], whole[:2])
    assert np.isnan(sol.qs[2:]).all()
    between = turned(save=dvi.Save(ts=[0.0, 1.0, 2.5, 3.0]), throw=False)
    assert between.status == "bad_step_size"
    np.testing.assert_array_equal(np.delete(between.qs, 2), np.delete(whole, 2))
    half = jax.jit(lambda h: turned(h=h, throw=False).result)(0.5)
    assert dvi.RESULTS[half] == dvi.RESULTS[dvi.RESULTS.bad_step_size]
    backwards = turned(method=dvi.Adjoint(rings.Turn()), throw=False)
    assert backwards.status == "bad_step_size"


def turns(ring, size, **options):
    zeros = np.zeros(size)
    return dvi.integrate(rings.problem(ring), zeros, zeros, num_steps=2, **options)


ERRORS = [
    (lambda r: r.set("QX*", b1=1.0), ValueError, r"no element matches 'QX\*'. Names are"),
    (lambda r: r.set("QF", b2=1.0), ValueError, "the quadrupole 'QF', has no parameter 'b2'"),
    (lambda r: r.set("Q*", b1=[1.0, 2.0, 3.0]), ValueError, "one number or 2, one"),
    (lambda r: r.get("QF", "k1"), ValueError, "has no parameter 'k1'"),
    (lambda r: rings.track(r.set("QF", b1=np.nan), np.zeros(6)), ValueError, "b1 of element 0, .*"
     "'QF', must be finite"),
    (lambda r: rings.track(r, np.zeros(4)), ValueError, "z must have 6 coordinates"),
    (lambda r: rings.track(r, np.zeros(6), 10, every=3), ValueError, "every must divide"),
    (lambda r: rings.track(r, np.zeros((1000, 6)), 10**9, every=1), ValueError, "GiB.*every"),
    (lambda r: rings.bend("B", 0.0, 0.1), ValueError, "length of a bend must be a positive"),
    (lambda r: rings.quadrupole("Q", 0.3, 1.0, slice=4), TypeError, "no argument 'slice'"),
    (lambda r: rings.bend("B", 0.3, 1.0, edge=0.1), TypeError, "no argument 'edge'"),
    (lambda r: rings.aperture("A"), ValueError, "aperture 'A' must have"),
    (lambda r: rings.lens("N", max, t=np.nan), ValueError, "t of lens 'N' must be a finite number"),
    (lambda r: rings.lens("N", 3.0), TypeError, "potential must be a function"),
    (lambda r: rings.Ring(["QF"]), TypeError, r"elements\[0\]"),
    (lambda r: turns(r, 4), ValueError, "shape of q0 must be one of"),
    (lambda r: turns(r, 3, h=0.5, method=rings.Turn()), ValueError, "h must be 1"),
]  # fmt: skip


@pytest.mark.parametrize(("make", "kind", "message"), ERRORS)
def test_errors(cell, make, kind, message):
    with pytest.raises(kind, match=message):
        make(cell)


def test_a_ring_needs_double_precision():
    with jax.enable_x64(False), pytest.raises(ValueError, match="a ring needs double precision"):
        rings.Ring([rings.drift("D", 1.0)])


@pytest.fixture(scope="module")
def at():
    return pytest.importorskip("at")


def lattice_of(at, name, six=False):
    import machine_data

    path = f"{next(iter(machine_data.__path__))}/{name}"
    with warnings.catch_warnings(action="ignore"):
        lattice = at.load_lattice(path)
        lattice.enable_6d() if six else lattice.disable_6d()
    for e in lattice:
        e.PassMethod = e.PassMethod.replace("RadPass", "Pass")
    return lattice


ORDER, SIGNS = [0, 1, 2, 3, 5, 4], np.array([1, 1, 1, 1, 1, -1])
"""(x, px, y, py, δ, ct) of pyAT is z[ORDER]·SIGNS, with ζ = −ct."""


def to_at(z):
    return np.asfortranarray((np.asarray(z)[:, ORDER] * SIGNS).T)


def tracked_by_at(lattice, z, turns=1):
    lattice.track(r := to_at(z), nturns=turns, refpts=None, in_place=True)
    return (r.T * SIGNS)[:, ORDER]


def at_elements(at):
    e = at.elements
    multi = {"poly_a": [2e-3, 0.3, 3.0], "poly_b": [1e-3, 1.2, 8.0]}
    bend = {"EntranceAngle": 0.1, "ExitAngle": 0.07, "PolynomB": [1e-3, 0.4, 2.0]}
    gap = {"FullGap": 0.04, "FringeInt1": 0.5, "FringeInt2": 0.4}
    quads = {"FringeQuadEntrance": 1, "FringeQuadExit": 1}
    exact = {"PassMethod": "ExactMultipolePass"}
    # No shift of δ: pyAT computes the lengths of its drifts before it shifts a particle.
    T = 1e-4 * np.array([1, 2, 3, 4, 0, 5])
    R = np.eye(6) + 0.01 * np.diag([1, 0, 1, 0, 1], -1)
    return {
        "DriftPass": e.Drift("D", 1.3),
        "ExactDriftPass": e.Drift("D", 1.3, PassMethod="ExactDriftPass"),
        "StrMPoleSymplectic4Pass": e.Multipole("M", 0.4, **multi, KickAngle=[1e-3, 2e-3]),
        "quadrupole with fringe": e.Quadrupole("Q", 0.4, 1.2, FringeQuadEntrance=1),
        "ExactMultipolePass": e.Multipole("M", 0.4, **multi, **exact, **quads),
        "ThinMPolePass": e.ThinMultipole("M", **multi),
        "BndMPoleSymplectic4Pass": e.Dipole("B", 1.1, 0.2, **bend, **gap, **quads),
        "edge of method 2": e.Dipole("B", 1.1, 0.2, **bend, **gap, FringeBendEntrance=2),
        "BndMPoleSymplectic4E2Pass": e.Dipole(
            "B", 1.1, 0.2, **bend, **gap, PassMethod="BndMPoleSymplectic4E2Pass"
        ),
        "ExactSectorBendPass": e.Dipole(
            "B", 1.1, 0.2, **bend, **quads, gK=0.01, FringeBendEntrance=1, FringeBendExit=1,
            PassMethod="ExactSectorBendPass",
        ),
        "CorrectorPass": e.Corrector("C", 0.3, [1e-3, -2e-3]),
        "SolenoidLinearPass": e.Element("S", Length=0.6, K=0.8, PassMethod="SolenoidLinearPass"),
        "RFCavityPass": e.RFCavity("RF", 0.4, 1e6, 5e8, 100, 1e9, PassMethod="RFCavityPass"),
        "Matrix66Pass": e.M66("M", R),
        "shifted and rolled": e.Quadrupole(
            "Q", 0.4, 1.2, T1=T, T2=-T, R1=R,
            R2=np.linalg.inv(R),
        ),
    }  # fmt: skip


QUICK_ELEMENTS = ["BndMPoleSymplectic4Pass", "StrMPoleSymplectic4Pass", "RFCavityPass"]


@pytest.mark.parametrize("names", [QUICK_ELEMENTS, pytest.param([], marks=pytest.mark.slow)])
def test_elements_agree_with_pyat(at, names):
    """Each in a ring of its own; without names all."""
    z, elements = particles(1000), at_elements(at)
    for name in names or elements:
        lattice = at.Lattice([elements[name]], energy=1e9)
        ours = np.asarray(rings.track(rings.from_at(lattice), z).z)
        assert np.abs(ours - tracked_by_at(lattice, z)).max() < 1e-12, name
        assert np.abs(ours - z).max() > 1e-6, name


def lattices(*names, marks=()):
    return [pytest.param(name, six, marks=marks) for name in names for six in (True, False)]


SLOW = ["dba.mat", "esrf.m", "thomx.m", "soleil.m", "australian_synchrotron.m", "err.mat"]


@pytest.mark.parametrize(
    ("name", "six"), [*lattices("hmba.mat")[:1], *lattices(*SLOW, marks=pytest.mark.slow)]
)
def test_lattices_agree_with_pyat(at, name, six):
    lattice, turns = lattice_of(at, name, six), 1 if name == "hmba.mat" else 3
    z = particles(100 if name == "err.mat" else 1000) * 0.1
    ours = np.asarray(rings.track(rings.from_at(lattice), z, turns).z)
    wanted = tracked_by_at(lattice, z, turns)
    assert np.isfinite(wanted).all()
    assert np.abs(ours - wanted).max() < (1e-14 if turns == 1 else turns * 1e-12)


def losses(at, lattice, z, turns):
    *_, info = lattice.track(to_at(z), nturns=turns, refpts=None, in_place=True, losses=True)
    theirs, ours = info["loss_map"], rings.track(rings.from_at(lattice), z, turns)
    lost = theirs["islost"]
    turn = np.where(lost, theirs["turn"].astype(int), -1) == np.asarray(ours.turn)
    element = np.where(lost, theirs["elem"].astype(int), -1) == np.asarray(ours.element)
    return lost.mean(), ((np.asarray(ours.lost) == lost) & turn & element).mean()


@pytest.mark.slow
def test_losses_agree_with_pyat(at):
    """At the limit of 1 m, and at apertures in the elements; same turn, same element."""
    lattice = lattice_of(at, "hmba.mat")
    z = particles(2000) * np.array([10, 1, 5, 1, 1, 10])
    share, same = losses(at, lattice, z, 100)
    assert 0.1 < share < 0.95
    assert same > 0.999
    for e in lattice:
        if e.Length > 0.3:
            e.EApertures = np.array([0.008, 0.006])
        elif e.Length > 0.2:
            e.RApertures = np.array([-0.01, 0.008, -0.005, 0.006])
    share, same = losses(at, lattice, z, 100)
    assert 0.1 < share < 0.99
    assert same > 0.999


def test_what_cannot_be_read_is_listed(at):
    e = at.elements
    radiates = e.Quadrupole("QR", 0.3, 1.0, PassMethod="StrMPoleSymplectic4QuantPass")
    fringe = e.Dipole("BX", 1.0, 0.1, FringeBendEntrance=3)
    lattice = at.Lattice([e.Drift("D", 1.0), radiates, fringe], energy=1e9)
    with pytest.raises(ValueError, match="2 of 3 elements have no counterpart") as error:
        rings.from_at(lattice)
    assert "1: QR (Quadrupole, StrMPoleSymplectic4QuantPass): radiation is not" in str(error.value)
    assert "2: BX (Dipole, BndMPoleSymplectic4Pass): FringeBendEntrance = 3" in str(error.value)


def test_the_symplectic_edge_is(at):
    """pyAT's edge with a fringe field is not: its kick depends on δ, and ζ does not change."""
    bend = at.elements.Dipole("B", 1.0, 0.2, FullGap=0.04, FringeInt1=0.5, FringeInt2=0.5)
    lattice = at.Lattice([bend], energy=1e9)
    z = np.array([1e-3, 0, 5e-3, 0, 0, 1e-2])
    corrected, theirs = (asymmetry(rings.from_at(lattice, symplectic=s), z) for s in (True, False))
    assert corrected < 1e-14 < 1e-6 < theirs


def test_files_of_xsuite(at, tmp_path):
    """Written by pyAT, with the cavities on; an aperture is read, and an element that pyAT does not
    know is refused, with its place."""
    lattice = lattice_of(at, "hmba.mat")
    path = tmp_path / "ring.json"
    at.save_xsuite(lattice, str(path))
    z = particles(5) * 0.1
    ring = rings.load(path)
    with pytest.raises(FileNotFoundError, match="there is no file"):
        rings.load(tmp_path / "missing.mat")
    lattice.enable_6d(dipole_pass=None, quadrupole_pass=None)
    for e in lattice:
        e.PassMethod = {"RFCavityPass": "CavityPass"}.get(e.PassMethod, e.PassMethod)
        if isinstance(e, at.Dipole):  # pyAT writes "linear", which has no fringe field
            e.FringeQuadEntrance = e.FringeQuadExit = 0
    wanted = rings.track(rings.from_at(lattice), z).z
    np.testing.assert_allclose(rings.track(ring, z).z, wanted, rtol=0, atol=1e-15)
    assert np.abs(np.asarray(wanted)[:, 5] - z[:, 5]).max() > 1e-8
    content = json.loads(path.read_text())
    content["elements"]["limit"] = {"__class__": "LimitEllipse", "a": 0.01, "b": 0.02}
    content["element_names"].insert(5, "limit")
    path.write_text(json.dumps(content))
    assert rings.load(path).get("limit", "radius_y").tolist() == [0.02]
    content["elements"]["limit"] = {"__class__": "Wire", "current": 1.0}
    path.write_text(json.dumps(content))
    message = r"5: limit \(Marker, IdentityPass\): pyAT has no element for Wire"
    with warnings.catch_warnings(action="ignore"), pytest.raises(ValueError, match=message):
        rings.load(path)


def test_strengths_can_be_traced_where_elements_are_made():
    """Values and derivatives are those of a ring with other parameters."""

    def made(x):
        parts = [
            rings.quadrupole("Q", 0.5, x),
            rings.drift("D", 1.0 + x).inside(ellipse=(x, 0.1)),
            rings.lens("L", lambda x, y, par: par["k"] * x**3, k=x),
            rings.corrector("C", 0.1, x, 0.0).placed(dx=x),
        ]
        return rings.Ring(parts)

    def of_set(x):
        ring = known.set("Q", b1=x).set("D", length=1.0 + x, radius_x=x).set("L", k=x)
        return ring.set("C", kick_x=x, dx=x)

    known = made(0.3)
    for change in (jax.jit, lambda f: jax.jit(jax.jacfwd(f))):
        found, expected = (change(lambda x, f=f: f(x).columns)(0.2) for f in (made, of_set))
        assert found.keys() == expected.keys()
        for name in found:
            np.testing.assert_allclose(found[name], expected[name], rtol=1e-15)
