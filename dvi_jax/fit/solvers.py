"""Which solver goes through a fit.

The libraries of solvers are imported when a fit is made: an eighth of the time that the package
would take to import, which most programs never need.
"""

import functools
from typing import Any


@functools.cache
def levenberg_marquardt() -> Any:
    """One object, so that all fits share what is compiled for it; `LeastSquaresStage` ends it."""
    import optimistix as optx

    return optx.LevenbergMarquardt(rtol=1e-14, atol=1e-300)


@functools.cache
def bfgs() -> Any:
    """One object, as above."""
    import optimistix as optx

    return optx.BFGS(rtol=1e-10, atol=1e-10)


def goes_by_optax(solver: Any) -> bool:
    """Whether its steps are those of a gradient transformation, with no search along them."""
    import optimistix as optx

    return isinstance(solver, optx.OptaxMinimiser)


def is_gauss_newton(solver: Any) -> bool:
    """Whether it works on the vector of residuals."""
    import optimistix as optx

    return isinstance(solver, optx.AbstractGaussNewton)


def solver_for(optimiser: Any, residuals: bool, many: bool, steps: int) -> Any:
    """The optimistix solver that is meant, for a loss of `residuals` or not, of `many` parameters
    or few."""
    import optax
    import optimistix as optx

    if optimiser is None:
        if many:
            rate = optax.warmup_cosine_decay_schedule(1e-5, 3e-3, max(steps // 20, 1), steps, 1e-5)
            optimiser = optax.adam(rate)
        else:
            return levenberg_marquardt() if residuals else bfgs()
    if isinstance(optimiser, optax.GradientTransformation):
        return optx.OptaxMinimiser(optimiser, rtol=0.0, atol=0.0)
    if is_gauss_newton(optimiser):
        if not residuals:
            raise ValueError(
                "dvi.Likelihood has no residual vector: take a minimiser such as "
                "optimistix.BFGS(rtol=1e-10, atol=1e-10), or leave optimiser out."
            )
        return optimiser
    minimisers = (
        optx.OptaxMinimiser,
        optx.AbstractQuasiNewton,
        optx.AbstractLBFGS,
        optx.AbstractGradientDescent,
    )
    if isinstance(optimiser, minimisers):
        return optimiser
    raise TypeError(
        "optimiser must be None, a least-squares solver or minimiser of optimistix, or a gradient "
        f"transformation of optax, got {optimiser!r}."
    )
