"""Common parts of the tests of the command line."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

import dvi_jax as dvi
from dvi_jax_cli import app
from dvi_jax_cli.work.table import TomlTable

ROOT = Path(dvi.__file__).parent.parent
EXAMPLES = ROOT / "examples"
MAIN = "from dvi_jax_cli import main; main()"
ELSEWHERE = ("state", "args", "t0", "lattice", "plots", "ring", "force")
"""Keys that one example shows for all kinds of files."""


def command(*words, **settings):
    """A command in this process."""
    return CliRunner().invoke(app, [str(w) for w in words], **settings)


def process(code, *words, folder=None, **environment):
    """A process of its own, in which nothing has been imported."""
    return subprocess.run(
        [sys.executable, "-c", code, *map(str, words)],
        capture_output=True,
        text=True,
        check=False,
        cwd=folder,
        timeout=60,
        env=os.environ | {"PYTHONPATH": str(ROOT)} | environment,
    )


def found(*words, code=0):
    """The strict JSON object that a command prints, and its exit code."""
    result = command(*words, "--json")
    assert result.exit_code == code, result.output
    return json.loads(result.stdout, parse_constant=pytest.fail)


def refuses(result, seen, allowed=""):
    """Bad input: the key and what was seen, what is allowed, no traceback."""
    assert result.exit_code == 2, result.output
    assert result.stdout == ""
    assert seen in result.stderr, result.stderr
    assert allowed in result.stderr.partition("allowed: ")[2], result.stderr
    assert "Traceback" not in result.stderr
    assert isinstance(result.exception, SystemExit)


def write(folder, text, name="file.toml"):
    (folder / name).write_text(text, encoding="utf-8")
    return folder / name


def read(path):
    return json.loads(Path(path).read_text(encoding="utf-8"))


def names(folder):
    """The names of the files in a folder."""
    return {path.name for path in Path(folder).iterdir()}


def keys_not_in(text, model):
    """Keys of a kind of file, and of its tables, that an example does not show."""
    missing = []
    for key, field in model.model_fields.items():
        if key not in ELSEWHERE and f"{key} = " not in text and f"[{key}]" not in text:
            missing.append(key)
        kind = field.annotation
        if key not in ELSEWHERE and isinstance(kind, type) and issubclass(kind, TomlTable):
            missing += keys_not_in(text, kind)
    return missing
