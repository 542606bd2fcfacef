"""Files of a release: one version, requirements that agree, links to files that exist."""

import importlib.util
import json
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import dvi_jax as dvi

ROOT = Path(__file__).parents[1]
SCRIPT = ROOT / "packaging" / "release.py"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]

spec = importlib.util.spec_from_file_location("release", SCRIPT)
release = importlib.util.module_from_spec(spec)
spec.loader.exec_module(release)

FILES = ("pyproject.toml", "dvi_jax/__init__.py", "packaging/release.py", *release.VERSIONS)


@pytest.fixture
def copy(tmp_path):
    for file in FILES:
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / file, tmp_path / file)
    return tmp_path


def run(folder, *words):
    command = [sys.executable, str(folder / "packaging" / "release.py"), *words]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)


def test_all_files_have_the_version_of_the_package():
    assert release.version() == dvi.__version__
    assert release.differences() == []
    pattern = re.compile(r'(?m)^\s*"?version"?\s*[:=]\s*["{]?(\d[\w.]*)')
    for file in ("CITATION.cff", "codemeta.json", "README.md", "packaging/conda/recipe.yaml"):
        versions = set(pattern.findall((ROOT / file).read_text(encoding="utf-8")))
        assert versions == {dvi.__version__}, file


@pytest.mark.parametrize("file", release.VERSIONS)
def test_another_version_is_reported_and_corrected(copy, file):
    text = (copy / file).read_text(encoding="utf-8")
    (copy / file).write_text(text.replace(dvi.__version__, "0.9"), encoding="utf-8")
    assert release.differences(copy) == [f"{file}: 0.9, not {dvi.__version__}"]
    release.write_version(copy)
    assert release.differences(copy) == []
    assert (copy / file).read_text(encoding="utf-8") == text


def test_a_tag_of_another_version_is_refused(copy):
    assert run(copy, "--tag", f"v{dvi.__version__}").returncode == 0
    wrong = run(copy, "--tag", "v9.9")
    assert wrong.returncode == 1
    assert "v9.9 is not" in wrong.stderr


