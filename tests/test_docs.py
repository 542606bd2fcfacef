"""The documentation: examples run, it builds without a warning, a browser shows it whole."""

import functools
import html.parser
import http.server
import importlib
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import threading
import urllib.parse
from pathlib import Path

import pages
import pytest
from compilation import flags_of_users

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"

BLOCK = re.compile(
    r"^(?:<!-- not run by the tests: (?P<reason>.+?) -->\n)?```python\n(?P<code>.*?)^```",
    re.S | re.M,
)
ELSEWHERE = {"sweeps", "fitting", "chaos", "certificate", "examples"}
ELSEWHERE |= {"interoperability", "migration"}
"""Pages whose numbers test_readme.py, test_certify.py, test_docstrings.py and test_interop_pages.py
compare."""


def examples(page):
    """(the code of a page, in one piece; the blocks that are left out)."""
    found = list(BLOCK.finditer(page.read_text(encoding="utf-8")))
    run = [m["code"] for m in found if m["reason"] is None]
    return "\n".join(run), [m["reason"] for m in found if m["reason"] is not None]


PAGES = [p for p in sorted(DOCS.glob("*.md")) if examples(p)[0] and p.stem not in ELSEWHERE]


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_examples_run(page, tmp_path):
    options = {"JAX_PLATFORMS": "cpu", "XLA_FLAGS": flags_of_users()}
    lines = pages.run(examples(page)[0], tmp_path, **options)
    for line in printed(page):
        assert line in lines


def test_a_wrong_number_of_a_comment_is_seen(tmp_path):
    code = "print(0.0712, 2.5e-11)  # 0.071 and 2.5e-11: the errors\nx = 1  # 3 bodies\n"
    code += "for k in range(2):\n    print(k, 'of', x)\n# 0 of 1\n# 1 of …\n"
    code += "print(3.14159)  # 3.14…\n"
    code += "print(-0.5, 1e-4)  # −0.5, and the other below 1e-3; 7 is not of it\n"
    code += "def f():\n    print(1)  # 2\nprint(3e-16)  # 8e-16: round-off\nprint('a')  # words\n"
    assert pages.run(code, tmp_path)[0] == "0.0712 2.5e-11"
    stated = [claim.text.strip() for claim in pages.claims(code)]
    assert stated[:3] == ["0.071 and 2.5e-11", "0 of 1\n1 of …", "3.14…"]
    assert len(stated) == 5
    for right, wrong in (
        ("# 0.071", "# 0.072"), ("and 2.5e-11", "and 2e-08"), ("# 0 of 1", "# 0 of 2"),
        ("# 3.14…", "# 3.15…"), ("# −0.5", "# 0.5"), ("below 1e-3", "below 1e-5"),
        ("# 8e-16", "# 8e-11"),
    ):  # fmt: skip
        assert code.count(right) == 1
        with pytest.raises(AssertionError, match=re.escape(wrong.split(" ")[-1])):
            pages.run(code.replace(right, wrong), tmp_path)
    code = "a = f()  # 0.25\nb = g()  # 8e-16\nc = h()  # 3 bodies\n"
    assert pages.wrong_values(code, {"a": 0.2502, "b": 1e-15}) == {}
    assert pages.wrong_values(code, {"a": 0.2602, "b": 1e-9}) == {
        "a": ("0.25", 0.2602), "b": ("8e-16", 1e-9)
    }  # fmt: skip


def too_long(text):
    """Lines of code, in fences or indented, that a desk shows only with a scroll bar."""
    code = re.findall(r"^```[^\n]*\n(.*?)^```", text, re.S | re.M)
    code += re.findall(r"(?<=\n\n)((?: {4}[^\n]*\n)+)", text)
    return [line for block in code for line in block.splitlines() if len(line) > 100]


