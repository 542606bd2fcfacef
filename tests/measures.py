"""How large the code is, how it is built, and what its names are.

    python tests/measures.py                        the measures next to their limits
    python tests/measures.py --names [PATH ...]     names that are participles or function words
    python tests/measures.py --picture FILE.svg     the layers of the packages, as a picture

The measures are those of `dvi_jax/`, `lanewise/` and `dvi_jax_cli/`. After them come the places
that exceed a limit.
"""

import ast
import collections
import importlib
import inspect
import io
import pkgutil
import re
import sys
import tokenize
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).parents[1]
PARTS = {
    "the core": [
        *("base", "engine", "problem", "methods", "observe", "lattices", "integration"),
        *("__init__", "__main__", "_namespaces"),
    ],
    "the questions": ["discover", "sweep", "fit", "proof", "dynamics"],
    "the leaves": ["systems", "plot", "explorer", "testing", "interop"],
    "lanewise": ["lanewise"],
    "the command line": ["dvi_jax_cli"],
}
"""Part of the code → its folders, those of `dvi_jax` by their names in it."""

PACKAGES = ("dvi_jax", "lanewise", "dvi_jax_cli")
LONGEST_FILE, MOST_PARAMETERS = 450, 9

LIMITS: dict[str, float] = {
    "lines of the core": 17_630,
    "lines of the questions": 22_475,
    "lines of the leaves": 25_515,
    "lines of lanewise": 12_980,
    "lines of the command line": 5_765,
    "raise statements": 671,
    "characters of error text": 45_000,
    "functions with more than 9 parameters": 2,
    "files of more than 450 lines": 0,
    "files at the top of dvi_jax": 3,
    "circles of imports": 0,
    "layers of imports": 16,
    "names that are participles or function words, per cent": 1.0,
    "names of one letter outside of equations, per cent": 15.1,
}
"""What the tests allow. When the code has become smaller lower them; only a new capability raises
the lines of a part, by its own size."""

COMMENTS = "lines of the core with a comment, per cent"
LEAST = {COMMENTS: 5.0}
"""What must not become less."""


@dataclass(frozen=True)
class Measures:
    """Numbers of the code, and the places where a limit is exceeded."""

    values: dict[str, float]
    places: list[str] = field(default_factory=list)


def measure(root: Path = ROOT, signatures: bool = True) -> Measures:
    """`signatures=False` leaves out what requires an import of the packages."""
    files = [path for package in PACKAGES for path in sorted((root / package).rglob("*.py"))]
    texts = {path: path.read_text() for path in files}
    trees = {path: ast.parse(text) for path, text in texts.items()}
    lines = {path: text.count("\n") for path, text in texts.items()}
    parts = {part: [p for p in files if _part(p.relative_to(root)) == part] for part in PARTS}
    raises = [node for tree in trees.values() for node in ast.walk(tree) if _is_raise(node)]
    names = [name for tree in trees.values() for name, _ in bound_names(tree)]
    plain = [name for tree in trees.values() for name in names_outside_equations(tree)]
    core = [*parts["the core"], *parts["lanewise"]]
    long_files = [f"{path.relative_to(root)}: {n} lines" for path, n in lines.items()]
    long_files = [t for t, n in zip(long_files, lines.values(), strict=True) if n > LONGEST_FILE]
    long_signatures = sorted(_long_signatures()) if signatures else []
    circles = [" → ".join(circle) for circle in _circles(_imports(root, trees))]
    top = [path for path in files if path.parent == root / "dvi_jax"]
    values = {
        **{f"lines of {part}": sum(lines[p] for p in parts[part]) for part in PARTS},
        "raise statements": len(raises),
        "characters of error text": sum(len(text) for node in raises for text in _strings(node)),
        f"functions with more than {MOST_PARAMETERS} parameters": len(long_signatures),
        f"files of more than {LONGEST_FILE} lines": len(long_files),
        "files at the top of dvi_jax": len(top),
        "circles of imports": len(circles),
        "layers of imports": len(layers(root)),
        "names that are participles or function words, per cent": _share(map(is_no_noun, names)),
        "names of one letter outside of equations, per cent": _share(len(n) == 1 for n in plain),
        COMMENTS: 100 * sum(_comments(texts[p]) for p in core) / sum(lines[p] for p in core),
    }
    return Measures(values, [*long_files, *long_signatures, *circles])


def _part(path: Path) -> str:
    parts = path.with_suffix("").parts
    folder = parts[1] if parts[0] == "dvi_jax" else parts[0]
    return next((part for part, folders in PARTS.items() if folder in folders), "the core")


def _share(flags: Iterable[bool]) -> float:
    listed = list(flags)
    return 100 * sum(listed) / max(len(listed), 1)


def _is_raise(node: ast.AST) -> bool:
    return isinstance(node, ast.Raise)


