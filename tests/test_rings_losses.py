"""Places of losses inside of elements against formulas and short slices; beam pipes."""

import dataclasses

import jax
import numpy as np
import pytest

from dvi_jax.systems import rings
from dvi_jax.systems.rings._maps import RingPart

BOX = {"rectangle": (-0.012, 0.01, -0.01, 0.01)}


def place_of(*elements, x=0.0, px=0.0, y=0.0, py=0.0, delta=0.0, turns=1):
    """s of the loss of one particle, and its element."""
    ring = rings.Ring(elements)
    out = rings.track(ring, np.array([x, px, y, py, 0.0, delta]), turns)
    return float(out.places(ring)), int(out.element)


D = rings.drift("D", 2.0)


def test_drifts_of_both_models():
    """Behind another element, through each side of a rectangle and an ellipse, in exact drifts."""
    first = rings.drift("D0", 0.5)
    for px, limit in ((0.01, 0.01), (-0.01, -0.012)):
        s, element = place_of(first, D.inside(**BOX), px=px)
        assert s == pytest.approx(limit / px, abs=1e-12)
        assert element == 1
    s, _ = place_of(first, D.inside(ellipse=(0.02, 0.01)), px=0.008, py=0.006)
    assert s == pytest.approx(1 / np.hypot(0.4, 0.6), abs=1e-12)
    exact = rings.drift("D", 2.0, model="exact").inside(**BOX)
    s, _ = place_of(exact, px=0.3, x=-0.01, delta=0.1)
    assert s == pytest.approx(0.02 * np.sqrt(1.1**2 - 0.3**2) / 0.3, abs=1e-12)
    s, _ = place_of(rings.drift("D", 1e3), px=0.004, x=-0.5)  # the limit of all coordinates
    assert s == pytest.approx(375.0, abs=1e-9)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_thick_quadrupole(sign):
    """Defocusing and focusing, off momentum, and by its inverse, an element of negative length."""
    k1, delta, px = 2.0 * sign, 0.1, 0.03
    root = np.sqrt(abs(k1) / (1 + delta))
    arc = np.arcsin if sign > 0 else np.arcsinh
    wanted = arc(0.01 * root * (1 + delta) / px) / root
    quadrupole = rings.quadrupole("Q", 1.4, k1, scheme=6).inside(**BOX)
    s, _ = place_of(D, quadrupole, px=px, x=-2 * px / (1 + delta), delta=delta)
    assert s == pytest.approx(2 + wanted, abs=1e-9)
    back = rings.quadrupole("Q", -1.4, k1, scheme=6).inside(**BOX)
    s, _ = place_of(D, back, px=-px, x=2 * px / (1 + delta), delta=delta)
    assert s == pytest.approx(2 - wanted, abs=1e-9)


def test_a_bend_with_a_gradient():
    """Off momentum: x″ = (hδ − (h² + b₁)x)/(1 + δ)."""
    h, b1, delta, length = 0.2, 0.3, 0.05, 1.5
    k = (h * h + b1) / (1 + delta)
    wanted = np.arccos(1 - 0.01 * (h * h + b1) / (h * delta)) / np.sqrt(k)
    magnet = rings.bend("B", length, h * length, (0, b1), scheme=6).inside(**BOX)
    assert place_of(magnet, delta=delta)[0] == pytest.approx(wanted, abs=1e-8)


FIELD = {"b": (0, 0.4, 3.0), "a": (0, 0.2), "edge_in": 0.1, "edge_out": 0.15, "fringe_in": 0.01}
SLICED = {
    "straight": rings.multipole("M", 1.0, (0, -1.2, 40.0), (0, 0.3), fringe=True),
    "bend": rings.bend("B", 1.0, 0.3, **FIELD),
    "exact_bend": rings.bend("B", 1.0, 0.3, **FIELD, model="exact", fringe=True),
    "solenoid": rings.solenoid("S", 1.0, 1.5),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SLICED)
