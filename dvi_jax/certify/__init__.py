"""The certificate: every method under every check of `dvi_jax.testing`, with controls."""

from ..testing import (
    CHECKS as CHECKS,
    CONTROLS as CONTROLS,
    METHODS as METHODS,
    QUICK as QUICK,
    Candidate as Candidate,
    Check as Check,
    Control as Control,
    Measured as Measured,
    altered as altered,
)
from .certificate import Certificate as Certificate, certify as certify
from .page import page_for as page_for
