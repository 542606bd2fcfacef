"""Version and address of a release, in all files that repeat them.

    python packaging/release.py                   check that all files have one version
    python packaging/release.py --tag v1.0.0      … and that a tag is that of this version
    python packaging/release.py --write           write the version, and the address if there is one
    python packaging/release.py --write --repository https://HOST/OWNER/NAME

The version is `__version__` of `dvi_jax/__init__.py`. The address is the setting `repository` of
`[tool.dvi-jax]` in pyproject.toml, or the argument. With an address, `--write` makes the project's
links, and turns the links of README.md into absolute ones, which also work on the page of a package
index. The release workflow does this in its own checkout; the result need not be committed.
"""

import argparse
import json
import re
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]

VERSIONS = {
    "CITATION.cff": r"(?m)^version: (.*)$",
    "codemeta.json": r'"version": "(.*)"',
    "README.md": r"version = \{(.*)\}",
    "packaging/conda/recipe.yaml": r'(?m)^  version: "(.*)"$',
}
"""File → where it repeats the version."""


def version(root: Path = ROOT) -> str:
    """The version of the package, from its source: importing it would import JAX."""
    text = (root / "dvi_jax" / "__init__.py").read_text(encoding="utf-8")
    match = re.search(r'^__version__ = "(.*)"$', text, re.M)
    assert match, "dvi_jax/__init__.py has no line __version__ = ..."
    return match[1]


def address(root: Path = ROOT) -> str:
    """The setting `repository`, or "" if the address is not known."""
    text = (root / "pyproject.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)["tool"]["dvi-jax"]["repository"]


def differences(root: Path = ROOT) -> list[str]:
    """A line for each file with another version than the package."""
    expected = version(root)
    lines = []
    for file, pattern in VERSIONS.items():
        match = re.search(pattern, (root / file).read_text(encoding="utf-8"))
        if not match or match[1] != expected:
            lines.append(f"{file}: {match[1] if match else 'no version'}, not {expected}")
    return lines


def absolute_links(text: str, base: str, tag: str) -> str:
    """Markdown whose relative links lead to the files of a tag; code stays as it is."""

    def link(match: re.Match) -> str:
        kind = "raw" if match[1].startswith("!") else "blob"
        return f"{match[1]}({base}/{kind}/{tag}/{match[2]})"

    pattern = re.compile(r"(!?\[[^\]]*\])\((?![a-z]+:|#)([^)\s]+)\)")
    pieces = re.split(r"(```.*?```|`[^`\n]*`(?!\]))", text, flags=re.S)
    pieces[::2] = [pattern.sub(link, piece) for piece in pieces[::2]]
    return "".join(pieces)


def links(base: str, tag: str) -> dict[str, str]:
    """Labels and addresses of `[project.urls]`."""
    return {
        "Repository": base,
        "Documentation": f"{base}/tree/{tag}/docs",
        "Issues": f"{base}/issues",
        "Changelog": f"{base}/blob/{tag}/CHANGELOG.md",
    }


def write_version(root: Path = ROOT) -> None:
    for file, pattern in VERSIONS.items():
        text = (root / file).read_text(encoding="utf-8")
        match = re.search(pattern, text)
        assert match, f"{file} has no version"
        text = text[: match.start(1)] + version(root) + text[match.end(1) :]
        (root / file).write_text(text, encoding="utf-8")


def write_address(base: str, root: Path = ROOT) -> None:
    """The address in pyproject.toml, README.md, CITATION.cff, codemeta.json and the recipe."""
    base = base.removesuffix(".git").rstrip("/")
    if not re.fullmatch(r"https://[\w.-]+(/[\w.-]+){2,}", base):
        raise SystemExit(f"{base!r} is not an address https://HOST/OWNER/NAME.")
    tag = f"v{version(root)}"

    def rewrite(file: str, pattern: str, replacement: str, before: str) -> None:
        """Replaces what an earlier call has written, or writes it before the line `before`."""
        text = re.sub(pattern, "", (root / file).read_text(encoding="utf-8"))
        assert text.count(before) == 1, f"{file} must have one line {before!r}"
        text = text.replace(before, replacement + before)
        (root / file).write_text(text, encoding="utf-8")

    table = "".join(f'{label} = "{url}"\n' for label, url in links(base, tag).items())
    rewrite(
        "pyproject.toml",
        r"\[project\.urls\]\n(?:.+\n)*\n",
        f"[project.urls]\n{table}\n",
        "[project.optional-dependencies]\n",
    )
    rewrite("CITATION.cff", r"repository-code: .*\n", f'repository-code: "{base}"\n', "license: ")
    rewrite(
        "packaging/conda/recipe.yaml",
        r"  (?:homepage|repository): .*\n",
        f"  homepage: {base}\n  repository: {base}\n",
        "  license: ",
    )
    readme = root / "README.md"
    text = absolute_links(readme.read_text(encoding="utf-8"), base, tag)
    readme.write_text(text, encoding="utf-8")
    meta = root / "codemeta.json"
    entries = json.loads(meta.read_text(encoding="utf-8"))
    entries |= {"codeRepository": base, "issueTracker": f"{base}/issues"}
    meta.write_text(json.dumps(entries, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--write", action="store_true", help="write, instead of a check")
    parser.add_argument("--repository", help="address (default: the setting in pyproject.toml)")
    parser.add_argument("--tag", help="a tag, which must be v followed by the version")
    options = parser.parse_args()
    if options.tag not in (None, f"v{version()}"):
        sys.exit(f"The tag {options.tag} is not v{version()}, the version of the package.")
    if options.write:
        write_version()
        if base := options.repository or address():
            write_address(base)
    if lines := differences():
        sys.exit("\n".join([*lines, "`python packaging/release.py --write` corrects them."]))


if __name__ == "__main__":
    main()
