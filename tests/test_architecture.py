"""Imports run downward only and cost little, and the public names exist."""

import ast
import inspect
import json
import re
import subprocess
import sys
import types
from collections.abc import Iterator
from pathlib import Path

import conftest
import pytest

import dvi_jax as dvi
from dvi_jax import _namespaces

ROOT = Path(dvi.__file__).parent
STAIR = [
    *(["base"], ["engine"], ["problem"], ["methods"], ["observe"], ["lattices"], ["integration"]),
    *(["discover"], ["sweep", "fit", "proof"], ["dynamics"]),
    *(
        ["systems", "plot"],
        ["explorer"],
        ["_namespaces"],
        ["__init__"],
        ["testing"],
        ["interop"],
        ["__main__"],
    ),
]
"""Folders and files of `dvi_jax`, each with imports from those before it only."""

STEP = {folder: i for i, folders in enumerate(STAIR) for folder in folders}
FILES = sorted(ROOT.rglob("*.py"))
LANEWISE = sorted((ROOT.parent / "lanewise").rglob("*.py"))
COMMAND_LINE = sorted(
    path for path in (ROOT.parent / "dvi_jax_cli").rglob("*.py") if "templates" not in path.parts
)
HEAVY = {"dvi_jax", "jax", "numpy", "matplotlib", "equinox", "pydantic"}
WORK = "work"
"""Folder of the command line with the files that a command imports when it runs."""

MOVING = ("jax._src", "jax.interpreters", "jax.extend", "jax.core")
"""Names of JAX that change between releases."""


LATER = (
    "optax", "optimistix", "lineax", "matplotlib", "scipy", "xarray", "zarr", "rich", "typer",
    "numpyro", "distributed", "diffrax", "rebound", "astropy", "arviz", "jplephem", "sympy",
    "pydantic", "panel", "bokeh",
)  # fmt: skip
"""Each of these is imported by the function that needs it."""


def test_texts_give_the_number_of_folders():
    count = sum(path.is_dir() and path.name != "__pycache__" for path in ROOT.iterdir())
    word = {16: "sixteen", 17: "seventeen", 18: "eighteen", 19: "nineteen"}[count]
    for name in ("docs/decisions.md", "CONTRIBUTING.md"):
        text = (ROOT.parent / name).read_text(encoding="utf-8")
        assert f"`dvi_jax` has {word} folders" in text, name


def process(code: str) -> str:
    """What a new process prints."""
    command = [sys.executable, "-c", code]
    out = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert out.returncode == 0, out.stderr
    return out.stdout


def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


