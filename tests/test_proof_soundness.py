"""Proofs against the truth, by programs that share nothing with those that make and check proofs.

The systems of `benchmarks/_soundness.py` are written twice: as functions for JAX, and as formulas
for NumPy, whose largest changes, trajectories and rounded steps are searched here.
"""

import runpy
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("flint")

SOUNDNESS = runpy.run_path(str(Path(__file__).parents[1] / "benchmarks" / "_soundness.py"))
CORPUS, Truth = SOUNDNESS["CORPUS"], SOUNDNESS["Truth"]
QUICK = (
    "cubic, ε of both signs",
    "slow spring backwards, ε of both signs",
    "implicit backwards, ε of both signs",
    "at add",
    "disc",
)
ROUND_OFF = 1e-18
"""Of the changes in long double, where an invariant is conserved exactly."""


def check(name, starts, capsys):
    """Prove, and search for a state or a trajectory that disproves it."""
    subject = CORPUS[name]()
    bound, truth = subject.prove(), Truth(subject)
    with np.errstate(all="ignore"):
        largest = [truth.largest_change(k, starts) for k in range(len(bound.per_step))]
        reach = [0.0, 0.0]
        if bound.level is not None:
            reach[0] = truth.escape(bound, max(200, starts // 50))
            reach[1] = truth.escape_from_starts(bound, 20 if starts < 10_000 else 200)
    ratios = [b / c if b else 0.0 for b, c in zip(bound.per_step, largest, strict=True)]
    with capsys.disabled():
        print(
            f"\n{name}: bound/largest {', '.join(f'{r:.3f}' for r in ratios)}; "
            f"{bound.steps:.3g} steps, reach {reach[0]:.4f}, {reach[1]:.4f}",
            end="",
        )
    for b, c in zip(bound.per_step, largest, strict=True):
        assert 0 <= c <= b + ROUND_OFF
    assert max(reach) <= 1
    return bound, truth, largest


@pytest.mark.parametrize("name", QUICK)
def test_no_state_and_no_trajectory_disproves_a_proof(name, capsys):
    bound, _, largest = check(name, 1000, capsys)
    # The ascent finds the neighbourhood of the maximum: otherwise it would test little.
    assert bound.per_step[0] < 4 * largest[0]


@pytest.mark.slow
@pytest.mark.parametrize("name", CORPUS)
def test_no_state_of_a_hundred_thousand_ascents_disproves_a_proof(name, capsys):
    check(name, 100_000, capsys)


@pytest.mark.parametrize("forwards", [True, False])
def test_steps_inside_end_with_the_interval_of_times(forwards):
    """The force −ε q t⁴ from t = 3 backwards, or from −3 forwards; a little later it is large."""
    h, time = (0.1, (-3.0, 0.0)) if forwards else (-0.1, (0.0, 3.0))
    subject = SOUNDNESS["driven"](h, 1e-5, time)
    bound, truth = subject.prove(), Truth(subject)
    assert bound.start_time == (-3.0 if forwards else 3.0)
    x = np.array([[0.2, 0.1, bound.start_time, 1e-5], [0.0, 0.3, bound.start_time, 5e-6]]).T
    counts = [bound.steps_inside(c[:1], c[1:2], c[3]) for c in x.T]
    assert all(20 < n <= 30 for n in counts)
    assert np.max(truth.farthest(x, np.array(counts))) <= 1
    with np.errstate(all="ignore"):
        assert np.min(truth.farthest(x, 2000)) > 1


@pytest.mark.parametrize("h", [0.1, -0.1])
def test_steps_inside_of_a_slow_time_have_its_direction(h):
    """From the middle of the interval τ changes by ε h in a step, up or down."""
    subject = SOUNDNESS["slow_spring"](h, (-0.02, 0.02), (-0.5, 0.5))
    bound, truth = subject.prove(), Truth(subject)
    assert abs(bound.start_time) < 1e-9
    for epsilon in (-0.02, -0.005, 0.015, 0.02):
        count = bound.steps_inside([0.02], [0.01], epsilon)
        assert 0 < count <= 0.5 / abs(h * epsilon) + 1
        x = np.array([[0.02, 0.01, bound.start_time, epsilon]]).T
        assert np.max(truth.farthest(x, count)) <= 1


# --- the rounding of computed steps --------------------------------------------------------------


def check_rounding(name, way, count, capsys):
    text, wrong = SOUNDNESS["rounding"](name, way, count)
    with capsys.disabled():
        print("\n" + text, end="")
    assert wrong == []


@pytest.mark.parametrize("way", SOUNDNESS["LAYOUTS"])
def test_computed_steps_have_errors_below_the_proved_rounding(way, capsys):
    check_rounding("cubic, ε of both signs", way, 20_000, capsys)


def test_the_rounding_of_a_negative_power_is_that_of_the_power_of_the_inverse(capsys):
    """The machine code computes (1/q)¹⁵, whose error is larger than that of 1/q¹⁵."""
    check_rounding("negative power", "machine code", 20_000, capsys)


@pytest.mark.slow
@pytest.mark.parametrize("way", SOUNDNESS["LAYOUTS"])
@pytest.mark.parametrize("name", SOUNDNESS["ROUNDED"])
def test_many_computed_steps_have_errors_below_the_proved_rounding(name, way, capsys):
    check_rounding(name, way, 300_000, capsys)