def test_the_address_is_one_setting_that_all_links_are_made_of(copy):
    base = "https://host.example/owner/name"
    before = {file: (copy / file).read_text(encoding="utf-8") for file in FILES}
    assert not any("host.example" in text for text in before.values())
    assert run(copy, "--write").returncode == 0  # without an address nothing changes
    assert {file: (copy / file).read_text(encoding="utf-8") for file in FILES} == before
    setting = before["pyproject.toml"].replace('repository = ""', f'repository = "{base}"')
    (copy / "pyproject.toml").write_text(setting, encoding="utf-8")
    result = run(copy, "--write")
    assert result.returncode == 0, result.stderr
    after = {file: (copy / file).read_text(encoding="utf-8") for file in FILES}
    project = tomllib.loads(after["pyproject.toml"])["project"]
    assert project.pop("urls") == release.links(base, f"v{dvi.__version__}")
    assert project == PROJECT
    assert json.loads(after["codemeta.json"])["codeRepository"] == base
    assert f'repository-code: "{base}"\n' in after["CITATION.cff"]
    assert f"  repository: {base}\n" in after["packaging/conda/recipe.yaml"]
    # A second address replaces the first one, but in the README: no link is relative any more.
    assert run(copy, "--write", "--repository", base + "2.git").returncode == 0
    project = tomllib.loads((copy / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert set(project["urls"].values()) == {
        url.replace("owner/name", "owner/name2")
        for url in release.links(base, f"v{dvi.__version__}").values()
    }
    citation = (copy / "CITATION.cff").read_text(encoding="utf-8")
    assert citation.count("repository-code") == 1
    for address in ("host.example/owner/name", "https://host.example", "https://a.b/c/d e"):
        assert run(copy, "--write", "--repository", address).returncode == 1


def test_links_of_the_readme_become_absolute():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    made = release.absolute_links(text, "https://host.example/a/b", "v1")
    targets = re.findall(r"\]\(https://host\.example/a/b/(blob|raw)/v1/([^)#]+)", made)
    assert len(targets) > 30
    assert {kind for kind, _ in targets} == {"blob", "raw"}
    assert all((ROOT / path).exists() for _, path in targets)
    code = re.compile(r"```.*?```", re.S)
    assert code.findall(made) == code.findall(text)
    assert re.findall(r"\]\((?!https:)[^)]*\)", code.sub("", made)) == []
    example = "[a](b.md) `[a](b)` [`a`](c/d.md#e) ![f](g.png) [h](https://i) [j](#k)"
    assert release.absolute_links(example, "B", "v1") == (
        "[a](B/blob/v1/b.md) `[a](b)` [`a`](B/blob/v1/c/d.md#e) ![f](B/raw/v1/g.png) "
        "[h](https://i) [j](#k)"
    )


def requirements():
    """Name → lower bound and the rest, of the requirements without a condition."""
    pairs = (re.match(r"([\w-]+)(.*?)(?:;.*)?$", text).groups() for text in PROJECT["dependencies"])
    return {name: bounds.strip() for name, bounds in pairs}


def test_recipe_and_metadata_have_the_requirements_of_the_project():
    recipe = (ROOT / "packaging" / "conda" / "recipe.yaml").read_text(encoding="utf-8")
    listed = re.findall(r"(?m)^    - ([\w-]+) +([<>=][\d.<>=,]*)$", recipe)
    names = {"matplotlib": "matplotlib-base", "typing-extensions": "typing_extensions"}
    expected = {names.get(name, name): bounds for name, bounds in requirements().items()}
    build = {"hatchling": ">=1.25"}
    assert dict(listed) == expected | build
    assert len(listed) == len(dict(listed))
    meta = json.loads((ROOT / "codemeta.json").read_text(encoding="utf-8"))
    assert meta["softwareRequirements"] == [f"{n} {b}" for n, b in requirements().items()]
    assert meta["runtimePlatform"] == f"Python {PROJECT['requires-python']}"
    assert meta["description"] == PROJECT["description"]
    assert meta["keywords"] == PROJECT["keywords"]


def test_workflows_test_the_pythons_that_the_project_names():
    versions = [c.rpartition(" ")[2] for c in PROJECT["classifiers"] if ":: 3." in c]
    listed = f"python: {json.dumps(versions)}"
    for workflow in ("test.yml", "wheels.yml"):
        assert listed in (ROOT / ".github" / "workflows" / workflow).read_text(encoding="utf-8")
    assert PROJECT["requires-python"] == f">={versions[0]}"


def test_the_article_cites_what_its_bibliography_has():
    text = (ROOT / "paper.md").read_text(encoding="utf-8")
    bibliography = (ROOT / "paper.bib").read_text(encoding="utf-8")
    body = text.split("\n---\n", 1)[1]
    keys = re.findall(r"(?m)^@\w+\{(\w+),", bibliography)
    assert set(re.findall(r"@(\w+)", body)) == set(keys)
    for path in re.findall(r"\]\(([^)]+)\)", body):
        assert (ROOT / path).exists(), path
    assert 600 < len(body.split()) < 1000  # two pages with the figure


@pytest.mark.slow
def test_each_page_of_the_reference_says_how_stable_its_names_are(monkeypatch, tmp_path):
    pytest.importorskip("sphinx")
    monkeypatch.syspath_prepend(str(ROOT / "docs" / "_ext"))
    reference = importlib.import_module("reference")
    reference.write(tmp_path)
    for page in reference.TITLES:
        text = (tmp_path / f"{page}.md").read_text(encoding="utf-8")
        assert ("are **provisional**" in text) == (page in reference.PROVISIONAL)
        assert ("are stable" in text) == (page not in reference.PROVISIONAL)
    assert set(reference.PROVISIONAL) < set(reference.TITLES)
    assert "## Stability" in (tmp_path / "index.md").read_text(encoding="utf-8")
