"""The gallery: a thumbnail for each notebook, example and plot function, made by the build.

Most thumbnails of plot functions are drawn by the examples of docs/examples.md, those of run files
by `dvi-jax`; an example without a picture has a picture of its text. They are stored in
docs/thumbnails, and drawn again if what they are made from has changed.

    python docs/_ext/gallery.py FOLDER NAME ...   (called by the build) draw plot functions
"""

import ast
import base64
import hashlib
import inspect
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
import usage
from docutils import nodes
from PIL import Image, ImageChops, ImageDraw, ImageFilter, ImageFont
from sphinx.util.docutils import SphinxDirective

DOCS = Path(__file__).parents[1]
SIZE = 240, 160
"""Pixels of a thumbnail."""

NOTEBOOKS = {
    "quick_start": 1, "your_own_system": 0, "discovering_invariants": 0, "limits": 0,
    "how_long": 0, "magnetic_moment": 0, "breakdown_of_mu": 0, "sweeps": 0, "fitting": 0,
    "alpha_particles": 0, "events": 0, "storage_ring": 2, "radiating_ring": 1, "planets": 0,
    "general_relativity": 0, "polar_motion": 0, "gpu": 0, "the_paper": 1,
}  # fmt: skip
"""Notebook → which of its pictures."""

EXAMPLES = {
    "overview.py": ("index", "overview.png"),
    "gallery.py": ("plots", "plot_phase_portrait.png"),
    "what_is_conserved.py": ("what-is-conserved", "drift_orders.png"),
    "proved.py": ("proved-bounds", ""),
    "noise.py": ("noise", "noise.png"),
    "events.py": ("events", "events.png"),
    "variational_lattice.py": ("lattices", "variational_damped.png"),
    "sweep_map.py": ("sweeps", "sweep_maps.png"),
    "many_hosts.py": ("clusters", ""),
    "solitons.py": ("many-coordinates", "solitons.png"),
    "transit_times.py": ("splitting", "transit_times.png"),
    "general_relativity.py": ("general-relativity", "general_relativity.png"),
    "polar_motion.py": ("polar-motion", "polar_motion.png"),
    "heavy_top.py": ("constraints", ""),
    "ring_fits.py": ("ring-invariants", ""),
    "alpha_particles.py": ("alpha-particles", ""),
    "alpha_losses.py": ("alpha-particles", "alpha_losses.png"),
    "alpha_invariants.py": ("alpha-particles", "alpha_invariants.png"),
    "alpha_optimise.py": ("alpha-particles", "alpha_optimise.png"),
    "alpha_collisions.py": ("alpha-particles", ""),
    "alpha_walls.py": ("alpha-particles", "alpha_walls.png"),
    "code_generation.py": ("lanewise", "code_generation.png"),
    "own_system.py": ("command-line", ""),
    "kepler.toml": ("command-line", "run trajectory.png"),
    "own_system.toml": ("command-line", "run trajectory.png"),
    "solar_system.toml": ("command-line", ""),
    "sweep.toml": ("sweeps", ""),
    "discover.toml": ("command-line", "discover drifts.png"),
    "fit.toml": ("fitting", "fit data.png"),
    "bound.toml": ("proved-bounds", ""),
    "ring.toml": ("storage-rings", ""),
    "alpha_losses.toml": ("alpha-particles", ""),
}
"""Example → its page, and its picture: of docs/pictures, or of a command, or of its text."""

PLOTS: dict[str, Any] = {
    "plot.phase_portrait": "plot_phase_portrait.png", "plot.section": "plot_section.png",
    "plot.balance": "plot_balance.png", "plot.drift_orders": "drift_orders.png",
    "plot.tune_map": "ring_tunes.png", "plot.sweep_map": ("sweeps", 0),
    "plot.slope_map": ("sweeps", 1), "plot.failure_map": ("sweeps", 2),
}  # fmt: skip
"""Plot function whose short example has too few points → a picture of docs/pictures, or a notebook
and which of its pictures."""


class Card(NamedTuple):
    """A thumbnail: its name, its caption, the address of its page, and its file if it has one."""

    name: str
    caption: str
    address: str
    file: str = ""


def plot_functions() -> list[str]:
    """The plot functions that have an example, in the order of the page on plots."""
    table = (DOCS / "plots.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\|[^|\n]*\|([^|\n]*)\|", table, re.M)
    names = [f"plot.{name}" for row in rows for name in re.findall(r"`(\w+)`", row)]
    drawn = [name for name in usage.page().code if name.startswith("plot.")]
    drawn = [name for name in drawn if name not in ("plot.save", "plot.style")]
    return [*(name for name in names if name in drawn), *(x for x in drawn if x not in names)]