def test_code_fits_and_links_lead_to_files():
    pages = [ROOT / "README.md", *DOCS.glob("*.md")]
    long = {page.name: too_long(page.read_text(encoding="utf-8")) for page in pages}
    assert {name: lines for name, lines in long.items() if lines} == {}
    line = "x" * 101
    assert too_long(f"```\n{line}\n```\n") == [line]
    assert too_long(f"a\n\n    {line}\n\n{line}\n") == [f"    {line}"]
    # Pages are read on a code host, too.
    pages = [*ROOT.glob("*.md"), *DOCS.glob("*.md")]
    assert len(pages) > 25
    missing = {p.name: missing_files(p, p.read_text(encoding="utf-8")) for p in pages}
    assert {name: links for name, links in missing.items() if links} == {}
    links = "[a](docs/none.md) [b](docs/faq.md)"
    assert missing_files(ROOT / "README.md", links) == ["docs/none.md"]


RAW = re.compile(r":::|```|\{(?:container|toctree|figure|note|math)\}|\]\([^)\s]*\)|<!--|&lt;!--")
"""Markup of MyST that a reader must not see."""


class _Text(html.parser.HTMLParser):
    """The text of a page without that of scripts and programs."""

    def __init__(self, page):
        super().__init__()
        self.inside, self.texts = [], []
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        if tag in ("script", "style", "pre", "code"):
            self.inside.append(tag)

    def handle_endtag(self, tag):
        if self.inside and self.inside[-1] == tag:
            self.inside.pop()

    def handle_data(self, data):
        if not self.inside:
            self.texts.append(data)


def raw_markup(page):
    """Markup that is left over in the HTML of a page."""
    return RAW.findall("".join(_Text(page).texts))


def loose_fences(text):
    """Lines with colons of a container that are not alone on their line, and open containers."""
    lines = [line for line in text.splitlines() if ":::" in line]
    fences = [re.fullmatch(r"(:{3,})(\{\w+\}.*)?", line) for line in lines]
    open_fences = []
    for match in filter(None, fences):
        if match[2]:
            open_fences.append(match[1])
        elif not open_fences or open_fences.pop() != match[1]:
            return [match[0]]
    return [line for line, match in zip(lines, fences, strict=True) if not match] + open_fences


def test_containers_of_pages_are_fences():
    """A paragraph that is filled again joins the lines of containers to text."""
    pages = {page.name: page.read_text(encoding="utf-8") for page in DOCS.glob("*.md")}
    assert ":::" in pages["index.md"]
    assert {name: loose_fences(text) for name, text in pages.items() if loose_fences(text)} == {}
    assert loose_fences("::::{container} a\ntext :::: ::::{container} b\n::::\n") != []
    assert loose_fences(":::{note}\ntext\n") == [":::"]
    assert loose_fences("::::{a}\n:::{b}\n::::\n:::\n") != []
    assert loose_fences("::::{a}\n:::{b}\n:::\n::::\n") == []
    for left in ("a :::: b", "```text", "[a](b.md)", "{toctree}"):
        assert raw_markup(f"<p>{left}</p>") != [], left
    assert raw_markup("<script>a:::b</script><pre>```</pre><p>a::b (c)</p>") == []


TOCTREE = re.compile(r"^```\{toctree\}\n((?:.+\n|\n)*?)```", re.M)


def children(page):
    """The pages that a page lists in its table of contents, which the sidebar shows."""
    lines = "".join(TOCTREE.findall(page.read_text(encoding="utf-8"))).splitlines()
    return [line for line in lines if line and not line.startswith(":")]


def test_the_sidebar_is_short_and_has_every_page_once():
    assert len(children(DOCS / "index.md")) <= 30
    listed = [child for page in DOCS.glob("*.md") for child in children(page)]
    assert len(set(listed)) == len(listed)
    notebooks = {f"notebooks/{path.stem}" for path in (ROOT / "notebooks").glob("*.ipynb")}
    pages = {path.stem for path in DOCS.glob("*.md")} - {"index", "examples"}
    assert set(listed) == pages | notebooks | {"reference/index"}


def test_the_gallery_has_every_notebook_example_and_plot(extensions):
    gallery = importlib.import_module("gallery")
    names = {kind: {card.name for card in gallery.cards(kind)} for kind in gallery.KINDS}
    files = [*(ROOT / "examples").glob("*.py"), *(ROOT / "examples").glob("*.toml")]
    assert names["examples"] == {path.name for path in files}
    assert names["notebooks"] == {path.stem for path in (ROOT / "notebooks").glob("*.ipynb")}
    from dvi_jax import plot

    functions = {f"plot.{n}" for n in extensions[0].public(plot)} - {"plot.save", "plot.style"}
    assert names["plots"] == functions


