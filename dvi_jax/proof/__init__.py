"""Proved bounds of how much invariants change, and the checker of their certificates."""

from .bound import DriftBound as DriftBound, ProofError as ProofError, bound_drift as bound_drift
