r"""Prey and predators of Lotka and Volterra, canonical in logarithmic populations.

    dx/dt = x (α − β y),    dy/dt = y (δ x − γ)

The system is Hamiltonian with the bracket {x, y} = xy, which is canonical in q = ln x and p = ln y.
Every map then leaves the populations positive.
"""

import jax.numpy as jnp
import numpy as np

from ._problem import Parameter, Problem, Start, library_problem


def hamiltonian(t0, t1, q0, p1, args):
    """H_D = α p1 − β exp p1 + γ q0 − δ exp q0; separable."""
    alpha, beta, gamma, delta = (args[name] for name in ("alpha", "beta", "gamma", "delta"))
    return jnp.sum(alpha * p1 - beta * jnp.exp(p1) + gamma * q0 - delta * jnp.exp(q0))


def populations(t0, t1, q0, p0, q1, p1, args):
    """Populations (x, y) of prey and predators at t1, shape (2,) + q.shape."""
    return jnp.stack(to_populations(q1, p1))


def to_populations(q, p):
    """Populations x = exp q of prey and y = exp p of predators; any shapes."""
    return jnp.exp(jnp.asarray(q)), jnp.exp(jnp.asarray(p))


def from_populations(x, y):
    """q = ln x and p = ln y of populations of prey and predators, NumPy; any shapes.

    **Raises** `ValueError` for populations that are not positive.
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    for name, number in (("x of prey", x), ("y of predators", y)):
        if not (positive := number > 0).all():
            value = number[~positive][0]
            raise ValueError(f"the population {name} must be positive, got {value}.")
    return np.log(x), np.log(y)


def equilibrium(args):
    """The equilibrium (γ/δ, α/β); small oscillations about it have the period 2π/√(αγ)."""
    return args["gamma"] / args["delta"], args["alpha"] / args["beta"]


def lotka_volterra() -> Problem:
    """Predators and prey: hares and lynxes in thousands, time in years, a cycle of 9.9 years.

    Rates and the initial 33.9 and 5.9 thousand are ours, close to fits to the pelts of 1900–1920
    (Carpenter 2018, *Predator–Prey Population Dynamics: the Lotka–Volterra model in Stan*).

    **Source** Lotka 1925, *Elements of Physical Biology*; Volterra 1926, *Mem. Acad. Lincei Roma*
    2, 31; canonical form: Hairer, Lubich & Wanner 2006, I.1.1 and VII.2.
    """
    q0, p0 = from_populations([33.9], [5.9])
    return library_problem(
        hamiltonian,
        Start("q0 and p0 are the logarithms of one prey and one predator population", (1,)),
        name="lotka_volterra",
        q0_p0_h=(q0, p0, 0.05),
        parameters={
            "alpha": Parameter(0.55, "growth of prey [1/year]"),
            "beta": Parameter(0.028, "prey eaten, for each predator [1/(year thousand)]"),
            "gamma": Parameter(0.84, "death of predators [1/year]"),
            "delta": Parameter(0.026, "growth of predators, for each prey [1/(year thousand)]"),
        },
        observables=[populations],
        units={"q": "ln(thousands)", "p": "ln(thousands)", "t": "year", "energy": "1/year"},
        source="Volterra 1926, Mem. Acad. Lincei Roma 2, 31; Hairer, Lubich & Wanner 2006, I.1.1",
    )
