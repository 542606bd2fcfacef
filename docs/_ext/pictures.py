"""Wide pictures slide on a phone, and a click shows them in full size; all have a text."""

import struct
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.transforms.post_transforms import SphinxPostTransform
from sphinx.util.osutil import relative_uri

WIDE, WIDER = 7.5, 11.0
"""Inches of width from which a phone or a desk shows the text of a picture too small."""


def size(path: Path) -> tuple[float, float] | None:
    """Width and height of a PNG in inches, of 110 pixels if it does not say; None for others."""
    png = path.read_bytes()
    if png[:8] != b"\x89PNG\r\n\x1a\n":
        return None
    at = png.find(b"pHYs", 0, png.find(b"IDAT"))
    per_metre = struct.unpack(">I", png[at + 4 : at + 8])[0] if at > 0 else 110 / 0.0254
    width, height = (n / (0.0254 * per_metre) for n in struct.unpack(">II", png[16:24]))
    return width, height


class Pictures(SphinxPostTransform):
    default_priority = 950  # when those of notebooks are files
    formats = ("html",)

    def run(self, **kwargs: Any) -> None:
        for image in list(self.document.findall(nodes.image)):
            found = size(Path(self.app.srcdir) / image["uri"])
            width = found[0] if found else 0.0
            if not image.get("alt"):
                image["alt"] = f"Picture drawn by the cell above ({self._title(image)})"
            if width >= WIDE:
                image["classes"] += ["wide", "wider"][: 1 + (width >= WIDER)]
                file = f"{self.app.builder.imagedir}/{self.env.images[image['uri']][1]}"
                address = relative_uri(self.app.builder.get_target_uri(self.env.docname), file)
                image.replace_self(nodes.reference("", "", image.deepcopy(), refuri=address))

    @staticmethod
    def _title(node: nodes.Node) -> str:
        while node.parent is not None and not isinstance(node, nodes.section):
            node = node.parent
        return node.next_node(nodes.title).astext()


def setup(app: Any) -> dict[str, bool]:
    app.add_post_transform(Pictures)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
