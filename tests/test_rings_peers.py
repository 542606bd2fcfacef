"""Rings from MAD-X through cpymad, from LatticeJSON, and the advice for Bmad."""

import numpy as np
import pytest

from dvi_jax.systems import rings

MAGNETS = """
beam, particle=electron, energy=1.0;
qf: quadrupole,l=0.5,k1=0.6,apertype=ellipse,aperture={0.02,0.01};
qd: quadrupole,l=0.5,k1=-0.6,k1s=0.01,tilt=0.02;
b: rbend,l=1,angle=0.1,k1=0.02,hgap=0.02,fint=0.5; b2: sbend,l=1,angle=0.1,e1=0.02;
s: sextupole,l=0.1,k2=3; m: multipole,knl={0,0.01}; so: solenoid,l=0.5,ks=0.05;
k: hkicker,l=0.1,kick=1e-4; p: collimator,l=0.2,apertype=rectellipse,aperture={0.03,0.02,0.04,0.01};
ring: sequence,l=12; qf,at=0.25; b,at=1.5; qd,at=2.75; s,at=4; m,at=4.5; b2,at=6; so,at=7;
k,at=8; p,at=10; endsequence; use,sequence=ring;
eoption,add=true; select,flag=error,pattern="^qf$"; ealign,dx=1e-4,dy=2e-4,dpsi=1e-3;
"""


@pytest.fixture
def madx():
    return pytest.importorskip("cpymad.madx").Madx(stdout=False)


def test_optics_and_orbit_of_madx(madx):
    """Of a ring with all kinds of magnets, fringe fields, tilts and EALIGN; MAD-X has v < c."""
    madx.input(MAGNETS)
    twiss = madx.twiss(sequence="ring", rmatrix=True)
    ring = rings.from_madx(madx.sequence.ring)
    optics = rings.optics(ring, chromatic=False)
    np.testing.assert_allclose(optics.tune, [twiss.summary.q1, twiss.summary.q2], atol=2e-7)
    beta = np.stack([twiss.betx, twiss.bety], 1)
    edwards = optics.beta / np.asarray(optics.gamma)[:, None] ** 2
    np.testing.assert_allclose(edwards[1:], beta, rtol=1e-6)
    orbit = np.stack([twiss.x, twiss.px, twiss.y, twiss.py], 1)
    np.testing.assert_allclose(optics.orbit[1:, :4], orbit, atol=1e-8)
    assert ring.get("qf*", "radius_y").tolist() == [0.01]
    assert ring.get("p*", "x_max").tolist() == [0.03]


def test_chromaticity_of_madx(madx):
    """Of TWISS and PTC, whose dq1 and dq2 are derivatives by PT = βδ for a velocity βc. TWISS with
    `chrom` takes differences with DELTAP, which are others for bends with inclined faces only."""
    pt = {}
    for face in (np.pi / 32, 0.0):
        madx.input(
            f"beam,particle=electron,energy=1; b: sbend,l=1.5,angle={np.pi / 16},e1={face},"
            f"e2={face}; qf: quadrupole,l=0.4,k1=1.3; qd: quadrupole,l=0.4,k1=-1.3;"
            "r: sequence,l=5.4; qf,at=0.2; b,at=1.55; qd,at=2.9; b,at=4.25; endsequence;"
            "use,sequence=r;"
        )
        both = [madx.twiss(sequence="r", chrom=chrom).summary for chrom in (False, True)]
        plain, differences = (np.array([s.dq1, s.dq2]) for s in both)
        madx.input("ptc_create_universe; ptc_create_layout,model=2,method=6,nst=20,exact=true;")
        madx.input("ptc_twiss,icase=5,no=2; ptc_end;")
        ptc = madx.table.ptc_twiss.summary
        np.testing.assert_allclose([ptc.dq1, ptc.dq2], plain, rtol=1e-7)
        ours = rings.optics(rings.from_madx(madx.sequence.r)).chromaticity
        np.testing.assert_allclose(ours, plain, rtol=5e-6)
        pt[face] = np.abs(differences / plain - 1)
    assert pt[0.0].max() < 5e-6
    assert pt[np.pi / 32].min() > 0.05


