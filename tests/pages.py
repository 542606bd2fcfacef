"""What the code of a page says that it prints, compared with what it prints.

A comment below a `print` is the text that it prints, in which … stands for anything. Without one,
a comment at its end begins with numbers of it: `# 0.07 and 1.2…: the two errors`. The numbers up to
a colon or a semicolon are rounded, or cut where … follows; after "below" a number is a bound.
"""

import ast
import io
import os
import re
import subprocess
import sys
import tokenize
from decimal import Decimal
from itertools import takewhile
from typing import NamedTuple

ROUND_OFF = 1e-12
"""Numbers below this are not compared: they differ between processors."""

MARK = "\x1e"
NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d*)?(?:e[-+]?\d+)?(?!\w)")


class Claim(NamedTuple):
    """The last line of a statement, and its comment about what it prints: below or at its end."""

    line: int
    text: str
    is_below: bool


def claims(code):
    """The claims of a program."""
    lines = code.splitlines()
    tokens = tokenize.generate_tokens(io.StringIO(code).readline)
    comments = {x.start[0]: x.string for x in tokens if x.type == tokenize.COMMENT}
    for node in filter(_prints, ast.parse(code).body):
        end = node.end_lineno or 0
        below = [*takewhile(lambda line: line.startswith("# "), lines[end:])]
        if below:
            yield Claim(end, "\n".join(line[2:] for line in below), True)
        elif NUMBER.search(_numbers_of(comments.get(end, ""))):
            yield Claim(end, _numbers_of(comments[end]), False)


def _prints(node):
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        return False
    calls = [x.func for x in ast.walk(node) if isinstance(x, ast.Call)]
    return any(isinstance(x, ast.Name) and x.id == "print" for x in calls)


def _numbers_of(comment):
    return re.split(r"[:;]", comment.removeprefix("#"))[0].replace("−", "-").replace("- ", "-")


def holds(claim, printed):
    """Whether a claim is right for what was printed."""
    if claim.is_below:
        parts = map(re.escape, claim.text.split("…"))
        return re.fullmatch(".*".join(parts), printed.rstrip("\n"), re.S) is not None
    numbers = NUMBER.findall(_numbers_of(printed.replace(":", " ").replace(";", " ")))
    for match in NUMBER.finditer(claim.text):
        before, after = claim.text[: match.start()].rstrip(), claim.text[match.end() :]
        if before.endswith("below"):
            fits = any(abs(float(x)) < float(match[0]) for x in numbers)
        elif after.startswith("…"):
            fits = any(x.startswith(match[0]) for x in numbers)
        else:
            fits = any(_rounds_to(x, match[0]) for x in numbers)
        if not fits:
            return False
    return True


def _rounds_to(number, text):
    value, x = float(text), float(number)
    if max(abs(value), abs(x)) < ROUND_OFF:
        return True
    exponent = Decimal(text).as_tuple().exponent
    return abs(x - value) <= 0.5 * 10.0**exponent * (1 + 1e-9)


def wrong_values(code, names):
    """Assignments with no more than a number as their comment, which the value does not round to:
    name → (number, value)."""
    found = re.findall(r"^(\w+) = .*# (-?\d[\d.]*(?:e-?\d+)?)$", code, re.M)
    values = {name: (text, float(names[name])) for name, text in found}
    return {name: pair for name, pair in values.items() if not _rounds_to(str(pair[1]), pair[0])}


def run(code, folder, **options):
    """The lines that a program prints. Its claims are compared."""
    stated = {claim.line: claim for claim in claims(code)}
    tree = ast.parse(code)
    body = []
    for node in tree.body:
        mark = [node.end_lineno] if node.end_lineno in stated and _prints(node) else []
        body += [*(_mark("") for _ in mark), node, *map(_mark, mark)]
    tree.body = body
    (folder / "page.py").write_text(ast.unparse(ast.fix_missing_locations(tree)), encoding="utf-8")
    out = subprocess.run(
        [sys.executable, "-W", "error::DeprecationWarning:dvi_jax", "page.py"],
        capture_output=True, text=True, check=False, cwd=folder, timeout=500,
        env={**os.environ, "MPLBACKEND": "Agg", "PYTHONUTF8": "1", **options},
    )  # fmt: skip
    assert out.returncode == 0, out.stderr[-3000:]
    parts = re.findall(f"{MARK}\n(.*?){MARK}(\\d+)\n", out.stdout, re.S)
    printed = {int(line): text for text, line in parts}
    wrong = {claim.text: printed[line] for line, claim in stated.items()
             if not holds(claim, printed[line])}  # fmt: skip
    assert not wrong, wrong  # the claims, and what was printed
    return re.sub(f"{MARK}\\d*\n", "", out.stdout).strip().splitlines()


def _mark(line):
    return ast.parse(f"print({MARK + str(line)!r})").body[0]
