"""Make the notebooks from their percent sources, or check the existing ones.

    python notebooks/make.py [NAME ...]           write NAME.ipynb, executed; without names all
    python notebooks/make.py --check [NAME ...]   execute again, compare, write nothing

A notebook holds what a fresh run gives: cells of the source, outputs, and nothing that changes from
run to run (times, identifiers, names of machines). Exit status 1 where something is wrong.
"""

import argparse
import base64
import io
import os
import re
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import jupytext
import nbformat
from ipykernel.kernelspec import get_kernel_dict
from jupyter_client.kernelspec import KernelSpec, KernelSpecManager
from jupyter_client.manager import AsyncKernelManager
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError
from PIL import Image, ImageChops

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent

LARGEST = 1_000_000
"""Bytes of a notebook: a code host shows larger ones slowly or not at all."""

UNSEEN = 6
"""Change of a colour, of 255, up to which a picture has a palette of 256 colours."""

LONGEST = 600
"""Seconds that a cell may take."""

RELATIVE = 2e-3
"""Numbers in outputs agree to this share, or to one unit of their last printed digit."""

ROUND_OFF = 1e-10
"""Numbers below this are round-off, whose size is that of a processor and its libraries."""

METADATA = {
    "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
    "language_info": {"name": "python"},
}

_NUMBER = re.compile(r"(?<![\w.])[-−+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?(?![\w.]*\w)")
_MACHINE = re.compile(r"""(?:^|[\s"'(=])(?:/(?:[\w.+-]+/)+|~/|[A-Za-z]:\\)""", re.MULTILINE)


def names() -> list[str]:
    """The notebooks, by the sources that are there."""
    return sorted(path.stem for path in HERE.glob("*.py") if path.name != "make.py")


def from_source(name: str) -> Any:
    """The notebook without outputs: cells of NAME.py, numbered, without words to the formatter."""
    text = (HERE / f"{name}.py").read_text(encoding="utf-8").replace("  # fmt: skip", "")
    return numbered(jupytext.reads(text, fmt="py:percent"))


def committed(name: str) -> Any:
    """NAME.ipynb as it is."""
    return nbformat.read(HERE / f"{name}.ipynb", as_version=4)


def numbered(book: Any) -> Any:
    """The notebook with identifiers that count its cells, and metadata that do not change."""
    for i, cell in enumerate(book.cells):
        cell.id, cell.metadata = f"cell-{i:02d}", {}
    book.metadata = METADATA
    book.nbformat, book.nbformat_minor = 4, 5
    return book


class _ThisPython(KernelSpecManager):
    """Kernels of the Python that runs this, whatever others are installed under its name."""

    def get_kernel_spec(self, kernel_name: str) -> KernelSpec:
        spec = get_kernel_dict()
        # Messages of the kernel about itself, such as its connection, are not shown.
        # "retina": pictures have twice the pixels, which sharp screens show in the same size.
        settings = "--IPKernelApp.log_level=40", "--InlineBackend.figure_formats=retina"
        return KernelSpec(**spec | {"argv": [*spec["argv"], *settings]})


def executed(name: str) -> Any:
    """The notebook of NAME.py, run in a fresh kernel on the CPU, in an empty directory.

    **Raises** `CellExecutionError` for a cell that raises, and its like.
    """
    book = from_source(name)
    with tempfile.TemporaryDirectory() as folder:
        env = os.environ | {
            "JAX_PLATFORMS": "cpu",
            "MPLBACKEND": "module://matplotlib_inline.backend_inline",
            "IPYTHONDIR": folder,  # nobody's settings
            "PYTHONPATH": os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")])),
        }
        client = NotebookClient(
            book,
            km=AsyncKernelManager(kernel_spec_manager=_ThisPython()),
            timeout=LONGEST,
            record_timing=False,
            resources={"metadata": {"path": folder}},
        )
        client.execute(env=env, cleanup_kc=True)  # or the kernel would stay, with its memory
    for cell in book.cells:
        if cell.cell_type == "code":
            cell.outputs = [_plain(output) for output in _joined(cell.outputs)]
    return numbered(book)


