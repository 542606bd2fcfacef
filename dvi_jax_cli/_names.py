"""Names that a shell completes, listed here since reading them from the package imports JAX.

`tests/test_cli.py` compares them with the package.
"""

from collections.abc import Sequence
from typing import Any

SYSTEMS = (
    "oscillator", "duffing", "van_der_pol", "slow_oscillator", "pendulum", "perturbed_pendulum",
    "lorentz_pendulum", "double_pendulum", "kepler", "relativistic_kepler", "oblate_kepler",
    "two_centres", "restricted_three_body", "hill", "n_body", "figure_eight", "solar_system",
    "henon_heiles", "toda", "fput", "stiff_fput", "nls_lattice", "uniform_field",
    "magnetic_mirror", "dipole_field", "rigid_body", "spinning_top", "polar_motion",
    "lotka_volterra",
)  # fmt: skip
"""Systems of the library."""

METHODS = (
    "TypeII", "Adjoint", "Strang", "StrangOfAdjoint", "Composition2", "TripleOfStrang",
    "Yoshida4", "Yoshida6", "Yoshida8", "Suzuki4", "BlanesMoan4", "BlanesMoan6", "McLachlan4",
    "McLachlan6", "McLachlan8", "KahanLi6", "KahanLi8", "GaussLegendre1", "GaussLegendre2",
    "GaussLegendre3", "GaussLegendre4", "LobattoIIIAIIIB2", "LobattoIIIAIIIB3",
    "LobattoIIIAIIIB4", "RungeKutta4",
)  # fmt: skip
"""Methods that are certified, as `dvi-jax certify --method` takes them."""

CHECKS = (
    "order", "forced-order", "symplecticity", "reversal", "adjoint", "energy", "momentum",
    "gradient", "modes", "jit", "vmap", "failure", "traces",
)  # fmt: skip
"""Checks of a certificate, as `dvi-jax certify --check` takes them."""

FILES = ("run", "sweep", "fit", "discover")
"""Kinds of TOML files."""

WORKLOADS = ("single", "batch", "implicit", "gradient")
"""Rows of `dvi-jax bench`."""

EXTRAS = {
    "cuda12": ("jax_cuda12_plugin",),
    "cuda13": ("jax_cuda13_plugin",),
    "distributed": ("distributed",),
    "bayes": ("numpyro",),
    "export": ("h5netcdf", "h5py", "pyarrow"),
    "ephemeris": ("jplephem", "skyfield_data"),
    "interop": ("astropy", "diffrax", "rebound", "scipy"),
}
"""Extra of the package → modules that it brings."""


def completer(names: Sequence[str]) -> dict[str, Any]:
    """The arguments of an option of typer that takes one of these names, or none."""

    def complete(incomplete: str) -> list[str]:
        return [name for name in names if name.startswith(incomplete)]

    return {"autocompletion": complete, "show_default": False}