def test_places_agree_with_slices_of_a_millimetre(name):
    """The same magnet as 1000 elements in a row, the first and the last with its ends."""
    element, count = SLICED[name], 1000
    body = next(i for i, part in enumerate(element.parts) if part.name == name)
    short = {**element.values, "length": 1.0 / count}
    thin = element.parts[body]._replace(slices=1)
    parts = [(*element.parts[:body], thin), *[(thin,)] * (count - 1)]
    slices = [dataclasses.replace(element, parts=own, values=short).inside(**BOX) for own in parts]
    whole, cut = rings.Ring([D, element.inside(**BOX)]), rings.Ring([D, *slices])
    rng = np.random.default_rng(0)
    z = rng.uniform(-1, 1, (200, 6)) * np.array([8e-3, 0.02, 8e-3, 0.02, 0, 0.05])
    z[:, (0, 2)] -= 2 * z[:, (1, 3)]
    s, wanted = (np.asarray(rings.track(ring, z).places(ring)) for ring in (whole, cut))
    lost = np.isfinite(s)
    assert lost.sum() > 60
    assert np.isfinite(wanted[lost]).all()
    # A particle that leaves the aperture and returns is lost between slices only.
    assert np.abs(s - wanted)[lost].max() < 1e-4
    assert (wanted[lost] > 2.0).mean() > 0.5


def test_exact_edges():
    """On the limit is inside; a smaller pipe loses a particle at its entrance; a thin aperture."""
    wide, narrow = D.inside(ellipse=(0.02, 0.02)), D.inside(ellipse=(0.01, 0.02))
    assert np.isnan(place_of(narrow, x=0.01)[0])
    assert place_of(wide, narrow, x=0.0100001) == (2.0, 1)
    assert place_of(narrow, x=0.0100001) == (0.0, 0)
    assert place_of(D, rings.aperture("A", ellipse=(0.01, 0.01)), D, px=0.006) == (2.0, 1)
    s, element = place_of(narrow, px=0.01 / 2 * (1 + 1e-9))
    assert (s, element) == (pytest.approx(2.0, abs=1e-8), 0)
    matrix = rings.Ring([D, D]).elements[1]
    assert place_of(wide, dataclasses.replace(matrix, parts=()), narrow, x=0.015) == (4.0, 2)


def test_a_thin_map_behind_the_body_loses_at_the_exit():
    """One that shifts particles by 1 mm, which are inside in the whole drift."""
    part, shift = rings.Ring([D]).elements[0], 1e-3 * np.eye(6)[0]
    values = {"length": 2.0, "matrix_in": np.eye(6), "shift_in": shift}
    parts = (*part.parts, RingPart("affine_in"))
    element = dataclasses.replace(part, parts=parts, values=values).inside(**BOX)
    assert place_of(element, px=0.0048)[0] == 2.0
    assert place_of(element, px=0.0052)[0] == pytest.approx(0.01 / 0.0052, abs=1e-12)


def test_apertures_in_the_frame_of_a_magnet_and_of_the_design():
    own, design = D.inside(**BOX).placed(dx=2e-3), D.placed(dx=2e-3).inside(**BOX)
    assert place_of(own, px=0.01)[0] == pytest.approx(1.2, abs=1e-12)
    assert place_of(design, px=0.01)[0] == pytest.approx(1.0, abs=1e-12)
    exact = rings.drift("D", 2.0, model="exact")
    own, design = exact.inside(**BOX).placed(yaw=-2e-3), exact.placed(yaw=-2e-3).inside(**BOX)
    # The axis goes towards −x: a point of the pipe is at x = 0.01 cos − s sin.
    slope, turn = np.tan(np.arcsin(0.01)), -2e-3
    wanted = 0.01 / (slope * np.cos(turn) - np.sin(turn)) * (np.cos(turn) + slope * np.sin(turn))
    assert place_of(own, px=0.01)[0] == pytest.approx(wanted, abs=1e-9)
    assert place_of(design, px=0.01)[0] == pytest.approx(0.01 / slope, abs=1e-6)


def test_correctors_cavities_and_later_turns():
    """A parabola, two half drifts, and a ring in which the particle is lost in its second turn."""
    wanted = (np.sqrt(0.002**2 + 2 * 0.005 * 0.01) - 0.002) / 0.005
    corrector = rings.corrector("C", 2.0, 0.01, 0.0).inside(**BOX)
    assert place_of(corrector, px=0.002)[0] == pytest.approx(wanted, abs=1e-9)
    cavity = rings.cavity("RF", 2.0, 0.5, 1e6, phase=np.pi / 2).inside(**BOX)
    # δ grows by 0.5 in the middle, which reduces the angle.
    assert place_of(cavity, px=0.0085)[0] == pytest.approx(1 + 0.0015 / 0.0085 * 1.5, abs=1e-9)
    assert place_of(cavity, px=0.0125)[0] == pytest.approx(0.8, abs=1e-9)
    ring = rings.Ring([D, rings.multipole("K", 0.0, (0.0, 0.1)), D.inside(**BOX)])
    z = np.array([[0.0, 0.0018, 0, 0, 0, 0], [0.0, 1e-4, 0, 0, 0, 0]])
    out = rings.track(ring, z[None], 2)
    s = np.asarray(out.places(ring))
    assert s.shape == (1, 2)
    assert np.isnan(s[0, 1])
    assert int(out.turn[0, 0]) == 1
    after = rings.track(ring, z[0]).z
    x, px = after[0] + 2 * after[1], after[1] - 0.1 * (after[0] + 2 * after[1])
    assert s[0, 0] == pytest.approx(float(2 + (0.01 - x) / px), abs=1e-12)


