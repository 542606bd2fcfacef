"""The report of a search for invariants, in words."""

from typing import Any

import numpy as np

from ..functions.families import power_text
from .expansions import growth_note

_FORMULA_TERMS = 12  # Terms of a formula in a report; ``str`` of a series shows all
_LAWS = 4  # Drift laws in a report
_CLOSED_FORMS = 6  # Numbers of an invariant that are shown as fractions or multiples of √2, π, …
_OBVIOUS = ("1/2", "1", "2")


def report(discovery: Any) -> str:
    """The lines of ``print(found)`` for a `Discovery`."""
    drop = 1e-9 if discovery.tolerance is None else np.sqrt(discovery.tolerance)
    # Coefficients of order 0 are known to about as many digits as the gap has.
    digits = int(np.clip(np.log10(discovery.gap) - 2, 2, 6)) if discovery.order == 0 else 6
    if discovery.tolerance is None and digits < 6:
        drop = 10.0 ** -(digits + 1)
    kind = "" if discovery.tolerance is None else "approximately "
    time = "" if np.isnan(discovery.seconds) else f", in {discovery.seconds:.1f} s"
    plural = "y" if discovery.count == 1 else "ies"
    lines = [
        f"{discovery.count} independent {kind}conserved quantit{plural}{_up_to(discovery.order)} "
        f"among the combinations of {discovery.basis.size} functions{time}"
    ]
    if (limit := discovery.tolerance) is not None:
        lines.append(f"  singular values up to {limit:g} of the largest count as zero")
    lines += [f"  {line}" for line in (_numbers(discovery), *discovery.warnings)]
    if discovery.count and discovery.count == 2 * int(np.prod(discovery.shape, dtype=int)):
        lines.append(
            "  as many independent invariants as coordinates: each orbit of the map has "
            "finitely many points, or the functions repeat along it"
        )
    if discovery.refused:
        lines.append(
            f"  {discovery.refused} combinations rejected: they fit the fitted samples, but not "
            "held-out samples, their own slopes or a lower order (chaos, too few samples, or too "
            "large a tolerance)"
        )
    for i, series in enumerate(discovery.invariants):
        lines.append(f"  I = {series.formula(_FORMULA_TERMS, drop, digits)}")
        lines += _invariant_lines(discovery, i, series)
    if count := len(discovery.dependent):
        lines.append(f"  functions of these that are conserved too: {count}")
        for series in discovery.dependent_invariants[:3]:
            lines.append(f"      {series.formula(_FORMULA_TERMS, drop, digits)}")
        if count > 3:
            lines.append("      … (all of them in dependent_invariants)")
    return "\n".join(lines + _not_conserved(discovery))


def _up_to(order: int) -> str:
    return f" up to order {power_text('ε', order)}" if order else ""


def _numbers(discovery: Any) -> str:
    """How many combinations are conserved at each order, and how clear that is."""
    counts = [f"{count}{_up_to(m) or ' for ε = 0'}" for m, count in enumerate(discovery.survivors)]
    next_value = f"the smallest singular value of the others is {discovery.gap:.1e} times as large"
    return f"combinations conserved: {', '.join(counts)}; {next_value}"


def _invariant_lines(discovery: Any, i: int, series: Any) -> list[str]:
    """What is known of one invariant."""
    half, large = np.max(discovery.typical_residuals[i], axis=0)
    lines = [
        f"      changes in a step on held-out samples: median {half:.1e}, 95 % below {large:.1e}, "
        f"largest {np.max(discovery.residuals[i]):.1e} of what its slopes predict"
    ]
    if discovery.exact[i]:
        lines.append("      exact at every ε tried")
    elif np.isfinite(size := discovery.reach[i]):
        lines.append(f"      corrections are as large as the leading-order term at ε = {size:.2g}")
    lines += growth_note("changes grow", discovery.powers[i])
    forms = [f"{n} = {form}" for n, form in series.recognised.items() if form not in _OBVIOUS]
    if forms and discovery.tolerance is None:
        total = f", … ({len(forms)} in all)" if len(forms) > _CLOSED_FORMS else ""
        lines.append(f"      recognised: {', '.join(forms[:_CLOSED_FORMS])}{total}")
    return lines


def _not_conserved(discovery: Any) -> list[str]:
    """What is not conserved, why, and what may help."""
    laws = [law for law in discovery.obstructions if law.kind != "unexplained"]
    lines = [f"  {law}" for law in laws[:_LAWS]]
    if len(laws) > _LAWS:
        lines.append(f"  {len(laws) - _LAWS} more are lost, each by such a law (obstructions)")
    count = discovery.survivors[0] - discovery.survivors[-1] - len(laws)
    if count > 0:
        lines.append(
            f"  {count} more {'is' if count == 1 else 'are'} conserved for ε = 0 and not at order "
            f"{discovery.order} in this basis: it may be too small, try functions of higher degree"
        )
    return lines + ([f"  {discovery.energy}"] if discovery.energy is not None else [])
