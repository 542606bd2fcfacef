"""Differentiable variational integrators for perturbed Hamiltonian systems."""

import sys
from typing import TYPE_CHECKING

from lanewise import Layout as Layout

from .base.cpu import configure_cpu as configure_cpu
from .base.devices import over_devices as over_devices
from .base.results import RESULTS as RESULTS, IntegrationError as IntegrationError
from .base.threads import over_threads as over_threads
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
    Composition as Composition,
    GaussLegendre as GaussLegendre,
    KahanLi as KahanLi,
    LobattoIIIAIIIB as LobattoIIIAIIIB,
    McLachlan as McLachlan,
    Method as Method,
    Rattle as Rattle,
    RungeKutta4 as RungeKutta4,
    Splitting as Splitting,
    StochasticEuler as StochasticEuler,
    StochasticMidpoint as StochasticMidpoint,
    Strang as Strang,
    Suzuki as Suzuki,
    TypeII as TypeII,
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
from .problem import flows as flows
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
    Langevin as Langevin,
    NoiseHamiltonians as NoiseHamiltonians,
)
from .problem.split import Split as Split
from .problem.system import System as System

if TYPE_CHECKING:  # names that are imported at their first use (`_namespaces`)
    from . import (
        fit as _fit,
        interop as interop,
        plot as plot,
        proof as proof,
        run as run,
        sweep as _sweep,
        systems as systems,
        testing as testing,
    )
    from .discover import (
        AdiabaticInvariant as AdiabaticInvariant,
        Balance as Balance,
        Basis as Basis,
        Chebyshev as Chebyshev,
        Discovery as Discovery,
        DriftLaw as DriftLaw,
        DriftOrder as DriftOrder,
        DriftSurface as DriftSurface,
        Generator as Generator,
        InvariantSeries as InvariantSeries,
        LatticePoint as LatticePoint,
        Polynomials as Polynomials,
        Radial as Radial,
        ShadowHamiltonian as ShadowHamiltonian,
        Symmetries as Symmetries,
        Symmetry as Symmetry,
        Trigonometric as Trigonometric,
        conformal_factor as conformal_factor,
        determining_residual as determining_residual,
        discover_invariants as discover_invariants,
        discrete_equations as discrete_equations,
        drift_order as drift_order,
        drift_surface as drift_surface,
        find_symmetries as find_symmetries,
        lattice_defect as lattice_defect,
        noether_balance as noether_balance,
        noether_identity as noether_identity,
        prolong as prolong,
        random_pairs as random_pairs,
        solution_pairs as solution_pairs,
        solve_gauge as solve_gauge,
    )
    from .discover.symmetries import library as _library
    from .dynamics import (
        FREQUENCY_RESULTS as FREQUENCY_RESULTS,
        SECTION_RESULTS as SECTION_RESULTS,
        Actions as Actions,
        Frequencies as Frequencies,
        FrequencyDiffusion as FrequencyDiffusion,
        FrequencyError as FrequencyError,
        FundamentalFrequencies as FundamentalFrequencies,
        InvariantDiffusion as InvariantDiffusion,
        PoincareSection as PoincareSection,
        Return as Return,
        ReturnMap as ReturnMap,
        SectionError as SectionError,
        actions as actions,
        bifurcation as bifurcation,
        frequencies as frequencies,
        frequency_diffusion as frequency_diffusion,
        fundamental_frequencies as fundamental_frequencies,
        invariant_diffusion as invariant_diffusion,
        poincare_section as poincare_section,
        stroboscope as stroboscope,
        tangent_map as tangent_map,
    )
    from .fit import (
        FIT_RESULTS as FIT_RESULTS,
        Bounds as Bounds,
        Cauchy as Cauchy,
        FitError as FitError,
        FitProgress as FitProgress,
        FitResult as FitResult,
        ForceLibrary as ForceLibrary,
        Identification as Identification,
        LeastSquares as LeastSquares,
        Likelihood as Likelihood,
        Model as Model,
        MultipleShooting as MultipleShooting,
        NetworkForce as NetworkForce,
        Observations as Observations,
        Posterior as Posterior,
        Prior as Prior,
        Samples as Samples,
        SingleShooting as SingleShooting,
        SoftL1 as SoftL1,
        fit as fit,
        identify as identify,
        sample as sample,
    )
    from .proof import (
        DriftBound as DriftBound,
        ExactInvariant as ExactInvariant,
        NoetherProof as NoetherProof,
        ProofError as ProofError,
        bound_drift as bound_drift,
        exact_coefficients as exact_coefficients,
        prove_noether as prove_noether,
    )
    from .sweep import (
        Axis as Axis,
        ClusterError as ClusterError,
        StoreError as StoreError,
        StoreMismatch as StoreMismatch,
        SweepCost as SweepCost,
        SweepInterrupted as SweepInterrupted,
        SweepProgress as SweepProgress,
        SweepResult as SweepResult,
        open_sweep as open_sweep,
        starts as starts,
        sweep as sweep,
        sweep_cost as sweep_cost,
    )
    from .testing import paper as paper

    fitting, sweeps, generators = _fit, _sweep, _library
    SymplecticEuler, StormerVerlet, Leapfrog, RK4 = TypeII, Strang, Strang, RungeKutta4
    Chord, SaveAt, Event, naff = SimplifiedNewton, Save, Stop, frequencies
    LinearTrend, PeakToPeak = Trend, Range
else:
    from ._namespaces import Folders as _Folders, Package as _Package

    sys.modules[__name__].__class__ = _Package
    sys.meta_path.insert(0, _Folders())

__version__ = "0.1.0"
