"""How an orbit came through a section."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._results import RESULTS


class SECTION_RESULTS(eqx.Enumeration):
    """Status of the crossings of one orbit; ``dvi.SECTION_RESULTS[found.result]`` is the text."""

    successful = ""
    never_crossed = (
        "The orbit never crossed the section. Likely causes: (a) g(t, q, p, args) has one sign all "
        "along it: take a surface that the orbit meets; (b) the direction is the other one: try "
        "direction=0; (c) too few steps; (d) steps so long that g turns twice within one; (e) all "
        "crossings were skipped: a smaller skip."
    )
    too_few_crossings = (
        "The orbit crossed the section fewer times than was asked for; what is missing is NaN. "
        "Take more steps, or ask for fewer crossings."
    )
    stopped = (
        "The condition of dvi.Stop was met before there were enough crossings; what is missing is "
        "NaN."
    )
    failed = (
        "The trajectory failed or escaped before there were enough crossings; what is missing is "
        "NaN. Its own status is in `run`."
    )


NAMES = ("successful", "never_crossed", "too_few_crossings", "stopped", "failed")


def judge(count: Array, wanted: int, run: RESULTS) -> SECTION_RESULTS:
    """The status of an orbit with so many crossings of those wanted."""
    result = SECTION_RESULTS.where(
        count == 0, SECTION_RESULTS.never_crossed, SECTION_RESULTS.too_few_crossings
    )
    result = SECTION_RESULTS.where(run == RESULTS.stopped, SECTION_RESULTS.stopped, result)
    ended_well = (run == RESULTS.successful) | (run == RESULTS.stopped)
    result = SECTION_RESULTS.where(ended_well, result, SECTION_RESULTS.failed)
    return SECTION_RESULTS.where(count >= wanted, SECTION_RESULTS.successful, result)


def name_of(result: SECTION_RESULTS) -> Any:
    """The short name of a status, or an array of names for a batch."""
    code = jnp.zeros(jnp.shape(result == SECTION_RESULTS.successful), jnp.int32)
    for i, name in enumerate(NAMES):
        code = jnp.where(result == getattr(SECTION_RESULTS, name), i, code)
    names = np.array(NAMES)[np.asarray(code)]
    return str(names) if names.ndim == 0 else names


class SectionError(RuntimeError):
    """Raised with ``throw=True`` when an orbit has another status than `successful`.

    `found` holds all crossings that there were, with the statuses.
    """

    def __init__(self, message: str, found: object = None):
        super().__init__(message)
        self.found = found
