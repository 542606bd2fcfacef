"""The truths about invariants and symmetries, by arithmetic that shares no code with the search."""

import contextlib

import jax.numpy as jnp
import numpy as np
import pytest
from exact_series import Count, Symmetries
from truths import components, perturbed, symmetries
from truths.maps import formula


def each_of(cases):
    """All cases, one of twelve in the fast run."""
    params = [
        pytest.param(case, id=case.name, marks=[pytest.mark.slow] if i % 12 else [])
        for i, case in enumerate(cases)
    ]
    return pytest.mark.parametrize("case", params)


def count(case):
    given = case.system, case.basis, case.order, case.h, case.samples(np.random.default_rng(0))
    try:
        return Count(*given)
    except (TypeError, ValueError):  # with functions that have no value modulo a prime
        return Count(*given, modular=False)


@each_of(perturbed.CASES)
def test_truths_of_perturbed_systems(case):
    counted = count(case)
    assert counted.survivors == case.survivors
    assert [counted.reaches(function) for function in case.truth] == [case.order] * len(case.truth)


def test_what_is_not_conserved_reaches_no_order():
    """Negative control: an energy that forgets the step, and an amplitude under friction."""
    by_name = {case.name: case for case in perturbed.CASES}
    energy, action = formula("q @ q + p @ p"), formula(perturbed.ACTION)
    assert count(by_name["cubic spring, order 1"]).reaches(energy) == -1
    assert count(by_name["linear friction"]).reaches(action) == 0


@each_of(symmetries.SYMMETRIES)
def test_truths_of_symmetries(case):
    samples, time = case.samples(np.random.default_rng(0)), case.options["time"]
    arguments = case.system, case.basis, case.order, case.h, samples, time
    nearby = exact = Symmetries(*arguments, modular=False)
    with contextlib.suppress(ValueError):  # some functions have no value modulo a prime
        exact = Symmetries(*arguments)
    assert exact.survivors == case.survivors
    assert exact.independent == len(case.truth)
    moving = sum(generator.xi0 is not None for generator in case.truth)
    assert exact.independent_hamiltonian >= case.variational - moving
    points = nearby.values.shape[1]
    q, p, *ts = (jnp.asarray(x[:points]) for x in samples)
    for generator in case.truth:
        vectors = components(generator, q, p, *(ts or [jnp.zeros(points)])).T
        assert nearby.holds(vectors if time else vectors[1:])
