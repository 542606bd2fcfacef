"""Misaligned elements, against the equations of motion in space, MAD-X, Xsuite and pyAT."""

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from dvi_jax.systems import rings
from dvi_jax.systems.rings import _exact
from dvi_jax.systems.rings._elements import C
from dvi_jax.systems.rings._maps import Particle

LENGTH, ANGLE = 1.5, 0.2
Z = np.array([[0, 0, 0, 0, 0, 0], [1e-3, 2e-4, -5e-4, 3e-4, 0, 1e-3]])
ERRORS = {"dx": 1e-3, "dy": -2e-3, "ds": 3e-3, "roll": 2e-3, "pitch": -1e-3, "yaw": 3e-3}


def frame(rotation, origin):
    """A frame as a matrix of homogeneous coordinates."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation.as_matrix(), origin
    return matrix


def reference(s, h, tilt):
    """The frame of the reference orbit after the distance s from the entrance."""
    a = h * s
    origin = [(np.cos(a) - 1) / h, 0, np.sin(a) / h] if h else [0, 0, s]
    twist = frame(Rotation.from_rotvec([0, 0, tilt]), [0, 0, 0])
    return twist @ frame(Rotation.from_rotvec([0, -a, 0]), origin) @ np.linalg.inv(twist)


def frames(length, h, anchor="entrance", tilt=0.0, **errors):
    """The frames of the design at its exit, and of the misaligned element at both ends, in
    coordinates of the entrance of the design."""
    e = dict.fromkeys(ERRORS, 0.0) | errors
    turn = Rotation.from_rotvec([0, e["yaw"], 0]) * Rotation.from_rotvec([-e["pitch"], 0, 0])
    error = frame(turn * Rotation.from_rotvec([0, 0, e["roll"]]), [e["dx"], e["dy"], e["ds"]])
    middle = reference(length / 2 if anchor == "middle" else 0.0, h, tilt)
    entrance = middle @ error @ np.linalg.inv(middle)
    end, twist = reference(length, h, tilt), frame(Rotation.from_rotvec([0, 0, tilt]), [0] * 3)
    return end, entrance @ twist, entrance @ end @ twist


def to_plane(r, u, path, plane):
    """Free motion to the plane s = 0 of a frame."""
    normal = plane[:3, 2]
    way = (plane[:3, 3] - r) @ normal / (u @ normal)
    return r + way * u, path + way * np.linalg.norm(u)


def in_space(z):
    x, px, y, py, _, delta = z
    return np.array([x, y, 0.0]), np.array([px, py, np.sqrt((1 + delta) ** 2 - px**2 - py**2)])


def in_plane(r, u, path, plane, length, delta):
    x, y, s = plane[:3, :3].T @ (r - plane[:3, 3])
    px, py, _ = plane[:3, :3].T @ u
    assert abs(s) < 1e-12
    return np.array([x, px, y, py, length - path, delta])


def by_equations_of_motion(z, field, length, h, **errors):
    """u' = u × B in space, in the field B(r) of a magnet that is moved as a rigid body."""
    end, entrance, exit_plane = frames(length, h, **errors)
    r, u = in_space(z)
    r, path = to_plane(r, u, 0.0, entrance)
    size, axes = np.linalg.norm(u), entrance[:3, :3]

    def rates(s, state):
        B = axes @ field(axes.T @ (state[:3] - entrance[:3, 3]))
        return np.concatenate([state[3:], np.cross(state[3:], B)]) / size

    def distance(s, state):
        return (state[:3] - exit_plane[:3, 3]) @ exit_plane[:3, 2]

    distance.terminal, distance.direction = True, 1
    run = solve_ivp(rates, (0, 2 * length), [*r, *u], "DOP853", events=distance, rtol=1e-12,
                    atol=1e-15)  # fmt: skip
    state = run.y_events[0][0]
    r, path = to_plane(state[:3], state[3:], path + run.t_events[0][0], end)
    return in_plane(r, state[3:], path, end, length, z[5])


def after(element, z=Z, **errors):
    return np.asarray(rings.one_turn(rings.Ring([element.placed(**errors)]), jnp.asarray(z)))


