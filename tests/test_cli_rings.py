"""Runs and sweeps of a ring that is read from a file."""

import shutil
from importlib.resources import files

import jax.numpy as jnp
import numpy as np
import pytest
from cli import EXAMPLES, command, found, refuses, write

from dvi_jax.systems import rings

pytest.importorskip("at")
RUN = """
system = "ring"
steps = 20
[ring]
file = "hmba.mat"
planes = "xy"
[state]
q0 = [1e-3, 1e-3]
p0 = [0.0, 0.0]
[output]
plots = false
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with a lattice of pyAT."""
    shutil.copy(str(files("machine_data") / "hmba.mat"), tmp_path / "hmba.mat")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_run_tracks_a_ring_of_a_file(folder):
    write(folder, RUN)
    assert found("run", "file.toml", "--out", "out")["status"]["result"] == "successful"
    got = np.load(folder / "out/trajectory.npz")
    z = jnp.array([1e-3, 0.0, 1e-3, 0.0, 0.0, 0.0])
    wanted = rings.track(rings.load("hmba.mat"), z, 20, every=1).z
    np.testing.assert_allclose(got["qs"][1:], wanted[:, [0, 2]], atol=1e-15)
    np.testing.assert_allclose(got["ps"][1:], wanted[:, [1, 3]], atol=1e-15)


def test_what_does_not_fit_a_ring_is_rejected(folder):
    for old, new, seen, allowed in (
        ("steps", 'method = "Strang"\nsteps', "method", "no method"),
        ("hmba", "none", "none.mat", "a lattice file"),
        ('"xy"', '"xz"', "xz", "xyz"),
        ('"ring"', '"kepler"', "ring", "only with system = ring"),
        ("[ring]\n", "[other]\n", "other", ""),
    ):
        write(folder, RUN.replace(old, new, 1))
        refuses(command("run", "file.toml", "--out", "out"), seen, allowed)


def test_the_sequence_and_the_model_of_a_file(folder):
    bend = "b: sbend,l=1.5,angle=0.2,k1=-0.4; d: drift,l=1; "
    lines = "one: line=(b,d); two: line=(d,b,d); beam,energy=1;"
    (folder / "ring.seq").write_text(bend + lines)
    keys = 'file = "ring.seq"\nuse = "two"\nmodel = "exact"'
    run = RUN.replace('file = "hmba.mat"', keys).replace("steps = 20", "steps = 2")
    write(folder, run)
    assert found("run", "file.toml", "--out", "out")["status"]["result"] == "successful"
    got = np.load(folder / "out/trajectory.npz")
    z = jnp.array([1e-3, 0.0, 1e-3, 0.0, 0.0, 0.0])
    ring = rings.load("ring.seq", use="two", model="exact")
    np.testing.assert_allclose(got["qs"][-1], rings.track(ring, z, 2).z[jnp.array([0, 2])])
    for old, new, seen, allowed in (("two", "three", "use must", "lattice file"),
                                    ("exact", "thick", "thick", "paraxial")):  # fmt: skip
        write(folder, run.replace(f'"{old}"', f'"{new}"'))
        refuses(command("run", "file.toml", "--out", "out2"), seen, allowed)


@pytest.mark.slow
def test_the_example_finds_the_particles_that_are_lost(folder):
    shutil.copy(EXAMPLES / "ring.toml", folder / "ring.toml")
    counts = found("sweep", "ring.toml")["trajectories"]
    x = np.linspace(-0.012, 0.012, 49)
    z = jnp.zeros((49, 6)).at[:, 0].set(x).at[:, 2].set(1e-3)
    lost = np.asarray(rings.track(rings.load("hmba.mat"), z, 500).lost)
    assert 0 < lost.sum() < 25
    assert counts == {"successful": int((~lost).sum()), "lost": int(lost.sum())}
