"""Systems that are ready to run: equations, parameters with units, a start, what is known."""

from ._problem import Problem as Problem
from .kepler import kepler as kepler
from .oscillator import oscillator as oscillator

LIBRARY = {"oscillator": oscillator, "kepler": kepler}
"""Name → function that makes the `Problem`."""
