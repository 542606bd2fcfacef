"""The examples of docs/examples.md, which the reference shows in the entries."""

import ast
import functools
import re
from pathlib import Path
from typing import NamedTuple

SECTION = re.compile(r"^## (\S+)\n+```python\n(.*?)^```", re.S | re.M)
ROW = re.compile(r"^\| `([\w.]+)` \| (.+?) \|$", re.M)
BLOCK = re.compile(r"^```python\n(.*?)^```", re.S | re.M)


def _names(tree: ast.AST, context: type[ast.expr_context]) -> set[str]:
    found = (node for node in ast.walk(tree) if isinstance(node, ast.Name))
    return {node.id for node in found if isinstance(node.ctx, context)}


class Examples(NamedTuple):
    """The page, read.

    - `imports`: the lines after which every example runs. `shared`: statements, in order, that
      several examples need.
    - `code`: name in the reference → its example. `origins`: name → where such an object comes
      from, for those that users do not make.
    """

    imports: str
    shared: tuple[str, ...]
    code: dict[str, str]
    origins: dict[str, str]

    def lines_before(self, code: str) -> list[str]:
        """The shared statements that an example needs, in order."""
        wanted, kept = _names(ast.parse(code), ast.Load), []
        for statement in reversed(self.shared):
            tree = ast.parse(statement)
            if _names(tree, ast.Store) & wanted:
                wanted |= _names(tree, ast.Load)
                kept.append(statement)
        return kept[::-1]

    def markdown(self, name: str) -> str:
        """What the reference adds to the entry of a name; empty if there is nothing."""
        if name in self.origins:
            origin = self.origins[name]
            return f"{origin[0].upper()}{origin[1:]}."
        if name not in self.code:
            return ""
        before = "".join(f"{line}\n" for line in self.lines_before(self.code[name]))
        gap = "\n" if before else ""
        return f"**Example**\n\n```python\n{before}{gap}{self.code[name]}```"


def read(text: str) -> Examples:
    """The examples of a page."""
    head, _, rest = text.partition("\n## ")
    imports, shared = BLOCK.findall(head)
    statements = [ast.get_source_segment(shared, node) for node in ast.parse(shared).body]
    code, origins = dict(SECTION.findall(f"## {rest}")), dict(ROW.findall(rest))
    return Examples(imports, tuple(filter(None, statements)), code, origins)


@functools.cache
def page() -> Examples:
    """The examples of docs/examples.md."""
    return read((Path(__file__).parents[1] / "examples.md").read_text(encoding="utf-8"))
