"""Component form: a function of small arrays, rewritten so that each array element is a lane."""

from ._evaluate import (
    Evaluator as Evaluator,
    evaluate as evaluate,
    in_arrays as in_arrays,
    operation_count as operation_count,
)
from ._value import Value as Value
