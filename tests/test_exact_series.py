"""The truths about invariants and symmetries, by arithmetic that shares no code with the search."""

import contextlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from exact_series import Count, Symmetries
from truths import Case, perturbed, symmetries

import dvi_jax as dvi

CASES = [case for case in perturbed.CASES if isinstance(case, Case)]


def count(case):
    samples = case.samples(np.random.default_rng(0))
    try:
        return Count(case.system, case.basis, case.order, case.h, samples)
    except (TypeError, ValueError):  # with functions that have no value modulo a prime
        return Count(case.system, case.basis, case.order, case.h, samples, modular=False)


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(case, id=case.name, marks=[pytest.mark.slow] if i % 12 else [])
        for i, case in enumerate(CASES)
    ],
)
def test_truths_of_perturbed_systems(case):
    counted = count(case)
    assert counted.survivors == case.survivors
    assert [counted.reaches(function) for function in case.truth] == [case.order] * len(case.truth)


def test_what_is_not_conserved_reaches_no_order():
    """Negative control: an energy that forgets the step, and an amplitude under friction."""
    by_name = {case.name: case for case in CASES}
    assert count(by_name["cubic spring, order 1"]).reaches(lambda q, p: q @ q + p @ p) == -1
    assert count(by_name["linear friction"]).reaches(perturbed.action) == 0


def _components(generator, q, p, t):
    def at_point(q, p, t):
        parts = generator(dvi.LatticePoint(t, q, p), None)
        return jnp.concatenate([jnp.ravel(jnp.asarray(x, float)) for x in parts])

    return jax.vmap(at_point)(q, p, t)


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(case, id=case.name, marks=[pytest.mark.slow] if i % 12 else [])
        for i, case in enumerate(symmetries.SYMMETRIES)
    ],
)
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
    q, p = (jnp.asarray(x[:points]) for x in samples[:2])
    t = jnp.asarray(samples[2][:points]) if len(samples) == 3 else jnp.zeros(points)
    for generator in case.truth:
        components = np.asarray(_components(generator, q, p, t)).T
        assert nearby.holds(components if time else components[1:])
