"""The reference, from the docstrings: a page for each package.

The docstrings are Markdown, which Sphinx's own autodoc does not read; here each public name becomes
a `py:function` or `py:class` of MyST with its docstring inside, and with its example of
docs/examples.md. A name in code font anywhere in the documentation, such as ``dvi.Save``, leads to
its entry.
"""

import dataclasses
import inspect
import math
import re
import types
from collections.abc import Iterable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any, get_args, get_type_hints

import numpy as np
import usage
from docutils import nodes
from sphinx import addnodes
from sphinx.transforms.post_transforms import SphinxPostTransform
from sphinx.util.docutils import SphinxDirective

import dvi_jax
import lanewise
from dvi_jax._namespaces import names
from dvi_jax.base.checks import settings_type
from dvi_jax.testing.paper.equations import EQUATIONS

PAGES = {
    "integration": "Systems and integration",
    "methods": "Methods",
    "noise": "Noise",
    "lattices": "Time grids",
    "solvers": "Root solvers, layout, devices",
    "observables": "Observables and reductions",
    "discovery": "Symmetries and invariants",
    "proof": "Proved bounds",
    "sweeps": "Sweeps",
    "fitting": "Fits",
    "dynamics": "Sections, frequencies, actions",
    "explorer": "The explorer",
}
"""Page → title."""

FOLDERS = {
    "dvi_jax": "integration",
    "dvi_jax.methods": "methods",
    "dvi_jax.methods.step": "integration",
    "dvi_jax.methods.constraint": "integration",
    "dvi_jax.problem.noise": "noise",
    "dvi_jax.lattices": "lattices",
    "dvi_jax.engine": "solvers",
    "dvi_jax.base.devices": "solvers",
    "lanewise": "solvers",
    "dvi_jax.observe": "observables",
    "dvi_jax.observe.solution": "integration",
    "dvi_jax.discover": "discovery",
    "dvi_jax.proof": "proof",
    "dvi_jax.sweep": "sweeps",
    "dvi_jax.fit": "fitting",
    "dvi_jax.dynamics": "dynamics",
    "dvi_jax.explorer": "explorer",
}
"""Package or module → the page of its public names; the longest name that fits decides."""

MODULES = {
    "generators": ("Generators of common symmetries", "generators"),
    "starts": ("Initial conditions of a sweep", "starts"),
    "elements": ("Orbital elements", "elements"),
    "forces": ("Forces on planets and satellites", "forces"),
    "systems": ("Library of systems", "systems"),
    "boozer": ("Guiding centres in Boozer coordinates", "systems.boozer"),
    "fields": ("Magnetic fields of coils and on grids", "systems.fields"),
    "rigid": ("Rotations of rigid bodies", "systems.rigid"),
    "rings": ("Storage rings", "rings"),
    "plot": ("Plots", "plot"),
    "interop": ("Other packages", "interop"),
}
"""Page → title, and the public module that it documents."""

GENERATOR = "lanewise"
"""The page of the package that makes machine code, and its name."""

TITLES = {
    **PAGES,
    **{page: title for page, (title, _) in MODULES.items()},
    GENERATOR: "Machine code for batches",
}
"""Page → title, in the order of the index."""

OWN = ("dvi_jax", "lanewise")
"""Packages that are documented here."""


def public(module: types.ModuleType) -> dict[str, Any]:
    """Public names of a module that are our own, in alphabetical order, without aliases."""
    listed = names() if module is dvi_jax else vars(module)
    things = {name: getattr(module, name) for name in listed if not name.startswith("_")}
    own = {
        name: thing
        for name, thing in things.items()
        if (inspect.isclass(thing) or inspect.isfunction(thing))
        and thing.__module__.startswith(OWN)
    }
    return dict(sorted(own.items(), key=lambda item: item[0].lower()))


def _room(thing: Any) -> str:
    """The page of a public name of `dvi_jax`, by the file where it is written."""
    folders = [name for name in FOLDERS if f"{thing.__module__}.".startswith(f"{name}.")]
    return FOLDERS[max(folders, key=len)]


