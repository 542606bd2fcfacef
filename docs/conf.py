"""How the documentation is built: `make docs`."""

import os
import shutil
import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE / "_ext"))
os.environ.setdefault("JAX_PLATFORMS", "cpu")

import dvi_jax  # noqa: E402

project = "dvi_jax"
author = "The dvi_jax developers"
copyright = "the dvi_jax developers, Apache-2.0"
release = version = dvi_jax.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.mathjax",
    "sphinx_copybutton",
    "reference",
    "scripts",
    "pictures",
    "gallery",
]
source_suffix = {".md": "myst-nb", ".ipynb": "myst-nb"}
# The reference has the examples, each in its entry.
exclude_patterns = ["_build", "_static", "_ext", "examples.md"]
templates_path = ["_templates"]
nitpicky = True
# Types in signatures are links where the reference has them, and plain text elsewhere.
nitpick_ignore_regex = [("py:class", r"(?!dvi_jax\.).*")]

# Notebooks are committed as they were executed; `make notebooks` renews them.
nb_execution_mode = "off"
nb_merge_streams = True
myst_enable_extensions = ["dollarmath", "colon_fence", "amsmath", "tasklist"]
myst_heading_anchors = 3
myst_links_external_new_tab = True
suppress_warnings = ["myst-nb.unknown_mime_type"]

# MathJax is in the folder of the pages, which can be read without a network.
mathjax_path = "mathjax/tex-svg-full.js"
mathjax3_config = {"svg": {"fontCache": "global"}, "options": {"enableMenu": False}}

html_theme = "furo"
html_title = f"dvi_jax {release}"
html_static_path = ["_static"]
html_css_files = ["dvi.css"]
html_copy_source = False
html_theme_options = {
    "navigation_with_keys": True,
    "light_css_variables": {"code-font-size": "78%"},  # a hundred characters in a line
}
# Apostrophes are primes, and quotes are of code.
smartquotes = False
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True
# Greek letters and formulas are what readers look for: no stemming of a language is lost on them.
html_search_language = "en"

_NOTEBOOKS = HERE.parent / "notebooks"


def _take_notebooks(app) -> None:
    """Copies of the executed notebooks, where Sphinx finds them."""
    into = Path(app.srcdir) / "notebooks"
    into.mkdir(exist_ok=True)
    wanted = {source.name: source for source in _NOTEBOOKS.glob("*.ipynb")}
    for name, source in wanted.items():
        if not (into / name).exists() or (into / name).read_bytes() != source.read_bytes():
            shutil.copyfile(source, into / name)
    for stale in set(into.glob("*.ipynb")) - {into / name for name in wanted}:
        stale.unlink()


def _find_notebooks(app, docname, source) -> None:
    """Links are written as a reader of the repository follows them."""
    source[0] = source[0].replace("](../notebooks/", "](notebooks/").replace("](../docs/", "](../")


def setup(app) -> None:
    app.connect("builder-inited", _take_notebooks)
    app.connect("source-read", _find_notebooks)
