"""The texts use the field's words; phrases that had to be decoded do not return."""

import language


def test_no_phrase_of_the_list_occurs():
    hits = {str(path): language.found(path) for path in language.files()}
    assert {path: lines for path, lines in hits.items() if lines} == {}


def test_a_planted_sentence_is_found(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("It works.\n\nThe energy wavers, as `it is told`.\n\n```\na foil\n```\n")
    assert [(line, words) for line, words, _ in language.found(page)] == [(3, "wavers")]
    module = tmp_path / "module.py"
    module.write_text('"""A sum.\n\nWhat is left is the foil."""\nx = "told"  # a look at x\n')
    assert [(line, words) for line, words, _ in language.found(module)] == [
        (4, "a look"),
        (3, "What is left"),
        (3, "foil"),
    ]


def test_every_kind_of_file_is_searched():
    names = {str(path.relative_to(language.ROOT)) for path in language.files()}
    pages = ("README.md", "docs/theory.md", "dvi_jax/testing/paper/claims.toml")
    for name in (*pages, "dvi_jax/problem/system.py", "lanewise/rules/loops.py"):
        assert name in names