def entries() -> dict[str, dict[str, tuple[str, Any]]]:
    """Page → name in the documentation → (name as one writes it, the thing)."""
    found: dict[str, dict[str, tuple[str, Any]]] = {page: {} for page in TITLES}
    for name, thing in public(dvi_jax).items():
        found[_room(thing)][f"dvi_jax.{name}"] = (f"dvi.{name}", thing)
    for page, (_, attribute) in MODULES.items():
        module = getattr(dvi_jax, attribute, None) or import_module(f"dvi_jax.{attribute}")
        for name, thing in _members(module):
            found[page][f"dvi_jax.{attribute}.{name}"] = (f"{attribute}.{name}", thing)
    for name, thing in public(lanewise).items():
        if getattr(dvi_jax, name, None) is not thing:
            found[GENERATOR][f"lanewise.{name}"] = (f"lanewise.{name}", thing)
    return found


def _members(module: types.ModuleType) -> Iterator[tuple[str, Any]]:
    for name, thing in public(module).items():
        if f"{thing.__module__}.".startswith(f"{module.__name__}."):
            yield name, thing


def _type(annotation: Any) -> Any:
    """The name of a type as a reader writes it; nothing for `Any` and for long ones."""
    empty = inspect.Parameter.empty
    if annotation is empty or annotation is Any:
        return empty
    text = annotation if isinstance(annotation, str) else inspect.formatannotation(annotation)
    text = re.sub(r"\b(?:[a-z_]\w*\.)+(?=[A-Z])", "", text)  # names without their modules
    text = re.sub(r"\b(?:Float|Int|Bool|Shaped|Num|Inexact)\[[^]]*\]", "Array", text)
    return empty if text == "Any" or len(text) > 40 or "<" in text else _Shown(text)


def signature(thing: Any) -> str:
    """`(a, *, b=1)`: names, types and defaults; the docstring explains them."""
    try:
        found = inspect.signature(thing)
    except (TypeError, ValueError):
        return "()"
    made = _made_defaults(thing)
    plain = [
        p.replace(annotation=_type(p.annotation), default=_default(made.get(name, p.default)))
        for name, p in found.parameters.items()
        if name not in ("self", "cls") and not name.startswith("_")
    ]
    if (settings := settings_type(thing)) is not None:
        plain[-1:] = _keywords(settings)
    try:
        return str(found.replace(parameters=plain, return_annotation=found.empty))
    except ValueError:
        return "(...)"


def _keywords(settings: Any) -> Iterator[inspect.Parameter]:
    """The keywords of a `TypedDict`, with the defaults that they have in `integrate`, or else None;
    `...` for those that cannot be None, whose default the docstring states."""
    defaults = inspect.signature(dvi_jax.integrate).parameters
    for name, kind in get_type_hints(settings).items():
        default = inspect.Parameter.empty
        if name not in settings.__required_keys__:
            default = _default(None)
            if name in defaults and name != "save":
                default = _default(defaults[name].default)
            elif kind is not Any and type(None) not in get_args(kind):
                default = _Shown("...")
        yield inspect.Parameter(
            name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=_type(kind)
        )


def _made_defaults(thing: Any) -> dict[str, Any]:
    """Defaults of fields with a factory, which a signature does not show."""
    fields = dataclasses.fields(thing) if dataclasses.is_dataclass(thing) else ()
    missing = dataclasses.MISSING
    return {f.name: f.default_factory() for f in fields if f.default_factory is not missing}


class _Shown:
    def __init__(self, text: str):
        self.text = text

    def __repr__(self) -> str:
        return self.text


def _default(value: Any) -> Any:
    if value is inspect.Parameter.empty:
        return value
    text = "2π" if isinstance(value, float) and value == 2 * math.pi else repr(value)
    if isinstance(value, np.ndarray) and value.size == 0:
        text = "[]"
    if callable(value) and hasattr(value, "__name__"):
        text = value.__name__
    if "<" in text or len(text) > 60:
        text = f"{type(value).__name__}(...)"
    return _Shown(" ".join(text.split()))


CODE = re.compile(r"(```.*?```|``.*?``|`[^`]*`|(?m:^ {4}[^\n]*$))", re.S)