def _joined(outputs: list[Any]) -> list[Any]:
    """Pieces of one stream that follow each other as one: where they break is chance."""
    found: list[Any] = []
    for output in outputs:
        last = found[-1] if found else None
        if last and output.output_type == last.output_type == "stream" and output.name == last.name:
            last.text += output.text
        else:
            found.append(output)
    return found


def _plain(output: Any) -> Any:
    """An output without its metadata; a picture without those inside of it, with its width."""
    if output.output_type in ("display_data", "execute_result"):
        width = output.metadata.get("image/png", {}).get("width")  # its height follows
        output.metadata = {}
        if "image/png" in output.data:
            output.metadata = {"image/png": {"width": width}} if width else {}
            output.data = {
                "image/png": _pixels(output.data["image/png"]),
                "text/plain": output.data.get("text/plain", "a picture"),
            }
    return output


def _pixels(encoded: str) -> str:
    """A PNG without chunks of text, which name versions; with a palette, a third of the bytes."""
    png = Image.open(io.BytesIO(base64.b64decode(encoded)))
    full, file = png.convert("RGB"), io.BytesIO()
    few = full.quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    # A palette that would change a colour visibly is not used.
    changes = ImageChops.difference(full, few.convert("RGB")).getextrema()
    image = few if max(most for _, most in changes) <= UNSEEN else full
    image.save(file, "PNG", optimize=True, dpi=png.info.get("dpi"))
    return base64.b64encode(file.getvalue()).decode("ascii")


# --- what is checked ---------------------------------------------------------------------------


def faults(name: str, book: Any = None) -> list[str]:
    """The faults of a notebook as it is, one line each; nothing is executed.

    - `book`: in place of the file.
    """
    path = HERE / f"{name}.ipynb"
    if book is None and not path.exists():
        return ["there is no notebook: make notebooks"]
    book = committed(name) if book is None else book
    text = nbformat.writes(book)
    size = len(text.encode("utf-8"))
    found = []
    if size >= LARGEST:
        found.append(f"{size} bytes, allowed are {LARGEST - 1}: fewer or smaller pictures")
    if book.metadata != METADATA or (book.nbformat, book.nbformat_minor) != (4, 5):
        found.append("metadata are not those that make.py writes: make notebooks")
    found += _out_of_step(from_source(name).cells, book.cells)
    code = [cell for cell in book.cells if cell.cell_type == "code"]
    if [cell.execution_count for cell in code] != list(range(1, len(code) + 1)):
        found.append("cells were not executed once each in their order: make notebooks")
    outputs = [output for cell in code for output in cell.outputs]
    if not any(_is_picture(output) for output in outputs):
        found.append("there is no picture")
    for i, cell in enumerate(book.cells):
        shown = sum(_is_picture(output) for output in cell.get("outputs", []))
        if cell.cell_type == "code" and shown != (asked := cell.source.count("plt.show()")):
            found.append(f"cell {i} has {shown} pictures for {asked} plt.show()")
    if not any(re.search(r"^\s*assert ", cell.source, re.MULTILINE) for cell in code):
        found.append("nothing is verified: there is no assert")
    for i, cell in enumerate(book.cells):
        if cell.id != f"cell-{i:02d}" or cell.metadata:
            found.append(f"cell {i}: its id or metadata are not those that make.py writes")
        for output in cell.get("outputs", []):
            said = _text(output)
            if output.output_type == "error":
                found.append(f"cell {i} raises {output.ename}: {output.evalue}")
            if output.output_type == "stream" and output.name == "stderr":
                found.append(f"cell {i} warns: {said.strip()[:200]}")
            if place := _MACHINE.search(said):
                found.append(f"cell {i} names a place on a machine: {place.group().strip()!r}")
    return found


def _out_of_step(wanted: list[Any], seen: list[Any]) -> list[str]:
    if len(wanted) != len(seen):
        return [f"{len(seen)} cells, the source has {len(wanted)}: make notebooks"]
    return [
        f"cell {i} is not that of the source: make notebooks"
        for i, (a, b) in enumerate(zip(wanted, seen, strict=True))
        if (a.cell_type, a.source) != (b.cell_type, b.source)
    ]


