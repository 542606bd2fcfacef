"""Runs, sweeps, fits and discoveries from TOML files: what is in them, the work, the report."""

from ._discover import discover_file as discover_file
from ._errors import InputError as InputError
from ._fit import fit_file as fit_file
from ._library import library_tables as library_tables
from ._run import run_file as run_file
from ._sweep import (
    sweep_cost as sweep_cost,
    sweep_file as sweep_file,
    sweep_status as sweep_status,
    verify_store as verify_store,
)
