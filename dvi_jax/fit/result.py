"""Result of a fit: parameters, their uncertainty, residuals."""

import os
from dataclasses import dataclass, field
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from ..base.checks import one_of
from ..base.files import publish_npz, read_npz
from ..base.printing import printable
from ..base.tables import Table
from .checks import same_parameters
from .optimise import FIT_RESULTS, NAMES, name_of
from .parameters import make_space
from .uncertainty import correlations

_FORMAT = 1

_PLAIN = (
    *("names", "loss", "degrees_of_freedom", "num_observed", "has_errors", "undetermined"),
    *("at_bounds", "trajectories", "seconds", "prior_chi2", "conflict", "priors", "start"),
)
_BY_ARC = ("ts", "observed", "predicted", "whitened", "errors")
"""Fields that a file has as JSON, and those that are a list of arrays."""

_NOTABLE = 0.01  # Part of a standard error from which on round-off is reported
_NEAR_TURN = 0.05  # Distance from a turn, in turns, that looks like an angle on another branch
_SIGNIFICANCE = 1e-4  # Probability of a χ² below which the residuals contradict sigma
_CORRELATED = 4.0  # Correlation of neighbouring residuals, in its standard errors, that is reported
_LITTLE = 0.1  # A model that explains less of the variance is little better than a constant