def literally(text: str) -> str:
    """Markdown in which E⁺_k − E⁻_k and Φ* are what they look like, and no emphasis."""
    pieces = CODE.split(text)
    pieces[::2] = [re.sub(r"_|(?<=Φ)\*", r"\\\g<0>", piece) for piece in pieces[::2]]
    return "".join(pieces)


def _docstring(thing: Any) -> str:
    return literally(inspect.getdoc(thing) or "")


def _is_own(thing: Any) -> bool:
    return getattr(thing, "__module__", "").startswith(OWN)


def _has_an_entry(cls: type) -> bool:
    return getattr(dvi_jax, cls.__name__, None) is cls


def _class_members(cls: type) -> Iterator[tuple[str, str, Any]]:
    """(kind, name, thing) of documented public members: its own and those of private bases."""
    seen = set()
    for base in cls.__mro__:
        if not _is_own(base) or (base is not cls and _has_an_entry(base)):
            continue
        for name, member in vars(base).items():
            if name.startswith("_") or name in seen:
                continue
            seen.add(name)
            plain = inspect.unwrap(getattr(member, "__func__", member))
            if isinstance(member, property):
                if member.fget is not None and member.fget.__doc__:
                    yield "property", name, member
            elif isinstance(member, classmethod | staticmethod):
                if plain.__doc__:
                    yield "classmethod", name, getattr(cls, name)
            elif plain.__doc__ and (inspect.isfunction(plain) or hasattr(member, "__wrapped__")):
                yield "method", name, plain


def _statuses(thing: Any) -> str:
    """Table of an enumeration of statuses: name and message."""
    items = getattr(thing, "_name_to_item", None)
    if not items:
        return ""
    rows = [f"| `{name}` | {str(thing[item]) or 'no error'} |" for name, item in items.items()]
    return "\n".join(["| status | message |", "| --- | --- |", *rows, ""])


def _entry(full: str, shown: str, thing: Any) -> str:
    kind = "class" if inspect.isclass(thing) else "function"
    arguments = signature(thing)
    if kind == "class" and issubclass(thing, BaseException):
        kind, arguments = "exception", ""
    body = _docstring(thing) if _docstring(thing) else "…"
    table = _statuses(thing) if kind == "class" else ""
    if table:
        arguments, body = "", "Statuses of a result, and what they say.\n\n" + table
    module, _, name = full.rpartition(".")
    lines = [f":::::{{py:{kind}}} {name}{arguments}", f":module: {module}", "", body, ""]
    lines += [usage.page().markdown(shown), ""]
    if kind == "class" and not table:
        bases = [f"`{base.__name__}`" for base in thing.__mro__[1:] if _has_an_entry(base)]
        lines += ["It has the members of " + " and ".join(bases) + ".", ""] if bases else []
        for what, member_name, member in _class_members(thing):
            extra = "" if what == "property" else signature(member)
            role = "method" if what == "classmethod" else what
            lines += [f"::::{{py:{role}}} {member_name}{extra}"]
            lines += [":classmethod:"] if what == "classmethod" else []
            lines += ["", _docstring(member), "::::", ""]
    return "\n".join([*lines, ":::::", ""])


FIRST = (
    *("System", "discretise", "from_lagrangian", "velocity_force"),
    *("integrate", "Integrator", "Save", "Solution", "RESULTS", "IntegrationError"),
    *("TypeII", "SymplecticEuler", "Strang", "StormerVerlet", "Yoshida", "GaussLegendre"),
    *("Uniform", "TimeTransformed", "Variational", "Compensated", "DoubleDouble", "FixedPoint"),
    *("Newton", "SimplifiedNewton", "Picard", "Reversible", "Checkpointed"),
    *("MaxDrift", "Range", "Trend", "Mean", "Section", "Stop"),
    *("discover_invariants", "find_symmetries", "drift_order", "bound_drift"),
    *("Polynomials", "ShadowHamiltonian"),
    *("sweep", "Axis", "open_sweep", "fit", "Observations"),
    *("poincare_section", "frequencies", "tangent_map"),
    "over_devices",
)
"""Names that most programs use; a table of the reference begins with them."""


