"""Proofs from TOML files: what they prove and write, which input they reject."""

import json
import shutil
from pathlib import Path

import pytest
from cli import command, found, names, refuses, write

pytest.importorskip("flint")

OWN = """
import jax.numpy as jnp
import dvi_jax as dvi

system = dvi.System(lambda t0, t1, q0, p1, args: (p1 @ p1 + q0 @ q0) / 2)

def energy(q, p, epsilon):
    return (p @ p + q @ q - 0.1 * (q @ p)) / 2

def singular(q, p, epsilon):
    return 1 / q[0]

def pair(q, p):
    return energy(q, p, 0.0)

kicked = dvi.System(lambda t0, t1, q0, p1, args: p1 @ p1 / 2, force=lambda *x: -x[2])

def inside(q, p):
    return 0.1 - q @ q

rotor = dvi.System(lambda t0, t1, q0, p1, args: p1 @ p1 / 2 - jnp.sum(jnp.cos(q0)))

def rotation(q, p):
    return p @ p / 2 - jnp.sum(jnp.cos(q)) - 0.05 * p @ jnp.sin(q)
"""

SMALL = """
system = "own.py:system"
h = 0.1
invariants = "own.py:energy"
epsilon = [0.0, 0.1]
[domain]
low = {q = [-0.5], p = -0.5}
high = {q = [0.5], p = 0.5}
[bound]
change = 1e-4
max_boxes = 200
[output]
dir = "out"
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    write(tmp_path, OWN, "own.py")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.slow
def test_the_example(folder):
    examples = Path(__file__).parents[1] / "examples"
    for name in ("bound.toml", "proved.py"):
        shutil.copy(examples / name, folder)
    result = command("bound", "bound.toml")
    assert result.exit_code == 0, result.output
    assert "no trajectory that starts in the domain with I_0" in result.output
    assert command("verify", "results/bound/certificate.json").exit_code == 0


def test_a_small_proof(folder):
    """The energy of the map is conserved exactly: only the rounding changes it."""
    contents = found("bound", write(folder, SMALL))
    assert contents["per_step"] == [0.0]
    assert 1e-17 < contents["rounding"][0] < 1e-15
    assert contents["steps"] > 1e11
    assert names(folder / "out") == {"bound.json", "certificate.json"}
    assert command("verify", "out/certificate.json").exit_code == 0
    path = folder / "out" / "certificate.json"
    content = json.loads(path.read_text())
    content["h"] = (0.2).hex()
    path.write_text(json.dumps(content))
    assert command("verify", "out/certificate.json").exit_code == 1


def test_no_epsilon_without_a_perturbation(folder):
    text = SMALL.replace("epsilon = [0.0, 0.1]", "").replace("energy", "pair")
    assert found("bound", write(folder, text))["per_step"] == [0.0]
    refuses(
        command("bound", write(folder, text.replace("own.py:system", "own.py:kicked"))), "epsilon"
    )


def test_an_angle(folder):
    text = SMALL.replace("epsilon = [0.0, 0.1]", "").replace("energy", "rotation")
    text = text.replace("own.py:system", "own.py:rotor").replace("1e-4", "0.1")
    angle = text.replace("[domain]", "[domain]\nperiodic = [true]")
    refuses(command("bound", write(folder, angle)), "domain of the angle q1 must be a whole turn")
    contents = found("bound", write(folder, angle.replace("0.5]", "3.2]").replace("0.5}", "3}")))
    assert contents["level"][1] > 1
    assert command("verify", "out/certificate.json").exit_code == 0


def test_nothing_is_proved_at_a_singularity(folder):
    result = command("bound", write(folder, SMALL.replace("energy", "singular")))
    assert result.exit_code == 1
    assert "nothing is proved: no bound was found on " in result.output


@pytest.mark.parametrize("text", ["no JSON", "[]", '{"status": "converged"}', "é\x00"])
def test_a_file_that_is_not_a_certificate(folder, text):
    path = write(folder, text, "fit.json")
    refuses(command("verify", path), f"{path} is not a certificate", "DriftBound.save")


@pytest.mark.parametrize(
    ("old", "new", "seen"),
    [
        ("low = {q = [-0.5]", "low = {q = [0.7]", "it is not below domain.high"),
        ("[0.0, 0.1]", "[0.1, 0.1]", "epsilon"),
        ("change = 1e-4", "ratio = 0.5", "bound.ratio"),
    ],
)
def test_bad_input(folder, old, new, seen):
    refuses(command("bound", write(folder, SMALL.replace(old, new))), seen)
