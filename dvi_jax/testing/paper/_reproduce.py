"""The whole reproduction, from measurements to files."""

import contextlib
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

import dvi_jax as dvi

from ...base.files import release, reserve, user_folder
from .claims import Claim, Verdict, judge, pretty
from .experiments import Measurements, measure
from .figures import FIGURES, draw
from .report import MARKS, counts, write_html, write_json, write_markdown, write_tables

_COLOUR = {Verdict.HOLDS: "green", Verdict.CORRECTED: "yellow", Verdict.FAILS: "red"}


@dataclass(frozen=True)
class Reproduction:
    """Result of `reproduce`: its folder, the measurements, the claims with verdicts."""

    out: Path
    measurements: Measurements
    claims: list[Claim]


def reproduce(out: Path | str, force: bool = False, console: Console | None = None) -> Reproduction:
    """The paper's figures, sweeps and verdicts, measured and written to a folder.

    All results are computed in double precision on the CPU, for every setting of the process.

    **Arguments**

    - `out`: the folder, created if missing: ``verdicts.json``, ``verdicts.md``, ``verdicts.html``
      (self-contained), ``figures/*.png`` and ``tables/*.csv``.
    - `force`: write into a folder that is not empty; other files in it stay.
    - `console`: rich console for progress and summary; by default standard output.

    **Raises** `FileExistsError` when `out` is a folder that is not empty and `force` is not set;
    `NotADirectoryError` when it is a file.

    **Source** the paper, Section 5; the verdicts' criteria are ours.
    """
    out = user_folder("out", out)
    if out.exists() and any(out.iterdir()) and not force:
        raise FileExistsError(
            f"out must be a new or an empty folder, but {out} is not empty: choose another folder, "
            "or use force=True (--force), which overwrites files of the same names."
        )
    console = Console() if console is None else console
    began = time.perf_counter()
    reserve(out)
    try:
        with jax.enable_x64(True), _on_cpu():
            measurements = measure(console)
    except BaseException:
        release(out)
        raise
    claims = judge(measurements)
    seconds = time.perf_counter() - began

    figures, tables = out / "figures", out / "tables"
    figures.mkdir(exist_ok=True)
    tables.mkdir(exist_ok=True)
    with console.status("drawing") as status:
        for i, path in enumerate(draw(measurements, figures), start=1):
            status.update(f"drawing: {path.name} ({i} of {len(FIGURES)})")
    setting: dict[str, Any] = {
        "dvi_jax": dvi.__version__,
        "jax": jax.__version__,
        "precision": "float64",
        "“h → 0”": f"order 4 at h = {measurements.small_step.h:g}",
        "measured in": f"{seconds:.0f} s",
    }
    write_tables(measurements, tables)
    write_json(claims, setting, out / "verdicts.json")
    write_markdown(claims, setting, out / "verdicts.md")
    write_html(claims, setting, figures, out / "verdicts.html")

    console.print(_summary(claims))
    console.print(f"{counts(claims)}; {time.perf_counter() - began:.0f} s.")
    surprises = [claim.key for claim in claims if not claim.is_expected]
    if surprises:
        console.print(f"[bold]Other verdicts than on record:[/bold] {', '.join(surprises)}.")
    console.print(f"Written to {out}: open verdicts.html.", soft_wrap=True)
    return Reproduction(out, measurements, claims)


def _summary(claims: list[Claim]) -> Table:
    look: Any = {"title_justify": "left", "box": SIMPLE_HEAD, "expand": True}
    table = Table(title="The paper's claims, measured", **look)
    for name, ratio in (("where", 2), ("the paper says", 4), ("measured now", 4)):
        table.add_column(name, ratio=ratio)
    table.add_column("verdict", no_wrap=True)
    for claim in claims:
        verdict = claim.verdict
        # The decisive check: the failing one of the printed claim, or its first if none fails.
        check = next((c for c in claim.printed if not c.passes), claim.printed[0])
        number = f"{check.quantity}: {pretty(check.value)}"
        text = f"[{_COLOUR[verdict]}]{MARKS[verdict]} {verdict.value}[/]"
        table.add_row(claim.where, claim.says, number, text)
    return table


def _on_cpu() -> Any:
    """JAX on the CPU: the runs are long, of few trajectories, which an accelerator is slow at."""
    try:
        return jax.default_device(jax.local_devices(backend="cpu")[0])
    except RuntimeError:  # a process without a CPU device
        return contextlib.nullcontext()
