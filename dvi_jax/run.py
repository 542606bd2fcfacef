"""Runs, sweeps, fits and discoveries from TOML files: the work of the command line.

Nothing in the package imports this module, so that `import dvi_jax` does not import pydantic.
"""

from dvi_jax_cli._errors import InputError as InputError
from dvi_jax_cli.work.discover import discover_file as discover_file
from dvi_jax_cli.work.fit import fit_file as fit_file
from dvi_jax_cli.work.library import library_tables as library_tables
from dvi_jax_cli.work.run import run_file as run_file
from dvi_jax_cli.work.sweep import (
    sweep_cost as sweep_cost,
    sweep_file as sweep_file,
    sweep_status as sweep_status,
    verify_store as verify_store,
)
