"""The paper's claims, each with a verdict that is computed from what was measured."""

from .claims_kepler import kepler_claims
from .claims_oscillator import oscillator_claims
from .claims_theory import theory_claims
from .experiments import Measurements
from .verdicts import Check as Check, Claim as Claim, Verdict as Verdict


def judge(measurements: Measurements) -> list[Claim]:
    """All claims of the paper, judged on these measurements."""
    parts = (theory_claims, oscillator_claims, kepler_claims)
    return [claim for part in parts for claim in part(measurements)]
