"""`explore`: the page of a system, in a browser or in a notebook."""

import socket
from typing import Any, Never

from ..base.checks import refuse_unknown, whole
from ..systems import LIBRARY, Problem
from .packages import require_panel
from .subject import Subject

ADDRESS = "127.0.0.1"
"""The only address on which the page is served."""


def explore(
    problem: Any,
    q0: Any = None,
    p0: Any = None,
    *,
    h: Any = None,
    epsilon: float | None = None,
    args: Any = None,
    method: Any = None,
    **unknown: Never,
) -> "Explorer":
    """A page with sliders on which the motion of a system is explored.

    It shows a trajectory with the energy and the invariants over time; a Poincaré section in which
    a click begins an orbit; an orbit diagram over a parameter; and the drifts of the invariants
    that `discover_invariants` finds. The last line of a notebook cell shows it there;
    ``dvi.explore(problem).serve()`` opens it in a browser, as `dvi-jax explore NAME` does.

    **Arguments** as for `integrate`: `problem` is a problem of the library or a `System`. The page
    begins with these values. It requires panel and bokeh: ``pip install "dvi-jax[explore]"``.

    **Returns** an `Explorer`.

    **Raises** `ValueError` and `TypeError` for invalid input, such as a system with noise;
    `ImportError` without panel, when it is shown.

    **Example**

    ```python
    page = dvi.explore(systems.henon_heiles(), method="Strang")
    print(page)
    # Explorer of henon_heiles: show it in a notebook, or call serve().
    ```
    """
    refuse_unknown("explore", explore, unknown)
    start = {"q0": q0, "p0": p0, "h": h, "epsilon": epsilon, "args": args, "method": method}
    name = problem.name if _is_of_library(problem) else ""
    lines = f"problem = dvi.systems.{name}()" if name else ""
    return Explorer(Subject(problem, start, lines, name))


class Explorer:
    """The page of a system: see `explore`.

    - ``serve(port=0, open_browser=True)``: serve it until Ctrl-C.
    - ``panel()``: a new object of panel, for a page or an application of your own.
    """

    def __init__(self, subject: Subject):
        self.subject = subject
        self._page: Any = None

    def __repr__(self) -> str:
        return f"Explorer of {self.subject.title}: show it in a notebook, or call serve()."

    def panel(self) -> Any:
        """The page as an object of panel. **Raises** `ImportError` without panel or bokeh."""
        return self._new_page().view

    def _new_page(self) -> Any:
        require_panel()
        from .page import Page

        return Page(self.subject)

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> Any:
        pn = require_panel()
        if self._page is None:
            pn.extension(inline=True)
            self._page = self._new_page()
            self._page.draw()
        return self._page.view._repr_mimebundle_(include, exclude)

    def serve(self, port: int = 0, open_browser: bool = True, ready: Any = None) -> None:
        """Serve the page on this machine alone, ``http://127.0.0.1:port``, until Ctrl-C.

        - `port`: 0 takes a free one. `ready`: called with the address when the page can be opened.

        Only pages of this address may connect to it. **Raises** `OSError` for a port in use.
        """
        pn = require_panel()
        port = whole("port", port, 0) or _free_port()
        _check_port(port)

        from bokeh.models import CustomJS

        from .style import PAGE, REDRAW

        def application() -> Any:
            page = self._new_page()
            pn.state.onload(page.load)
            pn.state.curdoc.js_on_event("document_ready", CustomJS(code=REDRAW))
            return page.view

        pn.config.raw_css = [*pn.config.raw_css, PAGE]
        names = [f"{host}:{port}" for host in (ADDRESS, "localhost")]
        server = pn.serve(
            application, port=port, address=ADDRESS, websocket_origin=names, show=False,
            start=False, verbose=False, title=f"{self.subject.title} – dvi_jax",
        )  # fmt: skip
        url = f"http://{ADDRESS}:{port}"
        if open_browser:
            server.io_loop.add_callback(server.show, "/")
        if ready is not None:
            server.io_loop.add_callback(ready, url)
        server.run_until_shutdown()


def _is_of_library(problem: Any) -> bool:
    """Whether a problem is one that its function in the library makes without arguments."""
    if not isinstance(problem, Problem) or problem.name not in LIBRARY:
        return False
    other = LIBRARY[problem.name]()
    return repr(other) == repr(problem) and other.system.H_D == problem.system.H_D


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((ADDRESS, 0))
        return probe.getsockname()[1]


def _check_port(port: int) -> None:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((ADDRESS, port))
        except OSError as error:
            text = f"the port {port} of {ADDRESS} is in use or not allowed: take another one"
            raise OSError(error.errno, text) from None
