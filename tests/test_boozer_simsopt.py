"""Guiding-centre orbits in a file of booz_xform: this package and simsopt, which both read it."""

import types

import jax
import numpy as np
import pytest
from scipy.io import netcdf_file
from test_boozer import written

import dvi_jax as dvi
from dvi_jax.systems import boozer

EV, MASS = 1.602176634e-19, 6.6446573357e-27


def peer_of(path, fields, mhd):
    """simsopt's radial splines of the Fourier modes of a file, with its flux and its angles."""
    with netcdf_file(path, "r", mmap=False) as file:
        data = {name: np.array(v.data) for name, v in file.variables.items()}
    rows = data["jlist"] - 1
    s = (rows - 0.5) / (data["ns_b"] - 1)
    booz = mhd.Boozer.__new__(mhd.Boozer)
    booz.mpi, booz.need_to_run_code = None, False
    flux = data["phi_b"]
    booz.equil = types.SimpleNamespace(wout=types.SimpleNamespace(phi=flux, chi=0 * flux))
    booz.bx = types.SimpleNamespace(
        asym=False, nfp=int(data["nfp_b"]), s_in=s, s_b=s, ns_in=len(s), ns_b=len(s),
        xm_b=data["ixm_b"], xn_b=data["ixn_b"], iota=data["iota_b"][rows],
        Boozer_G=data["bvco_b"][rows], Boozer_I=data["buco_b"][rows], bmnc_b=data["bmnc_b"].T,
        rmnc_b=data["rmnc_b"].T, zmns_b=data["zmns_b"].T, numns_b=-data["pmns_b"].T,
    )  # fmt: skip
    # simsopt imports these names only if mpi4py is installed, which nothing here requires.
    fields.Vmec, fields.Boozer = mhd.Vmec, mhd.Boozer
    return fields.BoozerRadialInterpolant(booz, 5, rescale=True, no_K=True)


@pytest.mark.slow
def test_orbits_of_simsopt_in_the_same_file(tmp_path):
    pytest.importorskip("booz_xform", reason="a requirement of simsopt's splines")
    names = "field.boozermagneticfield", "mhd", "field.tracing"
    fields, mhd, tracing = (
        pytest.importorskip(f"simsopt.{name}", reason='pip install "dvi-jax[peers]"')
        for name in names
    )
    path = written(tmp_path / "boozmn.nc", surfaces=41)
    peer = peer_of(path, fields, mhd)
    alphas = boozer.GuidingCentres(boozer.read_booz_xform(path, degree=3))
    start = np.array([[0.4, 0.5], [0.3, 2.0], [0.1, 0.4], [0.8, -0.2]])
    q, p, args = alphas.start(*start)
    seconds, steps = 2e-6, 400

    @jax.jit
    @jax.vmap
    def last(q, p, mu):
        sol = dvi.integrate(
            alphas.system, q, p, h=alphas.step(seconds) / steps, num_steps=steps,
            args={**args, "mu": mu}, method=dvi.GaussLegendre(2),
        )  # fmt: skip
        return sol.q_final, sol.p_final

    end = alphas.coordinates_of(*last(q, p, args["mu"]))
    ours = np.stack([end.s, end.theta, end.zeta, end.v_parallel / alphas.speed])
    # The angles of the file are left-handed: the angle of this package is −θ. simsopt's equations
    # require right-handed ones; in those of the file, its drifts are those of the other charge.
    flip = np.array([[1], [-1], [1], [1]])
    inside, speeds = np.ascontiguousarray((flip * start)[:3].T), alphas.speed * start[3]

    def difference(charge):
        paths, _ = tracing.trace_particles_boozer(
            peer, inside, speeds, tmax=seconds, mass=MASS, charge=charge * EV, Ekin=3.5e6 * EV,
            tol=1e-9, mode="gc_noK",
        )  # fmt: skip
        theirs = flip * np.array([path[-1, 1:] for path in paths]).T
        theirs[3] /= alphas.speed
        return np.abs((ours - theirs + np.pi) % (2 * np.pi) - np.pi).max()

    assert (np.abs(ours - start).max(1) > 0.02).all()
    assert difference(-2) < 1e-6
    assert difference(2) > 1e-2
