"""Systems that are ready to run: equations, parameters with units, a start, what is known."""

from ._problem import Problem as Problem
from .figure_eight import figure_eight as figure_eight
from .fput import fput as fput
from .henon_heiles import henon_heiles as henon_heiles
from .kepler import kepler as kepler
from .magnetic_mirror import magnetic_mirror as magnetic_mirror
from .n_body import n_body as n_body
from .oscillator import oscillator as oscillator
from .perturbed_pendulum import perturbed_pendulum as perturbed_pendulum
from .polar_motion import polar_motion as polar_motion
from .solar_system import solar_system as solar_system
from .stiff_fput import stiff_fput as stiff_fput
from .toda import toda as toda

LIBRARY = {
    "oscillator": oscillator,
    "kepler": kepler,
    "n_body": n_body,
    "figure_eight": figure_eight,
    "solar_system": solar_system,
    "henon_heiles": henon_heiles,
    "toda": toda,
    "fput": fput,
    "stiff_fput": stiff_fput,
    "perturbed_pendulum": perturbed_pendulum,
    "magnetic_mirror": magnetic_mirror,
    "polar_motion": polar_motion,
}
"""Name → function that makes the `Problem`."""
