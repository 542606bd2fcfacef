"""The explorer in a browser: slider, click, copy, download, errors; what may connect to it."""

import http.client
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time

import cli
import pytest

import dvi_jax as dvi
from dvi_jax import systems

BROWSER = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
SERVER = """
import sys
import compilation
compilation.set_flags()
from dvi_jax_cli import main
main()
"""
DATA = "name => Bokeh.documents[0].get_model_by_name(name).data"
SIZE = "name => Bokeh.documents[0].get_model_by_name(name).data.x.length"


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    """The address of a page of the command line, which Ctrl-C ends."""
    pytest.importorskip("panel")
    tests = str(cli.ROOT / "tests")
    words = ["explore", "henon_heiles", "--no-browser"]
    server = subprocess.Popen(
        [sys.executable, "-c", SERVER, *words], stdout=subprocess.PIPE, text=True,
        cwd=tmp_path_factory.mktemp("server"),
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(cli.ROOT), tests])},
    )  # fmt: skip
    line = server.stdout.readline()
    assert line.startswith("http://127.0.0.1:"), line
    try:
        yield line.split()[0]
        server.send_signal(signal.SIGINT)
        assert server.wait(20) == 0
    finally:
        server.kill()


@pytest.fixture(scope="module")
def page(address):
    """The page in Chromium, with its first picture."""
    if BROWSER is None:
        pytest.skip("there is no Chromium")
    driver = pytest.importorskip("playwright.sync_api")
    with driver.sync_playwright() as play:
        browser = play.chromium.launch(
            executable_path=BROWSER, args=["--no-sandbox", "--disable-gpu"]
        )
        context = browser.new_context(permissions=["clipboard-read", "clipboard-write"])
        page = context.new_page()
        page.set_default_timeout(60_000)
        page.goto(address)
        page.wait_for_selector("text=computed in")
        yield page
        browser.close()


@pytest.mark.slow
def test_a_slider_moves_the_picture_and_a_bad_value_keeps_it(page):
    before = page.evaluate(DATA, "series")
    handle = page.locator(".noUi-handle").first  # of h: the system has no perturbation
    handle.focus()
    for _ in range(3):
        handle.press("ArrowRight")
    page.wait_for_function(f"t => ({DATA})('series').t.at(-1) > t", arg=before["t"][-1])
    field = page.locator("input.bk-input[type=text]").first
    page.wait_for_function("field => Number(field.value) > 0.1", arg=field.element_handle())
    moved = page.evaluate(DATA, "series")
    field.fill("0")
    field.press("Enter")
    page.wait_for_selector("[role=alert]")
    assert "h must not be zero" in page.locator("[role=alert]").inner_text()
    assert page.evaluate(DATA, "series") == moved
    page.get_by_role("button", name="Reset the sliders").click()
    page.wait_for_function(f"t => ({DATA})('series').t.at(-1) == t",
                           arg=before["t"][-1])  # fmt: skip
    assert page.locator("[role=alert]").count() == 0


def copied(page, words):
    """The text of the clipboard, once it contains these words."""
    for _ in range(200):
        text = page.evaluate("() => navigator.clipboard.readText()")
        if words in text:
            return text
        page.wait_for_timeout(50)
    raise AssertionError(text)


@pytest.mark.slow
def test_code_is_copied_and_downloaded(page):
    page.get_by_role("button", name="Copy as Python").click()
    code = copied(page, "dvi.systems.henon_heiles()")
    compile(code, "copy.py", "exec")
    with page.expect_download() as event:
        page.get_by_text("Download py", exact=True).click()
    assert event.value.suggested_filename == "explore.py"
    assert event.value.path().read_text() == code
    page.get_by_role("button", name="Copy as TOML").click()
    copied(page, 'system = "henon_heiles"')


@pytest.mark.slow
def test_a_click_begins_an_orbit(page):
    page.get_by_role("button", name="Section").click()
    page.wait_for_function(f"() => ({SIZE})('section') > 100")
    count = page.evaluate(SIZE, "section")
    box = page.locator(".bk-Figure:visible").bounding_box()
    middle = box["x"] + 0.5 * box["width"], box["y"] + 0.45 * box["height"]
    page.mouse.click(*middle)
    page.wait_for_function(f"() => ({SIZE})('starts') == 1")
    page.wait_for_function(f"n => ({SIZE})('section') > n", arg=count)


@pytest.mark.slow
def test_only_this_machine_and_this_page_connect(address):
    port = int(address.rpartition(":")[2])
    upgrade = {"Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13",
               "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ=="}  # fmt: skip
    answers = []
    for origin in (address, "http://example.org", f"http://example.org:{port}"):
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
        connection.request("GET", "/ws", headers=upgrade | {"Origin": origin})
        answers.append(connection.getresponse().status)
        connection.close()
    assert answers == [101, 403, 403]
    other = socket.gethostbyname(socket.gethostname())
    with socket.socket() as probe:
        if not other.startswith("127."):
            assert probe.connect_ex((other, port)) != 0
    result = cli.command("explore", "kepler", "--no-browser", "--port", port)
    assert result.exit_code == 1
    assert f"the port {port} of 127.0.0.1 is in use" in result.stderr