def test_a_cavity_of_madx(madx):
    madx.input(
        "beam,particle=electron,energy=1.0; rf: rfcavity,l=0.2,volt=1,freq=499.654,lag=0.55;"
        "r: sequence,l=1; rf,at=0.5; endsequence; use,sequence=r;"
    )
    twiss = madx.twiss(sequence="r", rmatrix=True, betx=1, bety=1)
    ring = rings.from_madx(madx.sequence.r, model="paraxial")
    z = 1e-6 * np.array([0, 1, -1])[:, None] * np.eye(6)[4]
    delta = np.asarray(rings.track(ring, z).z)[:, 5]
    assert delta[0] == pytest.approx(twiss.pt[-1], rel=1e-6)
    assert (delta[1] - delta[2]) / 2e-6 == pytest.approx(twiss.re65[-1], rel=1e-6)


def test_what_madx_has_and_rings_have_not(madx):
    madx.input(
        "beam,particle=electron,energy=1.0; c: crabcavity,l=0.1; m: multipole,knl={0.1};"
        "r: sequence,l=3; c,at=1; m,at=2; endsequence; use,sequence=r;"
    )
    with pytest.raises(ValueError, match="2 of 7 elements have no counterpart here") as error:
        rings.from_madx(madx.sequence.r)
    assert "crabcavity is not supported" in str(error.value)
    assert "KNL[0], KSL[0] or ANGLE bend" in str(error.value)
    madx.input('select,flag=error,pattern="^m$"; efcomp,order=1,dkn={0,1e-3};')
    with pytest.raises(ValueError, match="errors of EFCOMP are not supported"):
        rings.from_madx(madx.sequence.r)
    madx.input("beam,particle=proton,energy=2.0; use,sequence=r;")
    with (
        pytest.warns(UserWarning, match="the beam of MAD-X has v = 0.88"),
        pytest.raises(ValueError, match="2 of 7"),
    ):
        rings.from_madx(madx.sequence.r)


LATTICE = {
    "version": "2.0",
    "energy": 1.5,
    "root": "ring",
    "lattices": {"cell": ["QF", "D", "B", "D"], "ring": ["cell", "cell", "S"]},
    "elements": {
        "QF": ["Quadrupole", {"length": 0.5, "k1": 0.6}],
        "D": ["Drift", {"length": 2.0}],
        "B": ["Dipole", {"length": 1.0, "angle": 0.1, "k1": -0.3, "e1": 0.05, "e2": 0.05}],
        "S": ["Sextupole", {"length": 0.1, "k2": 3.0}],
    },
}


def test_latticejson():
    """The units of its strengths are those of MAD; what is not read is refused."""
    ring = rings.from_latticejson(LATTICE, model="paraxial")
    cell = [
        rings.quadrupole("QF", 0.5, 0.6),
        rings.drift("D", 2.0),
        rings.bend("B", 1.0, 0.1, (0, -0.3), edge_in=0.05, edge_out=0.05),
        rings.drift("D", 2.0),
    ]
    same = rings.Ring([*cell, *cell, rings.sextupole("S", 0.1, 1.5)], energy=1.5e9)
    assert (ring.names, ring.energy) == (same.names, same.energy)
    for name in ("b1", "b2", "h", "edge_in", "edge_out", "length"):
        np.testing.assert_allclose(ring.columns[name], same.columns[name], rtol=1e-15)
    elements = {**LATTICE["elements"], "S": ["Sextupole", {"length": 0.1, "k2": 3.0, "tilt": 0.1}]}
    with pytest.raises(ValueError, match=r"1 of 9 elements .*\n  8: S: tilt is not supported"):
        rings.from_latticejson({**LATTICE, "elements": elements})


def test_elegant_through_latticejson(tmp_path):
    latticejson = pytest.importorskip("latticejson")
    path = tmp_path / "ring.lte"
    path.write_text("QF: KQUAD,L=0.5,K1=0.6\nD: DRIFT,L=2\nRING: LINE=(QF,D,QF)\n")
    ring = rings.from_latticejson(latticejson.load(path))
    assert [name.upper() for name in ring.names] == ["QF", "D", "QF"]
    assert ring.get("quadrupole", "b1").tolist() == [0.6, 0.6]


def test_advice_for_bmad(tmp_path):
    pytest.importorskip("at")
    (tmp_path / "ring.bmad").write_text("")
    with pytest.raises(ValueError, match=r"got 'ring\.bmad'\. Bmad's program bmad_to_mad_sad"):
        rings.load(tmp_path / "ring.bmad")
