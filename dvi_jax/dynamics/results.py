"""How an analysis of the frequencies of a signal ended."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array


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


NAMES = (
    "successful", "not_finite", "irregular_times", "no_signal", "window_too_short", "aliased",
    "unresolved", "not_converged", "not_quasi_periodic", "resonant",
)  # fmt: skip

CODE = {name: i for i, name in enumerate(NAMES)}
"""The place of a status in `NAMES`."""

WITHOUT_NUMBERS = NAMES[1:6]
"""Statuses that leave no line."""


def with_code(code: Array) -> FREQUENCY_RESULTS:
    """The status at a place in `NAMES`, for each lane of a batch."""
    code = jnp.asarray(code)
    if code.ndim:  # an enumeration is selected one lane at a time
        return jax.vmap(with_code)(code)
    result = FREQUENCY_RESULTS.successful
    for i, name in enumerate(NAMES):
        result = FREQUENCY_RESULTS.where(code == i, getattr(FREQUENCY_RESULTS, name), result)
    return result


def code_of(result: FREQUENCY_RESULTS) -> Array:
    """The place of a status in `NAMES`, for each lane of a batch."""
    code = jnp.zeros(jnp.shape(result == FREQUENCY_RESULTS.successful), jnp.int32)
    for i, name in enumerate(NAMES):
        code = jnp.where(result == getattr(FREQUENCY_RESULTS, name), i, code)
    return code


def name_of(result: FREQUENCY_RESULTS) -> Any:
    """The short name of a status, or an array of names for a batch."""
    names = np.array(NAMES)[np.asarray(code_of(result))]
    return str(names) if names.ndim == 0 else names


class FrequencyError(RuntimeError):
    """Raised with ``throw=True`` when a signal has another status than `successful`.

    `found` holds everything that was found, with its statuses.
    """

    def __init__(self, message: str, found: object = None):
        super().__init__(message)
        self.found = found


def raise_on_failure(found: Any) -> Any:
    """`found`, or a `FrequencyError` that names the first signal with another status."""
    fine = found.result == FREQUENCY_RESULTS.successful
    if found.result.is_traced():
        return found.result.error_if(found, ~fine)
    fine = np.asarray(fine)
    if fine.all():
        return found
    code = np.asarray(code_of(found.result))
    where = tuple(int(i) for i in np.argwhere(~fine)[0])
    which = (
        f"{(~fine).sum()} of {fine.size} signals; the first is number {where}: " if where else ""
    )
    name = NAMES[int(code[where])]
    raise FrequencyError(
        f"{which}{name}. {FREQUENCY_RESULTS[getattr(FREQUENCY_RESULTS, name)]} With throw=False "
        "what was found is returned with its statuses; here it is the `found` attribute of this "
        "error.",
        found,
    )
