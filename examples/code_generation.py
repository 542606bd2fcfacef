"""A picture of how `lanewise` turns a function of one trajectory into machine code.

Run: python examples/code_generation.py [FILE for the picture]
"""

import sys
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch, Rectangle

from dvi_jax import plot

mpl.use("Agg")

BOXES = [
    ((0.0, 4.9), "1  Function of one trajectory", """\
def run(q, p):
    def step(state, _):
        q, p = state
        p = p - 0.1 * q
        return (q + 0.1 * p, p), None
    return lax.scan(
        step, (q, p), None, length=1000)[0]""",
     "JAX traces it once; the result is a jaxpr."),
    ((8.0, 4.9), "2  Components: numbers, no arrays", """\
repeat 1000 times with (q, p):
    g = 0.1 * q
    h = p - g      ->  h = fma(-0.1, q, p)
    i = 0.1 * h
    j = q + i      ->  j = fma( 0.1, h, q)
    (q, p) = (j, h)""",
     "Zeros by structure are left out; one fixed rule\nmakes fused multiply-adds (fma)."),
    ((0.0, 0.0), "3  LLVM IR for a block of U·W trajectories", """\
loop:
  %q = phi <8 x double> [%q.0, ...], [%j, ...]
  %p = phi <8 x double> [%p.0, ...], [%h, ...]
  %h = call <8 x double> @llvm.fma(
           -0.1, %q, %p)
  %j = call <8 x double> @llvm.fma(
            0.1, %h, %q)""",
     "W trajectories are one vector (here 8), U vectors\na block. The state stays in registers."),
]  # fmt: skip
"""(left lower corner, title, code, what happens there)."""

WIDTH, HEIGHT = 7.3, 4.2
THREADS = [0, 1, 1, 0, 1, 0, 0, 1, 0, 1, 1, 0]
"""Which thread has claimed each block: whichever was free."""


def box(axis, corner, title, note):
    x, y = corner
    axis.add_patch(
        FancyBboxPatch(
            (x, y),
            WIDTH,
            HEIGHT,
            boxstyle="round,pad=0,rounding_size=0.15",
            facecolor="#f7f7f7",
            edgecolor="#555555",
            linewidth=1.0,
        )
    )
    axis.text(x + 0.25, y + HEIGHT - 0.2, title, va="top", weight="bold", size=11.5)
    axis.text(x + 0.25, y + 0.2, note, va="bottom", size=10.5, color="#333333")


def handler(axis, corner):
    """The call from XLA, and the blocks that two threads claim."""
    x, y = corner
    note = "Each thread of XLA's pool takes the next block when\nit has finished one."
    box(axis, corner, "4  Handler: called by XLA, shares blocks", note)
    axis.text(
        x + 0.3,
        y + HEIGHT - 0.85,
        "one batch, cut into blocks:",
        va="top",
        size=10.5,
        color="#333333",
    )
    side = (WIDTH - 0.6) / len(THREADS)
    for i, thread in enumerate(THREADS):
        axis.add_patch(
            Rectangle(
                (x + 0.3 + i * side, y + 2.05),
                0.85 * side,
                0.7,
                facecolor=plot.COLOURS[thread],
                edgecolor="none",
            )
        )
    for thread in (0, 1):
        left = x + 0.3 + 3.2 * thread
        axis.add_patch(Rectangle((left, y + 1.3), 0.35, 0.35, facecolor=plot.COLOURS[thread]))
        axis.text(left + 0.5, y + 1.47, f"thread {thread + 1}", va="center", size=10.5)


def picture(file: Path) -> Path:
    """Draw the picture into a file."""
    with plot.style():
        figure, axis = plt.subplots(figsize=(10.0, 6.1))
        axis.set(xlim=(-0.1, 15.4), ylim=(-0.1, 9.2))
        axis.axis("off")
        for corner, title, code, note in BOXES:
            box(axis, corner, title, note)
            axis.text(
                corner[0] + 0.3,
                corner[1] + HEIGHT - 0.85,
                code,
                va="top",
                size=9.8,
                family="monospace",
                linespacing=1.35,
            )
        handler(axis, (8.0, 0.0))
        for start, end in [
            ((7.3, 7.0), (8.0, 7.0)),
            ((8.6, 4.9), (6.7, 4.2)),
            ((7.3, 2.1), (8.0, 2.1)),
        ]:
            axis.add_patch(
                FancyArrowPatch(
                    start, end, arrowstyle="-|>", mutation_scale=16, color="#222222", linewidth=1.5
                )
            )
        return plot.save(figure, file)


if __name__ == "__main__":
    print(f"written: {picture(Path(sys.argv[1] if len(sys.argv) > 1 else 'code_generation.png'))}")
