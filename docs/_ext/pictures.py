"""Pictures of several panels slide on a phone, where they would be too small; all have a text."""

import struct
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.transforms.post_transforms import SphinxPostTransform

WIDE = 1.75
"""Width over height from which a picture has several panels in a row."""
LARGE = 9.0
"""Inches of width from which it has, whatever its height."""


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
        for image in self.document.findall(nodes.image):
            found = size(Path(self.app.srcdir) / image["uri"])
            if found and (found[0] > WIDE * found[1] or found[0] >= LARGE):
                image["classes"].append("wide")
            if not image.get("alt"):
                image["alt"] = f"Picture drawn by the cell above ({self._title(image)})"

    @staticmethod
    def _title(node: nodes.Node) -> str:
        while node.parent is not None and not isinstance(node, nodes.section):
            node = node.parent
        return node.next_node(nodes.title).astext()


def setup(app: Any) -> dict[str, bool]:
    app.add_post_transform(Pictures)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
