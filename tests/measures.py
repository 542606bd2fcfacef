"""How large the code is, and how it is built.

    python tests/measures.py [--picture docs/pictures/layers.svg]

prints the measures of `dvi_jax/`, `lanewise/` and `dvi_jax_cli/` next to their limits, and the
places that exceed one. The limits are what was reached; `GOALS` are what they should become.
`--picture` draws the layers: each module above all that it imports.
"""

import ast
import io
import sys
import tokenize
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGES = ("dvi_jax", "lanewise", "dvi_jax_cli")
APPLICATIONS = {
    "discover", "sweep", "fit", "dynamics", "systems", "plot", "testing", "interop", "run",
    "symmetry", "invariants", "proof",
}  # fmt: skip
"""What is no part of the core of `dvi_jax`."""

LONGEST_FILE, MOST_PARAMETERS = 450, 9
COMMENTS = "lines of the core with a comment, per cent (at least)"


@dataclass(frozen=True)
class Measures:
    """Numbers of the code, and where they come from."""

    lines: int
    raises: int
    comments: float
    """Share of the lines of the core that have a comment, in per cent."""
    long_files: list[str]
    long_signatures: list[str]
    circles: list[str]

    def values(self) -> dict[str, float]:
        return {
            "lines": self.lines,
            "raise statements": self.raises,
            COMMENTS: round(self.comments, 2),
            f"files of more than {LONGEST_FILE} lines": len(self.long_files),
            f"functions with more than {MOST_PARAMETERS} parameters": len(self.long_signatures),
            "circles of imports": len(self.circles),
        }


def measure(root: Path = ROOT) -> Measures:
    files = [path for package in PACKAGES for path in sorted((root / package).rglob("*.py"))]
    texts = {path: path.read_text() for path in files}
    trees = {path: ast.parse(text) for path, text in texts.items()}
    nodes = [(path, node) for path, tree in trees.items() for node in ast.walk(tree)]
    lengths = {path: text.count("\n") for path, text in texts.items()}
    core = [path for path in files if _is_core(path.relative_to(root))]
    return Measures(
        lines=sum(lengths.values()),
        raises=sum(isinstance(node, ast.Raise) for _, node in nodes),
        comments=100 * sum(_comments(texts[p]) for p in core) / sum(lengths[p] for p in core),
        long_files=[
            f"{path.relative_to(root)}: {n} lines"
            for path, n in lengths.items()
            if n > LONGEST_FILE
        ],
        long_signatures=[
            f"{path.relative_to(root)}:{node.lineno}: {node.name}, {_parameters(node)} parameters"
            for path, node in nodes
            if isinstance(node, ast.FunctionDef) and _parameters(node) > MOST_PARAMETERS
        ],
        circles=[" → ".join(circle) for circle in _circles(_imports(root, trees))],
    )


def _is_core(path: Path) -> bool:
    package, room = path.with_suffix("").parts[:2]
    return package == "lanewise" or (package == "dvi_jax" and room not in APPLICATIONS)


def _comments(text: str) -> int:
    """Comments that people read: not those of a linter or a formatter."""
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    texts = [token.string for token in tokens if token.type == tokenize.COMMENT]
    return sum(not text.startswith(("# noqa", "# fmt:", "# type:", "# pyright:")) for text in texts)


def _parameters(node: ast.FunctionDef) -> int:
    arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
    return sum(argument.arg not in ("self", "cls") for argument in arguments)


def _imports(root: Path, trees: dict[Path, ast.Module]) -> dict[str, set[str]]:
    """Module → modules that it imports, inside of functions as well, but not for types only."""
    names = {_module(path.relative_to(root)): path for path in trees}
    found: dict[str, set[str]] = defaultdict(set)
    for name, path in names.items():
        package = name if path.name == "__init__.py" else name.rpartition(".")[0]
        for node in run_nodes(trees[path]):
            for target in _targets(node, package):
                while target and target not in names:
                    target = target.rpartition(".")[0]
                if target and target != name:
                    found[name].add(target)
    return found


def _module(path: Path) -> str:
    parts = path.with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def run_nodes(node: ast.AST) -> Iterator[ast.AST]:
    """All parts of the code that are run, not those for type checkers only."""
    yield node
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
            continue
        yield from run_nodes(child)


