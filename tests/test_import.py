"""What importing the package costs: it takes JAX and Equinox, and leaves the rest for later."""

import subprocess
import sys

LATER = (
    "optax", "optimistix", "lineax", "matplotlib", "scipy", "xarray", "zarr", "rich", "typer",
    "numpyro", "distributed", "diffrax", "rebound", "astropy", "arviz", "jplephem", "sympy",
)  # fmt: skip
"""Each of these is imported by the function that needs it."""


def imported(code):
    found = f"{code}; import sys; print(*[m for m in {LATER!r} if m in sys.modules])"
    out = subprocess.run(
        [sys.executable, "-c", found], capture_output=True, text=True, check=False, timeout=120
    )
    assert out.returncode == 0, out.stderr
    return out.stdout.split()


def test_importing_takes_only_what_every_program_needs():
    assert imported("import dvi_jax, dvi_jax.systems") == []
    assert imported("import dvi_jax.plot") == ["matplotlib"]  # and so it would be seen
