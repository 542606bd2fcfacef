"""The command line ``dvi-jax``: help and completion without JAX, work with it."""

from ._app import app as app, main as main
