"""Systems that are ready to run: equations, parameters with units, a start, what is known."""

from ._problem import Problem as Problem
from .kepler import kepler as kepler
from .n_body import n_body as n_body
from .oscillator import oscillator as oscillator
from .solar_system import solar_system as solar_system

LIBRARY = {
    "oscillator": oscillator,
    "kepler": kepler,
    "n_body": n_body,
    "solar_system": solar_system,
}
"""Name → function that makes the `Problem`."""