def differences(old: Any, new: Any) -> list[str]:
    """Where the outputs of two notebooks of the same cells differ, one line each.

    Words must be equal, numbers nearly (`RELATIVE`, `ROUND_OFF`), pictures as many.
    """
    if len(old.cells) != len(new.cells):
        return [f"{len(old.cells)} cells, now {len(new.cells)}"]
    found = []
    for i, (a, b) in enumerate(zip(old.cells, new.cells, strict=True)):
        before, after = a.get("outputs", []), b.get("outputs", [])
        kinds = [[(o.output_type, _is_picture(o)) for o in cell] for cell in (before, after)]
        if kinds[0] != kinds[1]:
            found.append(f"cell {i}: kinds of outputs differ, {kinds[0]}, now {kinds[1]}")
            continue
        for x, y in zip(before, after, strict=True):
            if not _is_picture(x) and (what := unlike(_text(x), _text(y))):
                found.append(f"cell {i}: {what}")
    return found


def unlike(old: str, new: str) -> str:
    """The first thing that two texts differ in, or nothing."""
    for a, b in zip(old.splitlines(), new.splitlines(), strict=False):
        words = [" ".join(_NUMBER.sub("#", line).split()) for line in (a, b)]
        numbers = zip(_NUMBER.findall(a), _NUMBER.findall(b), strict=False)
        if words[0] != words[1] or not all(_near(x, y) for x, y in numbers):
            return f"{a.strip()!r}, now {b.strip()!r}"
    counts = len(old.splitlines()), len(new.splitlines())
    return "" if counts[0] == counts[1] else f"{counts[0]} lines, now {counts[1]}"


def _near(a: str, b: str) -> bool:
    x, y = (float(text.replace("−", "-")) for text in (a, b))
    size = max(abs(x), abs(y))
    return size < ROUND_OFF or abs(x - y) <= max(RELATIVE * size, 1.01 * max(_unit(a), _unit(b)))


def _unit(text: str) -> float:
    """The unit of the last digit: 0.001 for 1.234, 10 for 1.2e2; 0 for whole numbers."""
    mantissa, _, exponent = text.lower().partition("e")
    decimals = len(mantissa.partition(".")[2])
    if not decimals and not exponent:
        return 0.0
    return 10.0 ** (int(exponent or 0) - decimals)


def _is_picture(output: Any) -> bool:
    return "image/png" in output.get("data", {})


def _text(output: Any) -> str:
    if output.output_type == "stream":
        return output.text
    if output.output_type == "error":
        return "\n".join(output.traceback)
    return output.data.get("text/plain", "")


# --- the command --------------------------------------------------------------------------------


def made(name: str, check: bool) -> list[str]:
    """Make one notebook, or check it; what is wrong."""
    wrong = faults(name) if check else []
    try:
        book = executed(name)
    except CellExecutionError as error:
        return [*wrong, str(error)]
    if check:
        return wrong or differences(committed(name), book)
    nbformat.write(book, HERE / f"{name}.ipynb")
    return faults(name)


def main() -> int:
    """Make or check the requested notebooks, with one line each."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="notebooks; without names all")
    parser.add_argument("--check", action="store_true", help="compare and write nothing")
    given = parser.parse_args()
    if unknown := sorted(set(given.names) - set(names())):
        parser.error(f"no source for {', '.join(unknown)}; there are {', '.join(names())}.")
    status, total = 0, 0.0
    for name in given.names or names():
        print(f"{name:24}", end="", flush=True)
        began = time.perf_counter()
        wrong = made(name, given.check)
        total += (seconds := time.perf_counter() - began)
        path = HERE / f"{name}.ipynb"
        size = f"{path.stat().st_size / 1000:4.0f} kB" if path.exists() else "       "
        print(f"{seconds:6.1f} s  {size}  {'correct' if not wrong else 'wrong:'}")
        for line in wrong:
            print(f"    {line}")
        status |= bool(wrong)
    print(f"{'':24}{total:6.1f} s")
    return status


if __name__ == "__main__":
    sys.exit(main())
