"""`DriftBound`: what is proved about the change of invariants in each step."""

import json
import math
import os
from collections.abc import Sequence
from fractions import Fraction
from typing import Any

import equinox as eqx
import numpy as np

from ..base.checks import finite
from ..base.files import publish, user_path
from ..base.printing import first_lines


class DriftBound(eqx.Module):
    """Result of `bound_drift`: what is proved about the change of invariants in each step.

    For all states (q, p) of the domain and all ε of the interval, in one step of the map

        |I_k(q1, p1) − I_k(q0, p0)| ≤ per_step[k]                 in exact arithmetic,
                                    ≤ per_step[k] + rounding[k]   as computed.

    - `per_step`, `rounding`: [unit of the invariant]. `seen`: the largest change found at sample
      points of the boxes, a lower estimate of the least possible `per_step`.
    - `level`: (w, c): trajectories that start in the domain with Σ w_k I_k ≤ c stay in it for
      `steps` steps, exact or computed; None if that is not shown, and `reason` says why.
    - `start`: factor by which the domain is scaled about its middle so that all its states satisfy
      that. `change`: the change of Σ w_k I_k that `steps` steps exclude.
    - `start_time`: the time at which these trajectories start, if the map depends on the time: the
      begin of the interval if the steps go forwards, its end if they go backwards (h < 0, or ε < 0
      for a slow time), and a time between them for an interval of ε with both signs.
    - Of an angle (`periodic`) the domain is the circle, for computed states up to a largest |q|.
    - `boxes`: number of boxes of the proof. `formulas`: the invariants as text.
    - `certificate`: all that `dvi-jax verify` checks, see `save`.
    """

    per_step: tuple[float, ...] = eqx.field(static=True)
    rounding: tuple[float, ...] = eqx.field(static=True)
    seen: tuple[float, ...] = eqx.field(static=True)
    level: tuple[tuple[float, ...], float] | None = eqx.field(static=True)
    steps: int = eqx.field(static=True)
    start: float = eqx.field(static=True)
    change: float = eqx.field(static=True)
    boxes: int = eqx.field(static=True)
    reason: str = eqx.field(static=True)
    formulas: tuple[str, ...] = eqx.field(static=True)
    certificate: dict[str, Any] = eqx.field(static=True)

    @property
    def start_time(self) -> float:
        return float.fromhex(self.certificate["start"])

    def num_steps(self, change: float, invariant: int = 0) -> int | float:
        """The number of computed steps within which I_k changes by at most `change`, as long as
        the trajectory is in the domain; inf if it is conserved exactly, without rounding."""
        rate = self.per_step[invariant] + self.rounding[invariant]
        return math.floor(change / rate) if rate else math.inf

    def steps_inside(self, q0: Any, p0: Any, epsilon: float = 0.0) -> int:
        """The number of steps, exact or computed, within which the trajectory from this start is
        proved to stay in the domain; 0 if nothing is proved for it.

        - `q0`, `p0`: the start, with the shape that the domain has. If the map depends on the time,
          the start is at the time `start_time`. An angle may have made turns. `epsilon`: its ε.

        With C = Σ w_k I_k and the `level` (w, c), the trajectory is in the domain as long as
        C(q0, p0) + N Σ |w_k| (per_step[k] + rounding[k]) ≤ c + `steps` Σ |w_k| (…).

        **Raises** `ValueError` for an ε that is not in the interval of the proof.
        """
        exact, _ = tools()
        checker, x = exact.Checker(self.certificate), [*np.ravel(q0), *np.ravel(p0)]
        if not np.size(q0) == np.size(p0) == checker.n or not np.isfinite(x).all():
            raise ValueError(
                f"q0 and p0 must each have {checker.n} finite numbers, got {q0!r} and {p0!r}."
            )
        low, high = map(float, checker.epsilon)
        epsilon = finite("epsilon", epsilon)
        if not low <= epsilon <= high:
            raise ValueError(
                f"epsilon must be from {low!r} to {high!r} as in the proof, got {epsilon!r}."
            )
        if self.level is None:
            return 0
        start = exact.number(self.certificate["start"])
        point = [Fraction(float(v)) for v in (*x, start, epsilon)]
        algebra, zero = exact.Rounding(0), exact.ball(Fraction(0))
        state = [(exact.ball(v), zero) for v in point]
        n = checker.n
        lower = [-q or a for q, a in zip(checker.angles, checker.lower[:n], strict=True)]
        upper = [q or b for q, b in zip(checker.angles, checker.upper[:n], strict=True)]
        sides = zip(point, lower + checker.lower[n:], upper + checker.upper[n:], strict=False)
        margins = [g for g, _ in exact.run(checker.inside, state, algebra)]
        if not (all(a <= v <= b for v, a, b in sides) and all(g >= 0 for g in margins)):
            return 0
        weights, level = self.certificate["level"]
        level = exact.number(level)
        weights, per_step, rounding = (
            [exact.number(x) for x in row]
            for row in (weights, self.certificate["per_step"], self.certificate["rounding"])
        )
        rate = sum(abs(w) * (b + r) for w, b, r in zip(weights, per_step, rounding, strict=True))
        state.append(algebra.constant(checker.h))
        values = [exact.run(f, state, algebra)[0][0] for f in checker.invariants]
        value = sum(exact.ball(w) * v for w, v in zip(weights, values, strict=True))
        margin = level + self.steps * rate - Fraction(exact.round_up(value))
        steps = max(0, math.floor(margin / rate)) if rate else (2**62 if margin >= 0 else 0)
        # A computed angle grows, and its rounding is bounded up to a largest angle only.
        reach = [exact.number(x) for x in self.certificate["reach"][:n]]
        triples = [*zip(checker.angles, point, reach, strict=False)]
        steps = min([steps, *(int((q - abs(v)) / m) for q, v, m in triples if q and m)])
        rate = checker.h * (Fraction(float(epsilon)) if checker.slow else 1)
        end = checker.time[0] if rate < 0 else checker.time[1]
        if self.certificate["timed"] and rate:
            steps = min(steps, math.floor((end - start) / rate))
        return steps

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the certificate, a JSON file that ``dvi-jax verify`` checks."""
        publish(user_path("path", path), (json.dumps(self.certificate, indent=1) + "\n").encode())

    def __repr__(self) -> str:
        return first_lines(self.report(), "")

    def __str__(self) -> str:
        return self.report()

    def report(self) -> str:
        """What is proved, as text."""
        c = self.certificate
        low, high, quantum = (float.fromhex(x) for x in (*c["epsilon"], c["quantum"]))
        n = len(c["domain"][0]) // 2
        names = [f"{x}{i + 1 if n > 1 else ''}" for x in "qp" for i in range(n)]
        if c["timed"]:
            names.append("τ" if c["slow"] else "t")
        ends = [*zip(*c["domain"], strict=True), c["time"]]
        angles = [float.fromhex(x) for x in c.get("angles", [])] + [0.0] * len(names)
        sides = ", ".join(
            f"an angle {name}, |{name}| ≤ {angle:.3g} where it is computed"
            if angle
            else f"{name} in [{float.fromhex(a):.6g}, {float.fromhex(b):.6g}]"
            for name, (a, b), angle in zip(names, ends, angles, strict=False)
        )
        lines = [
            f"proved for each step from a state with {sides}"
            + (" and inside(q, p) ≥ 0" if c["inside"]["outputs"] else "")
            + f", for all ε in [{low:.6g}, {high:.6g}], h = {float.fromhex(c['h']):.6g}, "
            + f"computed in {c['arithmetic']} by {c['way']}"
            + (f" with increments on a grid of {quantum:.3g}:" if quantum else ":"),
            f"{'':4}{'change ≤':>10} {'seen':>9} {'rounding ≤':>10} "
            f"{'steps for ' + format(self.change, 'g'):>18}",
        ]
        for k, b in enumerate(self.per_step):
            lines.append(
                f"I_{k:<2}{b:10.2g} {self.seen[k]:9.2g} {self.rounding[k]:10.2g} "
                f"{self.num_steps(self.change, k):18.3g}"
            )
        if not any(self.num_steps(self.change, k) for k in range(len(self.per_step))):
            lines.append(
                f"no number of steps is proved: one step may already change each of them by more "
                f"than {self.change:g}"
            )
        if self.level is None:
            lines.append(f"it is not shown that trajectories stay in the domain: {self.reason}")
        else:
            weights, level = self.level
            text = f"no trajectory that starts in the domain with {combination(weights)} ≤ "
            text += f"{level:.6g} leaves it in {self.steps:.3g} steps"
            text += f" from {names[-1]} = {self.start_time:.6g}" if c["timed"] else ""
            if self.start:
                text += f"; all states of the domain scaled by {self.start:.3g} satisfy this"
            lines.append(text)
        lines.extend(f"I_{k} = {text}" for k, text in enumerate(self.formulas))
        return "\n".join(lines)


def tools() -> tuple[Any, Any]:
    try:
        from . import checker, search
    except ImportError as error:
        raise ImportError(
            f"proofs require python-flint, but its import failed ({error}): "
            'pip install "dvi-jax[proof]"'
        ) from error
    return checker, search


def combination(weights: Sequence[float]) -> str:
    """Σ w_k I_k as text."""
    terms = [
        (w, f"{abs(w):.4g} ".removeprefix("1 ") + f"I_{k}") for k, w in enumerate(weights) if w
    ]
    text = "".join(f" {'−' if w < 0 else '+'} {term}" for w, term in terms)
    return text.removeprefix(" + ").replace(" − ", "−", int(terms[0][0] < 0))
