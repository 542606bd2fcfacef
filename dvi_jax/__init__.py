"""Differentiable variational integrators for perturbed Hamiltonian systems."""

import sys
from typing import TYPE_CHECKING

from lanewise import Layout as Layout

from .base.devices import over_devices as over_devices
from .base.results import RESULTS as RESULTS, IntegrationError as IntegrationError
from .base.types import Interval as Interval
from .engine.newton import Newton as Newton, RootSolver as RootSolver
from .engine.picard import Picard as Picard, PicardThenNewton as PicardThenNewton
from .engine.simplified import SimplifiedNewton as SimplifiedNewton
from .integration.adjoints import Checkpointed as Checkpointed, Direct as Direct
from .integration.arithmetic import (
    Arithmetic as Arithmetic,
    Compensated as Compensated,
    DoubleDouble as DoubleDouble,
    FixedPoint as FixedPoint,
    FloatingPoint as FloatingPoint,
)
from .integration.integrate import integrate as integrate
from .integration.integrator import Integrator as Integrator
from .integration.reversible import Reversible as Reversible
from .lattices import (
    AdaptiveReversible as AdaptiveReversible,
    Given as Given,
    Lattice as Lattice,
    LatticeCondition as LatticeCondition,
    Place as Place,
    TimeTransformed as TimeTransformed,
    Uniform as Uniform,
    Variational as Variational,
)
from .methods import (
    BAOAB as BAOAB,
    OBABO as OBABO,
    Adjoint as Adjoint,
    BlanesMoan as BlanesMoan,
    Boris as Boris,
    Composition as Composition,
    GaussLegendre as GaussLegendre,
    HigueraCary as HigueraCary,
    KahanLi as KahanLi,
    LobattoIIIAIIIB as LobattoIIIAIIIB,
    MagneticSplitting as MagneticSplitting,
    McLachlan as McLachlan,
    Method as Method,
    Rattle as Rattle,
    RelativisticBoris as RelativisticBoris,
    RungeKutta4 as RungeKutta4,
    Splitting as Splitting,
    StochasticEuler as StochasticEuler,
    StochasticMidpoint as StochasticMidpoint,
    Strang as Strang,
    StrongSplitting as StrongSplitting,
    Suzuki as Suzuki,
    TypeII as TypeII,
    Vay as Vay,
    WisdomHolman as WisdomHolman,
    Yoshida as Yoshida,
)
from .methods.constraint import Projection as Projection, project as project
from .methods.step import Equations as Equations, StepInfo as StepInfo
from .observe import (
    GALI as GALI,
    MEGNO as MEGNO,
    SALI as SALI,
    ConstraintForce as ConstraintForce,
    Crossings as Crossings,
    Deviations as Deviations,
    Jump as Jump,
    Jumps as Jumps,
    Last as Last,
    LyapunovSpectrum as LyapunovSpectrum,
    MaxDrift as MaxDrift,
    Mean as Mean,
    Range as Range,
    Reduction as Reduction,
    Running as Running,
    Section as Section,
    Stop as Stop,
    TangentMap as TangentMap,
    Trend as Trend,
)
from .observe.solution import Save as Save, Solution as Solution
from .problem import elements as elements, flows as flows
from .problem.discretise import discretise as discretise
from .problem.energies import incoming_energy as incoming_energy, outgoing_energy as outgoing_energy
from .problem.implicit import Implicit as Implicit
from .problem.lagrangian import (
    from_lagrangian as from_lagrangian,
    from_type_iii as from_type_iii,
    legendre as legendre,
    velocity_force as velocity_force,
)
from .problem.noise import (
    Brownian as Brownian,
    BrownianPath as BrownianPath,
    Ito as Ito,
    Langevin as Langevin,
    NoiseHamiltonians as NoiseHamiltonians,
)
from .problem.split import Split as Split
from .problem.system import System as System

if TYPE_CHECKING:  # names that are imported at their first use: `_namespaces` has their list
    from types import ModuleType

    from . import fit as _fit, plot as plot, proof as proof, sweep as _sweep, systems as systems
    from .discover import *  # noqa: F403
    from .discover.symmetries import library as _library
    from .dynamics import *  # noqa: F403
    from .dynamics import frequencies as _frequencies
    from .explorer import *  # noqa: F403
    from .fit import *  # noqa: F403
    from .proof import *  # noqa: F403
    from .sweep import *  # noqa: F403
    from .systems import forces as forces, rings as rings

    # These use the names of this file, so that it does not import them.
    interop: ModuleType
    paper: ModuleType
    run: ModuleType
    testing: ModuleType

    fitting, sweeps, generators = _fit, _sweep, _library
    SymplecticEuler, StormerVerlet, Leapfrog, RK4 = TypeII, Strang, Strang, RungeKutta4
    Chord, SaveAt, Event, naff = SimplifiedNewton, Save, Stop, _frequencies
    LinearTrend, PeakToPeak = Trend, Range
else:
    from ._namespaces import (
        Folders as _Folders,
        Package as _Package,
        explain_calls as _explain_calls,
    )

    _explain_calls(sys.modules[__name__])
    for _module in (elements, flows):
        _explain_calls(_module)
    sys.modules[__name__].__class__ = _Package
    sys.meta_path.insert(0, _Folders())

__version__ = "1.0.0rc1"
