"""What a run tells: tables for the reader, contents for report.json."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ..systems.n_body import OBSERVABLES
from ..systems.solar_system import BODIES
from ._solar import Comparison
from ._watched import Watched


@dataclass(frozen=True)
class Table:
    """A table of the report: names of the columns, rows of texts."""

    title: str
    columns: list[str]
    rows: list[list[str]]


@dataclass
class Report:
    """What a run found.

    - `ok`: whether the trajectory was successful; `message` says why not.
    - `folder`, `files`: where everything is. `tables`, `notes`: for the reader.
    - `contents`: what report.json holds.
    """

    ok: bool
    message: str
    folder: Path
    files: list[str]
    contents: dict[str, Any]
    tables: list[Table] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def watched_table(watched: dict[str, Watched]) -> Table:
    rows = []
    for name, w in watched.items():
        s = w.summary()
        if w.reduction:
            relative = f"{s['relative']:.2e}" if "relative" in s and w.is_relative else ""
            rows.append([name, w.reduction, "", _few_numbers(s["value"]), relative])
        else:
            rows.append(
                [
                    name,
                    "",
                    _number(s["start"]),
                    _number(s["end"]),
                    f"{s['largest_saved_change']:.2e}",
                ]
            )
    return Table(
        "Observables (changes: relative, where the start is not zero)",
        ["name", "reduction", "start", "end or value", "change"],
        rows,
    )


def _number(value: Any) -> str:
    value = np.asarray(value)
    if value.ndim == 0:
        return f"{float(value):.8g}"
    return f"|…| = {np.linalg.norm(value):.3g}"


def _few_numbers(value: Any) -> str:
    value = np.asarray(value)
    if value.ndim == 1 and value.size <= 4:
        return ", ".join(f"{x:.3g}" for x in value)
    return _number(value)


def solar_contents(c: Comparison, always: dict[str, Watched], share: float) -> dict[str, Any]:
    drifts = {name: always[f"{name}_drift"].summary() for name in OBSERVABLES}
    return {
        "years": float(c.years[-1]),
        "position_error": {
            name: {
                "largest_km": np.nanmax(c.errors[:, i], initial=0.0),
                "last_km": c.errors[-1, i],
                "largest_arcsec": np.nanmax(c.angles[:, i], initial=0.0),
            }
            for i, name in enumerate(BODIES)
            if i > 0
        },
        "largest_relative_change": {name: s["relative"] for name, s in drifts.items()},
        "mercury_perihelion": {
            "ephemeris_minus_integration_arcsec_per_century": c.slope,
            "integrators_share_arcsec_per_century": share,
            "scatter_arcsec": c.scatter,
            "general_relativity_arcsec_per_century": c.relativity,
        },
    }


def solar_tables(report: Report, c: Comparison, always: dict[str, Watched]) -> None:
    contents = report.contents["solar_system"]
    along = np.unique(np.linspace(0, len(c.years) - 1, 11).round().astype(int))
    changes = [np.abs(always[name].change()) for name in OBSERVABLES]
    report.tables += [
        Table(
            "Conserved: relative change (linear momentum: of Σ|p|)",
            ["years", *(name.replace("_", " ") for name in OBSERVABLES)],
            [[f"{c.years[k]:.1f}", *(f"{change[k]:.1e}" for change in changes)] for k in along]
            + [["largest, every step", *(
                f"{x:.1e}" for x in contents["largest_relative_change"].values()
            )]],
        ),
        Table(
            "Heliocentric position beside DE421",
            ["planet", "largest [km]", "last [km]", "largest, from the Sun [″]"],
            [
                [name, *(f"{e[key]:.3g}" for key in ("largest_km", "last_km", "largest_arcsec"))]
                for name, e in contents["position_error"].items()
            ],
        ),
    ]  # fmt: skip
    if not np.isfinite(c.slope):
        return
    report.notes.append(
        f"Mercury's perihelion, ephemeris minus integration: {c.slope:.2f}″ per century "
        f"(scatter about the line {c.scatter:.2f}″); general relativity's share is "
        f"{c.relativity:.2f}″."
    )
    share = contents["mercury_perihelion"]["integrators_share_arcsec_per_century"]
    if np.isfinite(share):
        said = f"The integrator's own share, found with half the step: {share:.2f}″ per century."
        if abs(share) > 0.02 * c.relativity:
            said += " That is too much to tell relativity by: take a smaller h."
        report.notes.append(said)


def plain(value: Any) -> Any:
    """The same in types that JSON has; what is not finite goes as text, to stay visible."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        return plain(np.asarray(value).tolist())
    if isinstance(value, float) and not np.isfinite(value):
        return str(value)
    if value is None or isinstance(value, bool | int | float | str):
        return value
    return str(value)