@printable
@dataclass(frozen=True, eq=False)
class FitResult:
    r"""Parameters fitted to observations.

    - `params`: the pytree that was given, with fitted numbers; `x` those n numbers as one vector,
      `names` theirs.
    - `covariance`: of x, shape (n, n), by Gauss–Newton, s² (JᵀJ)⁻¹; for `dvi.Likelihood` the
      inverse of the Hessian. For robust losses J is that of √ρ, accurate to some tens of a percent
      of the scatter. s² is 1 when the data have errors, else their variance estimated from the
      residuals. Infinite for what the data do not determine, NaN for more than 400 parameters.
    - `history`: arrays with one entry for each step of the optimiser: `stage`, `horizon`,
      `loss`, `step`, `accepted`, and `x`, shape (steps, n).
    - `result`: how it ended, one of `FIT_RESULTS`; `status` its name.
    - `ts`, `observed`, `predicted`, `errors`: lists with an array for each arc, (N,) and (N, ...);
      errors are NaN where none were given, periodic predictions on the branch of the observed.
    - `whitened`: observed minus predicted in standard errors, (N, K) for each arc, independent of
      one another where covariances were given; NaN for missing values.
    - `loss`: ½ Σ ρ(r²) + priors; `num_observed`: number of values; `degrees_of_freedom`: values and
      priors minus parameters, without those that are not determined.
    - `prior_chi2`: Σ ((x − mean)/sigma)² of the priors; `priors`: names of their parameters.
    - `conflict`: `prior_chi2`, and what the priors add to `chi2`, to first order: a χ² with one
      degree of freedom for each prior if these agree with the data. 0 if not computed.
    - `undetermined`: parameter combinations that the data do not determine, as text.
    - `singular_values`: of the Jacobian with columns of unit length, largest first.
    - `curvature`: the second derivative of the loss along each principal direction over that of
      Gauss–Newton: near 1 where the errors are reliable. None if it was not computed.
    - `at_bounds`: names of the parameters that ended at a bound. Their entries of `covariance` are
      those of a free parameter or NaN: the error of such a parameter is not symmetric.
    - `trajectories`: status of each arc's trajectory.
    - `rounding`: standard errors of x from the round-off of the predictions, shape (n,), measured
      if it bounds the accuracy of the fit, else 0. They are included in `covariance`.
    - `start`: t0, and which parts of the initial state were fitted, as text.
    """

    params: PyTree
    x: np.ndarray
    names: list[str]
    covariance: np.ndarray
    history: dict[str, np.ndarray]
    result: FIT_RESULTS
    ts: list[np.ndarray]
    observed: list[np.ndarray]
    predicted: list[np.ndarray]
    whitened: list[np.ndarray]
    errors: list[np.ndarray]
    loss: float
    degrees_of_freedom: int
    num_observed: int
    has_errors: bool
    undetermined: list[str] = field(default_factory=list)
    singular_values: np.ndarray = field(default_factory=lambda: np.zeros(0))
    curvature: np.ndarray | None = None
    at_bounds: list[str] = field(default_factory=list)
    trajectories: list[str] = field(default_factory=list)
    prior_chi2: float = 0.0
    conflict: float = 0.0
    priors: list[str] = field(default_factory=list)
    seconds: float = 0.0
    rounding: np.ndarray = field(default_factory=lambda: np.zeros(0))
    start: str = ""

    @property
    def status(self) -> str:
        """The name of `result`."""
        return name_of(self.result)

    @property
    def sigma(self) -> np.ndarray:
        """Standard errors of x, shape (n,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def correlations(self) -> np.ndarray:
        """Correlations of x, shape (n, n); NaN where a variance is not finite."""
        return correlations(self.covariance)

    @property
    def residuals(self) -> list[np.ndarray]:
        """Observed minus predicted, in the units of the data, one array for each arc."""
        return [o - p for o, p in zip(self.observed, self.predicted, strict=True)]

    @property
    def rms(self) -> float:
        """Root mean square of the residuals, in the units of the data."""
        return float(np.sqrt(np.nanmean(np.concatenate([r.ravel() for r in self.residuals]) ** 2)))

    @property
    def explained(self) -> float:
        """Fraction of the variance of the data that the model explains,

            1 − Σ ((observed − predicted)/σ)² / Σ ((observed − mean)/σ)²,

        with the weighted mean of each component over each arc; σ = 1 for data without errors. It
        is 1 for a perfect fit, 0 for a model that is as good as these constants, and negative for
        a worse one. NaN for data that are constant.
        """
        residual_sum = total = 0.0
        arcs = zip(self.observed, self.predicted, self.errors, strict=True)
        for values_of_arc, model, errors in arcs:
            is_observed = np.isfinite(values_of_arc)
            sigma = np.where(is_observed, errors if self.has_errors else 1.0, np.inf)
            weight, values = 1 / sigma**2, np.where(is_observed, values_of_arc, 0.0)
            total_weight = np.where(is_observed.any(axis=0), weight.sum(axis=0), 1.0)
            mean = (weight * values).sum(axis=0) / total_weight
            residual_sum += np.sum(weight * np.where(is_observed, values - model, 0.0) ** 2)
            total += np.sum(weight * (values - mean) ** 2)
        return float(1 - residual_sum / total) if total > 0 else np.nan

    @property
    def chi2(self) -> float:
        """Σ of the squared whitened residuals."""
        return float(sum(np.nansum(r**2) for r in self.whitened))

    @property
    def reduced_chi2(self) -> float:
        """`chi2` and `prior_chi2` over the degrees of freedom: about 1 for right model, errors and
        priors. If it is so far from 1 that its probability is below 1e-4, the printed result says
        that the residuals contradict sigma (not for robust losses and likelihoods)."""
        total = self.chi2 + self.prior_chi2
        return total / self.degrees_of_freedom if self.degrees_of_freedom else np.nan

    def statistics(self) -> dict[str, float]:
        """Statistics of the whitened residuals: `rms`, `mean`, `largest`, `skewness`, `excess`
        kurtosis, and `lag_one`, the correlation of neighbours in time: 0 for a right model."""
        r = np.concatenate([w[np.isfinite(w)] for w in self.whitened])
        mean, spread = r.mean(), r.std()
        safe = spread if spread > 0 else 1.0
        pairs = [(w[:-1], w[1:]) for w in self.whitened]
        a, b = (np.concatenate([pair[i].ravel() for pair in pairs]) for i in (0, 1))
        is_pair = np.isfinite(a) & np.isfinite(b)
        total = (r**2).mean()
        has_pairs = is_pair.any() and total
        return {
            "rms": float(np.sqrt(total)),
            "mean": float(mean),
            "largest": float(np.abs(r).max()),
            "skewness": float((((r - mean) / safe) ** 3).mean()),
            "excess": float((((r - mean) / safe) ** 4).mean() - 3),
            "lag_one": float((a[is_pair] * b[is_pair]).mean() / total) if has_pairs else 0.0,
        }

    def __str__(self) -> str:
        width = max(len(n) for n in self.names[:40])
        lines = [f"{verdict(self)} after {len(self.history['loss'])} steps, {self.seconds:.1f} s"]
        for name, words in list(zip(self.names, numbers_in_words(self), strict=True))[:40]:
            lines.append(f"  {name:{width}}  {words}")
        if np.isnan(self.covariance).all() and len(self.at_bounds) < len(self.names):
            lines.append("  no errors: more than 400 parameters, or a derivative is not finite")
        if len(self.names) > 40:
            lines.append(f"  … and {len(self.names) - 40} more")
        errors = f"reduced chi² {self.reduced_chi2:.4g}, " if self.has_errors else ""
        part = max(self.explained, 0.0)
        explanation = f"{100 * part:.4g} % of the variance explained, " if part == part else ""
        lines.append(
            f"{errors}rms {self.rms:.4g}, {explanation}{self.num_observed} values, "
            f"{self.degrees_of_freedom} degrees of freedom"
        )
        lines += [self.start] if self.start else []
        lines += [*remarks(self), *filter(None, [rounding_remark(self)])]
        lines += [f"not determined: {words}" for words in self.undetermined]
        if self.result != FIT_RESULTS.converged and str(FIT_RESULTS[self.result]):
            lines.append(str(FIT_RESULTS[self.result]))
        return "\n".join(lines)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write everything but functions into one file (.npz), atomically."""
        header = {name: getattr(self, name) for name in _PLAIN}
        header |= {"result": self.status, "arcs": len(self.ts), "shape": _shape_of(self.params)}
        arrays = {"x": self.x, "covariance": self.covariance, "values": self.singular_values}
        arrays |= {f"history.{name}": value for name, value in self.history.items()}
        for name in _BY_ARC:
            arrays |= {f"{name}.{i}": a for i, a in enumerate(getattr(self, name))}
        arrays["rounding"] = self.rounding
        if self.curvature is not None:
            arrays["curvature"] = self.curvature
        publish_npz(path, _FORMAT, header, arrays)

    @classmethod
    def load(cls, path: str | os.PathLike[str], params: PyTree = None) -> "FitResult":
        """Read what `save` wrote.

        - `params`: a pytree like the fitted one; needed only if it is not made of dicts, lists and
          numbers (a network, whose functions are not in the file).

        **Raises** `FileNotFoundError`, and `ValueError` for a file that is not a fit or has another
        format, or params of other names.
        """
        header, arrays = read_npz(path, _FORMAT, "fit")
        if params is None:
            if header["shape"] is None:
                raise ValueError(
                    f"params is required to load {path}, which has more than numbers and arrays in "
                    "dicts: give params as in dvi.fit."
                )
            params = jax.tree.map(np.array, header["shape"], is_leaf=lambda x: isinstance(x, list))
        space, _ = make_space(params)
        same_parameters("params", space.names, header["names"], f"the fit in {path}")
        numbers = range(header["arcs"])
        by_arc: dict[str, Any] = {n: [arrays[f"{n}.{i}"] for i in numbers] for n in _BY_ARC}
        return cls(
            params=space.to_params(jnp.asarray(arrays["x"])),
            x=arrays["x"],
            covariance=arrays["covariance"],
            history=Table({k[8:]: v for k, v in arrays.items() if k.startswith("history.")}),
            result=getattr(FIT_RESULTS, one_of(f"the status in {path}", header["result"], NAMES)),
            singular_values=arrays["values"],
            curvature=arrays.get("curvature"),
            rounding=arrays.get("rounding", np.zeros(len(arrays["x"]))),
            **{name: header[name] for name in _PLAIN if name in header},
            **by_arc,
        )