PRINTED = re.compile(r"^<!-- printed -->\n```text\n(.*?)^```", re.S | re.M)


def printed(page):
    """The lines that a page says its code prints."""
    return "".join(PRINTED.findall(page.read_text(encoding="utf-8"))).splitlines()


def test_pages_show_what_they_print_and_say_what_is_left_out(tmp_path):
    formula, *last = printed(DOCS / "index.md")
    assert formula.startswith("0.5 q² − 0.05 q p + 0.5 p² + ε (")
    assert last == ["ε^1.99"]
    reasons = {page.stem: examples(page)[1] for page in sorted(DOCS.glob("*.md"))}
    assert {name for name in reasons if reasons[name]} <= {"clusters"}
    assert len(PAGES) >= 10
    page = tmp_path / "page.md"
    page.write_text(
        "```python\na\n```\n<!-- not run by the tests: it needs b -->\n```python\nb\n```\n"
    )
    assert examples(page) == ("a\n", ["it needs b"])


def missing_files(page, text):
    """Relative links of Markdown that lead to no file of the repository."""
    found = re.findall(r"\]\((?!https?:|mailto:|#)([^)#\s]+)", text)
    made = ("reference/",)  # by the build
    return [x for x in found if not x.startswith(made) and not (page.parent / x).exists()]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The folder of the pages, made in a copy; a warning is a failure."""
    folder = tmp_path_factory.mktemp("docs")
    ignore = shutil.ignore_patterns("_build", "reference", "__pycache__")
    shutil.copytree(DOCS, folder / "docs", ignore=ignore)
    for name in ("notebooks", "examples"):
        shutil.copytree(ROOT / name, folder / name)
    shutil.copy(ROOT / "CHANGELOG.md", folder)
    words = "-m sphinx -W --keep-going -q -b html -j auto docs html"
    out = subprocess.run(
        [sys.executable, *words.split()], cwd=folder, capture_output=True, text=True, check=False,
        env={**os.environ, "JAX_PLATFORMS": "cpu", "NO_COLOR": "1"}, timeout=900,
    )  # fmt: skip
    assert out.returncode == 0, out.stderr
    assert out.stderr == ""
    return folder / "html"


class _Anchors(html.parser.HTMLParser):
    def __init__(self, text):
        super().__init__()
        self.links, self.ids = [], set()
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        self.ids |= {attrs[k] for k in ("id", "name") if attrs.get(k)}
        for key in ("href", "src"):
            if attrs.get(key):
                self.links.append(attrs[key])


def dead_links(folder):
    """(page, link) for each that leads nowhere within the folder."""
    pages = {p: _Anchors(p.read_text(encoding="utf-8")) for p in sorted(folder.rglob("*.html"))}
    dead = []
    for page, found in pages.items():
        for link in found.links:
            parts = urllib.parse.urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            path = urllib.parse.unquote(parts.path)
            target = (page.parent / path).resolve() if path else page
            anchor = urllib.parse.unquote(parts.fragment)
            if target.is_dir():
                target = target / "index.html"
            known = pages.get(target)
            if not target.exists() or (anchor and known is not None and anchor not in known.ids):
                dead.append((page.name, link))
    return dead


@pytest.mark.slow
def test_links_names_and_sizes_of_the_site(site, tmp_path):
    assert len(list(site.rglob("*.html"))) > 40
    assert dead_links(site) == []
    left = {p.name: raw_markup(p.read_text(encoding="utf-8")) for p in site.rglob("*.html")}
    assert {name: words for name, words in left.items() if words} == {}
    (tmp_path / "a.html").write_text('<p id="x"><a href="b.html">b</a><a href="#x"><a href="#y">')
    assert dead_links(tmp_path) == [("a.html", "b.html"), ("a.html", "#y")]
    import dvi_jax as dvi
    from dvi_jax import _namespaces

    text = "".join(p.read_text(encoding="utf-8") for p in (site / "reference").glob("*.html"))
    names = [n for n in _namespaces.names() if callable(getattr(dvi, n))]
    assert len(names) > 120
    assert [n for n in names if f'id="dvi_jax.{n}"' not in text] == []
    # At most 500 kB with its pictures; scripts and styles are loaded once for all pages.
    large = {}
    for path in site.rglob("*.html"):
        text = path.read_text(encoding="utf-8")
        pictures = {path.parent / name for name in re.findall(r'<img[^>]* src="([^":]+)"', text)}
        size = path.stat().st_size + sum(picture.stat().st_size for picture in pictures)
        if size > 500e3:
            large[path.name] = size
    assert large == {}


def entry(site, page, name):
    """The HTML of one entry of the reference, from its signature to the next one."""
    text = (site / f"reference/{page}.html").read_text(encoding="utf-8")
    return text[text.index(f'id="dvi_jax.{name}"') :].split('<dt class="sig')[0]


@pytest.mark.slow
def test_names_and_formulas_of_the_site(site):
    """A parameter `fit` is no link; a picture's name is a picture; theirs is not ours."""
    assert "#dvi_jax.fit" not in entry(site, "plot", "plot.fit_against_data")
    assert "#dvi_jax.FitResult" in entry(site, "plot", "plot.fit_against_data")
    assert "#dvi_jax.drift_surface" in entry(site, "plot", "plot.drift_surface")
    read = {p: (site / f"{p}.html").read_text(encoding="utf-8") for p in ("plots", "systems")}
    assert "#dvi_jax.plot.drift_surface" in read["plots"]
    assert "#dvi_jax.drift_surface" not in read["plots"]
    assert "#dvi_jax.systems.kepler" in read["systems"]
    term = entry(site, "interop", "interop.diffrax_term")
    assert "#dvi_jax.interop.vector_field" in term
    notebook = (site / "notebooks/the_paper.html").read_text(encoding="utf-8")
    assert re.search(r'href="../what-is-conserved.html"><[^>]*>docs/what-is-conserved', notebook)
    theirs = (site / "migration.html").read_text(encoding="utf-8")
    first = re.findall(r"<tr[^>]*><td>(.*?)</td>", theirs, re.S)
    assert any("LobattoIIIAIIIB" in cell for cell in first)
    assert not [cell for cell in first if "<a " in cell]
    # No emphasis between the underscores of q_k and p_k; indices are set as indices.
    emphasised = [
        (path.name, words)
        for path in site.rglob("*.html")
        for words in re.findall(r"<em>([^<]*)</em>", path.read_text(encoding="utf-8"))
        if re.search(r"[=·{}∘]", words)
    ]
    assert emphasised == []
    paper = (site / "paper.html").read_text(encoding="utf-8")
    assert "E⁺<sub>k</sub> − E⁻<sub>k</sub> = εW<sub>k</sub>·(q<sub>k+1</sub>" in paper
    index = (site / "genindex.html").read_text(encoding="utf-8")
    assert "integrate() (in module dvi_jax)" in index
    assert "built-in" not in index


