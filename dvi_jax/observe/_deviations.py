"""Deviation vectors: small displacements of the start, mapped by the derivative of the steps."""

import abc
import dataclasses
import math
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from lanewise.jaxprs.jaxapi import is_traced

from ..base.checks import all_finite, array, whole
from ..base.types import Scalar
from ._reductions import Reduction

_UNROLL_UP_TO = 12
"""Vectors up to which the Gram–Schmidt process is unrolled: a loop compiles faster for many."""


_ON_MANIFOLD = "With a constraint no more deviation vectors are independent."


class Pushed(NamedTuple):
    """Deviation vectors after a step, w1 = M w0 with M = ∂(q1, p1)/∂(q0, p0).

    - `vectors`: shape (count, 2N), each one (δq, δp) raveled, N components of q.
    - `h`: the length of the step.
    """

    vectors: Array
    h: Scalar


def _state(t0, t1, q0, p0, q1, p1, args):
    return jnp.concatenate([q1.ravel(), p1.ravel()])


class Deviations(Reduction):
    """Base of the reductions that follow deviation vectors along a trajectory.

    The derivative of each step is applied to `vectors` of the memory, and `update` receives the
    result as a `Pushed` in place of a value: exact, by autodiff, with the perturbation and through
    implicit solves. Gradients are those of the steps, so that there is no `combine`.
    """

    function: ClassVar[Any] = staticmethod(_state)

    @abc.abstractmethod
    def vectors(self, memory: Any) -> Array:
        """The vectors before the next step, shape (count, 2N)."""

    def on_manifold(self, dimension: int) -> "Deviations":
        """The reduction for the states of a system with a constraint, a manifold of this dimension.

        **Raises** `ValueError` for more vectors than are independent there."""
        return self

    @abc.abstractmethod
    def update(self, memory: Any, k: Array, t: Scalar, value: Any) -> Any:
        """Memory after step k, which ended at time t; `value` is a `Pushed`."""


class _Sum(NamedTuple):
    """A compensated sum (Kahan 1965): a plain float32 sum of 10⁶ steps is wrong by per cents."""

    value: Array
    excess: Array

    def plus(self, x: Array) -> "_Sum":
        term = x - self.excess
        value = self.value + term
        # What rounding added to the sum, to be subtracted from the next term; exactly it is zero.
        return _Sum(value, (value - self.value) - term)


def _no_sum(shape: tuple[int, ...], dtype: Any) -> _Sum:
    return _Sum(jnp.zeros(shape, dtype), jnp.zeros(shape, dtype))


def _as_python_integer(value: Any) -> Any:
    """An integer of NumPy as one of Python, which can be hashed; anything else as it is."""
    return int(value) if isinstance(value, np.integer) else value


class _FrameIndicator(Deviations):
    """Base of indicators with an orthonormal frame, the first part of their memory. A subclass has
    the fields `seed`, of the first frame, and `scale`, a pair of units."""

    def __check_init__(self: Any):
        whole(f"seed of {type(self).__name__}", self.seed, 0)
        if not isinstance(self.scale, tuple | list) or len(self.scale) != 2:
            raise TypeError(
                f"scale of {type(self).__name__} must be a pair (unit of q, unit of p), got "
                f"{self.scale!r:.200}."
            )
        for letter, unit in zip("qp", self.scale, strict=True):
            if not any(map(is_traced, jax.tree.leaves(unit))):  # their values are not known
                all_finite(f"the scale of {letter} in {type(self).__name__}", unit, positive=True)

    def vectors(self, memory):
        units = self._units(memory[0])
        return memory[0] if units is None else memory[0] * units

    def _in_units(self, vectors: Array) -> Array:
        """Vectors of the state in the units of `scale`."""
        units = self._units(vectors)
        return vectors if units is None else vectors / units

    def _first_frame(self: Any, value: Array, count: int | None) -> Array:
        """Random orthonormal vectors, the same for every trajectory, shape (count, 2N)."""
        size = value.shape[0]
        if count is not None:
            whole(f"the number of vectors of {type(self).__name__}", count, high=size)
        # All `size` vectors are drawn, so that the first ones do not depend on the count.
        random = np.random.default_rng(self.seed).standard_normal((size, size))
        # In NumPy the frame is a constant of the program, and costs nothing in a run.
        frame = np.linalg.qr(random)[0][: size if count is None else count]
        return jnp.asarray(frame, value.dtype)

    def _units(self: Any, like: Array) -> Array | None:
        """The unit of each component of (q, p), shape (1, 2N); None where all are 1."""
        if all(isinstance(unit, float) and unit == 1.0 for unit in self.scale):
            return None
        size = like.shape[-1] // 2
        parts = []
        for letter, unit in zip("qp", self.scale, strict=True):
            unit = jnp.asarray(unit, like.dtype).ravel()
            array(f"the scale of {letter} in {type(self).__name__}", unit, (1,), (size,))
            parts.append(jnp.broadcast_to(unit, (size,)))
        return jnp.concatenate(parts)[None, :]


