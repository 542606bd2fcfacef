"""Runs and sweeps from TOML files: what is in them, the integration, the report."""

from ._errors import InputError as InputError
from ._library import library_tables as library_tables
from ._run import run_file as run_file
from ._sweep import (
    sweep_cost as sweep_cost,
    sweep_file as sweep_file,
    sweep_status as sweep_status,
    verify_store as verify_store,
)