@pytest.fixture(scope="module")
def extensions():
    """The two extensions of Sphinx in docs/_ext."""
    pytest.importorskip("sphinx")
    sys.path.insert(0, str(DOCS / "_ext"))
    try:
        yield importlib.import_module("reference"), importlib.import_module("scripts")
    finally:
        sys.path.remove(str(DOCS / "_ext"))


def test_docstrings_and_running_text_as_html(extensions):
    as_html = extensions[1].as_html
    assert as_html("q_{k+1} − ξ0_m < h^−order") == (
        "q<sub>k+1</sub> − ξ0<sub>m</sub> &lt; h<sup>−order</sup>"
    )
    assert as_html("T^−(2·w+2)") == "T<sup>−(2·w+2)</sup>"
    assert as_html("10 000 steps, 2.8e-13") == (
        '<span class="number">10 000</span> steps, <span class="number">2.8e-13</span>'
    )
    for plain in ("num_steps", "t_eval", "a < b", "2000 steps", "in 5 to 10"):
        assert as_html(plain) is None, plain
    import dvi_jax as dvi

    reference = extensions[0]
    assert reference.literally("E⁻_k and `a_b`, Φ*_h\n\n    x_1 *") == (
        r"E⁻\_k and `a_b`, Φ\*\_h" + "\n\n    x_1 *"
    )
    assert reference.signature(dvi.Adjoint) == "(method: Method = TypeII())"


