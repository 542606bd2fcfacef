"""Which runs may have noise, and the path of such a run."""

import jax

from ._arithmetic import Compensated, FloatingPoint
from ._integrator import Integrator
from .lattices import Given, Run, Uniform
from .methods import Method
from .noise import NoisePath, Path
from .observe import Section, is_observable


def noise_path(
    run: Run, path: Path | None, integrator: Integrator, method: Method, num_steps: int
) -> NoisePath | None:
    """The path for a run, None without noise. **Raises** `ValueError` if they do not fit."""
    noise = run.system.noise
    if noise is None:
        if path is None:
            return None
        raise ValueError(
            "path has no effect, because the system has no noise: leave path out, or give "
            "noise=... in dvi.System."
        )
    if path is None:
        raise ValueError(
            "path must be given for a system with noise: path=dvi.Brownian(jax.random.key(0)), or "
            "an integer, the seed of a key."
        )
    if not method.noises:
        raise ValueError(
            f"method={method!r:.200} is not a method for systems with noise. Use dvi.BAOAB() or "
            "dvi.OBABO() for noise on the momenta, dvi.StochasticEuler() or "
            "dvi.StochasticMidpoint() for every kind of noise."
        )
    if not isinstance(integrator.lattice, Uniform | Given):
        raise ValueError(
            f"lattice={integrator.lattice!r:.200} cannot be used with noise, because its steps "
            "depend on the state. Use dvi.Uniform() or dvi.Given(ts)."
        )
    if not isinstance(integrator.arithmetic, FloatingPoint | Compensated):
        raise ValueError(
            f"arithmetic={integrator.arithmetic!r:.200} cannot be used with noise. Use "
            "dvi.FloatingPoint() or dvi.Compensated()."
        )
    leaves = jax.tree.leaves(run.observe, is_leaf=is_observable)
    has_section = any(isinstance(f, Section) for f in leaves)
    # Between the ends of a step the path is not known.
    if run.save.ts is not None or run.stop is not None or has_section:
        raise ValueError(
            "dvi.Save(ts=...), dvi.Stop and dvi.Section cannot be used with noise, because they "
            "need states within a step. Use dvi.Save(every=m) and a reduction such as dvi.Range."
        )
    count = noise.count(run.t0, run.q0, run.p0, run.args)
    path.check(num_steps, method.noises)
    return NoisePath(path, method.noises, count)
