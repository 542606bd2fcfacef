"""A run from a TOML file: what is in it, the integration, the report."""

from ._errors import InputError as InputError
from ._run import run_file as run_file