@pytest.mark.parametrize("dpi", [110, 220, None])
def test_the_size_of_a_picture_does_not_depend_on_its_pixels(tmp_path, dpi):
    """A notebook's pictures have twice the pixels of those before; without a resolution: 110."""
    pytest.importorskip("sphinx")
    image = pytest.importorskip("PIL.Image")
    about = importlib.util.spec_from_file_location("of_docs", DOCS / "_ext/pictures.py")
    pictures = importlib.util.module_from_spec(about)
    about.loader.exec_module(pictures)
    name = tmp_path / "picture.png"
    image.new("L", (550, 330)).save(name, **({"dpi": (dpi, dpi)} if dpi else {}))
    width, height = pictures.size(name)
    assert width == pytest.approx(550 / (dpi or 110), rel=1e-3)
    assert height == pytest.approx(330 / (dpi or 110), rel=1e-3)


BROWSER = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
FLAGS = [
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
]  # fmt: skip
WIDTHS = (1280, 390)
"""A desk's and a phone's."""

FAULTS = r"""async (math) => {
  if (math && window.MathJax && MathJax.startup) await MathJax.startup.promise;
  const faults = [], all = s => [...document.querySelectorAll(s)];
  const wanted = all('.math').length, shown = all('.math mjx-container').length;
  if (wanted !== shown) faults.push(`${shown} of ${wanted} formulas are rendered`);
  for (const e of all('mjx-merror, [data-mjx-error]')) faults.push('formula: ' + e.textContent);
  const walk = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  for (let n = walk.nextNode(); n; n = walk.nextNode())
    if (/\$|\\\(|\\\[|[_^]\{|^\s*\[ \] |HAS_DEFAULT/.test(n.data)
        && (!n.parentElement.closest('pre, code, dt.sig, script, style, mjx-container')
            || /HAS_DEFAULT/.test(n.data) && n.parentElement.closest('dt.sig')))
      faults.push('left over: ' + n.data.trim().slice(0, 60));
  for (const i of all('img')) { i.loading = 'eager'; await i.decode().catch(() => 0);
    if (!i.naturalWidth) faults.push('picture: ' + i.src); }
  return [faults, wanted];
}"""

TOO_WIDE = """() => {
  const whole = document.documentElement, text = document.querySelector('.content');
  return Math.max(whole.scrollWidth - window.innerWidth,
                  text ? text.scrollWidth - text.clientWidth : 0);
}"""
"""Of the page, or of its text, which must not slide as a whole either."""

FAINT = r"""() => {
  const parts = c => c.match(/[\d.]+/g).map(Number).concat(1).slice(0, 4);
  const over = (a, b) => [0, 1, 2].map(i => a[i] * a[3] + b[i] * (1 - a[3])).concat(1);
  const behind = e => {
    const layers = [];
    for (; e; e = e.parentElement) layers.push(parts(getComputedStyle(e).backgroundColor));
    return layers.reverse().reduce((below, above) => over(above, below), [255, 255, 255, 1]); };
  const luminance = c => [0.2126, 0.7152, 0.0722].reduce((sum, weight, i) => sum + weight *
    (c[i] / 255 <= 0.03928 ? c[i] / 255 / 12.92 : ((c[i] / 255 + 0.055) / 1.055) ** 2.4), 0);
  const faint = new Set(), walk = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  for (let n = walk.nextNode(); n; n = walk.nextNode()) {
    const e = n.parentElement;
    if (!n.data.trim() || !e.checkVisibility({opacityProperty: true, visibilityProperty: true})
        || e.closest('svg, script, style, noscript, mjx-assistive-mml')) continue;
    const paper = behind(e), ink = over(parts(getComputedStyle(e).color), paper);
    const [dark, bright] = [luminance(ink), luminance(paper)].sort((a, b) => a - b);
    if ((bright + 0.05) / (dark + 0.05) < 4.5) faint.add('faint: ' + n.data.trim().slice(0, 30));
  }
  return [...faint];
}"""
"""Text whose contrast with what is behind it is below 4.5, the bound of WCAG 2.2 (AA, 1.4.3)."""