CASES = [
    *({name: value} for name, value in ERRORS.items()),
    {**ERRORS, "anchor": "middle"},
    {**ERRORS, "tilt": 0.7},
    {**ERRORS, "tilt": np.pi / 2, "anchor": "middle"},
]


@pytest.mark.parametrize("errors", CASES, ids=lambda e: "-".join(e)[:40])
def test_a_misaligned_bend_is_moved_as_a_rigid_body(errors):
    """A sector of a uniform field. The model has a hard edge, whose focusing is of order y² h²."""
    z, h = Z * 0.1, ANGLE / LENGTH
    small = {n: e * 0.1 if n in ERRORS else e for n, e in errors.items()}
    wanted = [by_equations_of_motion(a, lambda r: np.array([0, h, 0]), LENGTH, h, **small)
              for a in z]  # fmt: skip
    exact, paraxial = (after(rings.bend("B", LENGTH, ANGLE, model=model), z, **small)
                       for model in ("exact", "paraxial"))  # fmt: skip
    np.testing.assert_allclose(exact, wanted, rtol=0, atol=3e-8)
    np.testing.assert_allclose(paraxial, wanted, rtol=0, atol=1e-7)
    if errors.keys() != {"dy"}:  # the field is uniform along y
        aligned = [by_equations_of_motion(a, lambda r: np.array([0, h, 0]), LENGTH, h) for a in z]
        assert np.abs(np.subtract(wanted, aligned)).max() > 1e-6


@pytest.mark.parametrize("b", [(0.0, 1.2), (0.0, 0.0, 40.0), (0.01, 0.3, 2.0)])
def test_misaligned_multipoles_are_moved_as_rigid_bodies(b):
    def field(r):
        B = sum(k * complex(*r[:2]) ** n for n, k in enumerate(b))
        return np.array([B.imag, B.real, 0.0])

    errors = {**ERRORS, "anchor": "middle", "tilt": 0.3}
    wanted = [by_equations_of_motion(z, field, 0.4, 0.0, **errors) for z in Z]
    magnet = rings.multipole("M", 0.4, b, slices=20, scheme=6, model="exact")
    np.testing.assert_allclose(after(magnet, **errors), wanted, rtol=0, atol=1e-13)


ELEMENTS = {
    "drift": rings.drift("D", 1.3),
    "multipole": rings.multipole("M", 0.4, (1e-3, 1.2, 8.0), (2e-3, 0.3), slices=3),
    "thin": rings.multipole("M", 0.0, (1e-3, 1.2, 8.0), (2e-3, 0.3)),
    "bend": rings.bend("B", 1.1, 0.2, (1e-3, -0.5, 2.0), edge_in=0.1, edge_out=0.07, slices=3),
    "exact bend": rings.bend("B", 1.1, 0.2, edge_in=0.1, model="exact"),
    "straight bend": rings.bend("B", 1.1, 0.0, (1e-3, 0.5), slices=3),
    "corrector": rings.corrector("C", 0.3, 1e-3, -2e-3),
    "lens": rings.lens("L", lambda x, y, par: par["h"] * x**3 * y, h=3e3),
    "solenoid": rings.solenoid("S", 0.6, 0.8),
    "cavity": rings.cavity("RF", 0.4, 1e-3, 5e8, lag=0.05),
    "marker": rings.marker("M"),
}


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=() if n == "solenoid" else pytest.mark.slow) for n in ELEMENTS]
)
def test_every_element_has_its_own_map_in_its_own_frame(name):
    element, errors = ELEMENTS[name], {**ERRORS, "anchor": "middle", "tilt": 0.3}
    length, h = (element.values.get(key, 0.0) for key in ("length", "h"))
    end, entrance, exit_plane = frames(length, h if name != "lens" else 0.0, **errors)
    own = rings.Ring([element, rings.marker("E"), rings.drift("0", 0.0)])
    for z in Z:
        r, u = in_space(z)
        r, before = to_plane(r, u, 0.0, entrance)
        inner = np.asarray(rings.one_turn(own, in_plane(r, u, before, entrance, 0.0, z[5])))
        r, u = in_space(inner)
        r, u = exit_plane[:3, :3] @ r + exit_plane[:3, 3], exit_plane[:3, :3] @ u
        r, path = to_plane(r, u, 0.0, end)
        wanted = in_plane(r, u, path, end, inner[4], inner[5])
        other = rings.Ring([element.placed(**errors), rings.drift("0", 0.0)])
        np.testing.assert_allclose(rings.one_turn(other, z), wanted, rtol=0, atol=2e-15)


