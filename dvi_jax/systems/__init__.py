"""Systems that are ready to run, with parameters, units, initial conditions, known properties.

Each is a function without obligatory arguments that returns a `Problem`. Its entry in `LIBRARY`
gives the name in run files; `tests/test_library.py` tests every entry. Those with jumps are not in
it, because most commands make no jumps.
"""

from ..base.tables import Table as _Table
from . import boozer as boozer, fields as fields, rigid as rigid
from ._problem import (
    Adiabatic as Adiabatic,
    InSlowTime as InSlowTime,
    ParameterError as ParameterError,
    Problem as Problem,
)
from .bouncing_ball import bouncing_ball as bouncing_ball
from .dipole_field import dipole_field as dipole_field
from .double_pendulum import double_pendulum as double_pendulum
from .duffing import duffing as duffing
from .figure_eight import figure_eight as figure_eight
from .fput import fput as fput
from .henon_heiles import henon_heiles as henon_heiles
from .hill import hill as hill
from .kepler import kepler as kepler
from .klein_gordon import klein_gordon as klein_gordon
from .lennard_jones import lennard_jones as lennard_jones
from .lorentz_pendulum import lorentz_pendulum as lorentz_pendulum
from .lotka_volterra import lotka_volterra as lotka_volterra
from .magnetic_mirror import magnetic_mirror as magnetic_mirror
from .multibody import (
    chain as chain,
    dumbbell as dumbbell,
    slider_crank as slider_crank,
    spherical_pendulum as spherical_pendulum,
)
from .n_body import n_body as n_body
from .nls_lattice import nls_lattice as nls_lattice
from .oblate_kepler import oblate_kepler as oblate_kepler
from .oscillator import oscillator as oscillator
from .pendulum import pendulum as pendulum
from .perturbed_pendulum import perturbed_pendulum as perturbed_pendulum
from .phi4 import phi4 as phi4
from .planets.outer_solar_system import outer_solar_system as outer_solar_system
from .planets.polar_motion import polar_motion as polar_motion
from .planets.solar_system import solar_system as solar_system
from .pythagorean import pythagorean as pythagorean
from .relativistic_kepler import relativistic_kepler as relativistic_kepler
from .restricted_three_body import restricted_three_body as restricted_three_body
from .rigid_body import rigid_body as rigid_body
from .rotating_bodies import heavy_top as heavy_top, satellite as satellite
from .sinai_billiard import sinai_billiard as sinai_billiard
from .sine_gordon import sine_gordon as sine_gordon
from .slow_oscillator import slow_oscillator as slow_oscillator
from .spinning_top import spinning_top as spinning_top
from .stadium import stadium as stadium
from .stiff_fput import stiff_fput as stiff_fput
from .thermal import double_well as double_well, thermal_chain as thermal_chain
from .toda import toda as toda
from .two_centres import two_centres as two_centres
from .uniform_field import uniform_field as uniform_field
from .van_der_pol import van_der_pol as van_der_pol

LIBRARY = _Table(
    (function.__name__, function)
    for function in (
        *(oscillator, duffing, double_well, van_der_pol, slow_oscillator),
        *(pendulum, perturbed_pendulum, lorentz_pendulum, double_pendulum),
        *(kepler, relativistic_kepler, oblate_kepler, two_centres, restricted_three_body, hill),
        *(n_body, figure_eight, pythagorean, outer_solar_system, solar_system),
        *(henon_heiles, toda, fput, stiff_fput, thermal_chain, nls_lattice),
        *(klein_gordon, sine_gordon, phi4, lennard_jones),
        *(uniform_field, magnetic_mirror, dipole_field),
        *(spherical_pendulum, chain, slider_crank, dumbbell),
        *(rigid_body, spinning_top, heavy_top, satellite, polar_motion, lotka_volterra),
    )
)
"""Name → function that makes the `Problem`."""