def _notebook(name: str) -> Any:
    path = DOCS.parent / "notebooks" / f"{name}.ipynb"
    return json.loads(path.read_text(encoding="utf-8"))


def _title(name: str) -> str:
    return "".join(_notebook(name)["cells"][0]["source"]).splitlines()[0].removeprefix("# ")


def _summary(name: str) -> str:
    """The first sentence of an example."""
    text = (DOCS.parent / "examples" / name).read_text(encoding="utf-8")
    head = text.split("\n\n")[0] if name.endswith(".py") else text.split("\n#\n")[0]
    return " ".join(re.sub(r'"""|^# |`', "", head, flags=re.M).split()).split(". ")[0].rstrip(".")


def cards(kind: str) -> list[Card]:
    """The cards of one kind: notebooks, examples or plots."""
    if kind == "notebooks":
        names = sorted(path.stem for path in (DOCS.parent / "notebooks").glob("*.ipynb"))
        names.sort(key=lambda name: list(NOTEBOOKS).index(name) if name in NOTEBOOKS else 99)
        return [Card(name, _title(name), f"notebooks/{name}.html") for name in names]
    if kind == "plots":
        place = "reference/plot.html#dvi_jax"
        return [Card(name, name, f"{place}.{name}") for name in plot_functions()]
    listed = EXAMPLES.items()
    return [Card(name, _summary(name), f"{page}.html", name) for name, (page, _) in listed]


