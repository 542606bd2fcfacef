"""Parameters and perturbing forces of a model, estimated from observed trajectories."""

from ._fit import fit as fit
from .bayes import Samples as Samples, sample as sample
from .events import EventTimes as EventTimes
from .identify import Identification as Identification, Removal as Removal, identify as identify
from .library import ForceLibrary as ForceLibrary
from .losses import (
    Cauchy as Cauchy,
    LeastSquares as LeastSquares,
    Likelihood as Likelihood,
    SoftL1 as SoftL1,
)
from .model import Model as Model
from .network import NetworkForce as NetworkForce
from .observations import Observations as Observations
from .optimise import FIT_RESULTS as FIT_RESULTS, FitError as FitError
from .parameters import Bounds as Bounds, Prior as Prior
from .posterior import Posterior as Posterior
from .result import FitResult as FitResult
from .run import FitProgress as FitProgress
from .shooting import MultipleShooting as MultipleShooting, SingleShooting as SingleShooting
