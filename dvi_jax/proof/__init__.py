"""Proved bounds of how much invariants change, and the checker of their certificates."""

from .binding import Binding as Binding, holds_for as holds_for
from .bound import ProofError as ProofError, bound_drift as bound_drift
from .coefficients import exact_coefficients as exact_coefficients
from .noether import NoetherProof as NoetherProof, prove_noether as prove_noether
from .rational import ExactInvariant as ExactInvariant
from .result import DriftBound as DriftBound