# One bend without focusing: Xsuite; MAD-X (EALIGN) between two drifts of 1 m. Both particles of Z.
XSUITE = {
    ("roll", "entrance"): [
        [7.3298e-08, 9.7404e-08, -1.4950064e-04, -1.9866930e-04, -1.3725e-08],
        [1.42728276e-03, 3.6829118e-04, -1.9977967e-04, 1.0129290e-04, -2.38615386e-04],
    ],
    ("roll", "middle"): [
        [7.3917e-08, 9.8890e-08, -1.4975010e-04, -1.9966680e-04, -1.3787e-08],
        [1.42728882e-03, 3.6829260e-04, -2.0002512e-04, 1.0030090e-04, -2.38616072e-04],
    ],
    ("dx", "entrance"): [
        [2.6686e-09, 2.6489294e-05, 0, 0, 1.1258e-09],
        [1.42720622e-03, 3.9466980e-04, -5.0378028e-05, 3e-4, -2.38645008e-04],
    ],
    ("dx", "middle"): [
        [1.9833902e-05, 2.6356958e-05, 0, 0, -1.9888959e-06],
        [1.44702102e-03, 3.9453693e-04, -5.0377431e-05, 3e-4, -2.40638987e-04],
    ],
    ("tilt", "entrance"): [
        [3.7e-11, 5.0e-11, 0, 0, 1.1e-09],
        [1.42721049e-03, 3.6818775e-04, -5.0250582e-05, 3.0016819e-04, -2.38590408e-04],
    ],
}
MADX = {
    "roll": [
        [1.7061488e-07, 9.7354579e-08, -3.4816994e-04, -1.9866930e-04, -3.4585e-08],
        [1.98569318e-03, 3.6300863e-04, 2.0102777e-04, 1.0128771e-04, -2.78440374e-04],
    ],
    "dx": [
        [2.6494507e-05, 2.6489244e-05, 0, 0, -5.272e-10],
        [2.01203190e-03, 3.8939535e-04, 5.4901071e-04, 3e-4, -2.78524691e-04],
    ],
}


@pytest.mark.slow
def test_a_misaligned_bend_is_that_of_xsuite_and_madx():
    """The differences of up to 1e-7 are those of the hard edges of the three models."""
    bend = rings.bend("B", LENGTH, ANGLE, model="exact")
    ends = rings.drift("D", 1.0, model="exact"), rings.drift("D", 1.0, model="exact")
    cases = [(XSUITE[key], [bend.placed(**{key[0]: 1e-3}, anchor=key[1])]) for key in XSUITE]
    cases += [(MADX[key], [ends[0], bend.placed(**{key: 1e-3}), ends[1]]) for key in MADX]
    for wanted, elements in cases:
        ours = np.asarray(rings.one_turn(rings.Ring(elements), jnp.asarray(Z)))
        np.testing.assert_allclose(ours[:, :5], wanted, rtol=0, atol=1.5e-7)


def test_errors_and_tilts_of_a_straight_element_differ_only_in_name():
    quadrupole = rings.quadrupole("Q", 0.4, 1.2, slices=3)
    both = [after(quadrupole, **{key: 0.2}) for key in ("roll", "tilt")]
    np.testing.assert_allclose(*both, rtol=0, atol=1e-18)
    simple, full = (after(quadrupole, dx=1e-3, roll=0.1, ds=ds) for ds in (0.0, 1e-300))
    np.testing.assert_allclose(simple, full, rtol=0, atol=1e-18)