def _targets(node: ast.AST, package: str) -> Iterable[str]:
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    if not isinstance(node, ast.ImportFrom):
        return []
    base = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
    start = ".".join([*base, *([node.module] if node.module else [])])
    return [f"{start}.{alias.name}" for alias in node.names]


def _circles(imports: dict[str, set[str]]) -> list[list[str]]:
    """Strongly connected components of more than one module (Tarjan 1972)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(name: str) -> None:
        index[name] = low[name] = len(index)
        stack.append(name)
        for other in sorted(imports.get(name, ())):
            if other not in index:
                visit(other)
                low[name] = min(low[name], low[other])
            elif other in stack:
                low[name] = min(low[name], index[other])
        if low[name] == index[name]:
            component = stack[stack.index(name) :]
            del stack[stack.index(name) :]
            if len(component) > 1:
                found.append(sorted(component))

    for name in sorted(imports):
        if name not in index:
            visit(name)
    return found


def layers(root: Path = ROOT) -> list[list[str]]:
    """Packages and modules of `dvi_jax`, and the other two packages, each in the lowest layer that
    is above all that it imports; the lowest layer first."""
    files = [path for package in PACKAGES for path in (root / package).rglob("*.py")]
    imports = _imports(root, {path: ast.parse(path.read_text()) for path in files})
    below: dict[str, set[str]] = defaultdict(set)
    for path in files:
        name = _module(path.relative_to(root))
        below[_room(name)] |= {_room(other) for other in imports[name]} - {_room(name)}
    found: list[list[str]] = []
    while below:
        free = sorted(room for room, others in below.items() if not others & below.keys())
        found.append(free)
        below = {room: others for room, others in below.items() if room not in free}
    return found


def _room(module: str) -> str:
    parts = module.split(".")
    if parts[0] != "dvi_jax":
        return parts[0]
    return parts[1] if len(parts) > 1 else "import dvi_jax"


def draw_layers(path: Path) -> None:
    """The layers as a picture, text as text."""
    import matplotlib.pyplot as plt

    rows = layers()
    widest = max(len(row) for row in rows)
    plt.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "layers"})
    figure, axis = plt.subplots(figsize=(1.25 * widest, 0.5 * len(rows)), layout="constrained")
    axis.set(xlim=(-0.7, widest), ylim=(-0.6, len(rows) - 0.4))
    axis.axis("off")
    box = {"boxstyle": "round,pad=0.35", "facecolor": "#e8eef7", "edgecolor": "#33507a"}
    for y, row in enumerate(rows):
        axis.text(-0.65, y, str(y), color="#777777", va="center", fontsize=9)
        for i, room in enumerate(row):
            x = (i + 0.5) * widest / len(row) - 0.3
            axis.text(x, y, room, bbox=box, ha="center", va="center", fontsize=9)
    figure.savefig(path, metadata={"Date": None})


LIMITS = {
    "lines": 62_000,
    "raise statements": 761,
    COMMENTS: 5,
    f"files of more than {LONGEST_FILE} lines": 0,
    f"functions with more than {MOST_PARAMETERS} parameters": 8,
    "circles of imports": 0,
}
"""What the tests allow. When the code has become smaller lower them; only a new capability raises
them, by its own size (`proof`, its command and its picture: 2 150 lines; series of high order in
`discover`: 400; pairs of numbers: 1 200; null spaces in pairs: 400; guiding centres
in Boozer coordinates: 2 200; `Implicit`: 100)."""


GOALS = dict(zip(LIMITS, (33_000, 450, 5, 0, 15, 0), strict=True))


def exceeded(measures: Measures) -> list[str]:
    return [
        f"{name}: {value:g}, limit {LIMITS[name]:g}"
        for name, value in measures.values().items()
        if (value < LIMITS[name] if name == COMMENTS else value > LIMITS[name])
    ]


def main() -> int:
    if sys.argv[1:2] == ["--picture"]:
        draw_layers(Path(sys.argv[2]))
        return 0
    found = measure()
    print(f"{'':54}{'now':>9}{'limit':>9}{'goal':>9}")
    for name, value in found.values().items():
        print(f"{name:54}{value:9g}{LIMITS[name]:9g}{GOALS[name]:9g}")
    for place in (*found.long_files, *found.long_signatures, *found.circles):
        print(f"  {place}")
    print("\n".join(exceeded(found)))
    return bool(exceeded(found))


if __name__ == "__main__":
    sys.exit(main())
