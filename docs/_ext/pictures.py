"""Pictures of several panels slide on a phone, where they would be too small; all have a text."""

import struct
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.transforms.post_transforms import SphinxPostTransform

WIDE = 1.75
"""Width over height from which a picture has several panels in a row."""
LARGE = 1000
"""Pixels of width from which it has, whatever its height."""


def size(path: Path) -> tuple[int, int] | None:
    """Width and height of a PNG in pixels; None for other pictures."""
    head = path.read_bytes()[:24]
    return struct.unpack(">II", head[16:]) if head[:8] == b"\x89PNG\r\n\x1a\n" else None


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
