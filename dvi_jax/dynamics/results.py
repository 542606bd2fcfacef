"""How an analysis of frequencies, or of the crossings of a section, ended."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._results import RESULTS, status_code


class FREQUENCY_RESULTS(eqx.Enumeration):
    """Status of one signal; ``dvi.FREQUENCY_RESULTS[found.result]`` is the text.

    The first that applies, in this order. `unresolved` and `not_converged` make the lines that
    they speak of NaN, `not_quasi_periodic` and `resonant` what depends on all lines; the others
    leave no number at all.
    """

    successful = ""
    not_finite = (
        "The signal holds NaN or infinite values. Likely causes: (a) the trajectory failed or was "
        "stopped, see its own status; (b) it escaped. Analyse the part before, or another start."
    )
    irregular_times = (
        "The times are not uniform, so that they are not those of a Fourier transform. Save with "
        "dvi.Save(every=m) on the lattice dvi.Uniform()."
    )
    no_signal = (
        "The signal has no line: it is constant to round-off, or noise. Likely causes: (a) the "
        "start is an equilibrium; (b) this degree of freedom is not excited; (c) too few samples "
        "for lines in so much noise."
    )
    window_too_short = (
        "The leading line has fewer periods within the window than its main lobe needs, window + "
        "1, so that it is not told from a constant. Likely causes: (a) the trajectory is too "
        "short: take more steps, or a lower window; (b) a drift, or a coordinate that rotates, "
        "which is no sum of lines: analyse exp(i q), or the momentum."
    )
    aliased = (
        "The leading line lies above 9/10 of the Nyquist frequency π/Δt, Δt the time between "
        "samples: its sign, and whether it is the alias of a faster one, cannot be told. Save "
        "more often."
    )
    unresolved = (
        "Two lines are closer than the resolution 2π/T: their frequencies and amplitudes are not "
        "told apart, and are NaN. Likely causes: (a) the trajectory is too short: take a longer "
        "one; (b) the motion is chaotic; (c) more lines were asked for than there are: take a "
        "smaller count."
    )
    not_converged = (
        "The joint refinement of all lines did not converge for some of them, which are NaN. "
        "Likely causes: (a) the motion is chaotic; (b) more lines were asked for than there are: "
        "take a smaller count, or refine=False."
    )
    not_quasi_periodic = (
        "The signal is no sum of lines at integer combinations of so few frequencies. Likely "
        "causes: (a) the motion is chaotic: see dvi.frequency_diffusion; (b) too few lines: take a "
        "larger count; (c) combinations of high order: take a larger order; (d) the motion changes "
        "slowly: take a shorter window; (e) the window is too short for the weaker lines; (f) "
        "lines above the Nyquist frequency fold back to where none should be: save more often."
    )
    resonant = (
        "The lines have fewer independent frequencies than were asked for: an integer combination "
        "of them vanishes within the tolerance. Likely causes: (a) a resonance, or a degenerate "
        "system such as Kepler's: ask for fewer, num=...; (b) a degree of freedom that is not "
        "excited; (c) the trajectory is too short to tell."
    )


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


NAMES = (
    "successful", "not_finite", "irregular_times", "no_signal", "window_too_short", "aliased",
    "unresolved", "not_converged", "not_quasi_periodic", "resonant",
)  # fmt: skip

SECTION_NAMES = ("successful", "never_crossed", "too_few_crossings", "stopped", "failed")

CODE = {name: i for i, name in enumerate(NAMES)}
"""The place of a status in `NAMES`."""

WITHOUT_NUMBERS = NAMES[1:6]
"""Statuses that leave no line."""

code_of: Callable[[Any], Array] = status_code
"""The place of a status in `NAMES`, for each signal of a batch."""


class WithStatus(eqx.Module):
    """Base of results with a field `result`, their status."""

    @property
    def status(self: Any) -> Any:
        """The name of `result`, such as "successful"; an array of names for a batch."""
        return name_of(self.result)


def with_code(code: Any) -> FREQUENCY_RESULTS:
    """The status at a place in `NAMES`, or a batch of them."""
    _, structure = jax.tree.flatten(FREQUENCY_RESULTS.successful)
    return jax.tree.unflatten(structure, [jnp.asarray(code, jnp.int32)])


def name_of(result: FREQUENCY_RESULTS | SECTION_RESULTS) -> Any:
    """The short name of a status, or an array of names for a batch."""
    known = NAMES if isinstance(result, FREQUENCY_RESULTS) else SECTION_NAMES
    names = np.array(known)[np.asarray(code_of(result))]
    return str(names) if names.ndim == 0 else names


def judge(count: Array, wanted: int, run: RESULTS) -> SECTION_RESULTS:
    """The status of an orbit with so many crossings of those wanted."""
    result = SECTION_RESULTS.where(
        count == 0, SECTION_RESULTS.never_crossed, SECTION_RESULTS.too_few_crossings
    )
    result = SECTION_RESULTS.where(run == RESULTS.stopped, SECTION_RESULTS.stopped, result)
    ended_well = (run == RESULTS.successful) | (run == RESULTS.stopped)
    result = SECTION_RESULTS.where(ended_well, result, SECTION_RESULTS.failed)
    return SECTION_RESULTS.where(count >= wanted, SECTION_RESULTS.successful, result)


class FrequencyError(RuntimeError):
    """Raised with ``throw=True`` when a signal has another status than `successful`.

    `found` holds everything that was found, with its statuses.
    """

    def __init__(self, message: str, found: object = None):
        super().__init__(message)
        self.found = found


class SectionError(RuntimeError):
    """Raised with ``throw=True`` when an orbit has another status than `successful`.

    `found` holds all crossings that there were, with the statuses.
    """

    def __init__(self, message: str, found: object = None):
        super().__init__(message)
        self.found = found


def raise_on_failure(found: Any) -> Any:
    """`found`, or a `FrequencyError` that names the first signal with another status."""
    if found.result.is_traced():
        return found.result.error_if(found, found.result != FREQUENCY_RESULTS.successful)
    bad = np.asarray(found.result != FREQUENCY_RESULTS.successful)
    if not bad.any():
        return found
    where = tuple(int(i) for i in np.argwhere(bad)[0])
    which = f"{bad.sum()} of {bad.size} signals; the first is number {where}: " if where else ""
    name = str(np.asarray(found.status)[where])
    raise FrequencyError(
        f"{which}{name}. {FREQUENCY_RESULTS[getattr(FREQUENCY_RESULTS, name)]} With throw=False "
        "what was found is returned with its statuses; here it is the `found` attribute of this "
        "error.",
        found,
    )
