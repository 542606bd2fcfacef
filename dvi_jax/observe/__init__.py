"""Quantities computed along a trajectory during the run."""

from ._constraint_force import ConstraintForce as ConstraintForce
from ._deviations import (
    GALI as GALI,
    MEGNO as MEGNO,
    SALI as SALI,
    Deviations as Deviations,
    LyapunovSpectrum as LyapunovSpectrum,
    Pushed as Pushed,
    TangentMap as TangentMap,
)
from ._jump import Jump as Jump, Jumps as Jumps
from ._kept import Crossings as Crossings, RequestedTimes as RequestedTimes, Section as Section
from ._reductions import (
    Last as Last,
    MaxDrift as MaxDrift,
    Mean as Mean,
    Range as Range,
    Reduction as Reduction,
    Running as Running,
    Trend as Trend,
    is_observable as is_observable,
)
from ._states import (
    FORMS as FORMS,
    AtEnd as AtEnd,
    InSlowTime as InSlowTime,
    OfState as OfState,
    has_initial_value as has_initial_value,
    of_steps as of_steps,
    refuse_slow_time as refuse_slow_time,
)
from ._stop import Stop as Stop, Stopped as Stopped