def _strings(node: ast.AST) -> Iterator[str]:
    for inner in ast.walk(node):
        if isinstance(inner, ast.Constant) and isinstance(inner.value, str):
            yield inner.value


def _comments(text: str) -> int:
    """Comments that people read: not those of a linter or a formatter."""
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    texts = [token.string for token in tokens if token.type == tokenize.COMMENT]
    return sum(not text.startswith(("# noqa", "# fmt:", "# type:", "# pyright:")) for text in texts)


# --- signatures -----------------------------------------------------------------------------------


def _long_signatures() -> Iterator[str]:
    """Functions and methods by `inspect.signature`, which shows keywords that a decorator adds."""
    for package in PACKAGES:
        root = importlib.import_module(package)
        for info in pkgutil.walk_packages(root.__path__, f"{package}."):
            if not info.name.endswith("__main__"):
                yield from long_signatures_of(importlib.import_module(info.name))


def long_signatures_of(module) -> Iterator[str]:
    own = [x for x in vars(module).values() if getattr(x, "__module__", "") == module.__name__]
    for thing in own:
        inner = list(vars(thing).values()) if inspect.isclass(thing) else [thing]
        for function in filter(inspect.isfunction, inner):
            count = sum(
                name not in ("self", "cls") for name in inspect.signature(function).parameters
            )
            # An `__init__` that a dataclass has made has no code of its own.
            code = inspect.unwrap(function).__code__
            if count > MOST_PARAMETERS and not code.co_filename.startswith("<"):
                yield f"{module.__name__}.{function.__qualname__}: {count} parameters"


# --- names ----------------------------------------------------------------------------------------

FUNCTION_WORDS = set(
    """about above across after again against all along already also although always among an and
    another any anything are around as at away back be because been before behind being below
    beneath beside between beyond both but by can could did do does down each either else elsewhere
    enough ever every everything few for from further had has have here hence how however if in
    inside instead into is it its itself just least less many may meanwhile might more most much
    must near neither never nor not nothing now of off often on once one ones only onto or others
    otherwise our outside over own per perhaps quite rather rest same several shall should since so
    some something soon still such than that the their them then there these they this those though
    through thus till to together too toward towards twice under unless unlike until up upon very
    was well were what whatever when whenever wherever whether which while who whole whom whose why
    will with within without would yet""".split()  # noqa: SIM905
)
PARTICIPLES = set(
    """begun bent broken brought built caught chosen come done drawn driven fallen felt found
    forgotten frozen given gone got grown heard held hidden kept known laid led left lent lost made
    meant met paid ridden risen said seen sent shaken shown sought spoken spent struck taken taught
    thought thrown told torn understood undone unknown unseen withdrawn won worn written rewritten
    missing remaining following according going coming containing having making taking giving
    holding keeping leaving using waiting working growing shrinking standing""".split()  # noqa: SIM905
)
NOUNS = set(
    """bleed breed creed deed embed exceed feed greed hundred indeed kindred need pred proceed reed
    seed shed speed steed weed""".split()  # noqa: SIM905
)
"""What ends like a participle and is none."""

CONTRACT = {"observed", "fixed", "left"}
"""Public names (`Solution.observed`), and `left`, the opposite of right."""


def is_no_noun(name: str) -> bool:
    """Whether a name is a participle or a function word, which do not say what it holds."""
    word = name.strip("_").lower()
    if word in CONTRACT or word in NOUNS:
        return False
    ends = re.fullmatch("[a-z]{2,}ed", word) is not None
    return ends or word in FUNCTION_WORDS or word in PARTICIPLES


ARITHMETIC = ast.Add | ast.Sub | ast.Mult | ast.Div | ast.Pow | ast.MatMult


def bound_names(tree: ast.AST) -> Iterator[tuple[str, int]]:
    """(name, line) of variables, parameters, attributes, functions and classes."""
    for node in ast.walk(tree):
        match node:
            case ast.Name(id=name, ctx=ast.Store()) | ast.Attribute(attr=name, ctx=ast.Store()):
                pass
            case ast.arg(arg=name) | ast.FunctionDef(name=name) | ast.ClassDef(name=name):
                pass
            case ast.ExceptHandler(name=str(name)):
                pass
            case _:
                continue
        if name not in ("self", "cls", "_"):
            yield name, node.lineno  # pyright: ignore[reportAttributeAccessIssue]


