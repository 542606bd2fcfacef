"""The README's Python blocks run as printed."""

import re
import subprocess
import sys
from pathlib import Path

import pages
import pytest
from compilation import flags_of_users

README = Path(__file__).parents[1] / "README.md"
COMMAND_LINE = README.parent / "docs" / "command-line.md"


@pytest.fixture(autouse=True)
def as_users_compile(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", flags_of_users())


def blocks(page):
    return re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.S)


def output_of(code, folder):
    """The lines that a program prints; the numbers in its comments are compared."""
    return pages.run(code, folder)


@pytest.mark.slow
def test_python_blocks_run(tmp_path):
    code = blocks(README)
    assert len(code) >= 2
    assert len(code[0].splitlines()) <= 12
    code.append("""
energy = (sol.qs**2 + sol.ps**2).ravel()
J = jax.vmap(lambda q, p: found.invariants[0].evaluate(q, p, 0.05))(sol.qs, sol.ps)
print(*(float(np.abs(x / x[0] - 1).max()) for x in (energy, J)))
print(slopes.shape, bool(np.isfinite(slopes).all()))
""")
    formula, changes, last = output_of("\n".join(code), tmp_path)
    assert formula.startswith("0.5 q² − 0.05 q p + 0.5 p² + ε (0.251256 q⁴ − 0.0502513 q³ p")
    energy, invariant = map(float, changes.split())
    assert 0.07 < energy < 0.09
    assert invariant < 5e-6
    assert last == "(8,) True"
    assert (tmp_path / "invariants.png").stat().st_size > 10_000


def test_readme_answers_the_first_questions_early():
    lines = README.read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 150
    early = "\n".join(lines[:60])
    for answer in ("It is for people who", "pip install", "```python", "overview.png"):
        assert answer in early
    assert "| package | choose it for |" in "\n".join(lines[:75])


@pytest.mark.slow
def test_the_pages_on_sweeps_and_fitting_run(tmp_path):
    (block,) = blocks(README.parent / "docs" / "sweeps.md")
    printed = output_of(block + "\nprint(result.status_counts())", tmp_path)
    assert printed == ["{'successful': 12000}"]
    block = blocks(README.parent / "docs" / "fitting.md")[0]
    code = block + "\nprint(found.status, abs(float(found.params['epsilon']) - 0.02))"
    status, distance = output_of(code, tmp_path)[-1].split()
    assert status == "converged"
    assert float(distance) < 2e-3


@pytest.mark.slow
def test_the_page_on_chaos_runs(tmp_path):
    code = "\n".join(blocks(README.parent / "docs" / "chaos.md"))
    code += "\nprint(sorted({int(n) for n in np.bincount(megno.status.values.ravel())}))"
    code = code.replace("found = dvi.sweep(", "megno = dvi.sweep(").replace(
        '"megno": dvi.MEGNO()},\n)\n', '"megno": dvi.MEGNO()},\n).to_xarray()\n'
    )
    first, points, statuses = output_of(code, tmp_path)
    assert 1.9 < float(first.split()[0]) < 2
    assert points == "[1, 2, 4, 5, 2]"
    assert len(statuses.split(",")) > 1  # some of the grid escape


def test_commands_named_exist():
    text = README.read_text(encoding="utf-8") + COMMAND_LINE.read_text(encoding="utf-8")
    makefile = (README.parent / "Makefile").read_text(encoding="utf-8")
    for target in set(re.findall(r"`make ([a-z-]+)", text)) | {"paper", "test"}:
        assert re.search(rf"^{target}:", makefile, re.M), target
    for path in re.findall(r"examples/\w+\.\w+", text):
        assert (README.parent / path).exists(), path


RUN_BY = {
    "run examples/kepler.toml": "test_run.py",
    "run examples/own_system.toml": "test_run.py",
    "run examples/solar_system.toml": "test_run.py",
    "discover examples/discover.toml": "test_cli_discover.py",
    "sweep examples/sweep.toml": "test_cli_sweep.py",
    "fit examples/fit.toml": "test_cli_fit.py",
    "bound examples/bound.toml": "test_cli_bound.py",
    "report results/kepler": "test_run.py",
    "certify --quick": "test_certify.py",
    "paper": "test_paper.py",
}
"""Commands of docs/command-line.md → the tests that run them, and look at what they give."""

COMMANDS = re.findall(r"^dvi-jax (.+?) *(?:#.*)?$", COMMAND_LINE.read_text(encoding="utf-8"), re.M)
SHORT = [command for command in COMMANDS if command not in RUN_BY]


def test_each_command_is_run_somewhere():
    assert set(RUN_BY) <= set(COMMANDS)
    for command, file in RUN_BY.items():
        text = (Path(__file__).parent / file).read_text(encoding="utf-8")
        assert command.split("/")[-1].removeprefix("certify ") in text, command


@pytest.mark.slow
@pytest.mark.parametrize("command", SHORT)
def test_short_commands_run(command, tmp_path):
    out = subprocess.run(
        [sys.executable, "-m", "dvi_jax_cli", *command.split()],
        capture_output=True, text=True, check=False, cwd=tmp_path, timeout=200,
    )  # fmt: skip
    assert out.returncode == 0, out.stderr
    assert out.stdout
    assert command.startswith("new") == bool(list(tmp_path.iterdir()))