def numbers_in_words(fit: FitResult) -> list[str]:
    """Each fitted number with its standard error, or as one at its bound."""
    return [
        f"{x:.8g} at its bound: no symmetric error" if name in fit.at_bounds else with_error(x, s)
        for name, x, s in zip(fit.names, fit.x, fit.sigma, strict=True)
    ]


def remarks(fit: FitResult) -> list[str]:
    """What a user must know before the numbers are used."""
    return list(filter(None, [_little_explained(fit), *doubts(fit), _whole_turns(fit)]))


def doubts(fit: FitResult) -> list[str]:
    """The remarks on residuals that contradict sigma, and on priors that contradict the data."""
    return list(filter(None, [contradiction(fit), _prior_conflict(fit)]))


def verdict(fit: FitResult) -> str:
    """The status in words: a fit may have converged to a model that does not describe the data."""
    if fit.status == "converged" and contradiction(fit):
        return (
            f"converged, but the residuals contradict sigma (reduced chi² {fit.reduced_chi2:.4g}),"
        )
    return fit.status + ", but the priors contradict the data," * bool(_prior_conflict(fit))


def _prior_conflict(fit: FitResult) -> str:
    """The remark on priors that contradict the data; empty for others."""
    from scipy.special import gammaincc  # importing the package does not import it

    count = len(fit.priors)
    probability = float(gammaincc(count / 2, fit.conflict / 2)) if count else 1.0
    if probability >= _SIGNIFICANCE:
        return ""
    return (
        f"the priors contradict the data (probability {max(probability, 1e-300):.0e}): chi² of "
        f"their difference is {fit.conflict:.4g} for {count} of {', '.join(fit.priors[:4])}. A "
        "prior is wrong or too narrow, the model is incomplete, or this is a local minimum."
    )