def thumbnail(image: Image.Image) -> Image.Image:
    """A picture on a white ground of the size of thumbnails, in few colours, its lines thick."""
    image = image.convert("RGBA")
    flat = Image.alpha_composite(Image.new("RGBA", image.size, "white"), image).convert("RGB")
    flat = flat.crop((0, 0, _first_panel(flat), flat.height))
    flat = flat.crop(ImageChops.invert(flat.convert("L")).getbbox())
    # Lines are thick enough to have a pixel of the thumbnail.
    width, height = SIZE[0] - 8, SIZE[1] - 8
    shrinkage = max(flat.width / width, flat.height / height)
    flat = flat.filter(ImageFilter.MinFilter(2 * round(shrinkage / 3) + 1))
    flat.thumbnail((width, height), Image.Resampling.LANCZOS)
    ground = Image.new("RGB", SIZE, "white")
    ground.paste(flat, ((SIZE[0] - flat.width) // 2, (SIZE[1] - flat.height) // 2))
    return ground.quantize(64, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)


def _first_panel(image: Image.Image) -> int:
    """Where the first of several panels in a row ends, at white columns; or the whole width."""
    if image.width < 1.7 * image.height:
        return image.width
    columns = np.asarray(image.convert("L")).min(axis=0) > 250
    first, last = round(0.2 * image.width), round(0.8 * image.width)
    gaps = np.flatnonzero(columns[first:last])
    return first + int(gaps[0]) if gaps.size else image.width


def _text_picture(path: Path) -> Image.Image:
    """The first lines of the code of a file."""
    text = path.read_text(encoding="utf-8")
    start = 0
    if path.suffix == ".py":
        plain = (ast.Expr, ast.Import, ast.ImportFrom)
        body = [node for node in ast.parse(text).body if not isinstance(node, plain)]
        start = body[0].lineno - 1
    lines = [line for line in text.splitlines()[start:] if line.strip("# ")]
    font = ImageFont.truetype(matplotlib.get_data_path() + "/fonts/ttf/DejaVuSansMono.ttf", 11)
    image = Image.new("RGB", (SIZE[0] - 8, SIZE[1] - 8), "white")
    ImageDraw.Draw(image).multiline_text((0, 0), "\n".join(lines[:10]), "#333", font)
    return image


def _draw_notebook(name: str, number: int | None = None) -> Image.Image:
    outputs = [o for cell in _notebook(name)["cells"] for o in cell.get("outputs", ())]
    pictures = [o["data"]["image/png"] for o in outputs if "image/png" in o.get("data", {})]
    number = NOTEBOOKS.get(name, 0) if number is None else number
    png = base64.b64decode(pictures[min(number, len(pictures) - 1)])
    return Image.open(BytesIO(png))


def _call(*words: str, folder: str) -> None:
    path = os.pathsep.join([str(DOCS.parent), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "MPLBACKEND": "Agg", "PYTHONPATH": path}
    out = subprocess.run(
        [sys.executable, *words], cwd=folder, env=environment, capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    if out.returncode:
        raise RuntimeError(f"{' '.join(words)} failed: {out.stderr[-2000:]}")


def _draw_example(name: str) -> Image.Image:
    source, picture = DOCS.parent / "examples" / name, EXAMPLES[name][1]
    if not picture:
        return _text_picture(source)
    if " " not in picture:
        return Image.open(DOCS / "pictures" / picture)
    command, file = picture.split()
    with tempfile.TemporaryDirectory() as folder:
        _call("-m", "dvi_jax_cli", command, str(source), "--out", "made", folder=folder)
        return Image.open(Path(folder) / "made" / file).copy()


def _draw_plot(name: str) -> Image.Image:
    source = PLOTS[name]
    is_file = isinstance(source, str)
    return Image.open(DOCS / "pictures" / source) if is_file else _draw_notebook(*source)


def _key(kind: str, name: str) -> str:
    """A number that changes with what a thumbnail is made from."""
    if name in PLOTS:
        content = _draw_plot(name).tobytes()
    elif kind == "plots":
        content = usage.page().markdown(name).encode()
    elif kind == "notebooks":
        content = (DOCS.parent / "notebooks" / f"{name}.ipynb").read_bytes()
    else:
        content = (DOCS.parent / "examples" / name).read_bytes() + repr(EXAMPLES[name]).encode()
        if (picture := DOCS / "pictures" / EXAMPLES[name][1]).is_file():
            content += picture.read_bytes()
    content += inspect.getsource(thumbnail).encode()
    return hashlib.sha256(content).hexdigest()[:12]


def path_of(kind: str, name: str) -> Path:
    return DOCS / "thumbnails" / f"{name}-{_key(kind, name)}.png"


def make() -> None:
    """Draw the thumbnails that do not exist, and remove those of earlier states."""
    drawers: dict[str, Callable[[str], Image.Image]]
    drawers = {"notebooks": _draw_notebook, "examples": _draw_example, "plots": _draw_plot}
    paths = {(kind, c.name): path_of(kind, c.name) for kind in KINDS for c in cards(kind)}
    folder = DOCS / "thumbnails"
    folder.mkdir(exist_ok=True)
    for stale in set(folder.glob("*.png")) - set(paths.values()):
        stale.unlink()
    missing = [key for key, path in paths.items() if not path.exists()]
    functions = [name for kind, name in missing if kind == "plots" and name not in PLOTS]
    with tempfile.TemporaryDirectory() as drawn:
        if functions:
            _call(__file__, drawn, *functions, folder=drawn)
        for kind, name in missing:
            if name in functions:
                image = Image.open(Path(drawn) / f"{name}.png")
            else:
                image = drawers[kind](name)
            thumbnail(image).save(paths[kind, name], optimize=True)


KINDS = ("notebooks", "examples", "plots")


def draw_plots(folder: Path, names: list[str]) -> None:
    """Run the examples of plot functions, the shared lines once, and save what they draw."""
    import matplotlib.pyplot as plt

    page, known = usage.page(), {}
    exec(page.imports, known)
    done = set()
    for name in names:
        code = page.code[name]
        for line in page.lines_before(code):
            if line not in done:
                done.add(line)
                exec(line, known)
        plt.close("all")
        exec(code, dict(known))
        if figures := plt.get_fignums():
            plt.figure(figures[-1]).savefig(folder / f"{name}.png", dpi=80)
        else:  # an animation
            image = Image.open("orbit.gif")
            image.seek(image.n_frames - 1)
            image.convert("RGB").save(folder / f"{name}.png")


class Gallery(SphinxDirective):
    """The cards of one kind: ```{gallery} notebooks```."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        self.env.note_reread()
        return [nodes.container("", *self._cards(), classes=["cards", "gallery"])]

    def _cards(self) -> Iterator[nodes.Node]:
        kind = self.arguments[0]
        for card in cards(kind):
            picture = f"thumbnails/{path_of(kind, card.name).name}"
            image = nodes.image(uri=picture, alt=f"Picture of {card.name}")
            link = nodes.reference("", "", image, nodes.Text(card.caption), refuri=card.address)
            body = nodes.paragraph("", "", link)
            if card.file:
                body += nodes.literal(card.file, card.file)
            yield nodes.container("", body, classes=["card"])


def setup(app: Any) -> dict[str, bool]:
    app.connect("builder-inited", lambda _: make())
    app.add_directive("gallery", Gallery)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


if __name__ == "__main__":
    draw_plots(Path(sys.argv[1]), sys.argv[2:])
