"""Checks for the tests of a method: does it have the properties that it claims.

`check_method` makes all checks; each check is also a function of a method. They raise
`AssertionError` where a property that the method claims is not measured, and return `Measured`.
`check_symplectic`, `check_reversible` and `check_inverse` also take a `dvi_jax.systems.Problem`, in
place of the package's own.

| property | claimed by | check |
|---|---|---|
| order, without and with a force | `order` | `check_order`, `check_forced_order` |
| the step map is symplectic | `is_symplectic` | `check_symplectic` |
| the step over −h undoes the step | `is_symmetric` | `check_reversible` |
| `inverse` undoes the step | `is_invertible` | `check_inverse` |
| no drift in 100 000 steps | `is_symplectic` | `check_energy`, `check_momentum` |
| gradients: difference quotients, all adjoints agree | all | `check_gradient`, `check_modes` |
| compilation and batches change no result | all | `check_jit`, `check_batch` |
| a failure is reported, and changes no other trajectory | all | `check_failure` |
| equal methods share one compiled program | all | `check_traces` |

Each check is itself tested: `CONTROLS` are methods with one defect, which it must find.
"""

from .candidate import Candidate as Candidate
from .certificate import Certificate as Certificate, certify as certify
from .check import (
    CHECKS as CHECKS,
    Check as Check,
    Measured as Measured,
    check_method as check_method,
)
from .checks import (
    check_batch as check_batch,
    check_energy as check_energy,
    check_failure as check_failure,
    check_forced_order as check_forced_order,
    check_gradient as check_gradient,
    check_inverse as check_inverse,
    check_jit as check_jit,
    check_modes as check_modes,
    check_momentum as check_momentum,
    check_order as check_order,
    check_reversible as check_reversible,
    check_symplectic as check_symplectic,
    check_traces as check_traces,
    symplectic_defect as symplectic_defect,
)
from .controls import CONTROLS as CONTROLS, Control as Control, altered as altered
from .page import page_for as page_for
from .registry import METHODS as METHODS, QUICK as QUICK
