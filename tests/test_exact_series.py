"""The truths about perturbed systems, confirmed by arithmetic that shares no code with the search."""

import numpy as np
import pytest
from exact_series import Count
from truths import Case, perturbed

CASES = [case for case in perturbed.CASES if isinstance(case, Case)]


def count(case):
    samples = case.samples(np.random.default_rng(0))
    try:
        return Count(case.system, case.basis, case.order, case.h, samples)
    except (TypeError, ValueError):  # with functions that have no value modulo a prime
        return Count(case.system, case.basis, case.order, case.h, samples, modular=False)


@pytest.mark.parametrize("case", [pytest.param(case, id=case.name) for case in CASES])
def test_truths_of_perturbed_systems(case):
    counted = count(case)
    assert counted.survivors == case.survivors
    assert [counted.reaches(function) for function in case.truth] == [case.order] * len(case.truth)


def test_what_is_not_conserved_reaches_no_order():
    """Negative control: an energy that forgets the step, and an amplitude under friction."""
    by_name = {case.name: case for case in CASES}
    assert count(by_name["cubic spring, order 1"]).reaches(lambda q, p: q @ q + p @ p) == -1
    assert count(by_name["linear friction"]).reaches(perturbed.action) == 0
