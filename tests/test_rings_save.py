"""Rings in files of pyAT and Xsuite, and back."""

import json
import warnings
from typing import Any, Literal

import numpy as np
import pytest

from dvi_jax.systems import rings

at = pytest.importorskip("at")
pytestmark = pytest.mark.filterwarnings("ignore:AT tracking still assumes")
FIELD: dict[str, Any] = {"b": (1e-3, 0.7, 3.0), "a": (2e-3, 0.3)}
EDGES: dict[str, Any] = {"edge_in": 0.1, "edge_out": 0.07}
ELEMENTS = {
    "drift": rings.drift("D", 1.3),
    "exact drift": rings.drift("D", 1.3, model="exact"),
    "multipole": rings.multipole("M", 0.4, **FIELD, slices=3),
    "quadrupole": rings.quadrupole("Q", 0.4, 1.1, fringe=True, slices=3),
    "exact": rings.multipole("M", 0.4, **FIELD, slices=3, model="exact", fringe=True),
    "octupole": rings.octupole("O", 0.2, 50.0, slices=2),
    "thin": rings.multipole("M", 0.0, **FIELD),
    "bend": rings.bend("B", 1.1, 0.2, **FIELD, **EDGES, slices=3),
    "bend with fringe": rings.bend(
        "B", 1.1, 0.2, (0, 0.5), **EDGES, fringe=True, fringe_in=0.02, fringe_out=0.01
    ),
    "exact bend": rings.bend(
        "B", 1.1, 0.2, **EDGES, fringe_in=0.02, fringe_out=0.02, model="exact", slices=3
    ),
    "corrector": rings.corrector("C", 0.3, 1e-3, -2e-3),
    "solenoid": rings.solenoid("S", 0.6, 0.8),
    "cavity": rings.cavity("RF", 0.4, 1e-3, 5e8, lag=0.05, phase=0.3),
    "apertures": rings.quadrupole("Q", 0.3, 1.1).inside(
        ellipse=(0.02, 0.01), rectangle=(-0.01, 0.02, -0.03, 0.04)
    ),
    "collimator": rings.aperture("A", ellipse=(0.03, 0.02)),
    "placed": rings.quadrupole("Q", 0.3, 1.1, slices=2).placed(1e-4, -2e-4, 0.05),
    "tilted": rings.quadrupole("Q", 0.3, 1.1, slices=2).inside(ellipse=(0.02, 0.01)).placed(
        tilt=0.3
    ),
    "monitor": rings.marker("BPM", "monitor"),
}  # fmt: skip
Z = np.random.default_rng(0).normal(size=(20, 6)) * [1e-3, 1e-4, 1e-3, 1e-4, 1e-2, 1e-3]


def again(ring, path, format: Literal["at", "xsuite"] = "at"):
    rings.save(ring, path, format=format)
    with warnings.catch_warnings(action="ignore"):
        return rings.load(path, symplectic=True)


def compare(ring, other, tolerance=1e-15):
    assert other.names == ring.names
    assert other.energy == pytest.approx(ring.energy, rel=1e-14)
    np.testing.assert_allclose(other.places, ring.places, rtol=1e-14)
    z, wanted = rings.track(other, Z, 2), rings.track(ring, Z, 2)
    np.testing.assert_array_equal(z.lost, wanted.lost)
    np.testing.assert_allclose(z.z, wanted.z, rtol=0, atol=tolerance)


@pytest.mark.parametrize("suffix", [".mat", ".m", ".json"])
def test_all_elements_in_files_of_pyat(suffix, tmp_path):
    """In one ring; the map is the same to round-off, and so are losses."""
    ring = rings.Ring(ELEMENTS.values(), energy=2.5e9, periods=4)
    other = again(ring, tmp_path / f"ring{suffix}")
    compare(ring, other)
    assert other.periods == 4
    assert set(ring.kinds) - set(other.kinds) <= {"cavity", "solenoid", "aperture"}


