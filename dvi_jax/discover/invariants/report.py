"""The report of a search for invariants, in words."""

from typing import Any

import numpy as np

from ..functions.families import raised
from .expansions import grown

_SHOWN = 12  # Terms of a formula in a report; ``str`` of a series shows all
_LAWS = 4  # Drift laws in a report
_RECOGNISED = 6  # Numbers of an invariant that are shown as fractions or multiples of √2, π, …
_OBVIOUS = ("1/2", "1", "2")


def report(found: Any) -> str:
    """The lines of ``print(found)`` for a `Discovery`."""
    drop = 1e-9 if found.tolerance is None else np.sqrt(found.tolerance)
    # Coefficients of order 0 are known to about as many digits as the gap has.
    digits = int(np.clip(np.log10(found.gap) - 2, 2, 6)) if found.order == 0 else 6
    if found.tolerance is None and digits < 6:
        drop = 10.0 ** -(digits + 1)
    kind = "" if found.tolerance is None else "approximately "
    time = "" if np.isnan(found.seconds) else f", in {found.seconds:.1f} s"
    lines = [
        f"{found.count} independent {kind}conserved quantit{'y' if found.count == 1 else 'ies'}"
        f"{_up_to(found.order)} among the combinations of {found.basis.size} functions{time}"
    ]
    if found.tolerance is not None:
        lines.append(f"  singular values up to {found.tolerance:g} of the largest count as zero")
    lines += [f"  {line}" for line in (*_numbers(found), *found.warnings)]
    if found.count and found.count == 2 * int(np.prod(found.shape, dtype=int)):
        lines.append(
            "  as many independent invariants as coordinates: each orbit of the map has "
            "finitely many points, or the functions repeat along it"
        )
    if found.refused:
        lines.append(
            f"  {found.refused} combinations fit the samples that were fitted and were rejected: "
            "held-out samples, their own slopes or a lower order decide (chaos, too few samples, "
            "or too large a tolerance)"
        )
    for i, series in enumerate(found.invariants):
        lines += [f"  I = {series.formula(_SHOWN, drop, digits)}", *_about(found, i, series)]
    if len(found.dependent):
        lines.append(f"  functions of these that are conserved too: {len(found.dependent)}")
        for series in found.dependent_invariants[:3]:
            lines.append(f"      {series.formula(_SHOWN, drop, digits)}")
        if len(found.dependent) > 3:
            lines.append("      … (all of them in dependent_invariants)")
    return "\n".join(lines + _not_conserved(found))


def _up_to(order: int) -> str:
    return f" up to order {raised('ε', order)}" if order else ""


def _numbers(found: Any) -> list[str]:
    """How many combinations are conserved at each order, and how clear that is."""
    counts = [f"{n}{_up_to(m) or ' for ε = 0'}" for m, n in enumerate(found.survivors)]
    others = f"the smallest singular value of the others is {found.gap:.1e} times as large"
    return [f"combinations conserved: {', '.join(counts)}; {others}"]


def _about(found: Any, i: int, series: Any) -> list[str]:
    """What is known of one invariant."""
    half, most = np.max(found.typical_residuals[i], axis=0)
    notes = []
    if found.exact[i]:
        notes.append("exact at every ε tried")
    elif np.isfinite(found.reach[i]):
        notes.append(
            f"corrections are as large as the leading-order term at ε = {found.reach[i]:.2g}"
        )
    lines = [
        f"      changes in a step on held-out samples: median {half:.1e}, 95 % below {most:.1e}, "
        f"largest {np.max(found.residuals[i]):.1e} of what its slopes predict",
        *(f"      {note}" for note in notes),
        *grown("changes grow", found.powers[i]),
    ]
    known = [f"{x} = {y}" for x, y in series.recognised.items() if y not in _OBVIOUS]
    if known and found.tolerance is None:
        more = f", … ({len(known)} in all)" if len(known) > _RECOGNISED else ""
        lines.append(f"      recognised: {', '.join(known[:_RECOGNISED])}{more}")
    return lines


def _not_conserved(found: Any) -> list[str]:
    """What is not conserved, why, and what may help."""
    laws = [law for law in found.obstructions if law.kind != "unexplained"]
    lines = [f"  {law}" for law in laws[:_LAWS]]
    if len(laws) > _LAWS:
        lines.append(f"  {len(laws) - _LAWS} more are lost, each by such a law (obstructions)")
    lost = found.survivors[0] - found.survivors[-1] - len(laws)
    if lost > 0:
        lines.append(
            f"  {lost} more {'is' if lost == 1 else 'are'} conserved for ε = 0 and not at order "
            f"{found.order} in this basis: it may be too small, try functions of higher degree"
        )
    return lines + ([f"  {found.energy}"] if found.energy is not None else [])
