"""Three bodies that follow one another along a figure eight."""

from dataclasses import replace

import numpy as np

from ._problem import Problem
from .n_body import EIGHT_MOMENTA, EIGHT_POSITIONS, n_body

PERIOD = 6.32591398
"""Period of the orbit, as printed with the initial conditions."""


def figure_eight() -> Problem:
    """The figure-eight choreography: unit masses, G = 1, total and angular momentum zero.

    The initial conditions have eight digits, so that the orbit closes to about 1e-7 after one
    `PERIOD`. The step is a thousandth of that.

    **Source** Chenciner & Montgomery 2000, *Ann. Math.* 152, 881; digits by C. Simó, printed
    there.
    """
    problem = n_body(np.ones(3), EIGHT_POSITIONS, EIGHT_MOMENTA, h=PERIOD / 1000)
    return replace(problem, name="figure_eight")