@pytest.mark.slow
def test_rolled_bends_distort_the_vertical_orbit_as_in_pyat():
    """pyAT turns about the middle of the chord, which is moved from that of the arc by the roll
    times the sagitta, ours about the middle of the arc."""
    at = pytest.importorskip("at")
    A, rolls = np.pi / 16, (1e-4, -3e-4)

    def bends():
        sagitta = 1.5 / A * (1 - np.cos(A / 2))
        bend = rings.bend("B", 1.5, A, edge_in=A / 2, edge_out=A / 2)
        return [bend.placed(roll=r, dy=r * sagitta, anchor="middle") for r in rolls]

    def theirs():
        found = [at.Dipole("B", 1.5, A, EntranceAngle=A / 2, ExitAngle=A / 2) for _ in rolls]
        for bend, roll in zip(found, rolls, strict=True):
            at.tilt_elem(bend, roll)
        return found

    def cell(first, second, quadrupole, drift):
        return [quadrupole("QF", 0.4, 1.3), drift("D", 0.6), first, drift("D", 0.2),
                quadrupole("QD", 0.4, -1.3), drift("D", 0.6), second, drift("D", 0.2)]  # fmt: skip

    ours = rings.Ring(cell(*bends(), rings.quadrupole, rings.drift))
    lattice = at.Lattice(cell(*theirs(), at.Quadrupole, at.Drift), energy=1e9, periodicity=1)
    orbits = [rings.closed_orbit(r) for r in (ours, rings.from_at(lattice))]
    assert np.abs(orbits[0][2]) > 1e-5
    np.testing.assert_allclose(*orbits, rtol=0, atol=1e-11)


def test_each_parameter_is_given_once():
    quadrupole = rings.quadrupole("Q", 0.3, 1.0)
    limits = (-1e-3, 1e-3, -1.0, 1.0)
    lens = rings.lens("L", lambda x, y, par: par["roll"] * x, roll=1.0)
    for make, name in (
        (lambda: quadrupole.placed(dx=1e-3).placed(dx=2e-3), "dx"),
        (lambda: quadrupole.placed(roll=0.1).inside(ellipse=(1, 1)).placed(dx=1e-3), "roll"),
        (lambda: quadrupole.placed(yaw=0.1).placed(tilt=0.1), "dx"),
        (lambda: quadrupole.inside(rectangle=limits).inside(rectangle=limits), "x_min"),
        (lambda: rings.aperture("A", ellipse=(1, 1)).inside(ellipse=(2, 2)), "radius_x"),
        (lambda: lens.placed(dx=1e-3), "roll"),
    ):
        with pytest.raises(ValueError, match=rf"one value of each parameter, got \[.*'{name}'"):
            make()
    for make, message in (
        (lambda: rings.lens("L", lambda x, y, par: x, length=1.0), "length of lens 'L' is zero"),
        (lambda: rings.lens("L", lambda x, y, par: x, voltage=1.0), "voltage of lens 'L' is zero"),
        (lambda: quadrupole.placed(pitch=np.nan), "pitch of element 'Q' must be a finite"),
        (lambda: quadrupole.placed(anchor="exit"), "anchor must be one of 'entrance', 'middle'"),
    ):
        with pytest.raises(ValueError, match=message):
            make()
    # Different limits, and misalignments inside and outside of them, are parameters of their own.
    ring = rings.Ring([quadrupole.placed(dx=1e-3).inside(rectangle=limits, ellipse=(0.1, 0.1))])
    lost = rings.track(ring, [[5e-4, 0, 0, 0, 0, 0], [2e-3, 0, 0, 0, 0, 0]]).lost
    assert lost.tolist() == [False, True]


