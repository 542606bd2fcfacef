"""Milliseconds of a redraw of the explorer, and the picture of its page in the documentation.

    python benchmarks/explore.py [--steps 100000] [--check] [--picture docs/pictures/explore.png]

A redraw is one change of a slider: the run, the observables, and the decimation of what is drawn,
without the browser. The table has the median and the least time of 20. `--check`: exit status 1 if
the median is above 100 ms. `--picture` requires Chromium and playwright.
"""

import argparse
import shutil
import statistics
import subprocess
import sys
import time

import jax

import dvi_jax as dvi
from dvi_jax.explorer.model import STEPS, Model

NAMES = ("henon_heiles", "kepler", "duffing")
LIMIT = 100.0


def redraws(name: str, steps: int) -> tuple[list[float], int]:
    """Milliseconds of each redraw, and the programs that were compiled for them."""
    model = Model(dvi.explore(getattr(dvi.systems, name)(), method="Strang").subject)
    model.change(steps=steps)
    model.motion()
    programs: list[str] = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, *_, **__: (
            programs.append(event) if event.endswith("backend_compile_duration") else None
        )
    )
    times = []
    for i in range(20):
        model.move("h", model.subject.start.h * (1 - 0.01 * i))
        began = time.perf_counter()
        model.motion()
        times.append(1000 * (time.perf_counter() - began))
    return times, len(programs)


def draw(path: str) -> None:
    """The section of Hénon and Heiles with orbits that were begun by clicks."""
    from playwright.sync_api import sync_playwright

    words = ["-m", "dvi_jax", "explore", "henon_heiles", "--no-browser"]
    server = subprocess.Popen([sys.executable, *words], stdout=subprocess.PIPE, text=True)
    assert server.stdout is not None
    address = server.stdout.readline().split()[0]
    with sync_playwright() as play:
        browser = play.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox", "--disable-gpu"]
        )
        page = browser.new_page(viewport={"width": 1000, "height": 900}, device_scale_factor=1.4)
        page.set_default_timeout(240_000)
        page.goto(address)
        page.wait_for_selector("text=computed in")
        page.get_by_role("button", name="Section").click()
        page.wait_for_function("Bokeh.documents[0].get_model_by_name('section').data.x.length > 99")
        box = page.locator(".bk-Figure:visible").bounding_box()
        assert box is not None
        places = [
            (0.3, 0.5),
            (0.8, 0.6),
            (0.4, 0.5),
            (0.5, 0.5),
            (0.6, 0.5),
            (0.7, 0.5),
            (0.3, 0.6),
        ]
        for i, (x, y) in enumerate(places):
            page.mouse.click(box["x"] + x * box["width"], box["y"] + y * box["height"])
            page.wait_for_timeout(2500 if i else 6000)
        page.mouse.move(5, 5)
        page.wait_for_timeout(1500)
        page.screenshot(path=path)
        browser.close()
    server.terminate()


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--steps", type=int, default=STEPS[-1])
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--picture", default="")
    options = parser.parse_args(arguments)
    jax.config.update("jax_enable_x64", True)
    if options.picture:
        draw(options.picture)
        return 0
    worst = 0.0
    print("| system | median [ms] | least [ms] | compiled programs |\n|---|---|---|---|")
    for name in NAMES:
        times, count = redraws(name, options.steps)
        median = statistics.median(times)
        worst = max(worst, median)
        print(f"| {name} | {median:.0f} | {min(times):.0f} | {count} |")
    return int(options.check and worst > LIMIT)


if __name__ == "__main__":
    sys.exit(main())