def names_outside_equations(tree: ast.AST) -> Iterator[str]:
    """Names that are bound in functions without arithmetic, in which a letter is no symbol."""
    inner, own = [], []
    queue = collections.deque(ast.iter_child_nodes(tree))
    while queue:
        child = queue.popleft()
        (inner if isinstance(child, ast.FunctionDef | ast.ClassDef) else own).append(child)
        if not isinstance(child, ast.FunctionDef | ast.ClassDef):
            queue.extend(ast.iter_child_nodes(child))
    operators = [node.op for node in own if isinstance(node, ast.BinOp)]
    if not any(isinstance(operator, ARITHMETIC) for operator in operators):
        for node in own:
            match node:
                case ast.Name(id=name, ctx=ast.Store()) | ast.arg(arg=name):
                    if name not in ("self", "cls", "_"):
                        yield name
    for node in inner:
        yield from names_outside_equations(node)


# --- imports --------------------------------------------------------------------------------------


def _imports(root: Path, trees: dict[Path, ast.Module]) -> dict[str, set[str]]:
    """Module → modules that it imports, inside of functions and for type checkers as well."""
    names = {_module(path.relative_to(root)): path for path in trees}
    imports: dict[str, set[str]] = collections.defaultdict(set)
    for name, path in names.items():
        package = name if path.name == "__init__.py" else name.rpartition(".")[0]
        for node in ast.walk(trees[path]):
            for target in _targets(node, package):
                while target and target not in names:
                    target = target.rpartition(".")[0]
                if target and target != name:
                    imports[name].add(target)
    return imports


def _module(path: Path) -> str:
    parts = path.with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


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
    circles: list[list[str]] = []

    def visit(name: str) -> None:
        index[name] = low[name] = len(index)
        stack.append(name)
        for target in sorted(imports.get(name, ())):
            if target not in index:
                visit(target)
                low[name] = min(low[name], low[target])
            elif target in stack:
                low[name] = min(low[name], index[target])
        if low[name] == index[name]:
            component = stack[stack.index(name) :]
            del stack[stack.index(name) :]
            if len(component) > 1:
                circles.append(sorted(component))

    for name in sorted(imports):
        if name not in index:
            visit(name)
    return circles


def layers(root: Path = ROOT) -> list[list[str]]:
    """Packages and modules of `dvi_jax`, and the other two packages, each in the lowest layer that
    is above all that it imports; the lowest layer first."""
    files = [path for package in PACKAGES for path in (root / package).rglob("*.py")]
    trees = {path: ast.parse(path.read_text()) for path in files}
    imports = _imports(root, trees)
    below: dict[str, set[str]] = collections.defaultdict(set)
    for path in files:
        name = _module(path.relative_to(root))
        below[_folder(name)] |= {_folder(target) for target in imports[name]} - {_folder(name)}
    rows: list[list[str]] = []
    while below:
        free = sorted(folder for folder, targets in below.items() if not targets & below.keys())
        if not free:  # a circle
            free = sorted(below)
        rows.append(free)
        below = {folder: targets for folder, targets in below.items() if folder not in free}
    return rows


def _folder(module: str) -> str:
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
        for i, folder in enumerate(row):
            x = (i + 0.5) * widest / len(row) - 0.3
            axis.text(x, y, folder, bbox=box, ha="center", va="center", fontsize=9)
    figure.savefig(path, metadata={"Date": None})


# --- report ---------------------------------------------------------------------------------------


def exceeded(measures: Measures) -> list[str]:
    """The measures beyond their limits, as text."""
    return [
        f"{name}: {value:g}, limit {limit:g}"
        for name, value in measures.values.items()
        for limit in [LIMITS.get(name, LEAST.get(name))]
        if limit is not None and (value < limit if name in LEAST else value > limit)
    ]


def print_names(paths: list[str]) -> None:
    """Each name that is a participle or a function word, with its places."""
    files = [
        f
        for p in paths or PACKAGES
        for f in ([Path(p)] if p.endswith(".py") else sorted(Path(p).rglob("*.py")))
    ]
    places: dict[str, list[str]] = collections.defaultdict(list)
    total = 0
    for path in files:
        for name, line in bound_names(ast.parse(path.read_text())):
            total += 1
            if is_no_noun(name):
                places[name].append(f"{path}:{line}")
    for name, listed in sorted(places.items(), key=lambda item: -len(item[1])):
        print(f"{name} ({len(listed)}): {' '.join(listed)}")
    count = sum(map(len, places.values()))
    print(f"{count} of {total} names, {100 * count / max(total, 1):.2f} %")


def main() -> int:
    if sys.argv[1:2] == ["--picture"]:
        draw_layers(Path(sys.argv[2]))
        return 0
    if sys.argv[1:2] == ["--names"]:
        print_names(sys.argv[2:])
        return 0
    measures = measure()
    print(f"{'':60}{'now':>9}{'limit':>9}")
    for name, value in measures.values.items():
        print(f"{name:60}{value:9.5g}{LIMITS.get(name, LEAST.get(name, 0)):9g}")
    for place in measures.places:
        print(f"  {place}")
    print("\n".join(exceeded(measures)))
    return bool(exceeded(measures))


if __name__ == "__main__":
    sys.exit(main())