class TangentMap(Deviations):
    r"""Observable: the derivative of the whole run, ∂(q_K, p_K)/∂(q_0, p_0), shape (2N, 2N).

    The product M_K ⋯ M_1 of the steps' derivatives, in coordinates (q, p) raveled; the identity
    without steps. With a symplectic method and ε = 0, or a Hamiltonian perturbation, MᵀJM = J. Over
    a closed orbit it is the monodromy matrix, whose eigenvalues are the Floquet multipliers. On
    chaotic orbits its columns become parallel when e^{λt} approaches 1e16, and later it overflows:
    use `LyapunovSpectrum` there.
    """

    def start(self, value):
        return jnp.eye(value.shape[0], dtype=value.dtype)

    def vectors(self, memory):
        return memory

    def update(self, memory, k, t, value):
        return value.vectors

    def finish(self, memory):
        # The vectors are rows here; the columns of a Jacobian are the images of the unit vectors.
        return memory.T


class LyapunovSpectrum(_FrameIndicator):
    r"""Observable: the Lyapunov exponents λ_1, λ_2, … [1/time], shape (count,).

        λ_i = (1/|t|) Σ_k ln R_ii^(k),        M_k Q_{k−1} = Q_k R^(k)

    The derivative of each step maps an orthonormal frame Q, which the Gram–Schmidt process makes
    orthonormal again. In the limit λ_1 ≥ λ_2 ≥ …; before it, close ones may be in another order. A
    Hamiltonian system has pairs ±λ, and a pair of zeros for each integral in involution; with a
    linear damping −εp pairs sum to −ε. An exponent of zero has a value of about (ln t)/t. A run
    with h < 0 gives the exponents of the reversed motion.

    **Arguments**

    - `count`: number of exponents; None: all, 2N of N coordinates, and 2(N − m) with a constraint
      of m components, on which further ones have no meaning. The cost grows with it.
    - `seed`: of the first frame, which is random.
    - `scale`: (of q, of p): units of deviations, numbers or arrays like q; the limit is the same.

    **Source** Benettin et al. 1980, *Meccanica* 15, 9 and 21; Shimada & Nagashima 1979.
    """

    count: int | None = eqx.field(static=True, default=None, converter=_as_python_integer)
    seed: int = eqx.field(static=True, default=0)
    scale: Any = (1.0, 1.0)

    def __check_init__(self):
        if self.count is not None:
            whole("count of LyapunovSpectrum", self.count)

    def on_manifold(self, dimension):
        if self.count is None:
            return dataclasses.replace(self, count=dimension)
        whole("count of LyapunovSpectrum", self.count, high=dimension, hint=_ON_MANIFOLD)
        return self

    def start(self, value):
        frame = self._first_frame(value, self.count)
        return frame, _no_sum(frame.shape[:1], value.dtype), _no_sum((), value.dtype)

    def update(self, memory, k, t, value):
        # Logarithms are summed, since the growth itself would overflow.
        _, sums, time = memory
        frame, R = _gram_schmidt(self._in_units(value.vectors))
        return frame, sums.plus(jnp.log(_diagonal(R))), time.plus(value.h)

    def finish(self, memory):
        _, sums, time = memory
        return sums.value / jnp.abs(time.value)