def test_motion_that_cannot_be_traced_back_has_no_place():
    """No momentum along s: the coordinates behind the drift are NaN."""
    s, element = place_of(D, rings.drift("X", 1.0, model="exact"), px=0.9, py=0.9)
    assert element == 0  # 1.8 m
    assert 1.0 < s < 1.2
    s, element = place_of(rings.drift("X", 1.0, model="exact"), px=0.9, py=0.9)
    assert element == 0
    assert np.isnan(s)


def test_places_need_values():
    ring = rings.Ring([D.inside(**BOX)])
    with pytest.raises(TypeError, match="traced by JAX"):
        jax.jit(lambda z: rings.track(ring, z).places(ring))(np.zeros(6))
    other, out = rings.Ring([D]), rings.track(ring, np.array([0, 0.01, 0, 0, 0, 0]))
    with pytest.raises(ValueError, match="Give the ring that was tracked"):
        out.places(other)


# --- pipes ---------------------------------------------------------------------------------------


def test_a_pipe_with_a_taper_and_a_step():
    """Through elements of any length: the limits are those along s."""
    ring = rings.Ring([rings.drift("A", 1.0), rings.marker("M"), rings.drift("B", 3.0)])
    s, radius = [0.0, 1.0, 1.0, 4.0], np.array([0.02, 0.02, 0.015, 0.003])
    pipe = rings.beam_pipe(ring, s, ellipse=np.stack([radius, radius], 1))
    px = np.array([0.0, 0.004, 0.016, 0.021])
    z = np.zeros((4, 6))
    z[:, 1] = px
    out = rings.track(pipe, z)
    wanted = [np.nan, 1 + (0.015 - 0.004) / (0.004 + 0.004), 1.0, 0.02 / 0.021]
    np.testing.assert_allclose(out.places(pipe), wanted, atol=2e-8)
    assert out.element.tolist() == [-1, 2, 1, 0]
    box = rings.beam_pipe(ring, [0, 4], rectangle=[[-0.01, 0.03, -1, 1], [-0.01, 0.01, -1, 1]])
    np.testing.assert_allclose(rings.track(box, z).places(box)[2:], [0.03 / 0.021, 0.03 / 0.026])


def test_pipes_that_cannot_be():
    ring = rings.Ring([D])
    radius = [[0.01, 0.01]] * 2
    for s, options, message in (
        ([0.0, 1.0], {"ellipse": radius}, "between -1e-09 and 1, got 2.*s must cover them"),
        ([0.0, 2.0], {"ellipse": [0.01, 0.01]}, "ellipse must be a real array of shape"),
        ([2.0, np.nan], {"ellipse": radius}, "s must be finite"),
        ([0.0, 2.0], {"rectangle": [[0.01, 0.0, -1, 1]] * 2}, "positive"),
    ):
        with pytest.raises(ValueError, match=message):
            rings.beam_pipe(ring, s, **options)
    with pytest.raises(ValueError, match=r"got .*radius_x_in.* again"):
        rings.beam_pipe(rings.beam_pipe(ring, [0, 2], ellipse=radius), [0, 2], ellipse=radius)
    with pytest.warns(UserWarning, match=r"at s = 1 m, inside of element 'D', .* by 0.005 m"):
        rings.beam_pipe(ring, [0, 1, 2], ellipse=[[0.01, 0.01], [0.005, 0.01], [0.01, 0.01]])


def test_the_elements_of_a_ring_make_it_again():
    elements = [D, SLICED["exact_bend"].placed(1e-3, 0, 0.1).inside(**BOX), SLICED["solenoid"]]
    ring = rings.Ring(elements, energy=2e9, periods=3)
    again = rings.Ring(ring.elements, 2e9, 3)
    assert jax.tree.structure(again) == jax.tree.structure(ring)
    jax.tree.map(np.testing.assert_array_equal, again, ring)
