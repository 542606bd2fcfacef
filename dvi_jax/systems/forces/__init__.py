r"""Perturbing forces on N bodies and satellites.

    force = dvi.forces.Relativity(c) + dvi.forces.Harmonics(radius, {2: J2})
    problem = force.add_to(systems.n_body(masses, q0, p0))

Each force is a function W(t0, t1, q0, p1, args) for a `System`; `Force` explains the states that it
takes, sums and factors. A parameter is a number or a function of args, so that fits and sweeps can
vary it: ``Radiation(lambda args: args["beta"], c)``. Forces that depend on velocities make steps
implicit.
"""

from ._base import Force as Force
from ._dissipation import (
    Damping as Damping,
    Drag as Drag,
    Outgassing as Outgassing,
    Radiation as Radiation,
    Tides as Tides,
)
from ._gravity import (
    GalacticTide as GalacticTide,
    Harmonics as Harmonics,
    MassLoss as MassLoss,
    ThirdBody as ThirdBody,
)
from ._relativity import (
    LenseThirring as LenseThirring,
    PostNewtonian as PostNewtonian,
    PrecessionPotential as PrecessionPotential,
    Relativity as Relativity,
)
