"""Forces of `dvi.forces` in TOML files."""

import re

import numpy as np
import pytest
from cli import ROOT, command, refuses, write

import dvi_jax as dvi
from dvi_jax import forces, systems

PAGE = (ROOT / "docs" / "command-line.md").read_text(encoding="utf-8")
EXAMPLE = next(t for t in re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL) if "[[force]]" in t)

EXPLICIT = EXAMPLE.replace('"Strang"', '"RungeKutta4"')  # which compiles in less time


def in_file(folder, text):
    """The positions of the saved states of a run."""
    result = command("run", write(folder, text + "[output]\nplots = false\n"), "--out", "out")
    assert result.exit_code == 0, result.output
    with np.load("out/trajectory.npz") as saved:
        return saved["qs"]


def test_forces_of_a_file_are_those_of_python(tmp_path, monkeypatch):
    """The same bits as in Python, with a parameter in args, harmonics and a function."""
    monkeypatch.chdir(tmp_path)
    write(tmp_path, "def density(r, args):\n    return 1e-9\n", "air.py")
    drag = '[[force]]\nname = "Drag"\ndensity = "air.py:density"\nballistic = 1e3\n'
    tilt = 'tesseral = {"2,1" = [1e-3, 2e-3]}\npole = [0.0, 0.6, 0.8]\n'
    qs = in_file(tmp_path, EXPLICIT + tilt + drag + "on_bodies = [1]\n")
    record = systems.outer_solar_system()
    pole, c = (0.0, 0.6, 0.8), 173.1446
    harmonics = forces.Harmonics(
        0.00465, {2: lambda args: args["J2"]}, {(2, 1): (1e-3, 2e-3)}, pole=pole
    )
    air = forces.Drag(lambda r, args: 1e-9, 1e3, on_bodies=[1])
    force = forces.Relativity(c) + harmonics + air
    run = {"h": 100.0, "num_steps": 20, "method": dvi.RungeKutta4()}
    sol = dvi.integrate(force.add_to(record, args={"J2": 2e-7}), **run)
    np.testing.assert_array_equal(qs, sol.qs)
    # The control: without the last force.
    other = (forces.Relativity(c) + harmonics).add_to(record, args={"J2": 2e-7})
    assert np.any(dvi.integrate(other, **run).qs != qs)


DEFECTS = {
    ('name = "Relativity"', 'name = "Relativty"'): ("force[0].name", "did you mean Relativity?"),
    ('name = "Relativity"', ""): ("force[0].name: the key is missing", "PostNewtonian"),
    ("c = 173", "v = 173"): ("force[0].v: Relativity has no such parameter", "c, "),
    ("c = 173", "c = -173"): ("force[0]: c of forces.Relativity must be", "c, centre"),
    ("c = 173.1446", ""): ("force[0]", "parameters of Relativity: c"),
    ('{2 = "args.J2"}', '{two = "args.J2"}'): ("force[1].zonal.two", 'a degree, "2"'),
    ('"args.J2"', '"args.J3"'): ("force[1].zonal.2: the value is 'args.J3'", "args.NAME"),
    ('"args.J2"', '"os.system"'): ("force[1].zonal.2: the value is 'os.system'", "args.NAME"),
    ('"args.J2"', '"none.py:f"'): ("force[1].zonal.2: there is no file", ""),
    ("{2 =", "{1 ="): ("the degree of a harmonic", "radius, zonal"),
    ("outer_solar_system", "pendulum"): ("the last axis of q", ""),
    ("outer_solar_system", "own.py:system"): ("force: it is given", "no forces for a dvi.System"),
    ("[[force]]", "[force]"): ("force", "tables [[force]]"),
}


@pytest.mark.parametrize("change", DEFECTS, ids=lambda change: change[1])
def test_wrong_forces_are_refused(tmp_path, monkeypatch, change):
    monkeypatch.chdir(tmp_path)
    own = "import dvi_jax as dvi\nsystem = dvi.systems.pendulum().system\n"
    write(tmp_path, own, "own.py")
    text = EXAMPLE.replace(*change) if change[1] != "[force]" else EXAMPLE.split("[[force]]")[0]
    text += '[force]\nname = "Relativity"\n' if change[1] == "[force]" else ""
    assert text != EXAMPLE
    refuses(command("run", write(tmp_path, text), "--out", "out"), *DEFECTS[change])
