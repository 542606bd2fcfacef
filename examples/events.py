"""Events: bounces of a ball, an orbit in Sinai's billiard, and the map of the stadium.

Left: heights of a ball for three coefficients of restitution; the bounces accumulate at a finite
time. Middle: an orbit between the walls and the disc of Sinai's billiard. Right: place and
direction of the reflections of one orbit in the stadium.

Run: python examples/events.py [DIRECTORY for the picture]
"""

import sys
from pathlib import Path

import jax
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np

import dvi_jax as dvi
from dvi_jax import systems

jax.config.update("jax_enable_x64", True)
mpl.use("Agg")


def draw_ball(axes):
    for restitution in (1.0, 0.8, 0.5):
        sol = dvi.integrate(
            systems.bouncing_ball(restitution), h=0.02, num_steps=450, method="strang", throw=False
        )
        (line,) = axes.plot(sol.ts, sol.qs[:, 0], lw=1, label=f"e = {restitution}")
        n = min(int(sol.jumps.count), len(sol.jumps.ts))
        axes.plot(sol.jumps.ts[:n], 0 * sol.jumps.ts[:n], ".", color=line.get_color(), ms=5)
        print(f"e = {restitution}: {int(sol.jumps.count)} bounces, {sol.status}")
    axes.set(xlabel="t", ylabel="height", title="bouncing ball", ylim=(-0.05, 1.25))
    axes.legend(frameon=False, ncols=3, loc="upper center", fontsize="small")


def draw_orbit(axes):
    sol = dvi.integrate(systems.sinai_billiard(), h=0.5, num_steps=120)
    n = int(sol.jumps.count)
    points = np.concatenate([sol.qs[:1], sol.jumps.qs_before[:n]])
    axes.plot(*points.T, "C0", lw=0.7)
    angle = np.linspace(0, 2 * np.pi, 200)
    axes.fill(0.5 * np.cos(angle), 0.5 * np.sin(angle), color="0.8")
    axes.plot([-1, 1, 1, -1, -1], [-1, -1, 1, 1, -1], "k", lw=1)
    axes.set(aspect="equal", xticks=[], yticks=[], title=f"Sinai's billiard, {n} reflections")
    axes.axis("off")


def draw_stadium(axes):
    sol = dvi.integrate(systems.stadium(max_jumps=6000), num_steps=20000, save=dvi.Save(final=True))
    n = int(sol.jumps.count)
    (x, y), p = np.asarray(sol.jumps.qs_after[:n]).T, np.asarray(sol.jumps.ps_after[:n])
    # Arc length from the right end of the upper line, anticlockwise: both lines have length 2.
    right, left = np.arctan2(y, x - 1) % (2 * np.pi), np.arctan2(y, x + 1) % (2 * np.pi)
    cap = np.where(x > 1, (right + np.pi / 2) % (2 * np.pi) - np.pi, left - np.pi / 2 + 2)
    s = np.where(np.abs(x) > 1, cap, np.where(y > 0, 1 - x, np.pi + 3 + x))
    middle = np.stack([np.clip(x, -1, 1), 0 * y], axis=1)
    normal = np.stack([x, y], axis=1) - middle
    sine = normal[:, 0] * p[:, 1] - normal[:, 1] * p[:, 0]
    axes.plot(s, sine, "k.", ms=0.8)
    axes.set(xlabel="place along the wall", ylabel="sine of the angle", title="stadium")
    print(f"stadium: {n} reflections, speed {np.sqrt(np.sum(p[-1] ** 2)):.12f}")


def main():
    fig, axes = plt.subplots(1, 3, figsize=(10, 3.2), layout="constrained")
    draw_ball(axes[0])
    draw_orbit(axes[1])
    draw_stadium(axes[2])
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
    fig.savefig(folder / "events.png", dpi=110)
    print(f"picture: {folder / 'events.png'}")


if __name__ == "__main__":
    main()