class MEGNO(_FrameIndicator):
    r"""Observable: the mean exponential growth of nearby orbits ⟨Y⟩, a number.

        Y(t) = (2/t) ∫ (|ẇ|/|w|) s ds,        ⟨Y⟩(t) = (1/t) ∫ Y ds

    of one deviation vector w. It tends to 2 on quasi-periodic and on stable periodic orbits whose
    neighbours have other frequencies (to 0 if all have the same one, as in a linear system), and to
    λt/2 on chaotic ones, with the largest Lyapunov exponent λ. It is negative if dissipation makes
    w shrink. The integrals are sums over the steps, of order 2 in h.

    **Arguments** `seed` of the first vector, which is random; `scale` as for `LyapunovSpectrum`.

    **Source** Cincotta & Simó 2000, *A&AS* 147, 205; for maps Cincotta, Giordano & Simó 2003,
    *Physica D* 182, 151.

    **Example**

    ```python
    heiles = systems.henon_heiles()
    def megno(q0):
        sol = dvi.integrate(heiles.system, q0, jnp.array([0.45, 0.0]), h=0.1, num_steps=10_000,
                            observe={"megno": dvi.MEGNO()}, method=dvi.Strang(),
                            save=dvi.Save(final=True))
        return sol.observed["megno"]
    print(np.asarray(jax.vmap(megno)(jnp.array([[0.0, 0.1], [0.0, -0.25]])) < 3))     # regular?
    # [ True False]
    ```
    """

    seed: int = eqx.field(static=True, default=0)
    scale: Any = (1.0, 1.0)

    def start(self, value):
        # ∫ (|ẇ|/|w|) s ds is a sum of growths of ln |w| times the midpoint of the step.
        zero = jnp.zeros((), value.dtype)
        growth, area, time = (_no_sum((), value.dtype) for _ in range(3))
        return self._first_frame(value, 1), growth, zero, area, time

    def update(self, memory, k, t, value):
        _, growth, previous, area, time = memory
        vector = self._in_units(value.vectors)
        square = jnp.sum(vector**2)
        # The vector had length 1 before the step. ln |w|² is 2 ln |w|: the factor 2 of Y is in it.
        growth = growth.plus(jnp.log(square) * (time.value + value.h / 2))
        time = time.plus(value.h)
        current = growth.value / time.value
        # Trapezoidal rule, with Y(0) = 0 as the first `previous`.
        area = area.plus(value.h * (previous + current) / 2)
        return vector * lax.rsqrt(square), growth, current, area, time

    def finish(self, memory):
        *_, area, time = memory
        return area.value / time.value


class GALI(_FrameIndicator):
    r"""Observable: the generalised alignment indices GALI_2, …, GALI_k, shape (k − 1,).

        GALI_j = |ŵ_1 ∧ … ∧ ŵ_j|

    the volume spanned by the first j of k deviation vectors, each of length one. On a chaotic orbit
    GALI_j decreases as exp(−Σ_{i≤j} (λ_1 − λ_i) t); on a torus of n dimensions it is about constant
    for j ≤ n and decreases by powers of t above. The vectors are stored as an orthonormal frame and
    a triangular matrix, which is accurate down to the smallest number (1e-308); below it the value
    is 0. With ``log10=True`` the value is the logarithm, which has no such limit.

    **Arguments** `k`: number of vectors, 2 ≤ k ≤ 2N; `seed` of the first ones, which are random and
    orthogonal; `scale` as for `LyapunovSpectrum`.

    **Source** Skokos, Bountis & Antonopoulos 2007, *Physica D* 231, 30; the matrix: our own.
    """

    k: int = eqx.field(static=True, default=2, converter=_as_python_integer)
    seed: int = eqx.field(static=True, default=0)
    scale: Any = (1.0, 1.0)
    log10: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        whole("k of GALI", self.k, 2, hint="It is the number of deviation vectors.")

    def on_manifold(self, dimension):
        whole("k of GALI", self.k, 2, dimension, hint=_ON_MANIFOLD)
        return self

    def start(self, value):
        frame = self._first_frame(value, self.k)
        return frame, jnp.eye(self.k, dtype=value.dtype), _no_sum((self.k,), value.dtype)

    def update(self, memory, k, t, value):
        # The unit vectors are Q·(columns of C). Their part outside of the first j − 1 directions is
        # C_jj = exp(logs_j), which soon is negligible relative to the others but must not be lost.
        _, columns, logs = memory
        frame, R = _gram_schmidt(self._in_units(value.vectors))
        columns = jnp.sum(R[:, :, None] * columns[None, :, :], axis=1)
        shrink = lax.rsqrt(jnp.sum(columns**2, axis=0))
        return frame, columns * shrink[None, :], logs.plus(jnp.log(_diagonal(R) * shrink))

    def finish(self, memory):
        # The volume is the product of the diagonal, with 1 first. Logarithms do not underflow.
        logs = jnp.cumsum(memory[2].value)[1:]
        return logs / math.log(10) if self.log10 else jnp.exp(logs)