FOCUS = """() => {
  const e = document.activeElement, style = getComputedStyle(e);
  const seen = style.outlineStyle !== 'none' && parseFloat(style.outlineWidth) > 0;
  return [e.tagName, seen || style.boxShadow !== 'none', e.href || ''];
}"""


def browser_or_skip():
    if BROWSER is None:
        assert not os.environ.get("CI"), "CI has to have Chromium: see .ci/run"
        pytest.skip("Chromium is not installed")
    return pytest.importorskip("playwright.sync_api").sync_playwright


@pytest.fixture(scope="module")
def serve():
    """folder → address, over HTTP on this machine."""
    servers = []

    def start(folder):
        class Quiet(http.server.SimpleHTTPRequestHandler):
            def log_message(self, *_):
                pass

        handler = functools.partial(Quiet, directory=str(folder))
        server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
        threading.Thread(target=server.serve_forever, daemon=True).start()
        servers.append(server)
        return f"http://127.0.0.1:{server.server_address[1]}"

    yield start
    for server in servers:
        server.shutdown()


@pytest.fixture(scope="module")
def page():
    """A tab that asks nobody but the page's own server.

    `page.open_page(address)`; `page.faults(address)` → (what is wrong there, how many formulas).
    """
    with browser_or_skip()() as driver:
        browser = driver.chromium.launch(executable_path=BROWSER, args=FLAGS)
        tab, seen, home = browser.new_page(), [], []
        tab.on("pageerror", lambda e: seen.append(f"script: {e}"))

        def local_only(route):
            if not home or route.request.url.startswith((home[0], "data:", "blob:")):
                return route.continue_()
            seen.append(f"requested {route.request.url}")
            return route.abort()

        tab.route("**/*", local_only)

        def open_page(address):
            home[:] = [address[: address.index("/", 8)]]
            seen.clear()
            tab.goto(address)

        def faults(address):
            tab.set_viewport_size({"width": WIDTHS[0], "height": 900})
            open_page(address)
            found, formulas = tab.evaluate(FAULTS, True)
            for width in WIDTHS:
                tab.set_viewport_size({"width": width, "height": 900})
                over = tab.evaluate(TOO_WIDE)
                if over > 0:
                    found.append(f"{over} pixels too wide at {width}")
            for scheme in ("light", "dark"):
                tab.emulate_media(color_scheme=scheme)
                found.extend(f"{scheme}: {words}" for words in tab.evaluate(FAINT))
            return found + seen, formulas

        tab.faults, tab.open_page = faults, open_page
        yield tab
        browser.close()


@pytest.mark.slow
def test_a_browser_shows_every_page_whole(site, serve, page):
    home, found, formulas = serve(site), {}, 0
    for path in sorted(site.rglob("*.html")):
        name = path.relative_to(site).as_posix()
        faults, count = page.faults(f"{home}/{name}")
        formulas += count
        if faults:
            found[name] = faults
    assert found == {}
    assert formulas > 60
    assert page.faults(f"{home}/theory.html")[1] > 50


@pytest.mark.slow
def test_a_keyboard_leads_through_a_page(site, serve, page, tmp_path):
    """Tab reaches every part of the page in turn, and one sees where one is."""
    (tmp_path / "hidden.html").write_text(
        "<style>a:focus { outline: none }</style><a href='x'>x</a>", encoding="utf-8"
    )
    steps = {}
    for folder, name, presses in (
        (site, "getting-started.html", 130),
        (tmp_path, "hidden.html", 1),
    ):
        page.open_page(f"{serve(folder)}/{name}")
        steps[name] = []
        for _ in range(presses):
            page.keyboard.press("Tab")
            steps[name].append(page.evaluate(FOCUS))
    walked = steps["getting-started.html"]
    # After the last element the whole page has the focus once.
    assert [step for step in walked if not step[1] and step[0] != "BODY"] == []
    assert {"A", "INPUT", "BUTTON"} <= {step[0] for step in walked}
    assert walked[0][2].endswith("#furo-main-content")  # past the navigation by one key
    assert not steps["hidden.html"][0][1]


