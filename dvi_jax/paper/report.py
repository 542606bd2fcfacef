"""What a reproduction leaves on disk: verdicts as JSON, Markdown and HTML, and tables as CSV."""

import base64
import csv
import html
import json
import math
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .equations import EQUATIONS
from .experiments import Measurements
from .figures import FIGURES
from .numbers import relative_spread, spread
from .verdicts import Check, Claim, Verdict, pretty

MARKS = {Verdict.HOLDS: "✓", Verdict.MENDED: "≈", Verdict.FAILS: "✗"}
"""A sign beside every colour, so that no verdict hangs on colour alone."""


def counts(claims: Sequence[Claim]) -> str:
    """How many claims met each verdict, as one phrase."""
    number = Counter(claim.verdict for claim in claims)
    plural = {
        Verdict.HOLDS: "hold",
        Verdict.MENDED: "hold once mended",
        Verdict.FAILS: "do not hold",
    }
    parts = ", ".join(f"{number[verdict]} {words}" for verdict, words in plural.items())
    return f"{len(claims)} claims: {parts}"


def write_json(claims: Sequence[Claim], setting: dict[str, Any], path: Path) -> None:
    """The verdicts with every number, its band and its place; non-finite numbers as null."""

    def check(check: Check) -> dict[str, Any]:
        return {
            "what": check.what,
            "value": check.value if math.isfinite(check.value) else None,
            "band": check.band,
            "passes": check.passes,
        }

    rows = [
        {
            "key": claim.key,
            "where": claim.where,
            "paper_says": claim.says,
            "verdict": claim.verdict.value,
            "why": claim.reason,
            "as_on_record": claim.is_expected,
            "checks_as_printed": [check(c) for c in claim.printed],
            "checks_as_mended": [check(c) for c in claim.mended],
            "also_measured": {c.what: check(c)["value"] for c in claim.also},
        }
        for claim in claims
    ]
    document = {"setting": setting, "summary": counts(claims), "claims": rows}
    path.write_text(json.dumps(document, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")


def write_markdown(claims: Sequence[Claim], setting: dict[str, Any], path: Path) -> None:
    """The verdicts and the table of equations as Markdown."""

    def row(cells: Iterable[object]) -> str:
        return "| " + " | ".join(str(cell).replace("|", "\\|") for cell in cells) + " |"

    lines = [
        "# The paper's claims, measured",
        "",
        f"{counts(claims)}. {_setting_line(setting)}",
        "",
        row(("where", "the paper says", "measured now", "verdict", "why")),
        row(["---"] * 5),
        *(
            row(
                (
                    claim.where,
                    claim.says,
                    "<br>".join(f"*{kind}*: {text}" for kind, text in _check_texts(claim)),
                    f"{MARKS[claim.verdict]} **{claim.verdict.value}**",
                    claim.reason,
                )
            )
            for claim in claims
        ),
        "",
        "## Figures",
        "",
        *(
            f"![{caption}](figures/{name}.png)\n\n{caption}\n"
            for name, (_, caption) in FIGURES.items()
        ),
        "## The numbered equations and the code",
        "",
        row(("equation", "what", "code", "the print, and what is right")),
        row(["---"] * 4),
        *(
            row((f"({e.number})", e.what, ", ".join(f"`{c}`" for c in e.code), e.note))
            for e in EQUATIONS
        ),
        "",
    ]
    path.write_text("\n".join(lines), encoding="utf-8")


def write_html(claims: Sequence[Claim], setting: dict[str, Any], figures: Path, path: Path) -> None:
    """One page that needs nothing beside it: verdicts, figures (embedded), equations."""
    sections = []
    for claim in claims:
        kind = claim.verdict.name.lower()
        checks = "".join(
            f"<li><i>{label}:</i> {_math(text)}</li>" for label, text in _check_texts(claim)
        )
        sections.append(
            f'<tr><td class="where">{_esc(claim.where)}</td><td>{_math(claim.says)}</td>'
            f"<td><ul>{checks}</ul></td>"
            f'<td><span class="verdict {kind}">{MARKS[claim.verdict]} {claim.verdict.value}</span>'
            f"</td><td>{_math(claim.reason)}</td></tr>"
        )
    pictures = []
    for name, (_, caption) in FIGURES.items():
        data = base64.b64encode((figures / f"{name}.png").read_bytes()).decode()
        pictures.append(
            f'<figure><img alt="{_esc(caption)}" src="data:image/png;base64,{data}">'
            f"<figcaption>{_math(caption)}</figcaption></figure>"
        )
    equations = [
        f"<tr><td>({e.number})</td><td>{_math(e.what)}</td>"
        f"<td>{' '.join(f'<code>{_esc(c)}</code>' for c in e.code)}</td>"
        f"<td>{_math(e.note)}</td></tr>"
        for e in EQUATIONS
    ]
    page = _PAGE.format(
        summary=_esc(counts(claims)),
        setting=_esc(_setting_line(setting)),
        claims="\n".join(sections),
        figures="\n".join(pictures),
        equations="\n".join(equations),
    )
    path.write_text(page, encoding="utf-8")


def write_tables(m: Measurements, folder: Path) -> None:
    """The sweeps as CSV, one row per point; dimensionless."""
    mesh, small, cross = m.fixed_mesh, m.small_step, m.crossover
    sweep, limit = m.mesh_sweep, m.small_step_sweep
    _write_csv(
        folder / "crossover.csv",
        ("h", "variational_band", "rk4_steps_measured", "rk4_steps_predicted"),
        zip(cross.hs, cross.bands, cross.steps, cross.predicted, strict=True),
    )
    _write_csv(
        folder / "sweep_34_fixed_mesh.csv",
        ("h", "epsilon", "range_34_printed", "relative_range_34", "relative_range_exact"),
        zip(
            [mesh.h] * len(mesh.epsilons),
            mesh.epsilons,
            spread(mesh.printed),
            relative_spread(mesh.printed),
            relative_spread(mesh.exact),
            strict=True,
        ),
    )
    _write_csv(
        folder / "sweep_34_small_step.csv",
        ("h", "epsilon", "relative_range_34_printed", "relative_range_34_corrected"),
        zip(
            [small.h] * len(small.epsilons),
            small.epsilons,
            small.printed,
            small.corrected,
            strict=True,
        ),
    )
    _write_csv(
        folder / "sweep_49_50_fixed_mesh.csv",
        ("h", "epsilon", "relative_range_49", "range_50"),
        (
            (h, epsilon, sweep.relative_49[i, j], sweep.spread_50[i, j])
            for i, h in enumerate(sweep.hs)
            for j, epsilon in enumerate(sweep.epsilons)
        ),
    )
    _write_csv(
        folder / "sweep_50_small_step.csv",
        ("h", "epsilon", "drift_force_minus", "drift_force_plus", "drift_xi0_1_force_minus"),
        zip(
            [limit.h] * len(limit.epsilons),
            limit.epsilons,
            limit.attracting,
            limit.repelling,
            limit.literal,
            strict=True,
        ),
    )
    _write_csv(
        folder / "long_runs.csv",
        (
            "method",
            "largest_relative_energy_error",
            "largest_angular_momentum_error",
            "loop_width_at_apocentre",
            "turn_per_revolution_rad",
        ),
        (
            (
                run.name,
                run.error_at(1.0),
                float(np.max(np.abs(run.momentum_errors))),
                run.width,
                run.turn,
            )
            for run in m.long_runs.values()
        ),
    )


def _write_csv(path: Path, header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        for row in rows:
            writer.writerow([x if isinstance(x, str) else f"{float(x):.9g}" for x in row])


def _check_texts(claim: Claim) -> list[tuple[str, str]]:
    """Every number of a claim: the part it belongs to, and what it says."""
    parts = (("printed", claim.printed), ("mended", claim.mended), ("also", claim.also))
    return [(label, _check_text(check)) for label, checks in parts for check in checks]


def _check_text(check: Check) -> str:
    decides = math.isfinite(check.low) or math.isfinite(check.high) or check.low == math.inf
    value = f"{check.what}: {pretty(check.value)}"
    if not decides:
        return value
    return f"{value} ({'✓' if check.passes else '✗'} asked for: {check.band})"


def _setting_line(setting: dict[str, Any]) -> str:
    return "; ".join(f"{name} {value}" for name, value in setting.items()) + "."


def _esc(text: str) -> str:
    return html.escape(text, quote=True)


def _math(text: str) -> str:
    """Escaped text with the indices and exponents written as _x, _{…} and ^{…} set as such."""
    text = re.sub(r"_(?:\{([^}]*)\}|([A-Za-z0-9])(?![A-Za-z0-9]))", r"<sub>\1\2</sub>", _esc(text))
    return re.sub(r"\^(?:\{([^}]*)\}|([A-Za-z0-9])(?![A-Za-z0-9]))", r"<sup>\1\2</sup>", text)


_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>The paper's claims, measured</title>
<style>
:root {{ --ink: #1d2430; --soft: #5a6473; --line: #dfe3e8; --paper: #fff; --tint: #f6f7f9; }}
* {{ box-sizing: border-box; }}
body {{ margin: 0; background: var(--paper); color: var(--ink);
  font: 15px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", sans-serif; }}
main {{ max-width: 78rem; margin: 0 auto; padding: 2rem 1.25rem 4rem; }}
h1 {{ font-size: 1.7rem; margin: 0 0 .4rem; }}
h2 {{ font-size: 1.2rem; margin: 2.6rem 0 .8rem; }}
p.lead {{ font-size: 1.05rem; margin: 0; }}
p.setting {{ color: var(--soft); margin: .3rem 0 0; }}
nav a {{ margin-right: 1.2rem; color: #005a94; }}
nav {{ margin-top: .8rem; }}
.wide {{ overflow-x: auto; }}
table {{ border-collapse: collapse; width: 100%; min-width: 58rem; font-size: .9rem; }}
th.says {{ width: 20%; }} th.measured {{ width: 32%; }} th.why {{ width: 24%; }}
th {{ text-align: left; background: var(--tint); position: sticky; top: 0; }}
th, td {{ border-bottom: 1px solid var(--line); padding: .5rem .6rem; vertical-align: top; }}
td ul {{ margin: 0; padding: 0; list-style: none; }}
td li + li {{ margin-top: .25rem; }}
td li i {{ color: var(--soft); }}
sub, sup {{ font-size: .75em; line-height: 0; }}
.where {{ white-space: normal; font-weight: 600; min-width: 6.5rem; }}
.verdict {{ display: inline-block; white-space: nowrap; padding: .1rem .5rem; border-radius: 1rem;
  font-weight: 600; border: 1.5px solid currentColor; }}
.holds {{ color: #00614a; }}
.mended {{ color: #8a5a00; }}
.fails {{ color: #a63c00; }}
code {{ font: .85em ui-monospace, SFMono-Regular, Menlo, Consolas, monospace;
  background: var(--tint); padding: 0 .25em; overflow-wrap: anywhere; }}
figure {{ margin: 0 0 1.6rem; max-width: 60rem; }}
figure img {{ width: 100%; height: auto; border: 1px solid var(--line); border-radius: 4px;
  padding: .6rem; }}
figcaption {{ color: var(--soft); margin-top: .3rem; }}
</style>
</head>
<body><main>
<h1>The paper's claims, measured</h1>
<p class="lead">{summary}.</p>
<p class="setting">{setting}</p>
<p class="setting">Every number was measured in this run, and every verdict follows from the
numbers: a claim holds if the checks of what is printed pass, holds once mended if those of the
mended form do, and does not hold otherwise. All quantities are dimensionless, as in the
paper.</p>
<nav>
<a href="#claims">Claims</a><a href="#figures">Figures</a><a href="#equations">Equations</a>
</nav>
<h2 id="claims">Claims</h2>
<div class="wide"><table>
<thead><tr>
<th>where</th><th class="says">the paper says</th><th class="measured">measured now</th>
<th>verdict</th><th class="why">why</th>
</tr></thead><tbody>
{claims}
</tbody></table></div>
<h2 id="figures">Figures</h2>
{figures}
<h2 id="equations">The numbered equations and the code</h2>
<div class="wide"><table>
<thead><tr><th>equation</th><th>what</th><th>code</th><th>the print, and what is right</th></tr>
</thead><tbody>
{equations}
</tbody></table></div>
</main></body></html>
"""
