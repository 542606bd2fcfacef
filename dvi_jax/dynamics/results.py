"""Statuses of frequency analyses and of Poincaré sections."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from lanewise.jaxprs.jaxapi import is_traced

from ..base.printing import fields_of, first_lines
from ..base.results import RESULTS, status_code, status_counts


class FREQUENCY_RESULTS(eqx.Enumeration):
    """Status of one signal; ``dvi.FREQUENCY_RESULTS[found.result]`` is the text.

    The first that applies, in this order. With `unresolved` and `not_converged` the affected lines
    are NaN, with `not_quasi_periodic` and `resonant` all numbers that depend on all lines; with the
    others every number.
    """

    successful = ""
    not_finite = (
        "The signal holds NaN or infinite values. Likely causes: (a) the trajectory failed or was "
        "stopped, see its own status; (b) it escaped. Analyse the part before, or another initial "
        "condition."
    )
    irregular_times = (
        "The times are not uniform, as a Fourier transform requires. Save with dvi.Save(every=m) "
        "on the lattice dvi.Uniform()."
    )
    no_signal = (
        "The signal has no line: it is constant to round-off, or noise. Likely causes: (a) the "
        "initial condition is an equilibrium; (b) this degree of freedom is not excited; (c) too "
        "few samples for lines in so much noise."
    )
    window_too_short = (
        "The leading line has fewer than window + 1 periods within the window, the width of its "
        "main lobe, so that it cannot be distinguished from a constant. Likely causes: (a) the "
        "trajectory is too short: take more steps, or a lower window; (b) a drift, or a coordinate "
        "that rotates, which is not a sum of lines: analyse exp(i q), or the momentum."
    )
    aliased = (
        "The leading line lies above 9/10 of the Nyquist frequency π/Δt, Δt the time between "
        "samples: its sign is uncertain, and it may be the alias of a faster one. Save more often."
    )
    unresolved = (
        "Two lines are closer than the resolution 2π/T: their frequencies and amplitudes cannot be "
        "separated, and are NaN. Likely causes: (a) the trajectory is too short: take a longer "
        "one; (b) the motion is chaotic; (c) count is larger than the number of lines: take a "
        "smaller one; (d) friction: of one line that decays the frequency is given with "
        "throw=False, or take count=1."
    )
    not_converged = (
        "The joint refinement of all lines did not converge for some of them, which are NaN. "
        "Likely causes: (a) the motion is chaotic; (b) count is larger than the number of lines: "
        "take a smaller one, or refine=False."
    )
    not_quasi_periodic = (
        "The signal is not a sum of lines at integer combinations of num frequencies. Likely "
        "causes: (a) the motion is chaotic: see dvi.frequency_diffusion; (b) too few lines: take a "
        "larger count; (c) combinations of high order: take a larger order; (d) the motion changes "
        "slowly: take a shorter window; (e) the window is too short for the weaker lines; (f) "
        "lines above the Nyquist frequency appear at wrong frequencies: save more often."
    )
    resonant = (
        "The lines have fewer than num independent frequencies: an integer combination of them "
        "vanishes within the tolerance. Likely causes: (a) a resonance, or a degenerate system "
        "such as Kepler's: give a smaller num; (b) a degree of freedom that is not excited; (c) a "
        "trajectory that is too short."
    )


class SECTION_RESULTS(eqx.Enumeration):
    """Status of the crossings of one orbit; ``dvi.SECTION_RESULTS[found.result]`` is the text."""

    successful = ""
    never_crossed = (
        "The orbit never crossed the section. Likely causes: (a) g(t, q, p, args) has one sign all "
        "along it: take a surface that the orbit meets; (b) the direction is the other one: try "
        "direction=0; (c) too few steps; (d) steps so long that g changes sign twice within one; "
        "(e) all crossings were skipped: use a smaller skip."
    )
    too_few_crossings = (
        "The orbit crossed the section less often than requested; missing crossings are NaN. Take "
        "more steps, or fewer crossings."
    )
    stopped = (
        "The condition of dvi.Stop was met before there were enough crossings; missing crossings "
        "are NaN."
    )
    failed = (
        "The trajectory failed or escaped before there were enough crossings; missing crossings "
        "are NaN. Its own status is in `run`."
    )


NAMES, SECTION_NAMES = (
    tuple(vars(results)["_name_to_item"]) for results in (FREQUENCY_RESULTS, SECTION_RESULTS)
)

CODE = {name: i for i, name in enumerate(NAMES)}  # Indices in `NAMES`
code_of: Callable[[Any], Array] = status_code  # The same of a status, for each signal of a batch


def lacks_numbers(code: Any) -> Any:
    """Whether a status, by its index in `NAMES`, leaves no line: from `not_finite` to `aliased`."""
    return (code > 0) & (code <= CODE["aliased"])


class WithStatus(eqx.Module):
    """Base of results with a field `result`, their status."""

    @property
    def status(self: Any) -> Any:
        """The name of `result`, such as "successful"; an array of names for a batch."""
        all_names = NAMES if isinstance(self.result, FREQUENCY_RESULTS) else SECTION_NAMES
        names = np.array(all_names)[np.asarray(code_of(self.result))]
        return str(names) if names.ndim == 0 else names

    def __repr__(self: Any) -> str:
        """Statuses, and every array: its values if they are few, else its shape."""
        if is_traced(status_code(self.result)):
            return eqx.tree_pformat(self)
        lines = [f"{type(self).__name__}: {status_counts(self.status)}"]
        for name, text in fields_of(self):
            if name not in ("result", "run"):
                lines.append(f"  {name} = {text}")
        return first_lines("\n".join(lines), "")


def with_code(code: Any) -> FREQUENCY_RESULTS:
    """The status with an index in `NAMES`, or a batch of them."""
    _, structure = jax.tree.flatten(FREQUENCY_RESULTS.successful)
    return jax.tree.unflatten(structure, [jnp.asarray(code, jnp.int32)])


def judge(count: Array, capacity: int, run: RESULTS) -> SECTION_RESULTS:
    """The status of an orbit with `count` of `capacity` crossings."""
    kinds, is_stopped = SECTION_RESULTS, run == RESULTS.stopped
    result = kinds.where(count == 0, kinds.never_crossed, kinds.too_few_crossings)
    result = kinds.where(is_stopped, kinds.stopped, result)
    result = kinds.where((run == RESULTS.successful) | is_stopped, result, kinds.failed)
    return kinds.where(count >= capacity, kinds.successful, result)


class _WithFound(RuntimeError):
    def __init__(self, message: str, found: object = None):
        super().__init__(message)
        self.found = found


class FrequencyError(_WithFound):
    """Raised with ``throw=True`` when a signal has another status than `successful`.

    `found` is the whole result, with its statuses.
    """


class SectionError(_WithFound):
    """Raised with ``throw=True`` when an orbit has another status than `successful`.

    `found` is the whole result, with its statuses.
    """


AS_ATTRIBUTE = (
    "With throw=False the result is returned with its statuses; here it is the `found` attribute "
    "of this error."
)


def require_success(signals: Any, throw: bool) -> Any:
    """The result for some signals. **Raises** a `FrequencyError` that names the first signal with
    another status than `successful`, if `throw`."""
    if not throw:
        return signals
    is_bad = signals.result != FREQUENCY_RESULTS.successful
    if signals.result.is_traced():
        return signals.result.error_if(signals, is_bad)
    is_bad = np.asarray(is_bad)
    if not is_bad.any():
        return signals
    index = tuple(int(i) for i in np.argwhere(is_bad)[0])
    subject = "The status of the signal"
    if index:
        count = f"{is_bad.sum()} of {is_bad.size}"
        subject = f"{count} signals failed. The status of the first, index {index},"
    name = str(np.asarray(signals.status)[index])
    text = FREQUENCY_RESULTS[getattr(FREQUENCY_RESULTS, name)]
    raise FrequencyError(f"{subject} is {name}. {text} {AS_ATTRIBUTE}", signals)


def refuse_traced(name: str, *arrays: Any) -> None:
    """**Raises** `ValueError` for inputs of a function in NumPy that are traced by JAX."""
    if any(map(is_traced, arrays)):
        raise ValueError(
            f"{name} uses NumPy: call it once with the whole batch, outside of jit, vmap and grad."
        )
