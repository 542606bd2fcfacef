"""Phrases that a reader has to decode, and where they occur.

    python tests/language.py            list every occurrence
    python tests/language.py --count    numbers per phrase

Each phrase below was in the texts once; the right column is what to write. Searched are docstrings,
comments and string literals with a space of Python files, TOML files of the package, and Markdown
outside of code blocks.
"""

import argparse
import ast
import collections
import functools
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]

PHRASES = {
    # "disturbed" is the paper's word: allowed in its title and, in italics, where it is explained.
    r"(?<!\*)\bdisturb(?:ed|ing|s|ances?)?\b(?!\*| Hamiltonian systems(?:\s+under|$))": "perturbed",
    r"\bundisturbed\b": "unperturbed",
    r"\b(?:waver|wiggl)(?:s|es|ed|e|ing)?\b|\bswings\b": "oscillates, oscillation",
    r"\bgo(?:es)? (?:as|with)\b": "scales as",
    r"\btells?\b|\btold\b": "reports, returns, distinguishes",
    r"\bask(?:s|ed|ing)? (?:for|of|again)\b|\bis asked\b": "requires, requested",
    r"\bstands?\b(?! for| in for)": "is stored, is listed, is next to",
    r"\bwhat is left\b(?! out| to\b)": "residual, remainder",
    r"\bwhat is kept\b|\bwhat (?:it|a map|the map) keeps\b": "conserved quantities, output",
    r"\bmend(?:ed|s)?\b": "corrected",
    r"\bfoils?\b": "reference method",
    r"\bon trust\b|\bwith care\b|\bkeeps no books\b": "unchecked, checked",
    r"\bhouse\b|\bfront door\b|\bthe door\b": "package, layer, public API",
    r"\bleading parts?\b|\bsurvivors\b": "leading-order term, number of invariants per order",
    r"\bfunctions of one another\b": "functionally dependent",
    r"\bnoises\b": "noise realisations",
    r"\bdear\b|\banew\b": "expensive, again",
    r"\bcannot be meant\b|\b(?:is|may be) meant\b": "is invalid, means",
    r"\bnought\b|\b(?:is|are) (?-i:none)\b": "zero, does not exist",
    r"\bas it should be\b": "correct",
    r"\bbeside\b": "next to, compared with, and",
    r"\ba look\b|\blooked at\b|\b(?:is|are) seen\b": "check, checked, detected",
    r"\bcomes? back\b": "result, returns",
    r"\bto and fro\b|\bthere and back\b|\bthe other way about\b": "in both directions",
    r"\bworth knowing\b|\bin hand\b|\bat hand\b": "notes, in progress, available",
    r"\bhands? (?:it|them|over|out|back)\b|(?<!-)\bhanded\b": "passes, receives",
    r"\bof one's own\b": "user-defined",
}
"""Phrase → what to write."""

CODE = re.compile(r"``?[^`\n]*``?")


def strings_and_comments(text: str) -> Iterator[tuple[int, str]]:
    """(line, text) of docstrings, comments and string literals that contain a space."""
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT and "noqa" not in token.string:
            yield token.start[0], token.string
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value:
            yield node.lineno, node.value


def prose(text: str) -> Iterator[tuple[int, str]]:
    """(line, text) of Markdown outside of code."""
    fenced = False
    for number, line in enumerate(text.splitlines(), 1):
        if line.lstrip().startswith("```"):
            fenced = not fenced
        elif not fenced and not line.startswith("    "):
            yield number, re.sub(r"`[^`]*`", "", line)


@functools.cache
def _one(phrases: tuple[str, ...]) -> re.Pattern:
    """One expression with a group for each phrase."""
    return re.compile("|".join(f"({phrase})" for phrase in phrases), re.I)


def found(path: Path, phrases: dict[str, str] = PHRASES) -> list[tuple[int, str, str]]:
    """(line, words, what to write) of every occurrence in a file."""
    text = path.read_text(encoding="utf-8")
    parts = strings_and_comments(text) if path.suffix == ".py" else prose(text)
    return [
        (
            line + part.count("\n", 0, match.start()),
            match[0],
            list(phrases.values())[match.lastindex - 1],
        )
        for line, part in parts
        for match in _one(tuple(phrases)).finditer(CODE.sub(lambda m: "_" * len(m[0]), part))
    ]


def files() -> list[Path]:
    """Files whose words users read."""
    folders = ("dvi_jax", "dvi_jax_cli", "lanewise", "examples", "notebooks", "benchmarks", "tests")
    python = [p for folder in folders for p in sorted((ROOT / folder).rglob("*.py"))]
    pages = [
        p for p in [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")] if p.name != "CHANGELOG.md"
    ]
    data = sorted((ROOT / "dvi_jax").rglob("*.toml"))
    lists = ("language.py", "test_language.py", "measures.py")  # they contain the words themselves
    return [p for p in python + data + pages if p.name not in lists]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--count", action="store_true", help="numbers per phrase")
    parser.add_argument("paths", nargs="*", type=Path, help="files (default: all)")
    options = parser.parse_args()
    counts = collections.Counter()
    for path in options.paths or [p.relative_to(Path.cwd()) for p in files()]:
        for line, words, instead in found(path):
            counts[words.lower()] += 1
            if not options.count:
                print(f"{path}:{line}: {words!r}: {instead}")
    if options.count:
        for words, number in counts.most_common():
            print(f"{number:5} {words}")


if __name__ == "__main__":
    main()
