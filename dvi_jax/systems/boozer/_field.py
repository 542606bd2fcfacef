"""Magnetic fields in Boozer coordinates: a spectrum of |B| and profiles of flux functions."""

from typing import Any, Required, TypedDict, Unpack

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...base.checks import all_finite, array, finite, known, positive, whole
from ...base.keywords import checked_keywords
from ...base.printing import printable
from ._sums import Coefficients, Shape, total

_WIDEST = 0.4
"""Widest gap between two surfaces: in a wider one there may be what no other surface shows."""

Profile = Float[Array, " d"]
"""A polynomial in s: its coefficients, the constant first."""


@printable
class Field(eqx.Module):
    r"""A magnetic field in Boozer coordinates (ψ, θ, ζ), right-handed, s = ψ/ψ_edge.

        B = ∇ψ × ∇θ + ι(s) ∇ζ × ∇ψ = G(s) ∇ζ + I(s) ∇θ

        |B| = Σ_mn s^{m/2} [b_mn(s) cos(mθ − nζ) + b'_mn(s) sin(mθ − nζ)]

    with polynomials b_mn, b'_mn, ι, G and I in s. The motion of guiding centres depends on nothing
    else. 2πψ is the toroidal flux. K(ψ, θ, ζ)∇ψ, the radial covariant part of B, is left out: it is
    zero in a vacuum field, and otherwise of the order of the plasma pressure.

    **Arguments** (made by `from_modes`, `from_surfaces`, `read_booz_xform`, `from_near_axis`)

    - `psi_edge`: ψ at s = 1 [T m²], positive.
    - `coefficients`: of b_mn and b'_mn, shape (1 or 2, M + 1, 2K + 1, d + 1) [T]; entry (·, m, k)
      is the mode m, n = periods · (k − K + helicity · m).
    - `iota`, `G`, `I`: coefficients of polynomials in s [1, T m, T m]. I is zero at s = 0. `I` is
      None for a field without toroidal current, whose guiding centres need no root solve for s.
    - `shape`: number of periods and helicity.

    All arrays are differentiable. Methods take arrays of any one shape.

    **Source** Boozer 1981, *Phys. Fluids* 24, 1999; White & Chance 1984, *Phys. Fluids* 27, 2455.
    """

    psi_edge: Any
    coefficients: Coefficients
    iota: Profile
    G: Profile
    I: Profile | None  # noqa: E741 - the name of the literature
    shape: Shape = eqx.field(static=True)

    def strength(self, s: Any, theta: Any, zeta: Any) -> Array:
        """|B| [T] at s, θ, ζ."""
        s, theta, zeta = jnp.broadcast_arrays(*map(jnp.asarray, (s, theta, zeta)))
        r = jnp.sqrt(s)
        return self.at(r * jnp.cos(theta), r * jnp.sin(theta), zeta)

    def at(self, x: Any, y: Any, zeta: Any) -> Array:
        """|B| [T] at x = √s cos θ, y = √s sin θ and ζ: smooth at the magnetic axis."""
        return total(self.coefficients, self.shape, x, y, zeta)

    def poloidal_flux(self, s: Any) -> Array:
        """χ(s) = ψ_edge ∫₀ˢ ι ds [T m²]: the poloidal flux/2π."""
        powers = jnp.arange(1, self.iota.shape[0] + 1)
        return self.psi_edge * s * polynomial(self.iota / powers, s)

    @property
    def modes(self) -> list[tuple[int, int]]:
        """(m, n) of all modes, in the order of ``coefficients.reshape(parts, -1, d + 1)``."""
        _, M, K2, _ = self.coefficients.shape
        N, h = self.shape
        return [(m, N * (k - K2 // 2 + h * m)) for m in range(M) for k in range(K2)]

    @property
    def average(self) -> Array:
        """The mean of |B| on the axis [T]."""
        return self.coefficients[0, 0, self.coefficients.shape[2] // 2, 0]

    def scaled(self, B: float = 5.7, minor_radius: float = 1.7) -> "Field":
        """The same field with another mean |B| on the axis [T] and another minor radius
        a = √(2ψ_edge/B) [m]; the defaults are those of a reactor."""
        B, a = positive("B", B), positive("minor_radius", minor_radius)
        b = B / self.average
        length = a / jnp.sqrt(2 * self.psi_edge / self.average)
        current = None if self.I is None else self.I * b * length
        new = self.psi_edge * b * length**2, self.coefficients * b, self.G * b * length, current
        return eqx.tree_at(
            lambda f: (f.psi_edge, f.coefficients, f.G, f.I), self, new, is_leaf=lambda x: x is None
        )

    def split(self, helicity: int | None = None) -> "tuple[Field, Coefficients]":
        """The quasi-symmetric part, and the coefficients of the modes that break the symmetry.

        - `helicity`: h of the symmetry n = periods · h · m; that of the field by default. 0:
          quasi-axisymmetry, 1 or −1: quasi-helical symmetry.
        """
        N, h = self.shape
        h = h if helicity is None else whole("helicity", helicity, -99)
        is_symmetric = np.array([n == N * h * m for m, n in self.modes])
        c = self.coefficients
        mask = is_symmetric.reshape(c.shape[1:3])[None, :, :, None]
        symmetric = eqx.tree_at(lambda f: f.coefficients, self, jnp.where(mask, c, 0))
        return symmetric, jnp.where(mask, 0, c)

    def ripple(self, helicity: int | None = None) -> Array:
        """√(Σ B_mn²) of the symmetry-breaking modes over |B_00|, at s = 1."""
        symmetric, breaking = self.split(helicity)
        at_edge = jnp.sum(breaking, axis=-1)
        return jnp.sqrt(jnp.sum(at_edge**2)) / jnp.abs(symmetric.average)


def polynomial(c: Profile, s: Any) -> Array:
    """Σ_d c_d s^d, of any shape."""
    value = c[-1] * jnp.ones_like(s)
    for d in range(c.shape[0] - 2, -1, -1):
        value = value * s + c[d]
    return value


def _array(name: str, values: Any, *shape: int | str) -> np.ndarray:
    entries = array(name, known(name, values, float), shape, integers=True, empty=True)
    all_finite(name, entries)
    return entries


def from_modes(
    m: Any,
    n: Any,
    B: Any,
    *,
    psi_edge: float,
    iota: Any,
    G: Any,
    I: Any = None,  # noqa: E741
    periods: int = 1,
    helicity: int = 0,
) -> Field:
    r"""A `Field` from the polynomials of its modes, |B| = Σ s^{m/2} b_mn(s) cos(mθ − nζ).

    - `m`, `n`: mode numbers; each n is a multiple of `periods`, m is not negative.
    - `B`: coefficients of b_mn [T], shape (modes, d + 1), the constant first; or (2, modes, d + 1)
      with those of the sine terms.
    - `psi_edge`: ψ at the edge s = 1 [T m²]. `iota`, `G`, `I`: coefficients of polynomials in s; a
      number is a constant. I is zero on the axis: its first coefficient must be 0.
    - `helicity`: modes are stored around n = periods · helicity · m, so that a quasi-helical field
      (1 or −1) needs fewer of them. It does not change the field.

    **Raises** `ValueError` for a spectrum without the mode (0, 0), or with |B| ≤ 0 somewhere.
    """
    periods, h = whole("periods", periods), whole("helicity", helicity, -99)
    positive("psi_edge", psi_edge)
    ms, ns = (_integers(name, x) for name, x in (("m", m), ("n", n)))
    parts = _parts(B)
    lengths = len(ms), len(ns), len(parts[0])
    if len(set(lengths)) > 1 or 0 in lengths:
        raise ValueError(f"m, n and B must have one entry for each mode, got {lengths} entries.")
    if ms.min() < 0 or (ns % periods).any():
        raise ValueError(
            f"m must not be negative and n a multiple of periods={periods}, got m = {list(ms)}, "
            f"n = {list(ns)}."
        )
    k = ns // periods - h * ms
    K = int(np.abs(k).max())
    table = np.zeros((len(parts), int(ms.max()) + 1, 2 * K + 1, parts[0].shape[1]))
    for part, values in enumerate(parts):
        np.add.at(table[part], (ms, k + K), values)
    if not table[0, 0, K, 0] > 0:
        raise ValueError(
            "B must have a positive value of the mode m = n = 0 on the axis, the mean of |B|, got "
            f"{table[0, 0, K, 0]} T."
        )
    profiles = [np.atleast_1d(np.asarray(x, float)) for x in (iota, G, 0.0 if I is None else I)]
    for name, profile in zip(("iota", "G", "I"), profiles, strict=True):
        _array(name, profile, "degree")
    if profiles[2][0] != 0:
        raise ValueError(
            f"I must be zero on the axis, [0, ...], got the constant {profiles[2][0]}."
        )
    iota, G, current = map(jnp.asarray, profiles)
    psi, current = jnp.asarray(float(psi_edge)), None if I is None else current
    field = Field(psi, jnp.asarray(table), iota, G, current, Shape(periods, h))
    _check_positive(field)
    return field


def _integers(name: str, values: Any) -> np.ndarray:
    numbers = _array(name, values, "modes")
    if wrong := numbers[numbers != np.round(numbers)].tolist():
        raise ValueError(f"{name} must be integers (mode numbers), got {wrong[0]}.")
    return numbers.astype(int)


def _parts(values: Any) -> list[np.ndarray]:
    """The cosine part of B and, if it has three dimensions, the sine part."""
    if np.ndim(values) != 3:
        return [_array("B", values, "modes", "d")]
    if len(values) not in (1, 2):
        raise ValueError(f"B must have 1 or 2 parts on the first of three axes, got {len(values)}.")
    return list(_array("B", values, "parts", "modes", "d"))


def _check_positive(field: Field) -> None:
    s, theta, zeta = np.meshgrid(
        np.linspace(0, 1, 9),
        np.linspace(0, 2 * np.pi, 32, endpoint=False),
        np.linspace(0, 2 * np.pi / field.shape.periods, 32, endpoint=False),
    )
    low = jnp.min(field.strength(s, theta, zeta))
    if not low > 0:
        raise ValueError(
            f"|B| must be positive for 0 ≤ s ≤ 1, got {low:.3g} T. Check the signs of the modes."
        )
    G = polynomial(field.G, jnp.linspace(0, 1, 65))
    if not (jnp.all(G > 0) or jnp.all(G < 0)):
        raise ValueError(f"G must not be zero for 0 ≤ s ≤ 1, got {G.min():.3g} to {G.max():.3g}.")


class ProfileSettings(TypedDict, total=False):
    """Keywords of `from_modes`."""

    psi_edge: Required[float]
    iota: Required[Any]
    G: Required[Any]
    I: Any  # noqa: E741
    periods: int
    helicity: int


@checked_keywords
def from_surfaces(
    s: Any,
    m: Any,
    n: Any,
    B: Any,
    *,
    degree: int = 6,
    box: tuple[int, int] | None = None,
    tolerance: float = 1e-2,
    **settings: Unpack[ProfileSettings],
) -> Field:
    r"""A `Field` from values on flux surfaces, by least-squares polynomials in s.

    Each B_mn(s) becomes s^{m/2} b_mn(s) with a polynomial b_mn, which is smooth also on the axis:
    splines of low order would limit the order of a method. |B| is then a polynomial in √s cos θ and
    √s sin θ.

    - `s`: surfaces in 0 ≤ s ≤ 1, increasing, the last one at 0.9 or more, with gaps up to 0.4.
    - `m`, `n`: mode numbers; `B`: values [T], shape (surfaces, modes), or (2, surfaces, modes) with
      those of the sine terms.
    - `iota`, `G`, `I`: values on the surfaces [1, T m, T m]; `psi_edge`, `periods`, `helicity` as
      for `from_modes`.
    - `degree`: largest degree of the polynomials of the modes; those of the profiles have up to two
      more. Each takes the degree that predicts best the values on surfaces that are left out.
    - `box`: (M, K), only modes with m ≤ M and |n/periods −
      helicity·m| ≤ K. The cost of a step is proportional to (M + 1)(2K + 1).
    - `tolerance`: largest error of |B| over its mean, and of ι, G and I (over G).

    **Raises** `ValueError` for surfaces that do not reach the edge, or if an error is larger than
    `tolerance`: too few surfaces, or a degree that is too low.

    **Accuracy** The error is measured by leaving each surface out and predicting it from the
    others; at the ends it is scaled to the distance from s = 0 and s = 1. Between two surfaces it
    is the change of the fit by leaving one surface out, or by another degree that predicts nearly
    as well. What is narrower than a gap, so that no surface shows it, is not part of it, and
    neither are the modes outside of `box`.
    """
    s, values = _array("s", s, "surfaces"), _parts(B)
    periods, helicity = settings.get("periods", 1), settings.get("helicity", 0)
    degree = whole("degree", degree, 0)
    gaps = np.diff(s)
    if len(s) < 3:
        raise ValueError(f"s must have at least 3 surfaces, got {len(s)}.")
    is_wide = len(s) > 3 and max(s[0], *gaps) > _WIDEST
    if gaps.min() <= 0 or s[0] < 0 or s[-1] > 1 or s[-1] < 0.9 or is_wide:
        raise ValueError(
            f"s must increase, without a gap of more than {_WIDEST}, from 0 or more to the edge "
            f"(0.9 to 1), got {np.array2string(s, threshold=4)}. Divide s and psi_edge of an inner "
            "grid by s[-1]."
        )
    ms, ns = (_integers(name, x) for name, x in (("m", m), ("n", n)))
    array("B", values[0], (len(s), len(ms)), integers=True)
    names = ["iota", "G", *(["I"] if settings.get("I") is not None else [])]
    profiles = {name: _array(name, settings.get(name), len(s)) for name in names}
    if box is not None:
        if not isinstance(box, tuple | list) or len(box) != 2:
            raise TypeError(f"box must be a pair (M, K), such as (6, 4), got {box!r}.")
        M, K = (whole(f"entry {i} of box", x, 0) for i, x in enumerate(box))
        in_box = (ms <= M) & (np.abs(ns / periods - helicity * ms) <= K)
        ms, ns, values = ms[in_box], ns[in_box], [x[:, in_box] for x in values]
    mean = np.abs(values[0][:, (ms == 0) & (ns == 0)]).mean() if len(ms) else 0.0
    fits, errors = zip(*(_fit_modes(s, ms, x, degree) for x in values), strict=True)
    if mean > 0:
        _check_fit("|B|", np.sum(errors, axis=(0, 2)), mean, tolerance)
    current = profiles.pop("I", None)
    for name, profile in profiles.items():
        settings[name], error = _fit(s, profile, degree + 2)
        _check_fit(name, error, np.abs(profile).max(), tolerance)
    settings["I"], largest = None, np.abs(profiles["G"]).max()
    if current is not None and np.abs(current).max() > 1e-9 * largest:
        fit, error = _fit(s, current, degree + 1, 1.0)
        _check_fit("I", error, largest, tolerance)
        settings["I"] = np.append(0.0, fit)
    return from_modes(ms, ns, np.stack(fits), **settings)


def fitted_modes(
    name: str, s: Any, m: Any, n: Any, values: Any, scale: float, settings: tuple[Any, ...]
) -> np.ndarray:
    """The table of polynomials, shape (M + 1, 2K + 1, d + 1), of any function on surfaces.

    `settings`: periods, degree, box, and the largest error of the function over `scale`.
    """
    periods, degree, box, tolerance = settings
    k = n // periods
    M, K = box if box is not None else (int(m.max()), int(np.abs(k).max()))
    in_box = (m <= M) & (np.abs(k) <= K)
    fit, errors = _fit_modes(s, m[in_box], values[:, in_box], degree)
    _check_fit(name, np.sum(errors, axis=1), scale, tolerance)
    table = np.zeros((M + 1, 2 * K + 1, degree + 1))
    np.add.at(table, (m[in_box], k[in_box] + K), fit)
    return table


def _check_fit(name: str, errors: np.ndarray, scale: float, tolerance: float) -> None:
    """**Raises** `ValueError` if an error at or between the surfaces is too large."""
    if errors.max() > finite("tolerance", tolerance) * scale:
        raise ValueError(
            f"{name} must be determined by its values on the surfaces to tolerance={tolerance} of "
            f"its size, got {errors.max() / scale if scale else np.inf:.2g} with "
            f"{len(errors) // 2 + 1} surfaces, each predicted by the others. Give more surfaces, "
            "a larger degree, fewer large m (box=), or a larger tolerance."
        )


def _fit_modes(
    s: np.ndarray, m: np.ndarray, values: np.ndarray, degree: int
) -> tuple[np.ndarray, np.ndarray]:
    """`_fit` of each mode, with the power m/2."""
    fits, errors = np.zeros((len(m), degree + 1)), np.zeros((2 * len(s) - 1, len(m)))
    for power in np.unique(m):
        fits[m == power], errors[:, m == power] = _fit(s, values[:, m == power], degree, power / 2)
    return fits, errors


def _fit(
    s: np.ndarray, values: np.ndarray, degree: int, power: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """c with values ≈ s^power Σ_d c_d s^d by least squares, shape (…, degree + 1), and the error at
    each surface and in the middle between them, shape (2 surfaces − 1, …), for values of shape
    (surfaces, …).

    With few surfaces the residual is no measure: a polynomial of a high degree passes through all
    values and oscillates in between. The error is that of the prediction from the other surfaces,
    residual/(1 − H_ii) with the projection H of the fit, and the degree is the one, up to `degree`,
    for which it is smallest. The errors at both ends, where this is an extrapolation, are scaled
    to the distance from s = 0 and s = 1. That in a gap, which may be wide, is the largest change of
    the fit there if one surface is left out, or if the degree is another one of nearly the same
    error.
    """
    columns = values.reshape(len(s), -1)
    c, middles = np.zeros((columns.shape[1], degree + 1)), (s[1:] + s[:-1]) / 2
    # Without any term: the values themselves, also between the surfaces.
    errors = np.abs(np.vstack([columns, (columns[1:] + columns[:-1]) / 2]))
    weights = np.ones((len(s), 1))
    weights[[0, -1], 0] = s[0] / (s[1] - s[0]), (1 - s[-1]) / (s[-1] - s[-2])

    def basis_at(x, d):
        return np.polynomial.chebyshev.chebvander(2 * x - 1, d) * (x**power)[:, None]

    scores, predictions = [np.sum(errors[: len(s)] ** 2, axis=0)], [np.zeros_like(errors[len(s) :])]
    for d in range(min(degree, len(s) - 2) + 1):
        left, sizes, right = np.linalg.svd(basis_at(s, d), full_matrices=False)
        rank = int(np.sum(sizes > 1e-10 * sizes[0]))
        left, inverse = left[:, :rank], right[:rank].T / sizes[:rank]
        residuals = np.abs(columns - left @ (left.T @ columns))
        freedom = 1 - np.sum(left**2, axis=1, keepdims=True)
        # A surface that the others do not predict at all has no freedom, up to rounding.
        left_out = np.where(freedom > 1e-8, residuals / freedom.clip(1e-8), np.inf)
        estimates = np.maximum(residuals, weights * left_out)
        changes = np.abs(basis_at(middles, d) @ inverse @ left.T)
        gap_errors = np.max([np.outer(changes[:, i], left_out[i]) for i in range(len(s))], axis=0)
        scores.append(np.sum(estimates**2, axis=0))
        predictions.append(basis_at(middles, d) @ inverse @ (left.T @ columns))
        better = scores[-1] < np.sum(errors[: len(s)] ** 2, axis=0)
        errors[:, better], c[better] = np.vstack([estimates, gap_errors])[:, better], 0.0
        c[better, : d + 1] = (inverse @ (left.T @ columns[:, better])).T @ _monomials(d)
    # Degrees that predict nearly as well may differ in a gap more than any of them shows there.
    best, predicted = np.argmin(scores, axis=0), np.array(predictions)
    is_close = np.array(scores) < _NEARLY**2 * np.min(scores, axis=0)
    apart = np.abs(predicted - np.take_along_axis(predicted, best[None, None], axis=0))
    apart = np.max(np.where(is_close[:, None], apart, 0.0), axis=0)
    errors[len(s) :] = np.maximum(errors[len(s) :], apart)
    return c.reshape(*values.shape[1:], degree + 1), errors.reshape(-1, *values.shape[1:])


_NEARLY = 2.0
"""Ratio of the errors of two degrees up to which both count."""


def _monomials(degree: int) -> np.ndarray:
    """Coefficients in powers of s of the Chebyshev polynomials of 2s − 1, one in a row."""
    rows = np.zeros((degree + 1, degree + 1))
    for k in range(degree + 1):
        series = np.polynomial.Chebyshev.basis(k, domain=[0, 1])
        rows[k, : k + 1] = series.convert(kind=np.polynomial.Polynomial).coef
    return rows
