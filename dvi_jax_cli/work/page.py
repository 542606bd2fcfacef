"""An HTML page about results: one file, escaped text, pictures inside, no reference elsewhere."""

import base64
import io
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import matplotlib as mpl

from dvi_jax import plot
from dvi_jax.plot.style import figure_of

from .._show import TextTable

MAX_BYTES = 5_000_000
"""Size of a page at most."""

_PICTURES, _SVG = 3_000_000, 350_000
"""Bytes of all pictures; bytes up to which a picture is drawn by lines (SVG)."""
_ROWS, _CELL, _TEXT = 60, 2_000, 200_000
"""Rows of a table, characters of one cell and of one block of text that are shown."""
_NAMED = 10
"""Failures that are named."""

_INVALID = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\ud800-\udfff\ufffe\uffff]")
_NUMBER = re.compile(r"[-−+]?[\d.∞]|inf|nan|not resolved|none:|$")


@dataclass
class Chapter:
    """One result on a page.

    - `kind`, `title`: such as "run" and the name of the system.
    - `verdict`, `grade`: how it ended, in a word or two; "good", "bad" or "open".
    - `facts`: name → text, of what was run. `origin`: name → text, of versions and machine.
    - `statuses`: name → number. `failures`: one line for each, the first ones; `num_failures`.
    - `notes`: sentences for the reader. `formulas`: lines of mathematics.
    - `pictures`: description → function that returns axes, or the content of a PNG file.
    - `command`: that repeats the work; `remarks`: what it needs; `config`: text of the TOML file.
    """

    kind: str
    title: str
    verdict: str
    grade: str
    facts: dict[str, str] = field(default_factory=dict)
    statuses: dict[str, int] = field(default_factory=dict)
    failures: list[str] = field(default_factory=list)
    num_failures: int = 0
    notes: list[str] = field(default_factory=list)
    formulas: list[str] = field(default_factory=list)
    pictures: dict[str, Callable[[], Any] | bytes] = field(default_factory=dict)
    tables: list[TextTable] = field(default_factory=list)
    origin: dict[str, str] = field(default_factory=dict)
    command: str = ""
    remarks: list[str] = field(default_factory=list)
    config: str = ""


def page(title: str, chapters: Sequence[Chapter]) -> bytes:
    """The page, in UTF-8; the same chapters give the same bytes."""
    html = Element("html", {"lang": "en"})
    head, body = SubElement(html, "head"), SubElement(html, "body")
    SubElement(head, "meta", {"charset": "utf-8"})
    SubElement(head, "meta", {"name": "viewport", "content": "width=device-width, initial-scale=1"})
    _add(head, "title", f"{title}: report of dvi-jax")
    SubElement(head, "style").text = Path(__file__).with_name("page.css").read_text("utf-8")
    main = SubElement(body, "main")
    budget = _PICTURES // max(1, sum(len(chapter.pictures) for chapter in chapters))
    for chapter in chapters:
        _write(SubElement(main, "article"), chapter, budget)
    # ElementTree escapes all text and attributes, so that no text of a user becomes markup.
    text = ElementTree.tostring(html, encoding="unicode", method="html")
    return f"<!doctype html>\n{text}\n".encode()


def _add(parent: Element, tag: str, text: str = "", **attributes: str) -> Element:
    element = SubElement(parent, tag, {k.rstrip("_"): _clean(v) for k, v in attributes.items()})
    element.text = _clean(text)
    return element


def _clean(text: str) -> str:
    """The text without characters that HTML cannot have."""
    return _INVALID.sub("\ufffd", text)


def _short(text: str, limit: int, what: str = "characters") -> str:
    """The text, shortened with a remark on how much is left out."""
    excess = len(text) - limit
    return text if excess <= 0 else f"{text[:limit]} … and {excess} more {what}"


def _write(article: Element, chapter: Chapter, budget: int) -> None:
    header = SubElement(article, "header")
    _add(header, "p", chapter.kind, class_="kind")
    _add(header, "h1", _short(chapter.title, 200))
    _add(header, "p", chapter.verdict, class_=f"verdict {chapter.grade}")
    _add_facts(article, "What was run", chapter.facts)
    _add_statuses(article, chapter)
    for note in chapter.notes:
        _add(article, "p", _short(note, _CELL), class_="note")
    if chapter.pictures:
        _add(article, "h2", "Pictures")
        pictures = SubElement(article, "div", {"class": "pictures"})
        for description, source in chapter.pictures.items():
            _add_picture(pictures, description, source, budget)
    for table in chapter.tables:
        _add_table(article, table)
    if chapter.formulas:
        _add(article, "h2", "Formulas")
        _add(article, "pre", _short("\n".join(chapter.formulas), _TEXT), class_="formulas")
    _add(article, "h2", "How to repeat it")
    if chapter.command:
        _add(article, "pre", chapter.command, class_="command")
    for remark in chapter.remarks:
        _add(article, "p", remark)
    if chapter.config:
        _add(article, "pre", _short(chapter.config, _TEXT), class_="config")
    _add_facts(article, "Versions and machine", chapter.origin)


