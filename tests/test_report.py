"""Reports in HTML: of each kind of result, complete, escaped, without any other file."""

import re
import shlex
import shutil
import tomllib
from collections import Counter
from html.parser import HTMLParser
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cli import EXAMPLES, command, found, read, refuses, write

import dvi_jax as dvi
import dvi_jax_cli.work.page as page_module
from dvi_jax_cli._show import TextTable
from dvi_jax_cli.work.page import MAX_BYTES, Chapter, page
from dvi_jax_cli.work.repeat import plain, repetition, toml_text

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)

OWN = """
import jax.numpy as jnp
import dvi_jax as dvi

def H_D(t0, t1, q0, p1, args):
    return p1 @ p1 / 2 + args["k"] * jnp.sum(jnp.sqrt(q0 + 1.0))

system = dvi.System(H_D)

def height(t0, t1, q0, p0, q1, p1, args):
    return q1[0]

def level(q, p):
    return q[0]
"""

RUN = """
system = "own.py:system"
h = 0.1
steps = 30
[state]
q0 = [{q0}]
p0 = [0.5]
[args]
k = 1.0
[observables]
"<b>height" = "own.py:height"
level = "own.py:level"
largest = "Range(own.py:height)"
[output]
dir = "{name}"
plots = false
"""

SWEEP = """
system = "own.py:system"
h = 0.1
steps = 30
save = "final"
[state]
q0 = [0.5]
p0 = [{values = [0.0, -1.0, -2.0, -5.0], axis = "px"}]
[args]
k = {values = [0.5, 1.0, 2.0]}
[observables]
height = "own.py:height"
[output]
store = "sweep.zarr"
"""


class Reader(HTMLParser):
    """Tags, the text of each kind of element, attributes of pictures, and broken nesting."""

    VOID = ("meta", "img", "link", "br", "hr", "input")

    def __init__(self, text):
        super().__init__()
        self.open, self.tags, self.texts, self.attributes = [], [], {}, []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        if tag not in self.VOID:
            self.open.append((tag, dict(attrs).get("class", "")))

    def handle_endtag(self, tag):
        assert self.open.pop()[0] == tag

    def handle_data(self, data):
        for tag, kind in self.open[-1:]:
            self.texts.setdefault(tag, []).append(data)
            self.texts.setdefault(kind, []).append(data)


ELEMENTS = {"html", "head", "meta", "title", "style", "body", "main", "article", "header", "p"}
ELEMENTS |= {"h1", "h2", "dl", "div", "dt", "dd", "table", "thead", "tbody", "tr", "th", "td"}
ELEMENTS |= {"ul", "li", "figure", "img", "figcaption", "pre"}


def checked(file):
    """A page: small, whole, with no reference to anything else, and no element but ours."""
    content = Path(file).read_bytes()
    assert len(content) <= MAX_BYTES
    text = content.decode("utf-8")
    reader = Reader(text)
    assert set(reader.tags) <= ELEMENTS
    assert not re.search(
        r"https?:|//|@import|url\(|javascript:", re.sub(r"base64,[^\"]*", "", text)
    )
    for _, name, value in reader.attributes:
        assert name not in ("href", "srcset", "action", "data")
        assert not name.startswith("on")
        if name == "src":
            assert value.startswith(("data:image/svg+xml;base64,", "data:image/png;base64,"))
    pictures = reader.tags.count("img")
    alts = [value for tag, name, value in reader.attributes if (tag, name) == ("img", "alt")]
    assert len(alts) == pictures
    assert all(alts)
    return reader


def report_of(*words):
    """The object that the command prints for one chapter, and the page."""
    contents = found("report", *words)
    (chapter,) = contents["chapters"]
    assert contents["bytes"] == Path(contents["file"]).stat().st_size
    return chapter, checked(contents["file"])


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """A folder with a run that ends well, one that fails, a sweep and a saved batch."""
    folder = tmp_path_factory.mktemp("results")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        write(folder, OWN, "own.py")
        for name, q0, code in (("good", "0.5", 0), ("bad", "-0.9", 1)):
            write(folder, RUN.format(q0=q0, name=name), f"{name}.toml")
            result = command("run", f"{name}.toml")
            assert result.exit_code == code, result.output
        write(folder, SWEEP, "sweep.toml")
        result = command("sweep", "sweep.toml")
        assert result.exit_code == 0, result.output
    return folder


@pytest.fixture(autouse=True)
def _in_results(request, monkeypatch):
    if "results" in request.fixturenames:
        monkeypatch.chdir(request.getfixturevalue("results"))


