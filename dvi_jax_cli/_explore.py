"""The command that serves a page on this machine: explore SYSTEM."""

from typing import Annotated

import typer

from ._group import RUNS, app
from ._names import SYSTEMS, completer
from ._session import Session, command


@command(app, "explore", RUNS)
def explore(
    session: Session,
    system: Annotated[
        str,
        typer.Argument(
            metavar="SYSTEM",
            help="A system of the library, FILE.py:NAME, or a run file.",
            **completer(SYSTEMS),
        ),
    ],
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port of the page; 0 takes a free one.")
    ] = 0,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Open the page in a browser.")
    ] = True,
) -> None:
    """Open a page with sliders, sections and orbit diagrams of a system, until Ctrl-C.

    The page is at 127.0.0.1, this machine, and at no other address. It requires panel and bokeh:
    pip install "dvi-jax[explore]".

    Exit code 0: ended by Ctrl-C. 1: failed, such as by a port in use. 2: bad input, or panel is
    not installed.

    Examples
        dvi-jax explore henon_heiles
        dvi-jax explore system.py:system --port 5006 --no-browser
        dvi-jax explore run.toml              begins with the numbers of the file
    """
    session.unwritten = "the page cannot be served"
    from .work.explore import explorer_of

    def ready(url: str) -> None:
        session.line(f"{url} shows {page.subject.title}; Ctrl-C ends it.")
        if session.as_json:
            session.finish({"url": url, "system": page.subject.title})

    page = explorer_of(system)
    page.serve(port, browser, ready)
