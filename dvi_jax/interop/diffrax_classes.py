"""Term and solver as classes of diffrax: the one file that imports it at the top."""

from typing import Any, ClassVar

import diffrax  # pyright: ignore[reportMissingImports]
import jax
from jaxtyping import Array

import dvi_jax as dvi

from .fields import as_pair, vector_field


class DiscreteTerm(diffrax.AbstractTerm):
    """A system and its ε as a term of diffrax; see `diffrax_term`."""

    system: dvi.System
    epsilon: Array

    def vf(self, t, y, args):
        return vector_field(self.system, self.epsilon)(t, y, args)

    def contr(self, t0, t1, **kwargs):
        return t1 - t0

    def prod(self, vf, control):
        return jax.tree.map(lambda rate: control * rate, vf)


class DiscreteMap(diffrax.AbstractSolver):
    """A method of the package as a solver of diffrax; see `diffrax_solver`."""

    method: dvi.Method
    root_finder: dvi.RootSolver

    term_structure: ClassVar[Any] = DiscreteTerm
    interpolation_cls: ClassVar[Any] = diffrax.ThirdOrderHermitePolynomialInterpolation

    def order(self, terms):
        del terms
        return self.method.order

    def init(self, terms, t0, t1, y0, args):
        del terms, t0, t1, args
        as_pair(y0)
        return None

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        del solver_state, made_jump
        q0, p0 = y0
        term, direction = term_and_direction(terms)
        # One step of `integrate`, so that its arithmetic and its status are the same.
        step = {"t0": direction * t0, "h": direction * (t1 - t0), "num_steps": 1, "args": args}
        options: Any = {"method": self.method, "root_finder": self.root_finder, "throw": False}
        options |= {"adjoint": dvi.Direct(), "epsilon": term.epsilon, "save": dvi.Save(final=True)}
        solution = dvi.integrate(term.system, q0, p0, **step, **options)
        y1 = type(y0)((solution.qs[-1], solution.ps[-1]))  # a pair of diffrax's kind
        slopes = {
            name: terms.prod(terms.vf(t, y, args), terms.contr(t0, t1))
            for name, t, y in (("k0", t0, y0), ("k1", t1, y1))
        }
        return y1, None, {"y0": y0, "y1": y1, **slopes}, None, diffrax_status(solution.result)

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)


def term_and_direction(terms: Any) -> tuple[DiscreteTerm, Any]:
    """The term itself and the direction of time, 1 or −1."""
    if isinstance(terms, DiscreteTerm):
        return terms, 1
    # diffrax always runs forwards, through a wrapper that gives the term −t where t1 < t0.
    return terms.term, terms.direction


def diffrax_status(result: dvi.RESULTS) -> Any:
    """The status of diffrax for one of ours."""
    theirs: Any = diffrax.RESULTS
    status: Any = theirs.nonlinear_divergence
    pairs = {
        "successful": theirs.successful,
        "not_converged": theirs.nonlinear_max_steps_reached,
        "not_finite": getattr(theirs, "nonfinite", theirs.nonlinear_divergence),
    }
    for name, other in pairs.items():
        status = theirs.where(result == getattr(dvi.RESULTS, name), other, status)
    return status