def test_a_run_has_its_status_observables_and_command(results):
    chapter, reader = report_of("good")
    status = read("good/report.json")["status"]["result"]
    assert chapter["statuses"] == {status: 1}
    assert chapter["failures"] == 0
    assert reader.texts["verdict good"] == ["successful"]
    assert reader.tags.count("img") == 2  # of functions of a step and of a state
    assert "<b>height" in reader.texts["td"]  # the name of an observable, not markup
    assert shlex.split(chapter["command"]) == ["dvi-jax", "run", "good.toml", "--out", "good-again"]
    assert reader.texts["command"] == [chapter["command"]]
    assert "good.toml still has the values that were used:" in reader.texts["p"]
    assert dvi.__version__ in "".join(reader.texts["dd"])


def test_a_run_that_failed_says_where(results):
    chapter, reader = report_of("bad", "--out", "failed.html")
    status = read("bad/report.json")["status"]
    assert status["result"] != "successful"
    assert chapter["statuses"] == {status["result"]: 1}
    assert chapter["failures"] == 1
    (line,) = reader.texts["li"]
    assert line.startswith(f"{status['result'].replace('_', ' ')} at step {status['failed_step']} ")
    assert reader.texts["verdict bad"] == [status["result"].replace("_", " ")]


def test_a_sweep_counts_and_names_its_failures(results):
    chapter, reader = report_of("sweep.zarr")
    data = dvi.open_sweep("sweep.zarr").to_xarray()
    words = data.status.attrs["flag_meanings"].split()
    names = [words[code + 1] for code in np.ravel(data.status.values)]
    assert chapter["statuses"] == Counter(names)
    count = len(names) - names.count("successful")
    assert 0 < count == chapter["failures"] < len(names)
    assert f"{count} of {len(names)} trajectories failed" in reader.texts["verdict bad"]
    lines = [line for line in reader.texts["li"] if "px = " in line and "k = " in line]
    assert len(lines) == min(count, 10)
    k, p = np.argwhere(np.asarray(names).reshape(data.status.shape) != "successful")[0]
    first = dict(zip(data.status.dims, (k, p), strict=True))
    step = int(data.failed_step.isel(first))
    assert lines[0].endswith(f"at step {step}")
    assert "[{values = [0, -1, -2, -5], axis = px}]" in reader.texts["dd"]
    pictures = ["Status of each trajectory", "Map of height", "Map of p", "Map of q"]
    assert reader.texts["figcaption"] == pictures  # of the last states, not of their times
    assert reader.tags.count("img") == len(pictures)
    assert "[args]" in "".join(reader.texts["config"])
    expected = ["dvi-jax", "sweep", "sweep.toml", "--store", "sweep-again.zarr"]
    assert shlex.split(chapter["command"]) == expected


def test_a_saved_batch_counts_its_statuses(results):
    def one(p):
        system = dvi.System(lambda t0, t1, q0, p1, args: p1 @ p1 / 2 + jnp.sum(jnp.sqrt(q0 + 1.0)))
        options = {"h": 0.1, "num_steps": 30, "throw": False, "method": dvi.Strang()}
        energy = {"height": lambda t0, t1, q0, p0, q1, p1, args: q1[0]}
        return dvi.integrate(system, jnp.array([0.5]), p[None], observe=energy, **options)

    batch = jax.vmap(one)(jnp.array([5.0, -1.0, -9.0]))
    batch.save("batch.npz")
    chapter, reader = report_of("batch.npz")
    assert chapter["statuses"] == Counter(batch.status.tolist())
    assert chapter["failures"] == sum(name != "successful" for name in batch.status)
    assert 0 < chapter["failures"] < 3
    step = int(batch.stats["failed_step"][2])
    assert reader.texts["li"][-1].startswith("trajectory 2: ")
    assert f"at step {step} of 30" in reader.texts["li"][-1]
    assert reader.tags.count("img") == 2


def test_changed_and_missing_files_are_reported_with_the_values_that_were_used(results):
    contents = plain(read("good/report.json"))
    file, changed, missing = (dict(contents, run=name) for name in ("good", "changed", "missing"))
    file["run"] = "good.toml"
    changed["run"] = "bad.toml"
    remarks = ("still has the values", "has other values now", "There is no file missing ")
    for values, remark in zip((file, changed, missing), remarks, strict=True):
        fields = repetition("run", values, Path("good"))
        assert remark in fields["remarks"][-1]
        assert "q0 = [0.5]\n" in fields["config"]
        assert shlex.split(fields["command"])[2] == values["run"]


