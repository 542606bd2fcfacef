"""Rings from files of MAD-X, MAD8, elegant and Xsuite: what is read, and what is refused."""

import json
import warnings

import numpy as np
import pytest

from dvi_jax.systems import rings

at = pytest.importorskip("at")
pytestmark = pytest.mark.filterwarnings("ignore:AT tracking still assumes")
BEAM = "beam, particle=electron, energy=1.0;"
FODO = {
    ".seq": "qf: quadrupole,l=0.5,k1:=2*k; qd: quadrupole,l=0.5,k1=-0.6; k = 0.3;"
    "ring: sequence,l=5; qf, at=0.25; qd, at=2.75; endsequence;" + BEAM,
    ".madx": "qf: quadrupole,l=0.5,k1=0.6; qd: quadrupole,l=0.5,k1=-0.6; d: drift,l=2;"
    "cell: line=(qf,d,qd,d); " + BEAM,
    ".mad8": "qf: quadrupole,l=0.5,k1=0.6\nqd: quadrupole,l=0.5,k1=-0.6\nd: drift,l=2.0\n"
    "ring: line=(qf,d,qd,d)\nbeam,particle=electron,energy=1.0\n",
    ".lte": "QF: KQUAD,L=0.5,K1=0.6\nQD: QUAD,L=0.5,K1=-0.6\nD: DRIFT,L=2\n"
    "RING: LINE=(QF,D,QD,D)\n",
}


@pytest.fixture
def read(tmp_path):
    def read(content, suffix=".seq", **options):
        path = tmp_path / f"file{suffix}"
        path.write_text(content)
        return rings.load(path, **options)

    return read


def with_element(element, more=""):
    """A MAD-X file with one element e in a sequence of 10 m."""
    return f"e: {element}; s: sequence,l=10; e, at=5; endsequence; {more} {BEAM}"


@pytest.mark.parametrize("suffix", FODO)
def test_a_lattice_of_each_format(read, suffix):
    ring = read(FODO[suffix], suffix)
    assert ring.kinds == ("quadrupole", "drift", "quadrupole", "drift")
    np.testing.assert_allclose(ring.get("quadrupole", "b1"), [0.6, -0.6])
    np.testing.assert_allclose(ring.places[-1], 5.0)
    assert ring.energy == 1e9


@pytest.mark.parametrize(
    ("element", "reason"),
    [
        ("solenoid,l=0.8,ks=0.3", "no element for solenoid, and replaces it by a Drift"),
        ("tkicker,l=0,hkick=1e-3", "no element for tkicker, and replaces it by a Marker"),
        ("elseparator,l=1,ey=0.2", "no element for elseparator"),
        ("yrotation,angle=0.01", "no element for yrotation"),
        ("dipedge,h=0.1,e1=0.05", "no element for dipedge"),
        ("matrix,l=0.4,rm12=0.4", "no element for matrix"),
        ("multipole,knl={0.01,0.1}", r"KNL\[0\] = 0.01"),
        ("multipole,ksl={0.02}", r"KSL\[0\] = 0.02"),
        ("sbend,l=1.5,angle=0.2,k0=0.14", "pyAT leaves out k0 = 0.14"),
        ("rbend,l=1.5,angle=0.2,k0=0.14", "pyAT leaves out k0 = 0.14"),
        ("rbend,l=1.5,angle=-0.2", "RBEND with a negative angle"),
        ("sbend,l=1.5,angle=0.2,h1=0.3", "pyAT leaves out h1 = 0.3"),
        ("quadrupole,l=0.5,k1=0.6,knl={0,0,0.1}", "pyAT leaves out knl"),
    ],
)
def test_what_pyat_leaves_out_is_refused_with_its_place(read, element, reason):
    message = rf"1 of 3 elements have no counterpart here:\n  1: e \(.*{reason}"
    with pytest.raises(ValueError, match=message):
        read(with_element(element))


@pytest.mark.parametrize(
    "element",
    [
        "solenoid,l=0.8,ks=0",
        "tkicker,l=0.3,hkick:=0*pi",
        "multipole,knl={0,0.1,2},lrad=0.2",
        "sbend,l=1.5,angle=0.3,k0=0.2",
        "collimator,l=0.8,apertype=ellipse,aperture={0.02,0.01}",
        "monitor,l=0.2",
        "quadrupole,l=0.5,k1=0.6,knl={0,0},slot_id=3",
    ],
)
def test_elements_that_are_switched_off_are_read(read, element):
    assert read(with_element(element)).places[-1] == pytest.approx(10.0)


@pytest.mark.parametrize("content", ["{broken", "[1, 2]", '{"a": 1}'])
def test_a_json_file_that_is_no_lattice(read, content):
    with pytest.raises(ValueError, match=r"file\.json cannot be read: "):
        read(content, ".json")