def _rank(item: tuple[str, tuple[str, Any]]) -> tuple[int, str]:
    """The names that most programs use, then the others, then errors and statuses."""
    _, (shown, thing) = item
    name = shown.rpartition(".")[2]
    is_status = inspect.isclass(thing) and (
        issubclass(thing, BaseException) or hasattr(thing, "_name_to_item")
    )
    if name in FIRST and not is_status:
        return FIRST.index(name), ""
    return len(FIRST) + is_status, name.lower()


def _summary(thing: Any) -> str:
    """First sentence of a docstring, for tables."""
    if _statuses(thing) if inspect.isclass(thing) else False:
        return "Statuses and their messages."
    text = (inspect.getdoc(thing) or "").split("\n\n")[0]
    return literally(" ".join(text.split())).replace("|", r"\|")


def _table(listed: Iterable[tuple[str, Any]]) -> list[str]:
    rows = [f"| `{shown}` | {_summary(thing)} |" for shown, thing in listed]
    return ["| name | summary |", "| --- | --- |", *rows, ""]


PROVISIONAL = ("noise", "proof", "boozer", "rings", GENERATOR)
"""Pages whose names may change in a minor release."""

STABLE_NOTE = "The names on this page are stable ([stability](index.md#stability))."
PROVISIONAL_NOTE = (
    "The names on this page are **provisional**: they may change in a minor release "
    "([stability](index.md#stability))."
)

STABILITY = """## Stability

Versions are numbered MAJOR.MINOR.PATCH. Each page of the reference says whether its names are
stable or provisional.

- *Stable* names, their keywords and their statuses keep their meaning until the next major release.
  A name that is to be removed works for at least two minor releases and one year after the release
  that deprecates it. Until then its use gives a `DeprecationWarning`, which names the replacement.
- *Provisional* names may change in a minor release. The changelog says how to change a program.
- A correction may change numbers in any release, and the changelog reports it. The bits of a result
  are the same only for the same versions of this package, JAX and llvmlite on the same processor.
- Files that a release writes (solutions, discoveries, certificates, fits) can be read by all later
  releases with the same major number. A store of a sweep can be continued only by the release that
  began it.
- Everything else may change at any time: names that begin with an underscore, modules that are not
  in the reference, and the words of messages and of printed reports. TOML files and the options of
  `dvi-jax` are stable.
"""
"""Section of the index of the reference; CONTRIBUTING.md has the rules for developers."""

AFTER = "The examples run after [these lines](index.md#examples)."
"""Above the table of each page."""


def write(folder: Path) -> None:
    """The pages of the reference, as Markdown; a page that did not change is not written again."""
    folder.mkdir(parents=True, exist_ok=True)
    found = {page: dict(sorted(things.items(), key=_rank)) for page, things in entries().items()}
    pages = {}
    for page, title in TITLES.items():
        if not found[page]:
            continue
        note = PROVISIONAL_NOTE if page in PROVISIONAL else STABLE_NOTE
        parts = [f"# {title}", "", f"{note} {AFTER}", "", usage.page().markdown(page), ""]
        parts += _table(found[page].values())
        parts += [_entry(full, *rest) for full, rest in found[page].items()]
        pages[page] = "\n".join(parts)
    index = [
        "# Reference",
        "",
        "Every public class and function, from its docstring. The names that are used most are "
        "first on each page.",
        "",
        "(examples)=",
        "The examples run after these lines:",
        "",
        f"```python\n{usage.page().imports}```",
        "",
        STABILITY,
    ]
    index += ["```{toctree}", ":hidden:", "", *pages, "```", ""]
    for page in pages:
        index += [f"## [{TITLES[page]}]({page}.md)", "", *_table(found[page].values())]
    pages["index"] = "\n".join(index)
    for page, text in pages.items():
        path = folder / f"{page}.md"
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
    for stale in {p.stem for p in folder.glob("*.md")} - set(pages):
        (folder / f"{stale}.md").unlink()