@pytest.mark.slow
def test_the_same_results_give_the_same_page(results):
    content = Path(found("report", "good", "--out", "one.html")["file"]).read_bytes()
    found("report", "good", "--out", "one.html", "--force")
    assert Path("one.html").read_bytes() == content


DAMAGE = {
    "report.json": [
        b"",
        b"{",
        b"[]",
        b"{}",
        b'{"config": 3}',
        b'{"run": "x", "config": {}}',
        b"\xff",
    ],
    "trajectory.npz": [b"", b"PK\x03\x04", None],
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damaged_results_are_an_error_with_the_file(results, tmp_path, name):
    for i, content in enumerate(DAMAGE[name]):
        folder = tmp_path / str(i)
        shutil.copytree("good", folder)
        if content is None:
            (folder / name).unlink()
        else:
            (folder / name).write_bytes(content)
        result = command("report", folder)
        refuses(result, str(folder), "as dvi-jax w")
        assert not (tmp_path / f"{i}.html").exists()


def test_what_is_no_result_is_an_error_that_names_it(results, tmp_path):
    refuses(command("report", tmp_path / "missing"), "there is no", "a run, fit")
    refuses(command("report", tmp_path), "it contains nothing", "a run, fit")
    refuses(command("report", results), "it contains", "such as ")
    write(tmp_path, "x = 3", "notes.txt")
    refuses(command("report", tmp_path), "notes.txt", "a run, fit")
    refuses(command("report", tmp_path / "notes.txt"), "notes.txt", "a run, fit")
    np.savez(tmp_path / "other.npz", x=np.arange(3))
    refuses(command("report", tmp_path / "other.npz"), "other.npz", "Solution.save")
    refuses(command("report", "good", "--out", "own.py"), "exists already", "--force")
    assert Path("own.py").read_text(encoding="utf-8") == OWN
    refuses(command("report", "good", "--out", tmp_path / "no" / "x.html"), "there is no directory")


MARKUP = "<script>alert(1)</script>\"'&<img src=x onerror=y>\x00\x1b\ud800]]>"


def test_no_text_becomes_markup(tmp_path):
    table = TextTable(MARKUP, [MARKUP, MARKUP], [[MARKUP, MARKUP]])
    chapter = Chapter(MARKUP, MARKUP, MARKUP, "bad")
    for name in ("facts", "origin", "statuses"):
        setattr(chapter, name, {MARKUP: 3 if name == "statuses" else MARKUP})
    for name in ("failures", "notes", "formulas", "remarks"):
        setattr(chapter, name, [MARKUP])
    chapter.pictures, chapter.tables = {MARKUP: b"\x89PNG"}, [table]
    chapter.command = chapter.config = MARKUP
    (tmp_path / "page.html").write_bytes(page(MARKUP, [chapter]))
    reader = checked(tmp_path / "page.html")
    assert reader.tags.count("img") == 1
    shown = MARKUP.replace("\x00", "\ufffd").replace("\x1b", "\ufffd").replace("\ud800", "\ufffd")
    for tag in ("h1", "dt", "dd", "li", "th", "td", "command", "config", "formulas", "note"):
        assert shown in reader.texts[tag], tag


def test_large_results_are_shortened_with_a_remark(tmp_path, monkeypatch):
    table = TextTable("x", ["n", "y"], [[str(i), "y" * 5000] for i in range(500)])
    chapter = Chapter("run", "large", "successful", "good", tables=[table], config="z" * 300_000)
    chapter.failures, chapter.num_failures = [f"trajectory {i}" for i in range(10)], 12_345

    monkeypatch.setattr(page_module, "_SVG", 100)
    draw = lambda: dvi.plot.plt.figure().gca()  # noqa: E731
    wide = lambda: dvi.plot.plt.figure(figsize=(9, 3)).gca()  # noqa: E731
    chapter.pictures = {"points": draw, "file": b"0" * 3_000_000, "wide": wide}
    (tmp_path / "page.html").write_bytes(page("large", [chapter]))
    reader = checked(tmp_path / "page.html")
    text = " ".join(reader.texts["p"])
    assert "… and 440 more rows" in text
    assert reader.tags.count("tr") == 61
    assert "… and 12335 more failures" in text
    assert " … and 100000 more characters" in "".join(reader.texts["config"])
    assert [v[:15] for _, n, v in reader.attributes if n == "src"] == 2 * ["data:image/png;"]
    assert [v for tag, n, v in reader.attributes if (tag, n) == ("figure", "class")] == ["large"]
    assert any(
        "file cannot be drawn: 3 MB do not fit into the page" in t
        for t in reader.texts["figcaption"]
    )


@pytest.mark.slow
def test_a_phone_shows_a_report_legibly(tmp_path):
    """Only pictures, tables and the TOML file slide; letters of a picture are not too small."""
    playwright = pytest.importorskip("playwright.sync_api")
    if BROWSER is None:
        pytest.skip("there is no Chromium")
    chapter = Chapter("run", "long_" * 30, "successful", "good", command="dvi-jax run " * 20)
    chapter.tables = [TextTable("x", ["a long name of a column"] * 3, [["1.2345e-12"] * 3])]
    chapter.pictures = {"curve": lambda: dvi.plot.plt.figure(figsize=(6.4, 4.8)).gca()}
    chapter.notes, chapter.formulas = ["word " * 100], ["q² + " * 100]
    (tmp_path / "page.html").write_bytes(page("x", [chapter]))
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=BROWSER, args=["--no-sandbox"])
        tab = browser.new_page(viewport={"width": 390, "height": 844})
        tab.goto((tmp_path / "page.html").as_uri())
        width = "e => e.scrollWidth - e.clientWidth"
        assert tab.eval_on_selector("html", width) == 0
        for part in ("pre.command", "pre.formulas", "p.note", "h1", "figcaption", ".wide"):
            assert tab.eval_on_selector(part, width) == 0, part
        assert tab.eval_on_selector("img", "e => e.clientWidth") > 70 * 6.4  # pixels per inch
        browser.close()


