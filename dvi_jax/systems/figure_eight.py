"""Three bodies that chase one another along a figure eight."""

from dataclasses import replace

import numpy as np

from ._problem import Problem
from .n_body import n_body

PERIOD = 6.32591398
"""Time after which each body is back at its place, as printed with the start."""

_PLACE, _SPEED = np.array([0.97000436, -0.24308753]), np.array([-0.93240737, -0.86473146])
POSITIONS = np.array([_PLACE, -_PLACE, np.zeros(2)])
MOMENTA = np.array([-_SPEED / 2, -_SPEED / 2, _SPEED])


def figure_eight() -> Problem:
    """The figure-eight choreography: unit masses, G = 1, total and angular momentum zero.

    The start has eight digits, and so the orbit closes to about 1e-7 after one `PERIOD`. The step
    is a thousandth of that.

    **Source** Chenciner & Montgomery 2000, *Ann. Math.* 152, 881; digits by C. Simó, printed
    there.
    """
    problem = n_body(np.ones(3), POSITIONS, MOMENTA, h=PERIOD / 1000)
    return replace(problem, name="figure_eight")
