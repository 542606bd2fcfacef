"""Imports run downward only, and the public names are there."""

import ast
from pathlib import Path

import pytest

import dvi_jax as dvi

ROOT = Path(dvi.__file__).parent
FLOORS = [
    ["_compat", "_types", "_results"],
    ["_precision", "_progress"],
    ["engine"],
    ["_system", "_solution"],
    ["_discretise", "_adapters", "_energies", "_step"],
    ["methods", "lattices", "symmetry", "observe"],
    ["_arithmetic"],
    ["_rollout", "_extended", "_dense"],
    ["_segments"],
    ["_adjoints"],
    ["_reversible"],
    ["_integrate"],
    ["invariants", "sweep", "fit"],
    ["dynamics"],
    ["__init__", "systems", "plot"],
    ["paper", "run", "certify"],
    ["interop"],
    ["__main__"],
]
FLOOR = {room: i for i, rooms in enumerate(FLOORS) for room in rooms}
DOOR_ONLY = {"paper", "run", "certify", "interop"}
"""Leaves: of the package they use the public door and other leaves, no private room."""


def room_of(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return parts[0]


def imported_rooms(path: Path):
    """(room, name of what is imported) for every import of the package by the file."""
    package = ("dvi_jax", *path.relative_to(ROOT).with_suffix("").parts[:-1])
    for node in ast.walk(ast.parse(path.read_text())):
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


COMMAND_LINE = sorted((ROOT.parent / "dvi_jax_cli").glob("*.py"))
HEAVY = {"dvi_jax", "jax", "numpy", "matplotlib", "equinox"}
WORK = {"_bench"}
"""Files of the command line that a command imports when it runs."""


@pytest.mark.parametrize("path", COMMAND_LINE, ids=lambda p: p.name)
def test_command_line_imports_the_package_within_its_commands_alone(path):
    """And of it the public door and the other leaves, no private room."""
    tree = ast.parse(path.read_text())
    assert ast.get_docstring(tree).splitlines()[0].endswith(".")
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and not node.level:
            names = [node.module]
        else:
            continue
        for name in names:
            assert not any(part.startswith("_") for part in name.split(".")[1:]), name
            if name.split(".")[0] in HEAVY and path.stem not in WORK:
                assert node not in tree.body, f"{path.name} imports {name} before it runs"


def test_nothing_imports_the_command_line():
    for path in FILES:
        if path.name != "__main__.py":
            assert "dvi_jax_cli" not in path.read_text(), path


def test_door_has_no_logic():
    tree = ast.parse((ROOT / "__init__.py").read_text())
    assert all(isinstance(n, ast.ImportFrom | ast.Expr | ast.Assign) for n in tree.body)


PUBLIC = """
System discretise integrate Save Solution RESULTS IntegrationError Newton
RootSolver SimplifiedNewton Picard PicardThenNewton
legendre from_lagrangian from_type_iii velocity_force Layout configure_cpu over_threads over_devices
TypeII Adjoint Strang Yoshida Suzuki BlanesMoan McLachlan KahanLi Composition
GaussLegendre LobattoIIIAIIIB RungeKutta4
Uniform Given TimeTransformed Variational FloatingPoint Compensated FixedPoint
Section Stop Crossings LatticeCondition
Deviations TangentMap LyapunovSpectrum MEGNO GALI SALI Running
MaxDrift Range Trend Mean Last Reversible Checkpointed Direct
Generator prolong determining_residual conformal_factor noether_identity AdiabaticInvariant
generators random_pairs solution_pairs find_symmetries Symmetries Symmetry
Polynomials Basis Chebyshev Radial Trigonometric
discover_invariants InvariantSeries ShadowHamiltonian drift_order drift_surface
noether_balance solve_gauge
sweep Axis starts open_sweep SweepResult SweepProgress SweepInterrupted StoreError StoreMismatch
ClusterError sweep_cost SweepCost
fit Model Observations Bounds Prior LeastSquares SoftL1 Cauchy Likelihood
SingleShooting MultipleShooting FitResult FitProgress FIT_RESULTS FitError
Posterior Samples sample
tangent_map poincare_section PoincareSection SECTION_RESULTS SectionError ReturnMap Return
bifurcation stroboscope frequencies Frequencies FREQUENCY_RESULTS FrequencyError
fundamental_frequencies FundamentalFrequencies frequency_diffusion FrequencyDiffusion
actions Actions
ForceLibrary identify Identification NetworkForce
"""


@pytest.mark.parametrize("name", PUBLIC.split())
def test_public_name_is_documented(name):
    assert getattr(dvi, name).__doc__