def _add_facts(parent: Element, title: str, facts: dict[str, str]) -> None:
    if not facts:
        return
    _add(parent, "h2", title)
    entries = SubElement(parent, "dl")
    for name, text in facts.items():
        pair = SubElement(entries, "div")
        _add(pair, "dt", _short(name, 100))
        _add(pair, "dd", _short(text, _CELL) or "–")


def _add_statuses(article: Element, chapter: Chapter) -> None:
    if not (chapter.statuses or chapter.failures):
        return
    _add(article, "h2", "Statuses and failures")
    if chapter.statuses:
        total = sum(chapter.statuses.values())
        rows = [[n.replace("_", " "), str(k), f"{100 * k / total:.4g} %"]
                for n, k in chapter.statuses.items()]  # fmt: skip
        _add_table(article, TextTable("", ["status", "number", "fraction"], rows))
    if chapter.failures:
        items = SubElement(article, "ul", {"class": "failures"})
        for line in chapter.failures[:_NAMED]:
            _add(items, "li", _short(line, _CELL))
        count = max(chapter.num_failures, len(chapter.failures))
        if count > _NAMED:
            _add(article, "p", f"… and {count - _NAMED} more failures")


def _add_table(parent: Element, table: TextTable) -> None:
    if table.title:
        _add(parent, "h2", table.title)
    grid = SubElement(SubElement(parent, "div", {"class": "wide"}), "table")
    sides: list[dict[str, str]] = []
    for i in range(len(table.columns)):
        column = [row[i] for row in table.rows if i < len(row)]  # the last cells may be missing
        sides.append({"class_": "number"} if i and all(map(_NUMBER.match, column)) else {})
    row = SubElement(SubElement(grid, "thead"), "tr")
    for name, side in zip(table.columns, sides, strict=True):
        _add(row, "th", name, scope="col", **side)
    body = SubElement(grid, "tbody")
    for cells in table.rows[:_ROWS]:
        row = SubElement(body, "tr")
        for cell, side in zip([*cells, *[""] * (len(sides) - len(cells))], sides, strict=True):
            _add(row, "td", _short(cell, _CELL), **side)
    if len(table.rows) > _ROWS:
        _add(parent, "p", f"… and {len(table.rows) - _ROWS} more rows")


def _add_picture(parent: Element, description: str, source: Any, budget: int) -> None:
    figure = SubElement(parent, "figure")
    try:
        content, kind, inches = _image(source, budget)
    except (TypeError, ValueError) as error:  # results that have no such picture
        _add(figure, "figcaption", f"{description} cannot be drawn: {error}")
        return
    figure.set("style", f"--inches: {inches:.3g}")
    if inches >= 8:
        figure.set("class", "large")
    data = f"data:image/{kind};base64,{base64.b64encode(content).decode()}"
    _add(figure, "img", src=data, alt=description)
    _add(figure, "figcaption", description)


def _image(source: Callable[[], Any] | bytes, budget: int) -> tuple[bytes, str, float]:
    """A picture, its type and its width in inches, in `budget` bytes: lines (SVG) if they are few,
    else points (PNG), as fine as there is space for. **Raises** `ValueError` if it is too large."""
    if isinstance(source, bytes):
        if len(source) > budget:
            raise ValueError(f"{len(source) / 1e6:.2g} MB do not fit into the page")
        return source, "png", float(mpl.rcParamsDefault["figure.figsize"][0])
    settings: Any = {"svg.hashsalt": "dvi-jax", "svg.fonttype": "path"}
    with plot.style(), mpl.rc_context(settings):
        drawn = source()
        figure = figure_of(drawn.flat[0] if hasattr(drawn, "flat") else drawn)
        try:
            for kind, dpi, limit in (("svg+xml", 100, min(budget, _SVG)), *_PNGS):
                content = io.BytesIO()
                options: Any = {"metadata": {"Date": None}} if kind != "png" else {}
                figure.savefig(content, format=kind[:3], dpi=dpi, **options)
                if content.tell() <= min(limit, budget):
                    return content.getvalue(), kind, float(figure.get_figwidth())
        finally:
            plot.plt.close(figure)
    raise ValueError("there are too many pictures for one page")


_PNGS = [("png", dpi, MAX_BYTES) for dpi in (170, 120, 80, 50)]
