"""Public names of `dvi_jax` that are imported when they are first used."""

import difflib
import importlib
import sys
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

from .base.keywords import explain_calls as explain_calls

# Together they import matplotlib, pydantic and other libraries, which most programs do not need.
NAMESPACES = {
    **{
        name: f"dvi_jax.{name}"
        for name in (
            *("methods", "lattices", "observe", "discover", "dynamics", "proof"),
            *("systems", "plot", "explorer", "interop", "testing"),
        )
    },
    # The functions `dvi.sweep` and `dvi.fit` have the names of their folders.
    "fitting": "dvi_jax.fit",
    "sweeps": "dvi_jax.sweep",
    "elements": "dvi_jax.problem.elements",
    "flows": "dvi_jax.problem.flows",
    "forces": "dvi_jax.systems.forces",
    "noise": "dvi_jax.problem.noise",
    "paper": "dvi_jax.testing.paper",
    "rings": "dvi_jax.systems.rings",
    "generators": "dvi_jax.discover.symmetries.library",
    "starts": "dvi_jax.sweep.starts",
    "run": "dvi_jax_cli.run",
}
"""Attribute of `dvi_jax` → the module that it is."""

HOMES = {
    "discover": (
        *("AdiabaticInvariant", "Balance", "Basis", "Chebyshev", "Discovery", "DriftLaw"),
        *("DriftOrder", "DriftSurface", "Generator", "InvariantSeries", "LatticePoint"),
        *("Polynomials", "Radial", "ShadowHamiltonian", "Symmetries", "Symmetry", "Trigonometric"),
        *("conformal_factor", "determining_residual", "discover_invariants"),
        *("discrete_equations", "drift_order", "drift_surface", "find_symmetries"),
        *("lattice_defect", "noether_balance", "noether_identity", "prolong", "random_pairs"),
        *("solution_pairs", "solve_gauge"),
    ),
    "dynamics": (
        *("FREQUENCY_RESULTS", "SECTION_RESULTS", "Actions", "Frequencies", "FrequencyDiffusion"),
        *("FrequencyError", "FundamentalFrequencies", "PoincareSection", "Return", "ReturnMap"),
        *("InvariantDiffusion", "invariant_diffusion"),
        *("SectionError", "actions", "bifurcation", "frequencies", "frequency_diffusion"),
        *("fundamental_frequencies", "poincare_section", "stroboscope", "tangent_map"),
    ),
    "explorer": ("Explorer", "explore"),
    "fit": (
        *("FIT_RESULTS", "Bounds", "Cauchy", "EventTimes", "FitError", "FitProgress", "FitResult"),
        *("ForceLibrary", "Identification", "LeastSquares", "Likelihood", "Model"),
        *("MultipleShooting", "NetworkForce", "Observations", "Posterior", "Prior", "Samples"),
        *("SingleShooting", "SoftL1", "fit", "identify", "sample"),
    ),
    "proof": (
        *("DriftBound", "ExactInvariant", "NoetherProof", "ProofError", "bound_drift"),
        *("exact_coefficients", "holds_for", "prove_noether"),
    ),
    "sweep": (
        *("Axis", "ClusterError", "StoreError", "StoreMismatch", "SweepCost"),
        *("SweepInterrupted", "SweepProgress", "SweepResult", "open_sweep", "sweep"),
        "sweep_cost",
    ),
}
"""Package → names of `dvi_jax` that are imported from it at their first use."""

LAZY = {name: package for package, names in HOMES.items() for name in names}
"""Name of `dvi_jax` → the package that has it."""

ALIASES = {
    "Chord": "SimplifiedNewton",
    "Event": "Stop",
    "Leapfrog": "Strang",
    "LinearTrend": "Trend",
    "PeakToPeak": "Range",
    "RK4": "RungeKutta4",
    "SaveAt": "Save",
    "StormerVerlet": "Strang",
    "SymplecticEuler": "TypeII",
    "naff": "frequencies",
}
"""Other names of public objects: terms of the field and of other packages. The table in
docs/migration.md lists them."""


def names() -> list[str]:
    """All names of `dvi_jax` that are objects, aliases left out."""
    package = sys.modules["dvi_jax"]
    attributes = {n for n, thing in vars(package).items() if not isinstance(thing, ModuleType)}
    return sorted(n for n in {*attributes, *LAZY} - {*ALIASES} if not n.startswith("_"))


_FOREIGN_NAMES = {
    **dict.fromkeys(("Verlet", "VelocityVerlet"), "StormerVerlet"),
    **dict.fromkeys(("odeint", "solve", "simulate", "diffeqsolve"), "integrate"),
    **{"discretize": "discretise", "TimeGrid": "Uniform"},
}
"""Names in other packages → the name here."""


def _hint(name: str) -> str:
    if name in _FOREIGN_NAMES:
        return f" Did you mean {_FOREIGN_NAMES[name]!r}?"
    for space in () if name.startswith("_") else ("systems", "rings", "plot"):
        if hasattr(importlib.import_module(NAMESPACES[space]), name):
            return f" Did you mean 'dvi_jax.{space}.{name}'?"
    candidates = {*names(), *ALIASES, *NAMESPACES}
    close = difflib.get_close_matches(name, candidates, 1, 0.7)
    return f" Did you mean {close[0]!r}?" if close else " dir(dvi_jax) lists them."


class Package(ModuleType):
    """Class of the module `dvi_jax`."""

    def __getattr__(self, name: str):
        if name in NAMESPACES:
            module = importlib.import_module(NAMESPACES[name])
            explain_calls(module)
            return module
        if name in ALIASES:
            value = getattr(self, ALIASES[name])
        elif name in LAZY:
            module = importlib.import_module(f"{self.__name__}.{LAZY[name]}")
            explain_calls(module)
            value = getattr(module, name)
        else:
            raise AttributeError(
                f"module {self.__name__!r} has no attribute {name!r}.{_hint(name)}", name=name
            )
        # Stored in the module: `__getattr__` is called for missing names only, so once for each.
        setattr(self, name, value)
        return value

    def __setattr__(self, name: str, value: object) -> None:
        if isinstance(value, ModuleType) and name in {*NAMESPACES, *HOMES}:
            explain_calls(value)
        # An import of the package `dvi_jax.fit` would hide the function `dvi_jax.fit`.
        if not (isinstance(value, ModuleType) and name in LAZY):
            super().__setattr__(name, value)

    def __dir__(self) -> list[str]:
        return sorted({*names(), *NAMESPACES, "__version__", "__doc__", "__file__", "__path__"})


class Folders(MetaPathFinder, Loader):
    """Finder of `import dvi_jax.rings`: the module that `NAMESPACES` names, not a second copy."""

    def __init__(self) -> None:
        self._specs: dict[str, ModuleSpec | None] = {}

    def find_spec(self, fullname: str, path=None, target=None) -> ModuleSpec | None:
        # Submodules as well: Python would load `dvi_jax.rings._track` a second time from the path
        # of `dvi_jax.rings`, with classes that differ from those of the first.
        package, _, name = fullname.partition(".")
        first, _, _ = name.partition(".")
        is_alias = NAMESPACES.get(first, f"dvi_jax.{first}") != f"dvi_jax.{first}"
        return ModuleSpec(fullname, self) if package == "dvi_jax" and is_alias else None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        _, first, *inner = spec.name.split(".")
        module = importlib.import_module(".".join([NAMESPACES[first], *inner]))
        self._specs[module.__name__] = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        """Nothing: the module has been executed. The import system has replaced its `__spec__`."""
        module.__spec__ = self._specs.pop(module.__name__)
