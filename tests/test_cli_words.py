"""What the command line says names keys of TOML files, and no line of Python."""

import warnings

import pytest
import typer
from typer.testing import CliRunner

from dvi_jax_cli._errors import in_toml
from dvi_jax_cli._session import Session, command

MESSAGES = [
    ("give this time: dvi.Observations(..., t0=...).", "give this time: the key t0."),
    ("epsilon=... must be given", "epsilon = … must be given"),
    ("needs method=dvi.Rattle() or", 'needs method = "Rattle()" or'),
    ("use dvi.BAOAB() for noise", 'use "BAOAB()" for noise'),
    ("num_steps must be an integer", "steps must be an integer"),
    ("dvi.integrate failed", "integrate failed"),
    ("use arithmetic=dvi.DoubleDouble().", "use arithmetic = dvi.DoubleDouble() in Python."),
    ("path=dvi.Brownian(jax.random.key(0))", "path = dvi.Brownian(jax.random.key(0)) in Python"),
    ("give time=(t_begin, t_end) of", "give times = [t_begin, t_end] in [domain] of"),
    (
        "give observe={...} or save=dvi.Save(final=True)",
        'give a table [observables] or save = "final"',
    ),
    ("order=9: above order 6", "order = 9: above order 6"),
    ("in memory: give store=..., a directory", "in memory: give a store (--store), a directory"),
    ("the point (q, p) = (1, 2)", "the point (q, p) = (1, 2)"),
]


@pytest.mark.parametrize(("message", "expected"), MESSAGES)
def test_a_message_names_keys_of_the_file(message, expected):
    assert in_toml(message) == expected


def test_a_warning_is_one_line_without_a_path():
    app = typer.Typer()

    @command(app, "warn", jax=False)
    def warn(session: Session) -> None:
        """Warn."""
        for _ in range(2):
            warnings.warn("t0 is not given: dvi.Observations(..., t0=...).", stacklevel=1)
        warnings.warn("overflow encountered in square", RuntimeWarning, stacklevel=1)

    with warnings.catch_warnings():
        warnings.simplefilter("always")
        result = CliRunner().invoke(app, [])
    assert result.exit_code == 0
    assert result.output == "warning: t0 is not given: the key t0.\n"
