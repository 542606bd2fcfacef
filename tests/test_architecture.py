"""Imports run downward only, and the public names are there."""

import ast
import json
import subprocess
import sys
from pathlib import Path

import conftest
import measures
import pytest

import dvi_jax as dvi
from dvi_jax import _namespaces

ROOT = Path(dvi.__file__).parent
FLOORS = [
    ["base"],
    ["engine"],
    ["problem"],
    ["methods"],
    ["observe"],
    ["lattices"],
    ["integration"],
    ["discover"],
    ["sweep", "fit", "proof"],
    ["dynamics"],
    ["_namespaces"],
    ["__init__", "systems", "plot", "symmetry", "invariants"],
    ["testing"],
    ["interop"],
    ["run", "__main__"],
]
FLOOR = {room: i for i, rooms in enumerate(FLOORS) for room in rooms}
DOOR_ONLY = {"testing", "interop"}
"""Leaves: of the package they use the public door and other leaves, no private room."""


def room_of(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return parts[0]


def imported_rooms(path: Path):
    """(room, name of what is imported) for every import of the package by the file."""
    package = ("dvi_jax", *path.relative_to(ROOT).with_suffix("").parts[:-1])
    for node in measures.run_nodes(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            target = [*base, *(node.module or "").split(".")] if node.module else list(base)
            if target[:1] != ["dvi_jax"]:
                continue
            for alias in node.names:
                full = [*target, alias.name]
                yield (full[1] if full[1] in FLOOR else "__init__"), ".".join(full)
        elif isinstance(node, ast.Import):
            for alias in node.names:
                parts = alias.name.split(".")
                if parts[0] == "dvi_jax":
                    yield (parts[1] if len(parts) > 1 else "__init__"), alias.name


FILES = sorted(ROOT.rglob("*.py"))


def test_every_file_has_a_floor():
    assert {room_of(f) for f in FILES} <= set(FLOOR)
    assert len(FILES) > 20


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_run_downward(path):
    here = room_of(path)
    for room, name in imported_rooms(path):
        if room == here:
            continue
        assert FLOOR[room] < FLOOR[here], f"{path.name} (floor {FLOOR[here]}) imports {name}"
        if here in DOOR_ONLY:
            assert not room.startswith("_") or room == "__init__", f"{path.name} imports {name}"


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_first_line_says_what_the_file_is(path):
    docstring = ast.get_docstring(ast.parse(path.read_text()))
    assert docstring
    assert docstring.splitlines()[0].endswith(".")


COMMAND_LINE = sorted(
    p for p in (ROOT.parent / "dvi_jax_cli").rglob("*.py") if "templates" not in p.parts
)
HEAVY = {"dvi_jax", "jax", "numpy", "matplotlib", "equinox", "pydantic"}
WORK = "work"
"""Folder of the command line with the files that a command imports when it runs."""


@pytest.mark.parametrize("path", COMMAND_LINE, ids=lambda p: p.name)
def test_command_line_imports_the_package_within_its_commands_alone(path):
    """And of it public modules only. The files in `work` are imported by a command that runs."""
    tree = ast.parse(path.read_text())
    assert ast.get_docstring(tree).splitlines()[0].endswith(".")
    for node in ast.walk(tree):
        of_work = str(getattr(node, "module", "")).split(".")[0] == WORK
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and (of_work or not node.level):
            names = [node.module]
        else:
            continue
        for name in names:
            assert not any(part.startswith("_") for part in name.split(".")[1:]), name
            if name.split(".")[0] in {*HEAVY, WORK} and path.parent.name != WORK:
                assert node not in tree.body, f"{path.name} imports {name} before it runs"


LANEWISE = sorted((ROOT.parent / "lanewise").rglob("*.py"))
MOVING = ("jax._src", "jax.interpreters", "jax.extend", "jax.core")
"""Names of JAX that change between releases."""


def imported_modules(path: Path):
    """The full name of all that a file imports from other packages."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and not node.level:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


@pytest.mark.parametrize("path", LANEWISE, ids=lambda p: p.name)
def test_lanewise_imports_nothing_of_this_package(path):
    names = [name.split(".")[0] for name in imported_modules(path)]
    assert not {"dvi_jax", "dvi_jax_cli"} & set(names)
    docstring = ast.get_docstring(ast.parse(path.read_text()))
    assert docstring
    assert docstring.splitlines()[0].endswith(".")


def names_that_move(path: Path) -> list[str]:
    return [
        name
        for name in imported_modules(path)
        if any(f"{name}.".startswith(f"{moving}.") for moving in MOVING)
    ]


def test_names_of_jax_that_move_are_imported_in_one_file():
    users = [path for path in (*LANEWISE, *FILES) if names_that_move(path)]
    assert users == [ROOT.parent / "lanewise" / "jaxprs" / "jaxapi.py"]
    attributes = [
        (path.name, ast.unparse(node))
        for path in (*LANEWISE, *FILES)
        for node in ast.walk(ast.parse(path.read_text()))
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
    out = subprocess.run(
        [sys.executable, "-c", GLOBALS], capture_output=True, text=True, check=False, timeout=120
    )
    assert out.returncode == 0, out.stderr
    new = json.loads(out.stdout)
    own = {"lanewise", "eliminate", "unit_vectors", "least_over_lanes"}
    own |= {"linear_map", "implicit_root", "rounded_product", "lost_by_product"}
    assert new["dead code"] == ["lanewise"]  # none for a loop of JAX
    assert "lanewise" in new["batching"]  # what is looked for can be found
    assert {name for names in new.values() for name in names} <= own


def test_nothing_imports_the_command_line():
    for path in FILES:
        if path.relative_to(ROOT).as_posix() not in ("__main__.py", "run.py"):
            assert "dvi_jax_cli" not in path.read_text(), path


def test_importing_the_package_does_not_import_pydantic():
    code = "import sys, dvi_jax; assert 'pydantic' not in sys.modules, 'imported'"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert out.returncode == 0, out.stderr
    code = "import sys, dvi_jax.run; assert 'pydantic' not in sys.modules, 'imported'"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "imported" in out.stderr  # the control: it would be found


def test_door_has_no_logic():
    tree = ast.parse((ROOT / "__init__.py").read_text())
    nodes = [
        inner
        for node in tree.body
        for inner in (node.body + node.orelse if isinstance(node, ast.If) else [node])
    ]
    assert all(isinstance(n, ast.Import | ast.ImportFrom | ast.Expr | ast.Assign) for n in nodes)
    tests = [ast.unparse(node.test) for node in tree.body if isinstance(node, ast.If)]
    assert tests == ["TYPE_CHECKING"]


PUBLIC = """
System discretise integrate Save Solution RESULTS IntegrationError Newton
RootSolver SimplifiedNewton Picard PicardThenNewton
legendre from_lagrangian from_type_iii velocity_force Implicit
Layout configure_cpu over_threads over_devices
TypeII Adjoint Strang Yoshida Suzuki BlanesMoan McLachlan KahanLi Composition
GaussLegendre LobattoIIIAIIIB RungeKutta4 Split Splitting WisdomHolman
Rattle project Projection ConstraintForce
Uniform Given AdaptiveReversible TimeTransformed Variational
FloatingPoint Compensated DoubleDouble FixedPoint
Section Stop Crossings LatticeCondition
Deviations TangentMap LyapunovSpectrum MEGNO GALI SALI Running
MaxDrift Range Trend Mean Last Reversible Checkpointed Direct
Generator prolong determining_residual conformal_factor noether_identity AdiabaticInvariant
generators random_pairs solution_pairs find_symmetries Symmetries Symmetry
Polynomials Basis Chebyshev Radial Trigonometric
discover_invariants InvariantSeries ShadowHamiltonian drift_order drift_surface
noether_balance solve_gauge
bound_drift DriftBound ProofError ExactInvariant exact_coefficients prove_noether NoetherProof
sweep Axis starts open_sweep SweepResult SweepProgress SweepInterrupted StoreError StoreMismatch
ClusterError sweep_cost SweepCost
fit Model Observations Bounds Prior LeastSquares SoftL1 Cauchy Likelihood
SingleShooting MultipleShooting FitResult FitProgress FIT_RESULTS FitError
Posterior Samples sample
tangent_map poincare_section PoincareSection SECTION_RESULTS SectionError ReturnMap Return
bifurcation stroboscope frequencies Frequencies FREQUENCY_RESULTS FrequencyError
fundamental_frequencies FundamentalFrequencies frequency_diffusion FrequencyDiffusion
actions Actions
Langevin NoiseHamiltonians Brownian BrownianPath
BAOAB OBABO StochasticEuler StochasticMidpoint invariant_diffusion InvariantDiffusion
ForceLibrary identify Identification NetworkForce
"""


@pytest.mark.parametrize("name", PUBLIC.split())
def test_public_name_is_documented(name):
    assert getattr(dvi, name).__doc__


def test_packages_are_attributes_in_a_fresh_process():
    """They are imported when they are used, and not before."""
    code = """
import sys, dvi_jax as dvi
from dvi_jax import _namespaces
assert not any(f"dvi_jax.{n}" in sys.modules for n in ("plot", "systems", "interop", "testing"))
for name, package in _namespaces.NAMESPACES.items():
    assert name in dir(dvi), name
    assert getattr(dvi, name) is sys.modules[f"dvi_jax.{package}"], name
from dvi_jax.fit import Model  # the package has the name of the function
assert dvi.fitting.Prior is dvi.Prior and callable(dvi.fit) and callable(dvi.sweep)
try:
    dvi.plots
except AttributeError as error:
    assert "no attribute 'plots'" in str(error), error
else:
    raise AssertionError
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_type_checkers_and_programs_see_the_same_names():
    """`__init__.py` lists for type checkers what `_namespaces` imports at the first use."""
    tree = ast.parse((ROOT / "__init__.py").read_text())
    block = next(node for node in tree.body if isinstance(node, ast.If))
    listed = {
        node.module: {alias.asname for alias in node.names}
        for node in block.body
        if isinstance(node, ast.ImportFrom) and node.module
    }
    namespaces = {"_library", "starts", "paper"}
    objects = {home: names - namespaces for home, names in listed.items()}
    assert {home: names for home, names in objects.items() if names} == {
        home: set(names) for home, names in _namespaces.HOMES.items()
    }
    for name in _namespaces.names():
        assert getattr(dvi, name) is not None
    short = [name for name in dir(dvi) if name in {*_namespaces.names(), *_namespaces.ALIASES}]
    assert sorted(_namespaces.SHORT) == short
    assert len(short) <= 50


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