@pytest.mark.slow
@pytest.mark.parametrize("name", [n for n in ELEMENTS if n != "monitor"])
def test_each_element_in_a_file_of_pyat(name, tmp_path):
    ring = rings.Ring([ELEMENTS[name]])
    compare(ring, again(ring, tmp_path / "ring.mat"))


@pytest.mark.slow
def test_a_lattice_of_pyat_in_a_file(tmp_path):
    """Saved, read and saved again: with misalignments as matrices."""
    import machine_data

    with warnings.catch_warnings(action="ignore"):
        lattice = at.load_lattice(f"{next(iter(machine_data.__path__))}/hmba.mat")
    ring = rings.from_at(lattice)
    other = again(ring, tmp_path / "ring.mat")
    compare(ring, other)
    shifted = rings.Ring([ELEMENTS["placed"]])
    compare(shifted, again(again(shifted, tmp_path / "one.mat"), tmp_path / "two.json"))


def test_all_elements_in_a_file_of_xsuite(tmp_path):
    """Also names that occur more than once, which have numbers in such a file."""
    elements = {**ELEMENTS, "tilted": rings.quadrupole("QT", 0.3, 1.1, slices=2).placed(tilt=0.3)}
    ring = rings.Ring(elements.values(), energy=2.5e9, periods=4)
    other = again(ring, tmp_path / "ring.json", "xsuite")
    assert other.periods == 4
    compare(ring, other)
    content = json.loads((tmp_path / "ring.json").read_text())
    assert content["elements"]["RF"]["lag"] == pytest.approx(
        180 - 360 * 5e8 * 0.05 / 299792458 - np.degrees(0.3)
    )
    assert content["elements"]["O"]["knl"][3] == pytest.approx(0.2 * 6 * 50)


@pytest.mark.parametrize(
    ("element", "reason"),
    [
        (ELEMENTS["tilted"], "only magnets are placed or tilted"),
        (rings.drift("D", 1.0).placed(dx=1e-3), "only magnets are placed or tilted"),
        (rings.lens("L", lambda x, y, par: par["g"] * x**3, g=1.0), "lens is not there"),
    ],
)
def test_what_has_no_counterpart_in_xsuite(element, reason, tmp_path):
    with pytest.raises(ValueError, match=f"0: {element.name} .*{reason}"):
        rings.save(rings.Ring([element]), tmp_path / "ring.json", format="xsuite")


NO_COUNTERPARTS = {
    "lens is not there": rings.lens("L", lambda x, y, par: par["g"] * x**3, g=1.0),
    "moved_in, straight, moved_out is not there": ELEMENTS["multipole"].placed(yaw=1e-3),
    "beam is not there": rings.beam_beam("IP", 1e-9, (1e-4, 1e-4)),
    "scheme=6 is not there": rings.quadrupole("Q", 0.3, 1.0, scheme=6),
    "its multipoles in curved coordinates": rings.bend("B", 1.0, 0.1, (0, 1.0), model="exact"),
    "use inside before placed": ELEMENTS["placed"].inside(ellipse=(0.1, 0.1)),
    "the slip of its phase": rings.cavity("RF", 0.0, 1e-3, 5e8, slip=0.1),
    "different fringe fields": rings.bend("B", 1.0, 0.1, model="exact", fringe_in=0.1),
}


@pytest.mark.parametrize("reason", NO_COUNTERPARTS)
def test_what_has_no_counterpart(reason, tmp_path):
    ring = rings.Ring([rings.drift("D", 1.0), NO_COUNTERPARTS[reason]])
    kind = ring.kinds[1]
    message = (
        rf"1 of 2 elements have no counterpart in this format:\n  1: {ring.names[1]} \({kind}\): "
    )
    with pytest.raises(ValueError, match=message + f".*{reason}"):
        rings.save(ring, tmp_path / "ring.mat")
    assert not (tmp_path / "ring.mat").exists()
    with pytest.raises(ValueError, match="end of path must be one of"):
        rings.save(ring, tmp_path / "ring.seq")
