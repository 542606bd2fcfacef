"""Methods certified by measurement: order, structure, gradients, compilation, with controls."""

from .candidate import Candidate as Candidate
from .certificate import Certificate as Certificate, certify as certify
from .checks import CHECKS as CHECKS, Check as Check
from .controls import CONTROLS as CONTROLS, Control as Control, altered as altered
from .measured import Measured as Measured
from .registry import METHODS as METHODS, QUICK as QUICK
from .table import page_for as page_for