def test_a_parameter_that_the_map_was_made_without_is_not_changed():
    """Without an effect on the map it would change only s."""
    for element, name in (
        (rings.multipole("E", 0.0, (0, 0.1)), "length"),
        (rings.cavity("E", 0.0, 1e-3, 5e8), "length"),
        (rings.lens("E", lambda x, y, par: x), "length"),
        (rings.bend("E", 1.0, 0.0, model="exact"), "h"),
    ):
        ring = rings.Ring([element, rings.drift("D", 1.0)])
        assert ring.get("E", name) == 0
        for change in (lambda r, n: r.set("E", **{n: 0.1}), lambda r, n: r.perturbed("E", n)):
            with pytest.raises(ValueError, match=f"'E', was made with {name} = 0"):
                change(ring, name)
    ring = rings.Ring([rings.bend("E", 1.0, 0.1, model="exact"), rings.drift("D", 1.0)])
    assert ring.set("*", length=0.5).set("E", h=0.2).places[-1] == 1.0


def exact_bend(**options):
    return rings.bend("B", 0.5, 0.02, model="exact", **options)


def with_cavity(**phase):
    """A ring in 6D whose closed orbit is zero; the phases are next to a half turn."""
    bend = rings.bend("B", 1.0, 0.2, model="exact", edge_in=0.1, edge_out=0.1)
    cavity = rings.cavity("C", 0.0, -2e-3, C / 2, **phase)
    quads = rings.quadrupole("QF", 0.5, 0.9, slices=1), rings.quadrupole("QD", 0.5, -0.8, slices=1)
    return rings.Ring([quads[0], rings.drift("L", 1.0), quads[1], bend, bend, cavity])


def long_cell(name):
    if name in RINGS_IN_6D:
        return with_cavity(**RINGS_IN_6D[name])
    ends = rings.quadrupole("QF", 0.5, 0.6, slices=1), rings.quadrupole("QD", 0.5, -0.5, slices=1)
    between = {
        "roll 0.1": rings.drift("D", 0.5).placed(roll=0.1),
        "roll −0.3": rings.drift("D", 0.5).placed(roll=-0.3),
        "tilt": rings.drift("D", 0.5).placed(tilt=0.3),
        "roll 2.5": rings.drift("D", 0.5).placed(roll=2.5),
        "solenoid": rings.solenoid("S", 0.5, 0.1),
        "exact bend": exact_bend(),
        "pole faces": exact_bend(edge_in=0.1, edge_out=-0.07),
        "gap": exact_bend(edge_in=0.1, edge_out=0.05, fringe_in=0.02, fringe_out=0.01),
        "gradient": exact_bend(b=(0, 5e-3), edge_in=0.1, edge_out=0.05, fringe=True),
        "moved": exact_bend(edge_in=0.1, edge_out=0.05).placed(dx=0.0),
        "edges": rings.bend("B", 0.5, 0.02, edge_in=0.1, edge_out=0.05, fringe_in=0.02),
        "hard edges": rings.quadrupole("Q", 0.5, 5e-3, model="exact", fringe=True),
    }[name]
    return rings.Ring([ends[0], rings.drift("L", 2.0), ends[1], *[between] * 10])


RINGS_IN_6D = {"phase of π": {"phase": np.pi}, "lag": {"lag": 1.0}}


@pytest.mark.parametrize(
    "name",
    ["roll 0.1", "pole faces",
     *(pytest.param(n, marks=pytest.mark.slow)
       for n in ("solenoid", "exact bend", "phase of π", "roll −0.3", "tilt", "roll 2.5", "gap",
                 "gradient", "moved", "edges", "hard edges", "lag"))],
)  # fmt: skip
def test_the_rounding_of_many_turns_has_no_sign(name):
    """The actions of small amplitudes are constant. A rotation whose c² + s² is not 1 changes all
    of them by 3 to 10 units of round-off in a turn, and 1 + hx − pz in a bend by far more. Sines
    and momenta of order 1 in a pole face or a cavity would change them by 1e-7 to 1e-3."""
    ring, turns = long_cell(name), 20_000
    planes = 3 if name in RINGS_IN_6D else 2
    modes = np.asarray(rings.optics(ring, chromatic=False).modes[0, :planes])
    amplitudes = 1e-10 * np.exp(2j * np.pi * np.random.default_rng(0).uniform(size=(32, planes)))
    z = np.pad(np.real(amplitudes @ modes), ((0, 0), (0, 6 - 2 * planes)))
    last = np.asarray(rings.track(ring, z, turns).z)
    S = np.kron(np.eye(planes), [[0, 1], [-1, 0]])
    actions = [np.abs(x[:, : 2 * planes] @ (-1j * modes.conj() @ S).T) ** 2 for x in (z, last)]
    change = np.mean(actions[1] / actions[0] - 1, axis=0)
    assert np.abs(change).max() < (1e-12 if name in PARAXIAL else 5e-11)


