"""Files of a reproduction: verdicts as JSON, Markdown and HTML, and tables as CSV."""

import base64
import csv
import html
import json
import math
import re
import string
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..page import markdown_table
from .claims import Claim, NumberCheck, Verdict, pretty
from .equations import EQUATIONS, Equation
from .experiments import Measurements
from .figures import FIGURES
from .numbers import largest, relative_spread

MARKS = {Verdict.HOLDS: "✓", Verdict.CORRECTED: "≈", Verdict.FAILS: "✗"}
"""A sign for each colour, so that verdicts can be read without colours."""


def counts(claims: Sequence[Claim]) -> str:
    """The number of claims with each verdict, as one phrase."""
    number = Counter(claim.verdict for claim in claims)
    plural = zip(Verdict, ("hold", "hold once corrected", "do not hold"), strict=True)
    parts = ", ".join(f"{number[verdict]} {words}" for verdict, words in plural)
    return f"{len(claims)} claims: {parts}"


def write_json(claims: Sequence[Claim], setting: dict[str, Any], path: Path) -> None:
    """The verdicts with every number, its band and its place; non-finite numbers as null."""

    def value(check: NumberCheck) -> float | None:
        return check.value if math.isfinite(check.value) else None

    def rows(checks: Sequence[NumberCheck]) -> list[dict[str, Any]]:
        return [
            {"what": c.quantity, "value": value(c), "band": c.band, "passes": c.passes}
            for c in checks
        ]

    document = {
        "setting": setting,
        "summary": counts(claims),
        "claims": [
            {
                "key": claim.key,
                "where": claim.where,
                "paper_says": claim.says,
                "verdict": claim.verdict.value,
                "why": claim.reason,
                "as_on_record": claim.is_expected,
                "checks_as_printed": rows(claim.printed),
                "checks_as_corrected": rows(claim.corrected),
                "also_measured": {c.quantity: value(c) for c in claim.context},
            }
            for claim in claims
        ],
    }
    path.write_text(json.dumps(document, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")


def write_markdown(claims: Sequence[Claim], setting: dict[str, Any], path: Path) -> None:
    """The verdicts and the table of equations as Markdown."""

    def cells_of(claim: Claim) -> Sequence[str]:
        checks = "<br>".join(f"*{kind}*: {text}" for kind, text in _check_texts(claim))
        verdict = f"{MARKS[claim.verdict]} **{claim.verdict.value}**"
        return claim.where, claim.says, checks, verdict, claim.reason

    columns = ("where", "the paper says", "measured now", "verdict", "why")
    equations = [
        (f"({e.number})", e.statement, ", ".join(f"`{code}`" for code in e.code), e.note)
        for e in EQUATIONS
    ]
    equation_columns = ("equation", "what", "code", "the print, and what is right")
    parts = [
        "# The paper's claims, measured",
        f"{counts(claims)}. {_setting_line(setting)}",
        markdown_table(columns, map(cells_of, claims)),
        "## Figures",
        *(f"![{text}](figures/{name}.png)\n\n{text}" for name, (_, text) in FIGURES.items()),
        "## The numbered equations and the code",
        markdown_table(equation_columns, equations) + "\n",
    ]
    path.write_text("\n\n".join(parts), encoding="utf-8")


def write_html(claims: Sequence[Claim], setting: dict[str, Any], figures: Path, path: Path) -> None:
    """One self-contained page: verdicts, figures (embedded), equations."""

    def row(cells: Iterable[str]) -> str:
        return "<tr>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>"

    def claim_row(claim: Claim) -> str:
        kind = claim.verdict.name.lower()
        checks = "".join(f"<li><i>{k}:</i> {_math(text)}</li>" for k, text in _check_texts(claim))
        verdict = f"{MARKS[claim.verdict]} {claim.verdict.value}"
        badge = f'<span class="verdict {kind}">{verdict}</span>'
        texts = (html.escape(claim.where), _math(claim.says), f"<ul>{checks}</ul>", badge)
        return row((*texts, _math(claim.reason))).replace("<td>", '<td class="where">', 1)

    def picture(name: str, caption: str) -> str:
        data = base64.b64encode((figures / f"{name}.png").read_bytes()).decode()
        return (
            f'<figure><img alt="{html.escape(caption)}" src="data:image/png;base64,{data}">'
            f"<figcaption>{_math(caption)}</figcaption></figure>"
        )

    def equation_row(e: Equation) -> str:
        code = " ".join(f"<code>{html.escape(c)}</code>" for c in e.code)
        return row((f"({e.number})", _math(e.statement), code, _math(e.note)))

    template = Path(__file__).with_name("page.html").read_text(encoding="utf-8")
    page = string.Template(template).substitute(
        summary=html.escape(counts(claims)),
        setting=html.escape(_setting_line(setting)),
        claims="\n".join(map(claim_row, claims)),
        figures="\n".join(picture(name, caption) for name, (_, caption) in FIGURES.items()),
        equations="\n".join(map(equation_row, EQUATIONS)),
    )
    path.write_text(page, encoding="utf-8")


def write_tables(m: Measurements, folder: Path) -> None:
    """The sweeps as CSV, one row per point; dimensionless."""
    mesh, small, cross = m.fixed_mesh, m.small_step, m.crossover
    sweep, limit, runs = m.mesh_sweep, m.small_step_sweep, m.long_runs.values()
    h, epsilon = (x.ravel() for x in np.meshgrid(sweep.hs, sweep.epsilons, indexing="ij"))
    tables: dict[str, dict[str, Any]] = {
        "crossover": {
            "h": cross.hs,
            "variational_band": cross.bands,
            "rk4_steps_measured": cross.steps,
            "rk4_steps_predicted": cross.predicted,
        },
        "sweep_34_fixed_mesh": {
            "h": mesh.h,
            "epsilon": mesh.epsilons,
            "range_34_printed": np.ptp(mesh.printed, axis=-1),
            "relative_range_34": relative_spread(mesh.printed),
            "relative_range_exact": relative_spread(mesh.exact),
        },
        "sweep_34_small_step": {
            "h": small.h,
            "epsilon": small.epsilons,
            "relative_range_34_printed": small.printed,
            "relative_range_34_corrected": small.corrected,
        },
        "sweep_49_50_fixed_mesh": {
            "h": h,
            "epsilon": epsilon,
            "relative_range_49": sweep.relative_49.ravel(),
            "range_50": sweep.spread_50.ravel(),
        },
        "sweep_50_small_step": {
            "h": limit.h,
            "epsilon": limit.epsilons,
            "drift_force_minus": limit.attracting,
            "drift_force_plus": limit.repelling,
            "drift_xi0_1_force_minus": limit.literal,
        },
        "long_runs": {
            "method": [run.name for run in runs],
            "largest_relative_energy_error": [run.error_at(1.0) for run in runs],
            "largest_angular_momentum_error": [largest(run.momentum_errors) for run in runs],
            "loop_width_at_apocentre": [run.width for run in runs],
            "turn_per_revolution_rad": [run.turn for run in runs],
        },
    }
    for name, columns in tables.items():
        with (folder / f"{name}.csv").open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(columns)
            for row in zip(*np.broadcast_arrays(*columns.values()), strict=True):
                writer.writerow([x if isinstance(x, str) else f"{float(x):.9g}" for x in row])


def _check_texts(claim: Claim) -> list[tuple[str, str]]:
    """The part (printed, corrected, also) and the text of each number of a claim."""

    def text(check: NumberCheck) -> str:
        mark = f" ({'✓' if check.passes else '✗'} required: {check.band})" if check.decides else ""
        return f"{check.quantity}: {pretty(check.value)}{mark}"

    parts = {"printed": claim.printed, "corrected": claim.corrected, "also": claim.context}
    return [(part, text(check)) for part, checks in parts.items() for check in checks]


def _setting_line(setting: dict[str, Any]) -> str:
    return "; ".join(f"{name} {value}" for name, value in setting.items()) + "."


def _math(text: str) -> str:
    """Escaped text with _x, _{…} and ^{…} as subscripts and superscripts."""
    text = re.sub(
        r"_(?:\{([^}]*)\}|([A-Za-z0-9])(?![A-Za-z0-9]))", r"<sub>\1\2</sub>", html.escape(text)
    )
    return re.sub(r"\^(?:\{([^}]*)\}|([A-Za-z0-9])(?![A-Za-z0-9]))", r"<sup>\1\2</sup>", text)