def imported_modules(path: Path) -> Iterator[str]:
    """The full name of all that a file imports, also for type checkers."""
    package = (*path.relative_to(ROOT.parent).with_suffix("").parts[:-1],)
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            start = [*base, *([node.module] if node.module else [])]
            yield from (".".join([*start, alias.name]) for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


def step_of(module: str) -> str:
    """Folder or file of `dvi_jax` that an imported name is in."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 and parts[1] in STEP else "__init__"


def upward(path: Path) -> Iterator[str]:
    """Imports of a file of `dvi_jax` that do not run downward."""
    here = path.relative_to(ROOT).with_suffix("").parts[0]
    for module in imported_modules(path):
        there = step_of(module)
        if module.split(".")[0] == "dvi_jax" and there != here and STEP[there] >= STEP[here]:
            yield f"{path.relative_to(ROOT)} imports {module}"


def test_imports_run_downward():
    assert {path.relative_to(ROOT).with_suffix("").parts[0] for path in FILES} == set(STEP)
    assert [line for path in FILES for line in upward(path)] == []


def test_an_import_that_runs_upward_is_seen(monkeypatch):
    monkeypatch.setitem(STEP, "base", STEP["integration"])
    assert any("base" in line for path in FILES for line in upward(path))


def test_first_line_says_what_a_file_is():
    docstrings = {
        path: (ast.get_docstring(parsed(path)) or "").split("\n")[0]
        for path in (*FILES, *LANEWISE, *COMMAND_LINE)
    }
    assert [path for path, line in docstrings.items() if not line.endswith(".")] == []


def test_command_line_imports_the_package_within_its_commands_alone():
    """And of it public modules only. The files in `work` are imported by a command that runs."""
    early, private = [], []
    for path in COMMAND_LINE:
        tree = parsed(path)
        for node in ast.walk(tree):
            in_work = str(getattr(node, "module", "")).split(".")[0] == WORK
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and (in_work or not node.level):
                names = [str(node.module)]
            else:
                continue
            for name in names:
                first, *inner = name.split(".")
                private += [(path.name, name) for part in inner if part.startswith("_")]
                at_work = path.parent.name == WORK or path.name == "run.py"
                if first in {*HEAVY, WORK} and not at_work and node in tree.body:
                    early.append((path.name, name))
    assert (early, private) == ([], [])


def test_lanewise_imports_nothing_of_this_package():
    names = {name.split(".")[0] for path in LANEWISE for name in imported_modules(path)}
    assert not {"dvi_jax", "dvi_jax_cli"} & names


def test_names_of_jax_that_move_are_imported_in_one_file():
    def moves(name: str) -> bool:
        return any(f"{name}.".startswith(f"{moving}.") for moving in MOVING)

    files = (*LANEWISE, *FILES)
    users = {path for path in files if any(map(moves, imported_modules(path)))}
    assert users == {ROOT.parent / "lanewise" / "jaxprs" / "jaxapi.py"}
    attributes = [
        (path.name, ast.unparse(node))
        for path in files
        for node in ast.walk(parsed(path))
        if isinstance(node, ast.Attribute) and ast.unparse(node) in MOVING
    ]
    assert attributes == []


GLOBALS = """
import json
import jax, jax.numpy, jax.scipy.linalg, equinox, optimistix, lineax, optax
from jax._src.interpreters.batching import fancy_primitive_batchers
from jax.interpreters import ad, mlir, partial_eval

TABLES = {
    "dead code": partial_eval.dce_rules, "batching": fancy_primitive_batchers,
    "forward": ad.primitive_jvps, "transposes": ad.primitive_transposes,
    "lowering": mlir._lowerings, "lowering on a CPU": mlir._platform_specific_lowerings["cpu"],
    "partial evaluation": partial_eval.custom_partial_eval_rules,
}
CONFIGURED = ("jax_enable_x64", "jax_numpy_rank_promotion", "jax_default_matmul_precision",
              "jax_compilation_cache_dir", "jax_debug_nans")

def state():
    tables = {name: dict(table) for name, table in TABLES.items()}
    return tables, {name: getattr(jax.config, name) for name in CONFIGURED}

before, settings = state()
import dvi_jax, dvi_jax.systems
after, settings_after = state()
assert settings == settings_after
new = {}
for name, table in before.items():
    assert all(after[name][p] is rule for p, rule in table.items()), name
    new[name] = sorted({p.name for p in after[name]} - {p.name for p in table})
print(json.dumps(new))
"""


def test_importing_changes_no_rule_of_a_primitive_of_jax():
    """Rules are added for primitives of lanewise only, and no setting is changed."""
    new = json.loads(process(GLOBALS))
    own = {"lanewise", "eliminate", "unit_vectors", "least_over_lanes"}
    own |= {"linear_map", "implicit_root", "with_derivative", "rounded_product"}
    own |= {"lost_by_product", "with_change", "constant_unless"}
    assert new["dead code"] == ["lanewise", "with_change"]  # none for a loop of JAX
    assert "lanewise" in new["batching"]  # what is looked for can be found
    assert {name for names in new.values() for name in names} <= own


def imported(code: str) -> list[str]:
    return process(
        f"{code}; import sys; print(*[m for m in {LATER!r} if m in sys.modules])"
    ).split()


def test_importing_takes_only_what_every_program_needs():
    assert imported("import dvi_jax, dvi_jax.systems") == []
    assert imported("import dvi_jax.plot") == ["matplotlib"]  # and so it would be seen
    assert "pydantic" in imported("import dvi_jax.run")


def test_nothing_imports_the_command_line():
    users = [path for path in FILES if any("dvi_jax_cli" in m for m in imported_modules(path))]
    assert users == [ROOT / "__main__.py"]


def test_public_names_exist_and_are_documented():
    undocumented = [name for name in _namespaces.names() if not getattr(dvi, name).__doc__]
    assert undocumented == []
    assert {"System", "integrate", "discover_invariants", "sweep"} <= {*_namespaces.names()}
    assert {"KahanLi", "Langevin", "rings", "integrate"} <= {*dir(dvi)}
    assert not {*_namespaces.ALIASES, "over_threads"} & {*dir(dvi)}


def test_every_alias_is_listed_and_means_its_name():
    page = (ROOT.parent / "docs" / "migration.md").read_text(encoding="utf-8")
    table = page.split("## Aliases")[1].split("##")[0]
    rows = [line.split("|")[1:3] for line in table.splitlines() if line.startswith("| `")]
    listed = {
        alias: re.findall(r"`dvi\.(\w+)`", meant)[0]
        for aliases, meant in rows
        for alias in re.findall(r"`dvi\.(\w+)`", aliases)
    }
    assert listed == _namespaces.ALIASES
    for alias, name in _namespaces.ALIASES.items():
        assert getattr(dvi, alias) is getattr(dvi, name)


def test_type_checkers_and_programs_see_the_same_names():
    """Type checkers read `from .discover import *`, programs the list of `_namespaces`."""
    for folder, names in _namespaces.HOMES.items():
        package = getattr(dvi, {"fit": "fitting", "sweep": "sweeps"}.get(folder, folder))
        public = {
            name
            for name, thing in vars(package).items()
            if not name.startswith("_") and not isinstance(thing, types.ModuleType)
        }
        assert set(names) <= public
        assert all(inspect.isclass(getattr(package, name)) for name in public - set(names))


def test_packages_are_attributes_in_a_fresh_process():
    """They are imported when they are used, and not before; the command line knows their names."""
    code = """
import sys, dvi_jax as dvi
from dvi_jax import _namespaces
assert not any(f"dvi_jax.{n}" in sys.modules for n in ("plot", "systems", "interop", "testing"))
for name, package in _namespaces.NAMESPACES.items():
    assert name in dir(dvi), name
    assert getattr(dvi, name) is sys.modules[package], name
import dvi_jax.rings, dvi_jax.run
from dvi_jax.noise import Langevin
assert dvi_jax.rings is dvi.systems.rings and Langevin is dvi.Langevin
assert dvi_jax.rings.__spec__.name == dvi_jax.rings.__name__ == "dvi_jax.systems.rings"
from dvi_jax.fit import Model  # the package has the name of the function
assert dvi.fitting.Prior is dvi.Prior and callable(dvi.fit) and callable(dvi.sweep)
try:
    dvi.plots
except AttributeError as error:
    assert "no attribute 'plots'" in str(error), error
else:
    raise AssertionError
from dvi_jax_cli.work.expressions import public
from dvi_jax.discover import AbstractBasis
assert {"Polynomials", "Radial"} <= public(AbstractBasis).keys()
"""
    process(code)


def test_an_invalid_part_is_refused():
    assert conftest.part_of("3/4") == (3, 4)
    for text in ("0/4", "5/4", "x/4", "2"):
        with pytest.raises(pytest.UsageError, match="such as 1/4, got"):
            conftest.part_of(text)


def test_every_file_of_long_tests_is_in_one_part():
    files = dict.fromkeys(sorted(conftest.SECONDS), 3) | {f"test_new_{i}": i for i in range(20)}
    parts = conftest.in_parts(files, 4)
    assert sorted(file for part in parts for file in part) == sorted(files)
    seconds = [sum(conftest.SECONDS.get(file, 0) for file in part) for part in parts]
    assert max(seconds) < 1.3 * min(seconds)