def contradiction(fit: FitResult) -> str:
    """The remark on residuals that contradict sigma, by the χ² distribution; empty for others."""
    from scipy.special import gammainc, gammaincc  # importing the package does not import it

    total, degrees = fit.chi2 + fit.prior_chi2, fit.degrees_of_freedom
    # Robust losses expect outliers, and a likelihood has its own use of sigma.
    is_square = abs(2 * fit.loss - total) <= 1e-9 * total
    if not (fit.has_errors and is_square and degrees > 0):
        return ""
    is_large = total > degrees
    probability = float((gammaincc if is_large else gammainc)(degrees / 2, total / 2))
    if probability >= _SIGNIFICANCE:
        return ""
    causes = "sigma is too large, or the data are not independent"
    if is_large:
        causes = (
            "the model is incomplete, this is a local minimum, h is too large, or sigma is too "
            "small. The standard errors do not include this"
        )
    return (
        f"the residuals contradict sigma: reduced chi² must be 1 ± {np.sqrt(2 / degrees):.2g} and "
        f"is {fit.reduced_chi2:.4g} (probability {max(probability, 1e-300):.0e}). Likely causes: "
        f"{causes}."
    )


def _whole_turns(fit: FitResult) -> str:
    """The remark on angles whose residuals are small apart from some of a whole turn."""
    sizes = np.abs(np.concatenate([r[np.isfinite(r)] for r in fit.residuals]))
    for name, turn in (("2π", 2 * np.pi), ("360", 360.0)):
        count = int((np.abs(sizes - turn) < _NEAR_TURN * turn).sum())
        if count and np.median(sizes) < _NEAR_TURN * turn:
            return (
                f"{count} residuals are near ±{name}: if the values are angles, give their period "
                "to dvi.Observations(..., period=...)."
            )
    if not (contradiction(fit) or _little_explained(fit)):
        return ""
    # A fit that has followed no branch has no such residuals, but its data jump within a turn.
    for values in (column for v in fit.observed for column in v.reshape(len(v), -1).T):
        values = values[np.isfinite(values)]
        jump, span = (np.abs(x).max(initial=0.0) for x in (np.diff(values), np.ptp(values)))
        for name, turn in (("2π", 2 * np.pi), ("360", 360.0)):
            if 0.5 * turn < jump <= span <= 1.001 * turn:
                return (
                    f"values jump by up to {jump:.3g} in an interval of at most {name}: if they "
                    "are angles, give their period to dvi.Observations(..., period=...)."
                )
    return ""


def _little_explained(fit: FitResult) -> str:
    """The remark on a fit that is hardly better than a constant; empty for a better one."""
    if not fit.explained < _LITTLE:
        return ""
    comparison = "no better" if fit.explained <= 0 else "little better"
    return (
        f"the model describes the data {comparison} than constants do: this may be a local "
        "minimum, or the data are constants and noise. Start from other parameters."
    )


def neighbour_remark(fit: FitResult) -> str:
    """The remark on residuals of data without errors that are correlated; empty for others."""
    lag_one = 0.0 if fit.has_errors else fit.statistics()["lag_one"]
    if lag_one * np.sqrt(fit.num_observed) < _CORRELATED:
        return ""
    return (
        f"the residuals of neighbouring times are correlated (lag_one {lag_one:.2g}). Likely "
        "causes: terms are missing, this is a local minimum, h is too large, or the errors of the "
        "data are not independent. The standard errors do not include this."
    )


def rounding_remark(fit: FitResult) -> str:
    """The remark on a fit whose accuracy is bounded by rounding; empty for another one."""
    with np.errstate(invalid="ignore", divide="ignore"):
        part = fit.rounding / fit.sigma
    part = part[np.isfinite(part)].max(initial=0.0)
    if fit.result != FIT_RESULTS.converged or part < _NOTABLE:
        return ""
    return (
        "converged at the level of rounding: the round-off of the predictions changes parameters "
        f"by up to {part:.1g} of their errors, which include it"
    )


def with_error(x: float, sigma: float) -> str:
    """``1.00063 ± 0.00002``, with two digits of the error."""
    if not np.isfinite(sigma) or sigma <= 0:
        return f"{x:.8g} ± {sigma:.2g}"
    digits = 1 - int(np.floor(np.log10(sigma)))
    size = np.floor(np.log10(abs(x))) if x else 0
    if -4 <= size <= 6 and 0 <= digits <= 12:
        return f"{x:.{digits}f} ± {sigma:.{digits}f}"
    return f"{x:.{max(int(size) + digits, 1)}e} ± {sigma:.1e}"


def _shape_of(params: PyTree) -> Any:
    """The pytree as JSON with lists in place of arrays, or None for one that is more than that."""
    leaves = jax.tree.leaves(params)
    plain = all(eqx.is_array_like(x) for x in leaves) and _is_plain(params)
    return jax.tree.map(lambda x: np.asarray(x).tolist(), params) if plain and leaves else None


def _is_plain(node: Any) -> bool:
    """Whether it consists of arrays and numbers in dicts; a list would be loaded as an array."""
    if isinstance(node, dict):
        return all(isinstance(k, str) and _is_plain(v) for k, v in node.items())
    return isinstance(node, np.ndarray | np.generic | jax.Array | float | int)
