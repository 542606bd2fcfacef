# %% [markdown]
# # {{title}}
#
# The system `{{system}}` of the library: one trajectory, and what it keeps.

# %%
import jax

import dvi_jax as dvi
from dvi_jax import plot, systems

jax.config.update("jax_enable_x64", True)  # invariants need double precision

problem = systems.LIBRARY["{{system}}"]()
print(problem)

# %%
solution = dvi.integrate(
    problem.system,
    problem.q0,
    problem.p0,
    h=problem.h,
    num_steps=2000,
    epsilon=0.0,
    args=problem.args,
    method=dvi.TypeII(),
    save=dvi.Save(every=10),
    observe={name: dvi.MaxDrift(f) for name, f in problem.observables.items()},
)
print(solution.status, solution.observed)

# %%
plot.trajectory(solution.ts, solution.qs, solution.ps)