class LinkNames(SphinxPostTransform):
    """Names of the package in code font lead to the reference, names of pages to the pages."""

    default_priority = 5

    def run(self, **kwargs: Any) -> None:
        for literal in list(self.document.findall(nodes.literal)):
            if isinstance(literal.parent, nodes.reference | addnodes.pending_xref):
                continue
            if self.env.docname == "migration" and self._is_first_cell(literal):
                continue  # their names, some of which are ours too
            page = re.fullmatch(r"docs/([\w-]+)\.md", literal.astext())
            if page is not None and page[1] in self.env.found_docs:
                self._link(literal, refdomain="std", reftype="doc", reftarget=f"/{page[1]}")
                continue
            found = meant(literal.astext(), self.env.docname)
            target = next((x for x in found if not self._is_own_entry(literal, x)), None)
            if target is None:
                continue
            self._link(literal, refdomain="py", reftype="obj", reftarget=target)

    def _link(self, literal: nodes.literal, **to: str) -> None:
        link = addnodes.pending_xref(
            "", refdoc=self.env.docname, refexplicit=True, refwarn=True, **to
        )
        literal.replace_self(link)
        link += literal

    @staticmethod
    def _is_own_entry(node: nodes.Node, target: str) -> bool:
        while node is not None:
            if isinstance(node, addnodes.desc):
                signatures = node.findall(addnodes.desc_signature)
                return any(f"{s.get('module')}.{s.get('fullname')}" == target for s in signatures)
            node = node.parent
        return False

    @staticmethod
    def _is_first_cell(node: nodes.Node) -> bool:
        while node is not None and not isinstance(node, nodes.entry):
            node = node.parent
        return node is not None and node.parent.index(node) == 0


class EquationMap(SphinxDirective):
    """The paper's numbered equations, as `dvi_jax.testing.paper.equations` has them."""

    def run(self) -> list[nodes.Node]:
        rows = ["| equation | what it says | as printed? | code |", "| --- | --- | --- | --- |"]
        for equation in EQUATIONS:
            code = ", ".join(f"`{_as_written(name)}`" for name in equation.code)
            note = equation.note or "as printed"
            cells = (f"({equation.number})", equation.statement, note, code)
            rows.append("| " + " | ".join(literally(c).replace("|", r"\|") for c in cells) + " |")
        holder = nodes.container()
        self.state.nested_parse(rows, 0, holder)
        return holder.children


NAMES: dict[str, str] = {}
"""What is written in code font → full name of its entry."""

HOMES = {
    "plots": "plot",
    "reference/plot": "plot",
    "systems": "systems",
    "reference/systems": "systems",
}
"""Pages where a bare name is first that of a module."""

OTHER_MEANINGS = {"fit", "sample", "sweep", "actions", "frequencies", "lattice_defect"}
"""Bare words that are arguments, fields and commands as well."""


def meant(text: str, page: str) -> list[str]:
    """Full names of the entries that a text in code font may lead to, the likeliest first."""
    name = re.sub(r"\(.*\)$", "", text, flags=re.S)
    found = [NAMES.get(f"{HOMES[page]}.{name}")] if page in HOMES else []
    if text not in OTHER_MEANINGS:
        found.append(NAMES.get(name))
    found.append(
        NAMES.get(f"{page.removeprefix('reference/')}.{name}")
    )  # `vector_field` in interop
    return [full for full in found if full is not None]


def _as_written(full: str) -> str:
    """`dvi_jax.symmetry.prolong` after `import dvi_jax as dvi`."""
    return re.sub(r"^dvi_jax\b", "dvi", full)


def _fill_names() -> None:
    for page in entries().values():
        for full, (shown, _) in page.items():
            names = {full, shown, full.removeprefix("dvi_jax."), _as_written(full)}
            for name in names:
                NAMES.setdefault(name, full)


def _write(app: Any) -> None:
    _fill_names()
    write(Path(app.srcdir) / "reference")


def setup(app: Any) -> dict[str, Any]:
    app.connect("builder-inited", _write)
    app.add_directive("equation-map", EquationMap)
    app.add_post_transform(LinkNames)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