@pytest.mark.slow
def test_what_is_wrong_with_a_page_is_seen(site, serve, page, tmp_path):
    """The controls: one fault of each kind."""
    (tmp_path / "mathjax.js").symlink_to(site / "_static/mathjax/tex-svg-full.js")
    page_text = """<!doctype html><meta charset="utf-8"><body>
      <script>window.MathJax = {options: {processHtmlClass: "math", ignoreHtmlClass: "un"}}</script>
      <script src="mathjax.js"></script>%s</body>"""
    bodies = {
        "fine": '<p class="math">\\(x^2\\)</p><code>$HOME</code>',
        "unrendered": '<div class="un"><p class="math">x</p></div>',
        "wrong": '<p class="math">\\(\\frac{1\\)</p>',
        "dollar": '<p class="un">costs $x$</p>',
        "braces": '<p class="un">q_{k+1}</p>',
        "task": "<ul><li>[ ] to do</li></ul>",
        "default": '<dl><dt class="sig">f(x=_HAS_DEFAULT_FACTORY)</dt></dl>',
        "wide": '<div style="width: 2000px">x</div>',
        "slides": '<div class="content" style="overflow: auto"><p style="width: 2000px">x</p>',
        "picture": '<img src="none.png">',
        "outside": '<script src="http://192.0.2.1/x.js"></script>',
        "script": "<script>throw new Error('no')</script>",
        "faint": '<p style="color: #888; background: #fff">faint words</p>',
    }
    seen = {}
    home = serve(tmp_path)
    for name, body in bodies.items():
        (tmp_path / f"{name}.html").write_text(page_text % body, encoding="utf-8")
        seen[name] = "; ".join(page.faults(f"{home}/{name}.html")[0])
    assert seen.pop("fine") == ""
    expected = {
        "unrendered": "0 of 1 formulas", "wrong": "formula", "dollar": "left over: costs $x$",
        "braces": "left over: q_{k+1}", "task": "left over: [ ]", "default": "left over: f(x=_HAS",
        "wide": "pixels too wide at 390",
        "slides": "pixels too wide at 390", "picture": "none.png", "outside": "requested http://192",
        "script": "script: ", "faint": "dark: faint: faint words",
    }  # fmt: skip
    for name, words in expected.items():
        assert words in seen[name], (name, seen[name])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "where"),
    [
        ("balance law", "theory"),
        ("drift_order", "reference/discovery"),
        ("MEGNO", "chaos"),
        ("adaptive", "lattices"),
        ("Verlet", "which-method"),
        ("Julia", "migration"),
        ("plasma", "faq"),
        ("neural network", "faq"),
        ("cite", "faq"),
        ("constraints", "constraints"),
        ("CUDA", "gpu"),
        ("friction", "which-method"),
        ("non-separable", "which-method"),
        ("kepler", "systems"),
        ("adiabatic invariant", "index"),
        ("H_D", "faq"),
    ],
)
def test_search_finds(site, serve, page, words, where):
    home = serve(site)
    page.set_viewport_size({"width": 1280, "height": 900})
    page.open_page(f"{home}/search.html?q={urllib.parse.quote(words)}")
    page.wait_for_function(  # results come one after the other
        "/found|not match/.test(document.querySelector('#search-results p.search-summary')"
        "?.innerText)", timeout=20_000,
    )  # fmt: skip
    links = page.eval_on_selector_all("#search-results li a", "as => as.map(a => a.href)")
    assert any(f"/{where}.html" in link for link in links), links
    page.open_page(f"{home}/search.html?q=xyzzyq")
    page.wait_for_function("document.querySelector('#search-results p.search-summary') !== null")
    assert page.locator("#search-results li").count() == 0
