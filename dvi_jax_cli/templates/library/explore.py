# %% [markdown]
# # {{title}}
#
# The system `{{system}}` of the library: one trajectory, and what it conserves.

# %%
import jax

import dvi_jax as dvi
from dvi_jax import plot, systems

jax.config.update("jax_enable_x64", True)  # invariants need double precision

problem = systems.LIBRARY["{{system}}"]()
print(problem)

# %%
settings = {"h": problem.h, "args": problem.args, "method": dvi.TypeII(), "epsilon": 0.0}
drifts = {name: dvi.MaxDrift(f) for name, f in problem.observables.items()}
start, save = (problem.q0, problem.p0), dvi.Save(every=10)
solution = dvi.integrate(
    problem.system, *start, num_steps=2000, save=save, observe=drifts, **settings
)
print(solution.status, solution.observed)

# %%
plot.trajectory(solution.ts, solution.qs, solution.ps)