PARAXIAL = {"roll 0.1", "solenoid", "roll −0.3", "tilt", "roll 2.5", "edges", "hard edges"}


def exact_faces(z, start, end, h):
    """(10.26) and (12.41) of Forest 1998 with 60 digits, the whole px; h = 0: free motion."""
    x, px, y, py, zeta, delta = (mp.mpf(float(v)) for v in z)
    px, angle, p2 = px + mp.sin(start), end - start, (1 + delta) ** 2 - py**2
    pz, c, s = mp.sqrt(p2 - px**2), mp.cos(angle), mp.sin(angle)
    free, radius = px * c + pz * s, mp.sqrt(p2)
    if h == 0:
        end_x, end_px = x * pz / (pz * c - px * s), free
        path = x * s / (pz * c - px * s)
    else:
        end_px = free - h * x * s
        path = (angle + mp.asin(px / radius) - mp.asin(end_px / radius)) / h
        end_pz = mp.sqrt(p2 - end_px**2)
        # Larmor's circle: the distance of its centre from the plane does not change.
        end_x = (end_pz - (pz * c - px * s) + h * x * c) / h
    return end_x, end_px - mp.sin(end), y + py * path, py, zeta - (1 + delta) * path, delta


@pytest.mark.parametrize("size", [1e-10, 1e-3])
@pytest.mark.parametrize("h", [0.0, 0.04, -0.3])
def test_pole_faces_have_the_digits_of_small_amplitudes(size, h):
    z = Particle(*size * np.array([1.0, -0.4, 0.7, 0.3, -0.2, 0.5]))
    for start, end in ((0.0, 0.1), (0.1, 0.0), (0.0, -0.4), (-0.4, 0.0)):
        image = jax.jit(_exact.wedge if h else _exact.rotate)(z, {"h": h}, start, end)
        with mp.workdps(60):
            wanted = exact_faces(z, mp.mpf(start), mp.mpf(end), mp.mpf(h))
            errors = [abs(a - b) for a, b in zip(map(float, image), wanted, strict=True)]
        assert max(errors) < 2e-15 * size


def test_rotations_of_any_angle():
    """Quarters of a turn, shears, and their derivatives are those of sine and cosine."""
    z = jnp.asarray([1e-3, 2e-4, -5e-4, 3e-4, 0, 1e-3])
    drift = rings.Ring([rings.drift("D", 0.0).placed(roll=0.0)])

    def image(angle):
        return rings.one_turn(rings.Ring([rings.solenoid("S", 2.0, angle)]), z)

    def wanted(angle):
        """The rotation by an angle of the focusing of this angle."""
        p = 1 + z[5]
        k = angle / 2 / p
        c, s = jnp.cos(2 * k), jnp.sin(2 * k)
        x, u = c * z[0] + s / k * z[1] / p, c * z[1] - k * s * z[0] * p
        y, v = c * z[2] + s / k * z[3] / p, c * z[3] - k * s * z[2] * p
        return jnp.stack([c * x + s * y, c * u + s * v, c * y - s * x, c * v - s * u])

    @jax.jit
    def both(angle):
        rolled = rings.one_turn(drift.set("D", roll=angle), z)
        return image(angle), jax.jacfwd(image)(angle), rolled

    for angle in (0.3, -0.9, 2.0, 4.0, -11.0):
        value, slope, rolled = both(angle)
        np.testing.assert_allclose(value[:4], wanted(angle), rtol=0, atol=1e-17)
        np.testing.assert_allclose(slope[:4], jax.jacfwd(wanted)(angle), rtol=0, atol=1e-16)
        np.testing.assert_allclose(rolled, z, rtol=0, atol=1e-18)
