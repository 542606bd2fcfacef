"""Runs, sweeps, fits and discoveries from TOML files: `dvi_jax.run`.

`dvi_jax` imports this module when it is used, because it imports pydantic.
"""

from ._errors import InputError as InputError
from .work.discover import discover_file as discover_file
from .work.fit import fit_file as fit_file
from .work.html_report import html_report as html_report
from .work.library import library_tables as library_tables
from .work.run import run_file as run_file
from .work.sweep import (
    sweep_cost as sweep_cost,
    sweep_file as sweep_file,
    sweep_status as sweep_status,
    verify_store as verify_store,
)
