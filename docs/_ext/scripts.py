"""Small typography of running text: q_{k+1} and ε^2 are set as such, numbers are not torn apart.

Pages and docstrings are read as text too, so formulas in a line are written in characters.
What is searched for, and what another builder shows, stays the text as it was written.
"""

import ast
import html
import re
from typing import Any

from docutils import nodes
from sphinx.transforms.post_transforms import SphinxPostTransform

SCRIPTED = re.compile(
    r"_(?:\{(?P<below>[^{}]*)\}|(?<=[^\W_][_])(?P<index>[^\W_])(?!\w)"
    r"|(?<=[⁺⁻*'̄̃][_])(?P<after_mark>[^\W_])(?!\w))"
    r"|\^(?:\{(?P<above>[^{}]*)\}|(?P<power>[−-]?[^\W_]+(?:\.\d+)?)"
    r"|(?P<bracket>−?\((?:[^()]|\([^()]*\))*\)))"
)
NUMBER = re.compile(
    r"\d+(?:\.\d+)?e[-−+]?\d+|(?<!\d)\d{1,3}(?: \d{3})+(?!\d)|\d+ %"
    r"|\b(?:pass|FAIL) \d\S*"
)
PIECE = re.compile(rf"(?P<number>{NUMBER.pattern})|(?:{SCRIPTED.pattern})")


def is_code(text: str) -> bool:
    """Whether a block is Python, or a formula in characters, such as H̃ = H + h^r H_r."""
    try:
        ast.parse(text)
    except SyntaxError:
        return text.isascii()
    return True


class typeset(nodes.inline):
    """A piece of text and its HTML."""


def as_html(text: str) -> str | None:
    """The HTML of a text, or None if it is the text itself."""
    parts, end = [], 0
    for found in PIECE.finditer(text):
        parts.append(html.escape(text[end : found.start()], quote=False))
        kind = found.lastgroup
        inside = html.escape(found[kind], quote=False)
        if kind == "number":
            parts.append(f'<span class="number">{inside}</span>')
        else:
            tag = "sub" if kind in ("below", "index", "after_mark") else "sup"
            parts.append(f"<{tag}>{inside}</{tag}>")
        end = found.end()
    return "".join([*parts, html.escape(text[end:], quote=False)]) if parts else None


class Typeset(SphinxPostTransform):
    default_priority = 900
    formats = ("html",)
    _as_it_is = (
        nodes.literal, nodes.FixedTextElement, nodes.math, nodes.math_block, nodes.raw,
        nodes.Invisible,
    )  # fmt: skip

    def run(self, **kwargs: Any) -> None:
        for block in list(self.document.findall(nodes.literal_block)):
            text = block.astext()
            if block.get("language", "none") in ("none", "default") and not is_code(text):
                made = as_html(text) or html.escape(text, quote=False)
                block.replace_self(typeset("", nodes.Text(text), html=f"<pre>{made}</pre>"))
        for text in list(self.document.findall(nodes.Text)):
            above = text.parent
            while above is not None and not isinstance(above, self._as_it_is):
                if above.tagname.startswith("desc_sig") or above.tagname == "desc_name":
                    break
                above = above.parent
            made = None if above is not None else as_html(text.astext())
            if made is not None:
                text.parent.replace(text, typeset("", nodes.Text(text.astext()), html=made))


def _visit(self: Any, node: nodes.Element) -> None:
    self.body.append(node["html"])
    raise nodes.SkipNode


def setup(app: Any) -> dict[str, Any]:
    app.add_node(typeset, html=(_visit, None))
    app.add_post_transform(Typeset)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