def test_what_elegant_has_and_pyat_does_not(read):
    lines = FODO[".lte"].replace("=(QF", "=(E,QF")
    for element, reason in (
        ("SOLENOID,L=0.4,B=0.2", "no element for SOLENOID"),
        ("SOLENOID,L=0.4,KS=0.2", "no element for SOLENOID"),
        ("MALIGN,DXP=1e-3", "no element for MALIGN"),
        ("CSBEND,L=1,ANGLE=0.1,XKICK=0.2", "leaves out xkick"),
    ):
        with pytest.raises(ValueError, match=f"0: E .*{reason}"):
            read(f"E: {element}\n{lines}", ".lte")
    with pytest.raises(ValueError, match=r"cannot be read: .*CWIGGLER"):
        read(f"E: CWIGGLER,L=1\n{lines}", ".lte")
    for element in ("WATCH", "SOLENOID,L=0.4,KS=0", "CSBEND,L=1,ANGLE=0.1,N_SLICES=4,NONLINEAR=1"):
        assert len(read(f"E: {element}\n{lines}", ".lte")) == 5


def test_commands_that_change_a_lattice_are_refused(read):
    for command in (
        "seqedit, sequence=s; endedit;", "ealign, dx=1e-3;", "beam, bv=-1;", "cycle, start=e;",
        "makethin, sequence=s;", "add2expr, var=k, expr=1;",
    ):  # fmt: skip
        with pytest.raises(ValueError, match="changes its lattice by"):
            read(with_element("drift,l=1", command))


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (
            "k = 0.1; if (k > 0) {k = 0.3;} q: quadrupole,l=1,k1=k; s: line=(q);",
            "conditions, loops",
        ),
        ("k = 0.1; while (k < 1) {k = k + 1;}; q: drift,l=1; s: line=(q);", "conditions, loops"),
        ("a(x): macro = {k = x;}; exec, a(2); q: drift,l=1; s: line=(q);", "conditions, loops"),
        ("q: drift,l=1; s: line=(q, -2*q);", "repeated backwards"),
        ("q: drift,l=1; t: line=(q); s: line=(q, 2*(-t));", "repeated backwards"),
        ("option, -rbarc; q: rbend,l=1,angle=0.1; s: line=(q);", "RBARC = FALSE"),
        ("option, rbarc=false; q: rbend,l=1,angle=0.1; s: line=(q);", "RBARC = FALSE"),
        ("q: drift,l=1; s: sequence,l=3; q,at=0.5; q,at=1.4; endsequence;", "the first by 0.1 m"),
        ("q: drift,l=1; s: sequence,l=3; q,at=0.5; q,at=2.9; endsequence;", "the first by 0.4 m"),
    ],
)
def test_statements_that_pyat_misreads_are_refused(read, text, reason):
    with pytest.raises(ValueError, match=reason):
        read(text + BEAM, use="s")


def test_commands_without_effect_are_read(read):
    commands = 'option,-echo; title,"a"; use,period=s; select,flag=twiss; twiss; save; stop;'
    assert len(read(with_element("drift,l=1", commands))) == 3


def test_attributes_that_are_assigned_later(read):
    later = FODO[".madx"] + "qf->k1 = 0.9; qd -> k1 := -2*k; k = 0.4;"
    np.testing.assert_allclose(read(later).get("quadrupole", "b1"), [0.9, -0.8])
    old = read(FODO[".mad8"].replace("ring:", "qf[k1] := 0.9\nring:"), ".mad8")
    np.testing.assert_allclose(old.get("quadrupole", "b1"), [0.9, -0.6])


def test_the_sequence_is_selected(read):
    two = "d: drift,l=1; first: line=(d,d); second: line=(d,d,d); " + BEAM
    assert len(read(two, use="SECOND")) == 3
    for use in (None, "third"):
        with pytest.raises(ValueError, match=f"use must be .*: first, second; got {use!r}"):
            read(two, use=use)
    assert len(read(two.replace("first", "ring"))) == 2


def test_an_error_lists_ten_elements(read):
    places = "".join(f"e, at={i}.5;" for i in range(25))
    with pytest.raises(ValueError, match=r"(?s)25 of 51 .*\n  and 15 more$") as error:
        read(f"e: solenoid,l=0.1,ks=1; s: sequence,l=30; {places} endsequence; {BEAM}")
    assert len(str(error.value).splitlines()) == 12
    with pytest.raises(ValueError, match=r"path must end with one of .*, got 'file.txt'"):
        read("", ".txt")


def test_variables_that_are_not_defined(read):
    text = with_element("quadrupole,l=0.5,k1:=kq")
    with pytest.warns(UserWarning, match="does not define kq: zero, as in MAD"):
        assert read(text).get("e", "b1") == 0
    with pytest.raises(ValueError, match="'kq' is not defined"):
        read(text, strict=True)
    with warnings.catch_warnings(action="error", category=UserWarning):
        warnings.filterwarnings("ignore", "AT tracking")
        assert read(text, kq=0.7).get("e", "b1") == 0.7


