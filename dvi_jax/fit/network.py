"""Unknown forces as networks of a potential and a damping."""

from collections.abc import Callable
from typing import Any, TypedDict, Unpack

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..base.checks import argument_names, function, one_of, positive, refuse_unknown, whole
from ..base.printing import printable
from ..base.types import Args, Scalar, State
from .checks import require_shape


class LayerSettings(TypedDict, total=False):
    """The layers of the networks of a `NetworkForce`."""

    width: int
    depth: int
    activation: Callable[..., Any]
    initial: float


def _momentum(q: Any, p: Any) -> Any:
    return p


@printable
class NetworkForce(eqx.Module):
    r"""A force from two networks: a potential and a damping.

        W(q, p) = −∇φ(q) − D(q, p) v,     D = L Lᵀ ≥ 0

    The second part never does positive work: −vᵀ D v ≤ 0 for all parameters.

    - `n`: q and p have shape (n,). `key`: of `jax.random`, for the initial weights.
    - `width`, `depth`: neurons of a hidden layer, and number of hidden layers, of each network, by
      default 8 and 2.
    - `conservative`, `dissipative`: which of the parts are present.
    - `damping_of`: ``"q"``, or ``"qp"`` for a D that depends on both.
    - `activation`: a smooth function. The force contains its derivative: with softplus, the
      default, it is a network of sigmoids.
    - `velocity`: function ``(q, p)`` → v, shape (n,), the q̇ = ∂H/∂p in the work. None means v = p,
      for masses 1, or any that are equal.
    - `scale_q`, `scale_p`: sizes of q and p: networks receive ``q / scale_q`` and
      ``p / scale_p``.
    - `initial`: initial scale of the last layers, by default 0.3, so that the force begins small.
      With much smaller values the earlier layers have no effect, and the least-squares problem is
      ill-conditioned.

    The module is a force, ``dvi.System(H_D, force=network)``, and its own parameters:

        model = lambda network: dict(system=dvi.System(H_D, force=network), q0=..., p0=...,
                                     h=0.1, epsilon=1.0)
        fit = dvi.fit(model, data, dvi.NetworkForce(2, key=jax.random.key(0)))

    and then ``fit.params`` is a `NetworkForce`. Up to 400 parameters (`size`) are fitted by
    Levenberg–Marquardt, which is far better here than gradient steps: take small networks. The
    data determine the force, but not single weights, and the fit reports these as undetermined.

    **Raises** `ValueError` or `TypeError` for invalid input; `ValueError`, when called, for q of
    another shape.

    **Source** Our own; potentials by networks, Greydanus, Dzamba & Yosinski 2019; D = L Lᵀ,
    Zhong, Dey & Chakraborty 2020, *Dissipative SymODEN*.
    """

    potential_net: eqx.nn.MLP | None
    damping_net: eqx.nn.MLP | None
    n: int = eqx.field(static=True)
    damping_of: str = eqx.field(static=True)
    scale_q: float = eqx.field(static=True)
    scale_p: float = eqx.field(static=True)
    velocity: Callable[..., Any] = eqx.field(static=True)

    def __init__(
        self,
        n: int,
        *,
        key: Array,
        conservative: bool = True,
        dissipative: bool = True,
        damping_of: str = "q",
        velocity: Callable[..., Any] | None = None,
        scale_q: float = 1.0,
        scale_p: float = 1.0,
        **layers: Unpack[LayerSettings],
    ):
        names = argument_names(NetworkForce)
        refuse_unknown("NetworkForce", NetworkForce, [n for n in layers if n not in names])
        if not (conservative or dissipative):
            raise ValueError("conservative and dissipative are both False: set one to True.")
        self.n = whole("n", n)
        self.damping_of = one_of("damping_of", damping_of, ("q", "qp"))
        self.scale_q, self.scale_p = positive("scale_q", scale_q), positive("scale_p", scale_p)
        self.velocity = function("velocity", _momentum if velocity is None else velocity)
        shape = whole("width", layers.get("width", 8)), whole("depth", layers.get("depth", 2))
        activation = function("activation", layers.get("activation", jax.nn.softplus))
        initial = positive("initial", layers.get("initial", 0.3))
        potential_key, damping_key = jax.random.split(key)
        self.potential_net = self.damping_net = None
        if conservative:
            # A constant of φ is no force: a bias there would be a parameter without effect.
            net = eqx.nn.MLP(n, 1, *shape, activation, use_final_bias=False, key=potential_key)
            self.potential_net = _with_last_layer(net, initial)
        if dissipative:
            inputs = n if damping_of == "q" else 2 * n
            net = eqx.nn.MLP(inputs, n * (n + 1) // 2, *shape, activation, key=damping_key)
            # D is quadratic in L and has no slope at L = 0: it begins at initial² on the diagonal.
            start = jnp.asarray(initial * np.eye(n)[np.tril_indices(n)])
            net = _with_last_layer(net, initial)
            self.damping_net = eqx.tree_at(lambda m: m.layers[-1].bias, net, start)

    def __call__(self, t0: Scalar, t1: Scalar, q0: State, p1: State, args: Args) -> State:
        """W(q0, p1): shape (n,), [energy / unit of q]; independent of times and args."""
        del t0, t1, args
        return self.conservative(q0) + self.dissipation(q0, p1)

    def potential(self, q: State) -> Scalar:
        """φ(q) − φ(0), a scalar [energy]; zero without this part."""
        q = self._vector(q)
        return self._phi(q) - self._phi(jnp.zeros_like(q))

    def conservative(self, q: State) -> State:
        """−∇φ(q), shape (n,)."""
        return -jax.grad(self._phi)(self._vector(q))

    def damping(self, q: State, p: State) -> Array:
        """D = L Lᵀ, symmetric and positive semidefinite, shape (n, n)."""
        L = self._factor(q, p)
        return L @ L.T

    def dissipation(self, q: State, p: State) -> State:
        """−D v, shape (n,)."""
        if self.damping_net is None:
            return jnp.zeros_like(self._vector(q))
        L = self._factor(q, p)
        return -L @ (L.T @ self.velocity(q, p))

    def power(self, q: State, p: State) -> Scalar:
        """Power of the damping, −vᵀ D v ≤ 0 [energy / time]."""
        return jnp.dot(self.velocity(q, p), self.dissipation(q, p))

    @property
    def size(self) -> int:
        """Number of parameters."""
        return sum(x.size for x in jax.tree.leaves(eqx.filter(self, eqx.is_inexact_array)))

    def _phi(self, q: Array) -> Array:
        if self.potential_net is None:
            return jnp.zeros((), q.dtype)
        return self.potential_net(q / self.scale_q)[0]

    def _factor(self, q: Array, p: Array) -> Array:
        """L, lower triangular."""
        q, p = self._vector(q), self._vector(p)
        if self.damping_net is None:
            return jnp.zeros((self.n, self.n), q.dtype)
        x = q / self.scale_q
        if self.damping_of == "qp":
            x = jnp.concatenate([x, p / self.scale_p])
        entries = self.damping_net(x)
        place = np.zeros((self.n, self.n), int)
        place[np.tril_indices(self.n)] = np.arange(len(entries))
        return jnp.where(np.tri(self.n, dtype=bool), entries[place], 0.0)

    def _vector(self, x: Any) -> Array:
        x = jnp.asarray(x)
        require_shape(f"q and p for dvi.NetworkForce({self.n}, ...)", x, (self.n,))
        return x


def _with_last_layer(net: eqx.nn.MLP, size: float) -> eqx.nn.MLP:
    """The network with the weights of its last layer times `size`."""
    return eqx.tree_at(lambda m: m.layers[-1].weight, net, replace_fn=lambda w: size * w)
