"""All measurements of a reproduction, with progress."""

from dataclasses import dataclass
from typing import Any

from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from . import discoveries, kepler, oscillator, theory


@dataclass(frozen=True)
class Measurements:
    """All measured data; figures, tables and verdicts are made from it."""

    fixed_mesh: oscillator.FixedMesh
    crossover: oscillator.Crossover
    small_step: oscillator.SmallStep
    mesh_sweep: kepler.MeshSweep
    small_step_sweep: kepler.SmallStepSweep
    long_runs: dict[str, kepler.LongRun]
    repulsion: dict[str, float]
    variational_mesh: dict[str, float]
    limits: dict[str, float]
    symmetries: dict[str, float]
    identities: dict[str, float]
    discoveries: dict[str, Any]


EXPERIMENTS = {
    "fixed_mesh": ("oscillator, h = 0.1", oscillator.fixed_mesh),
    "crossover": ("crossover with RK4", oscillator.crossover),
    "small_step": ("oscillator, h → 0", oscillator.small_step),
    "mesh_sweep": ("Kepler, sweep of ε and h", kepler.mesh_sweep),
    "small_step_sweep": ("Kepler, h → 0", kepler.small_step_sweep),
    "long_runs": ("Kepler, 100 000 steps", kepler.long_runs),
    "repulsion": ("Kepler, printed sign", kepler.repulsion),
    "variational_mesh": ("Kepler, variational mesh", kepler.variational_mesh),
    "limits": ("equations as h → 0", theory.limits),
    "symmetries": ("conformal factors", theory.symmetries),
    "identities": ("Noether identities", theory.identities),
    "discoveries": ("discovery of invariants", discoveries.discoveries),
}
"""Field of `Measurements` → label of its progress bar, and function that measures it."""


def measure(console) -> Measurements:
    """All `Measurements`, with a progress bar for each experiment on the given rich console."""
    columns = (
        TextColumn("{task.description:<26}"),
        BarColumn(bar_width=24),
        TextColumn("{task.percentage:>4.0f} %"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console) as progress:
        tasks = {
            key: progress.add_task(name, total=1.0, start=False)
            for key, (name, _) in EXPERIMENTS.items()
        }

        def run(key):
            progress.start_task(tasks[key])
            numbers = EXPERIMENTS[key][1](lambda part: progress.update(tasks[key], completed=part))
            progress.update(tasks[key], completed=1.0)
            return numbers

        return Measurements(**{key: run(key) for key in EXPERIMENTS})
