"""First calls: what is checked or converted before a run is few programs, not one for each step."""

import jax
import numpy as np
import pytest
from compilation import programs_of_xla

import dvi_jax as dvi
from dvi_jax import elements, systems
from dvi_jax.systems import boozer

MASSES = np.array([1.0, 1e-3, 3e-4])
ORBITS = elements.Keplerian(
    *np.array([[1.0, 2.0], [0.1, 0.2], [0.3, 0.2], [1.0, 2.0], [0.5, 0.1], [0.7, 2.7]])
)
FIELD = boozer.precise_qa()


@pytest.fixture(scope="module")
def alphas():
    particles = boozer.GuidingCentres(FIELD)
    return particles, *particles.start(0.4, 0.3, 0.2, 0.1)


def run_of_planets(_):
    outer = systems.outer_solar_system()
    method = dvi.WisdomHolman("democratic", encounters=3.0)
    return dvi.integrate(outer, num_steps=2, method=method)


def coordinates(alphas):
    particles, q, p, _ = alphas
    return particles.coordinates_of(q, p)


def invariant(alphas):
    particles, *state = alphas
    return particles.second_invariant(*state)


CALLS = {
    "positions of planets": (lambda _: elements.to_bodies(ORBITS, MASSES), 14),
    "orbits of planets": (
        lambda _: elements.of_bodies(np.eye(3), np.eye(3)[::-1] * 0.1, MASSES), 8,
    ),
    "a run of planets": (run_of_planets, 20),
    "coordinates of alphas": (coordinates, 4),
    "the second invariant": (invariant, 6),
    "a well": (lambda _: boozer.well(FIELD, 0.4, 0.3, 0.2, 0.3), 8),
}  # fmt: skip
"""What is called, and the largest number of programs. It was up to ten times as large."""


@pytest.mark.parametrize("name", CALLS)
def test_a_first_call_is_few_programs_and_another_one_none(name, alphas):
    call, most = CALLS[name]
    jax.clear_caches()
    with programs_of_xla() as programs:
        call(alphas)
    assert 0 < len(programs) <= most
    with programs_of_xla() as programs:
        call(alphas)
    assert not programs
