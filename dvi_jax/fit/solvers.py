"""Choice of the optimiser of a fit.

The libraries of optimisers are imported when a fit is made: they take an eighth of the time to
import the package, and most programs never need them.
"""

import functools
from typing import Any

from ..base.checks import instance
from .checks import requires


def _optimistix() -> Any:
    import optimistix

    return optimistix


@functools.cache
def levenberg_marquardt() -> Any:
    """One object, so that all fits share what is compiled for it. Its own tolerances are never met:
    `LeastSquaresStage` decides when it ends."""
    return _optimistix().LevenbergMarquardt(rtol=1e-14, atol=1e-300)


@functools.cache
def bfgs() -> Any:
    """One object, as above."""
    return _optimistix().BFGS(rtol=1e-10, atol=1e-10)


def is_optax(solver: Any) -> bool:
    """Whether its steps are those of a gradient transformation, without a line search."""
    return isinstance(solver, _optimistix().OptaxMinimiser)


def is_gauss_newton(solver: Any) -> bool:
    """Whether it works on the vector of residuals."""
    return isinstance(solver, _optimistix().AbstractGaussNewton)


def solver_for(optimiser: Any, residuals: bool, is_large: bool, steps: int) -> Any:
    """The optimistix solver for the user's choice. `residuals`: whether the loss has a vector of
    them; `is_large`: whether there are too many parameters for a Jacobian; `steps`: of Adam."""
    import optax

    optx = _optimistix()
    if optimiser is None:
        if not is_large:
            return levenberg_marquardt() if residuals else bfgs()
        rate = optax.warmup_cosine_decay_schedule(1e-5, 3e-3, max(steps // 20, 1), steps, 1e-5)
        optimiser = optax.adam(rate)
    if isinstance(optimiser, optax.GradientTransformation):
        return optx.OptaxMinimiser(optimiser, rtol=0.0, atol=0.0)
    condition = "a minimiser as optimiser, such as optimistix.BFGS(1e-10, 1e-10)"
    fits = residuals or not is_gauss_newton(optimiser)
    requires(fits, "dvi.Likelihood", condition, type(optimiser).__name__)
    minimisers = optx.OptaxMinimiser, optx.AbstractQuasiNewton, optx.AbstractLBFGS
    classes = optx.AbstractGaussNewton, optx.AbstractGradientDescent, *minimisers
    of_optimistix = "None, a least-squares solver or minimiser of optimistix"
    description = f"{of_optimistix}, or a gradient transformation of optax"
    return instance("optimiser", optimiser, classes, description)