@pytest.mark.slow
def test_the_page_without_a_browser():
    """Errors, failures and clicks of a page whose widgets are set by the program."""
    pytest.importorskip("panel")
    from dvi_jax.explorer.page import Page

    explorer = dvi.explore(systems.kepler(), h=0.05, method="Strang")
    bundle = explorer._repr_mimebundle_()  # of a notebook
    bundle = bundle[0] if isinstance(bundle, tuple) else bundle
    assert "bk-" in bundle["text/html"] or "bokeh" in bundle["text/html"]
    page = explorer._page
    assert isinstance(page, Page)
    assert "computed in" in page.state.object
    points = page.motion.lines.data["x"][0]
    slider = page._controls["epsilon"]
    slider.bar.value = 0.1
    assert slider.number.value == 0.1
    assert page.model.settings.epsilon == 0.1
    assert page.motion.lines.data["x"][0] is not points
    points = page.motion.lines.data["x"][0]
    slider = page._controls["args.K"]
    slider.number.value = -1.0
    assert "K must be" in page.message.object
    assert page.motion.lines.data["x"][0] is points
    assert page.model.settings.args["K"] == 1.0
    slider.number.value = 50.0  # beyond the end of the slider
    assert page.model.settings.args["K"] == 50.0
    assert slider.bar.value == slider.bar.end
    page.reset()
    assert (page.message.object, slider.number.value) == ("", 1.0)
    opened = []
    page._open = lambda view, draws=True: opened.append(view)
    page._open_section(0.03)
    assert page.model.settings.epsilon == pytest.approx(0.03)
    assert page._controls["epsilon"].number.value == pytest.approx(0.03)
    page.click(5.0, 5.0)
    assert "no state at (5, 5)" in page.message.object
    assert page.model.orbits == []
    page.model.change(degree=10)
    page.discover()
    for _ in range(100):
        if not page.search.disabled:
            break
        time.sleep(0.05)
    assert "lower the degree" in page.message.object


@pytest.mark.slow
def test_ctrl_c_does_not_end_the_interpreter_while_a_thread_searches(monkeypatch):
    """XLA in a thread would end the process with an error: the command leaves at once."""
    pytest.importorskip("panel")
    from dvi_jax.explorer import page as module
    from dvi_jax_cli import _main

    end = threading.Event()
    monkeypatch.setattr(module.Model, "drifts", lambda model, report: end.wait(20) and 1 / 0)
    assert not _main._is_searching()
    dvi.explore(systems.kepler(), h=0.05, method="Strang")._new_page().discover()
    (thread,) = (t for t in threading.enumerate() if t.name == module.SEARCH)
    assert _main._is_searching()
    assert not thread.daemon  # a script waits for it
    end.set()
    thread.join(20)
    assert not _main._is_searching()


def test_the_object_of_a_notebook_and_its_errors(monkeypatch):
    explorer = dvi.explore(systems.kepler())
    assert repr(explorer) == "Explorer of kepler: show it in a notebook, or call serve()."
    assert explorer.subject.name == "kepler"
    assert dvi.explore(systems.kepler().system, [0.0, 1.2], [-1.0, -0.6], h=0.1,
                       args={"K": 1.0}, epsilon=0.0).subject.name == ""  # fmt: skip
    with pytest.raises(TypeError, match="steps"):
        dvi.explore(systems.kepler(), steps=3)

    monkeypatch.setitem(sys.modules, "bokeh", None)  # as if it were not installed
    for show in (explorer.panel, explorer.serve, explorer._repr_mimebundle_):
        with pytest.raises(ImportError, match=r'pip install "dvi-jax\[explore\]"'):
            show()
    result = cli.command("explore", "kepler")
    cli.refuses(result, 'pip install "dvi-jax[explore]"')


def test_the_command_refuses_what_it_cannot_explore(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = (cli.ROOT / "dvi_jax_cli/templates/own/system.py").read_text(encoding="utf-8")
    cli.write(tmp_path, text, "system.py")
    for name, seen in (
        ("keplar", "the value is 'keplar'"),
        ("system.py:system", "has no initial condition"),
        ("system.py:none", "has no 'none'"),
        ("none.py:system", "there is no file"),
        ("run.toml", "there is no such file"),
    ):
        cli.refuses(cli.command("explore", name, "--no-browser"), seen)


def test_the_command_reads_run_files_and_python_files(tmp_path):
    from dvi_jax.explorer import copies
    from dvi_jax.explorer.model import Model
    from dvi_jax_cli.work.explore import explorer_of

    templates = cli.ROOT / "dvi_jax_cli/templates/own"
    for name in ("system.py", "run.toml"):
        cli.write(tmp_path, (templates / name).read_text(encoding="utf-8"), name)
    subject = explorer_of(str(tmp_path / "run.toml")).subject
    assert subject.name == "system.py:system"
    assert subject.start.args["mass"] == pytest.approx(subject.start.args["mass"])
    code = copies.python(Model(subject))
    assert f"sys.path.insert(0, {str(tmp_path)!r})" in code
    assert "from system import system  # noqa: E402\n\nproblem = system\n" in code
    assert explorer_of("pendulum").subject.lines == "problem = dvi.systems.pendulum()"