def test_a_table_is_written_as_toml_and_read_again():
    table = {"a b": 'text "x"\n\x7fé', "n": -3, "x": 1e-300, "big": 1e16, "yes": True}
    table |= {"inf": float("inf"), "rows": [[1.0, float("-inf")], []], "empty": {}}
    table |= {"t": {"q": {"geomspace": [1e-4, 1.0, 3]}, "list": [{"a": 1, "b c": [2]}]}}
    assert tomllib.loads(toml_text(table)) == table


@pytest.mark.slow
def test_the_command_repeats_the_same_numbers(results):
    for name, file in (("good", "trajectory.npz"), ("sweep.zarr", None)):
        _, *words = shlex.split(report_of(name, "--out", f"{name}.2.html")[0]["command"])
        assert command(*words).exit_code == 0
        if file:
            first, again = (np.load(Path(folder) / file) for folder in (name, f"{name}-again"))
            assert all(np.array_equal(first[key], again[key]) for key in first.files)
        else:
            first, again = map(dvi.open_sweep, (name, "sweep-again.zarr"))
            assert np.array_equal(first["height"], again["height"], equal_nan=True)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["fit", "discover", "bound"])
def test_reports_of_the_examples(kind, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(EXAMPLES, "examples")
    assert command(kind, f"examples/{kind}.toml").exit_code == 0
    chapter, reader = report_of(f"results/{kind}")
    assert reader.tags.count("img") >= 1
    assert "verdict good" in reader.texts
    words = shlex.split(chapter["command"])
    assert words == ["dvi-jax", kind, f"examples/{kind}.toml", "--out", f"results/{kind}-again"]
    if kind == "fit":
        assert chapter["verdict"] == read("results/fit/fit.json")["status"] == "converged"
        alone, again = report_of("results/fit/fit.npz")
        assert alone["verdict"] == "converged"
        assert reader.tags.count("img") == again.tags.count("img")
    elif kind == "discover":
        entries = read("results/discover/invariants.json")["invariants"]
        assert chapter["verdict"] == f"{len(entries)} invariant"
        reasons = Counter(x for entry in entries for x in entry["drift"]["excluded"])
        counts = {f"ε: {x or 'used in the fit'}": n for x, n in reasons.items()}
        assert chapter["statuses"] == counts
        assert f"I1 = {entries[0]['formula']}" in "".join(reader.texts["formulas"])
    else:
        assert chapter["verdict"] == "proved"
        file = Path("results/bound/certificate.json")
        assert report_of(file)[0]["verdict"] == "proved"
        text = file.read_text(encoding="utf-8").replace('"rounding": [', '"rounding": ["0x0p+0", ')
        file.write_text(text.replace('"steps": ', '"steps": 9'), encoding="utf-8")
        chapter, reader = report_of("results/bound", "--force")
        assert (chapter["verdict"], chapter["failures"]) == ("not proved", 1)
        assert "verdict bad" in reader.texts
