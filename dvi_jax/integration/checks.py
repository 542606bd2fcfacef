"""Which runs may have noise, and the path of such a run."""

import jax
from jaxtyping import Array

from lanewise.jaxprs.jaxapi import is_traced

from ..lattices import Lattice, Run
from ..methods import Method
from ..observe import Section, is_observable
from ..problem.noise import BrownianPath, NoisePath
from .arithmetic import Compensated, FloatingPoint
from .integrator import Integrator


def noise_path(
    run: Run, path: BrownianPath | None, how: Integrator, method: Method, h: Array, num_steps: int
) -> NoisePath | None:
    """The path for a run, None without noise. **Raises** `ValueError` if they do not fit."""
    noise = run.system.noise
    if noise is None and path is None:  # nearly every run
        return None
    observed = jax.tree.leaves(run.observe, is_leaf=is_observable)
    stops = run.save.ts is not None or run.stop is not None
    adapts = how.lattice.has_memory or type(how.lattice).transform is not Lattice.transform
    # What the user has to change first comes first.
    wrong = {
        "path has no effect, because the system has no noise: leave path out, or give noise= in "
        "dvi.System.": noise is None,
        "path must be given for a system with noise: path=dvi.Brownian(jax.random.key(0)), or an "
        "integer, the seed of a key.": path is None,
        f"method={method!r:.200} is not a method for systems with noise. Use dvi.BAOAB() or "
        "dvi.OBABO() for noise on the momenta, dvi.StochasticEuler() or dvi.StochasticMidpoint() "
        "for every kind of noise.": not method.increments,
        # The path would not be independent of the state.
        f"lattice={how.lattice!r:.200} cannot be used with noise, because its steps depend on the "
        "state. Use dvi.Uniform() or dvi.Given(ts).": adapts,
        f"arithmetic={how.arithmetic!r:.200} cannot be used with noise. Use dvi.FloatingPoint() "
        "or dvi.Compensated().": not isinstance(how.arithmetic, FloatingPoint | Compensated),
        f"h must be positive for a system with noise, got h={h}.": not is_traced(h) and not h > 0,
        # Between the ends of a step the path is not known.
        "dvi.Save(ts=...), dvi.Stop and dvi.Section cannot be used with noise, because they need "
        "states within a step. Use dvi.Save(every=m) and a reduction such as dvi.Range.": stops
        or any(isinstance(f, Section) for f in observed),
    }
    if found := [why for why, is_so in wrong.items() if is_so]:
        raise ValueError(found[0])
    assert noise is not None
    assert path is not None
    path.check(num_steps)
    return NoisePath(path, method.increments, noise.count(run.t0, run.q0, run.p0, run.args))
