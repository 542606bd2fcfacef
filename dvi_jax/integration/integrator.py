"""The options of an integration as one object, for every function that runs trajectories."""

from typing import Any

import equinox as eqx

from lanewise import Layout

from ..base.checks import instance
from ..base.keywords import accept_newton
from ..engine.newton import RootSolver
from ..engine.picard import PicardThenNewton
from ..lattices import Given, Lattice, Uniform
from ..methods import Method, Rattle, Splitting, Strang, TypeII, as_method
from ..problem.discretise import is_first_order
from ..problem.split import Split
from ..problem.system import System
from .adjoints import AbstractAdjoint
from .arithmetic import Arithmetic, Compensated, FloatingPoint
from .reversible import Reversible


@accept_newton
class Integrator(eqx.Module):
    """The options of an integration: the keywords of `integrate` that are not the problem itself.

    - `method`: see `integrate`. None: the map that the user wrote, `TypeII()`; for a system with
      `discretise(H, order=1)`, whose map has order one, `Strang()`; with a `Split`, `Splitting()`;
      with a constraint, `Rattle()`.
    - `root_finder`: the solver of implicit steps. Here and in `integrate` `newton` is another name
      of it; both at once raise a `TypeError`.
    - `lattice`: the time grid. `arithmetic`: the representation of the state.
    - `layout`: machine code or arrays. `adjoint`: the computation of reverse-mode gradients.

    `integrate`, `sweep`, `Model` (for `fit`), `poincare_section`, `bifurcation`, `ReturnMap`,
    `tangent_map`, `invariant_diffusion`, `drift_order`, `drift_surface`, `discover_invariants`,
    `find_symmetries` and `solution_pairs` accept it as `integrator=`. The last three examine one
    step; they raise an error for fields without an effect there that are not the defaults. `sweep`
    computes no gradients and does not use `adjoint`.

    **Raises** `TypeError` for a field of another type.

    **Example**

    ```python
    accurate = dvi.Integrator(method=dvi.KahanLi(8), arithmetic=dvi.Compensated())
    kepler = systems.kepler()
    sol = dvi.integrate(kepler.system, kepler.q0, kepler.p0, args=kepler.args, h=0.1, num_steps=100,
                        integrator=accurate)
    print(sol.status)
    # successful
    ```
    """

    method: Method | None = eqx.field(default=None, converter=as_method)
    root_finder: RootSolver = PicardThenNewton()
    lattice: Lattice = Uniform()
    arithmetic: Arithmetic = FloatingPoint()
    layout: Layout = Layout()
    adjoint: AbstractAdjoint = Reversible()

    def __check_init__(self):
        for name, (kind, hint) in _FIELDS.items():
            value = getattr(self, name)
            if name != "method" or value is not None:
                instance(name, value, kind, f"an instance of dvi.{kind.__name__}", f"Take {hint}.")

    @property
    def newton(self) -> RootSolver:
        """Another name of `root_finder`."""
        return self.root_finder

    def method_for(self, system: System) -> Method:
        """The method, or the default for this system. **Raises** `ValueError` for options that do
        not fit a constraint, or its absence."""
        method = default_method(system) if self.method is None else self.method
        has_constraint = system.constraint is not None
        # By the class, as in `steps_of`: a bound method of a module takes 20 µs to make.
        if not type(method).takes(method, has_constraint):
            raise ValueError(
                "a system with a constraint needs method=dvi.Rattle() or a composition of it, with "
                f"noise dvi.BAOAB() or dvi.OBABO(), got {method!r}."
                if has_constraint
                else f"method={method!r} needs a constraint: give dvi.System(H_D, constraint=g), "
                "or another method."
            )
        # By type: `TimeTransformed` is a `Uniform` that takes other equations.
        plain = {"lattice": (Uniform, Given), "arithmetic": (FloatingPoint, Compensated)}
        for name, kinds in plain.items() if has_constraint else ():
            if type(value := getattr(self, name)) not in kinds:
                choices = " or ".join(f"dvi.{kind.__name__}" for kind in kinds)
                raise ValueError(f"a system with a constraint needs {name}={choices}, got {value}.")
        return method


_FIELDS = {
    "method": (Method, "one such as dvi.Strang()"),
    "lattice": (
        Lattice,
        "dvi.Uniform(), dvi.Given(ts), dvi.AdaptiveReversible(g), dvi.TimeTransformed(g) or "
        "dvi.Variational()",
    ),
    "adjoint": (AbstractAdjoint, "dvi.Reversible(), dvi.Checkpointed() or dvi.Direct()"),
    "root_finder": (RootSolver, "dvi.Newton(), dvi.SimplifiedNewton() or dvi.Picard()"),
    "arithmetic": (
        Arithmetic,
        "dvi.FloatingPoint(), dvi.Compensated(), dvi.DoubleDouble() or dvi.FixedPoint(quantum)",
    ),
    "layout": (Layout, 'dvi.Layout() or dvi.Layout(form="arrays")'),
}

# Made once: a new one in every call would take some ten microseconds.
_DEFAULT, _STRANG, _TYPE_II = Integrator(), Strang(), TypeII()


def default_method(system: System) -> Method:
    """The method of a run without `method`."""
    if system.constraint is not None:
        return Rattle()
    # A map of order one that `discretise` made was not chosen by the user, and Strang's composition
    # of it has order two. A map that the user wrote stays as it is.
    if isinstance(system.H_D, Split):
        return Splitting()
    method = getattr(system.H_D, "own_method", None)
    if isinstance(method, Method):
        return method
    return _STRANG if is_first_order(system.H_D) else _TYPE_II


def chosen(integrator: Integrator | None = None, **options: Any) -> Integrator:
    """The integrator of a call: the object, or one made of single options (None: not given).
    **Raises** `TypeError` for another object, `ValueError` for both."""
    options = {name: value for name, value in options.items() if value is not None}
    if integrator is None:
        return Integrator(**options) if options else _DEFAULT
    instance("integrator", integrator, Integrator, "a dvi.Integrator(...)")
    if options:
        names = ", ".join(options)
        raise ValueError(
            f"{names} and integrator cannot be given together: set {names} in dvi.Integrator(...)."
        )
    return integrator


def only(integrator: Integrator, function: str, *names: str) -> Integrator:
    """The integrator. **Raises** `ValueError` for a field that is not used and not the default."""
    # Otherwise an option without effect would be ignored without a word.
    for name in _FIELDS:
        value, default = getattr(integrator, name), getattr(_DEFAULT, name)
        if name not in names and not eqx.tree_equal(value, default):
            raise ValueError(
                f"{function} does not use {name}, got an integrator with {name}={value!r:.200}. It "
                f"uses only {' and '.join(names)}."
            )
    return integrator