def xsuite(**element):
    particle = {"mass0": 5.11e5, "q0": 1, "gamma0": [2e3], "beta0": [1.0]}
    elements = {"e": element, "d": {"__class__": "Drift", "length": 1.0}}
    line = {"__class__": "Line", "elements": elements, "element_names": ["e", "d"]}
    return json.dumps({**line, "particle_ref": particle})


def test_bends_of_xsuite(read):
    """k0 is the whole field, not the difference to the one that bends by the angle."""
    bend = {"__class__": "Bend", "length": 1.5, "angle": 0.3, "k1": -0.4}
    ring = read(
        xsuite(**bend, k0=0.2, edge_entry_hgap=0.02, edge_exit_hgap=0.02, edge_entry_fint=0.5),
        ".json",
    )
    assert ring.get("e", "b0") == 0.0
    assert ring.get("e", "b1") == -0.4
    assert ring.get("e", "fringe_in") == pytest.approx(2 * 0.02 * 0.5)
    with pytest.raises(ValueError, match=r"0: e .*leaves out k0 - angle/length"):
        read(xsuite(**bend, k0=0.19), ".json")
    with pytest.raises(ValueError, match=r"0: e .*leaves out hxl = 0.1"):
        read(xsuite(__class__="Multipole", length=0.0, knl=[0.1, 0.0], hxl=0.1), ".json")


@pytest.mark.parametrize(
    ("kind", "values", "reason"),
    [
        ("Solenoid", {"length": 0.5, "ks": 0.3}, "no element for Solenoid"),
        ("SRotation", {"angle": 0.3}, "no element for SRotation"),
        ("CrabCavity", {"crab_voltage": 1e6}, "no element for CrabCavity"),
        ("RFMultipole", {"knl": [0.1]}, "no element for RFMultipole"),
        ("Translation", {"dx": 0.1}, "no element for Translation"),
        ("Quadrupole", {"length": 0.5, "k1": 0.3, "main_is_skew": True}, "out main_is_skew"),
        ("Quadrupole", {"length": 0.5, "rot_s_rad": 0.1, "shift_x": 1e-3}, "out shift_x"),
        ("Quadrupole", {"length": 0.5, "rot_y_rad": 0.1, "rot_shift_anchor": 0.1}, "out rot_y_rad"),
        ("Sextupole", {"length": 0.5, "k2": 3.0, "edge_exit_active": 1}, "out edge_exit_active"),
        ("Bend", {"length": 1.0, "angle": 0.2, "edge_entry_active": 0}, "out edge_entry, suppr"),
        (
            "Bend",
            {"length": 1.0, "angle": 0.2, "edge_exit_model": "suppressed"},
            "out edge_exit, s",
        ),
        ("Bend", {"length": 1.0, "angle": 0.2, "edge_exit_hgap": 0.02}, "out edge_exit_hgap"),
    ],
)
def test_what_pyat_leaves_out_of_elements_of_xsuite(read, capsys, kind, values, reason):
    with pytest.raises(ValueError, match=rf"0: e .*{reason}"):
        read(xsuite(__class__=kind, **values), ".json")
    assert capsys.readouterr().out == ""


def test_multipoles_of_xsuite(read):
    """All orders are read, and the length of a thin one is that of its radiation."""
    multipole = {"__class__": "Multipole", "length": 0.5, "knl": [0.1, 0.2, 0, 0, 0, 120.0]}
    thin, thick = (read(xsuite(**multipole, isthick=x), ".json") for x in (False, True))
    assert (thin.places[-1], thick.places[-1]) == (1.0, 1.5)
    for ring, length in ((thin, 1.0), (thick, 0.5)):
        field = [ring.get("e", f"b{n}") * length for n in (0, 1, 5)]
        np.testing.assert_allclose(np.ravel(field), [0.1, 0.2, 1.0])


def test_the_exact_model_of_a_file(read):
    text = "b: sbend,l=1.5,angle=0.3,k1=-0.4,e1=0.1,hgap=0.02,fint=0.5; d: drift,l=1; "
    ring = read(text + "q: quadrupole,l=0.5,k1=1; ring: line=(b,d,q); " + BEAM, model="exact")
    gap = 2 * 0.02 * 0.5
    wanted = rings.Ring([
        rings.bend("b", 1.5, 0.3, (0, -0.4, 0), (0, 0), edge_in=0.1, fringe_in=gap,
                   fringe_out=gap, model="exact"),
        rings.drift("d", 1.0, "exact"),
        rings.quadrupole("q", 0.5, 1.0, model="exact"),
    ], energy=1e9)  # fmt: skip
    assert ring.program.parts == wanted.program.parts
    assert ring.program.rows == wanted.program.rows
    for name, column in wanted.columns.items():
        np.testing.assert_allclose(ring.columns[name], column, err_msg=name)
    with pytest.raises(ValueError, match="model must be"):
        read(FODO[".seq"], model="thick")
