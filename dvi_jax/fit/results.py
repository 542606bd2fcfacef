"""Status of a fit."""

import equinox as eqx


class FIT_RESULTS(eqx.Enumeration):
    """Status of a fit; ``dvi.FIT_RESULTS[fit.result]`` is the text."""

    converged = ""
    steps_done = "The given number of steps was taken; a stochastic optimiser has no other end."
    max_steps_reached = (
        "The optimiser did not converge within max_steps. Likely causes: (a) it needs more steps; "
        "(b) the data do not determine a direction of the parameters: see the singular values of "
        "the result; (c) the start is far away: give a better one, or shorter horizons."
    )
    stalled = (
        "No step along the descent makes the loss smaller, though its gradient is not zero. Likely "
        "causes: (a) the loss is not smooth at this scale: an implicit solve with a loose "
        "tolerance, a trajectory that is chaotic over the arc (take dvi.MultipleShooting(...)); "
        "(b) a trajectory that fails for nearby parameters."
    )
    not_finite = (
        "The residuals, the sum of their squares or their derivatives are not finite. Likely "
        "causes: (a) a trajectory fails at these parameters; (b) a function of the model has no "
        "derivative there; (c) predictions are larger than the standard errors by more than "
        "10¹⁵⁰: the trajectory diverges, or sigma is in other units."
    )
    discontinuous = (
        "The segments of multiple shooting do not meet within the tolerance. Likely causes: (a) "
        "too few steps; (b) segments that are too long for a chaotic trajectory: take more."
    )


NAMES = ("converged", "steps_done", "max_steps_reached", "stalled", "not_finite", "discontinuous")


def name_of(result: FIT_RESULTS) -> str:
    """The short name of a status."""
    return next(name for name in NAMES if bool(result == getattr(FIT_RESULTS, name)))


class FitError(RuntimeError):
    """Raised by `fit` with ``throw=True`` when it did not converge; `fit` is the `FitResult`."""

    def __init__(self, message: str, fit: object = None):
        super().__init__(message)
        self.fit = fit
