"""What discovery reports is true, for many cases of which the truth is known."""

import functools

import pytest
import truths
from truths.table import all_cases

CASES = all_cases()
UNDECIDED = 0.05
"""Share of the cases in which the report may warn that it cannot tell."""


@functools.cache
def outcome(i):
    return truths.judged(CASES[i])[0]


@pytest.mark.parametrize(
    "i",
    [
        pytest.param(i, id=f"{case.kind}: {case.name}", marks=[pytest.mark.slow] if i % 12 else [])
        for i, case in enumerate(CASES)
    ],
)
def test_nothing_false_and_nothing_missed_without_a_warning(i):
    assert outcome(i) in ("found", "undecided"), CASES[i].source


@pytest.mark.slow
def test_few_cases_are_undecided():
    undecided = [case.name for i, case in enumerate(CASES) if outcome(i) == "undecided"]
    assert len(undecided) <= UNDECIDED * len(CASES), undecided


def test_names_are_distinct():
    assert len({case.name for case in CASES}) == len(CASES)