class SALI(_FrameIndicator):
    r"""Observable: the smaller alignment index, a number.

        SALI = min(|ŵ_1 + ŵ_2|, |ŵ_1 − ŵ_2|)

    of two deviation vectors: from √2 it decreases as exp(−(λ_1 − λ_2) t) on a chaotic orbit, and is
    about constant on a regular one of two or more degrees of freedom (on a closed curve, also of a
    map, it decreases as 1/t²). It is computed like `GALI`, down to 1e-308.

    **Arguments** as for `GALI`.

    **Source** Skokos 2001, *J. Phys. A* 34, 10029.
    """

    seed: int = eqx.field(static=True, default=0)
    scale: Any = (1.0, 1.0)
    log10: bool = eqx.field(static=True, default=False)

    @property
    def _pair(self) -> GALI:
        return GALI(2, self.seed, self.scale, log10=True)

    def start(self, value):
        return self._pair.start(value)

    def update(self, memory, k, t, value):
        return self._pair.update(memory, k, t, value)

    def finish(self, memory):
        # |ŵ_1 ∧ ŵ_2| = sin θ, and |ŵ_1 − ŵ_2| = 2 sin(θ/2) = sin θ √(2/(1 + |cos θ|)).
        log_sine = self._pair.finish(memory)[0]
        cosine = jnp.sqrt(jnp.maximum(1 - jnp.exp(2 * math.log(10) * log_sine), 0))
        log_sali = log_sine + jnp.log10(2 / (1 + cosine)) / 2
        return log_sali if self.log10 else jnp.exp(math.log(10) * log_sali)


def _gram_schmidt(vectors: Array) -> tuple[Array, Array]:
    """(Q, R), ``vectors[j] = Σ_i R[i, j] Q[i]``: Q orthonormal, R upper triangular, R_jj > 0."""
    # The modified process, row by row. Once is enough: the vectors are an orthonormal frame after
    # one step, far from dependent.
    count = vectors.shape[0]
    if count > _UNROLL_UP_TO:
        return _gram_schmidt_in_a_loop(vectors)
    frame, rows = [], []
    for i in range(count):
        v = vectors[0]
        square = jnp.sum(v**2)
        shrink = lax.rsqrt(square)
        unit = v * shrink
        projections = jnp.sum(vectors[1:] * unit[None, :], axis=1)
        rows.append(jnp.concatenate([jnp.zeros(i, v.dtype), (square * shrink)[None], projections]))
        frame.append(unit)
        vectors = vectors[1:] - projections[:, None] * unit[None, :]
    return jnp.stack(frame), jnp.stack(rows)


def _gram_schmidt_in_a_loop(vectors: Array) -> tuple[Array, Array]:
    """The same for many vectors: one program whatever their number."""
    count = vectors.shape[0]
    index = jnp.arange(count)

    def row(i, state):
        V, R = state
        square = jnp.sum(V[i] ** 2)
        shrink = lax.rsqrt(square)
        unit = V[i] * shrink
        projections = jnp.where(index > i, V @ unit, 0)
        V = (V - projections[:, None] * unit[None, :]).at[i].set(unit)
        return V, R.at[i].set(projections.at[i].set(square * shrink))

    return lax.fori_loop(0, count, row, (vectors, jnp.zeros((count, count), vectors.dtype)))


def _diagonal(R: Array) -> Array:
    # Single elements of a small matrix stay in registers of the machine code.
    count = R.shape[0]
    return jnp.stack([R[i, i] for i in range(count)]) if count <= _UNROLL_UP_TO else jnp.diagonal(R)
