"""The steps of a fit as they are taken: how many remain, their history, the checkpoint."""

import hashlib
import os
import re
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..base.files import publish_npz, read_npz, user_file, user_path
from ..base.keywords import user_level
from ..base.printing import printable
from ..base.progress import bar_of, reporter
from ..base.reads import reads
from ..base.tables import Table
from .checks import same_fit
from .optimise import Position, Record, StageTask
from .problem import FitProblem

_INTERVAL = 5.0  # Seconds between checkpoints
_FORMAT = 3

_VECTORS = ("base", "scale", "z")
_LISTS = ("leaves", "extra")
"""Fields of `Position` that a checkpoint has as arrays; the others are in its header."""


@printable
@dataclass(frozen=True)
class FitProgress:
    """Progress of a fit: `step` of the optimiser of at most `max_steps`, the `stage` and its
    `horizon`, the `loss`, the parameters `x` with their `names`, `seconds` since the fit began."""

    step: int
    max_steps: int
    stage: int
    horizon: float
    loss: float
    x: np.ndarray
    names: list[str]
    seconds: float


def _bar_columns(p: FitProgress) -> dict[str, Any]:
    first = [f"{n} {v:.7g}" for n, v in zip(p.names[:3], p.x[:3], strict=True)]
    return {
        "description": f"fit, stage {p.stage + 1}",
        "total": p.max_steps,
        "completed": p.step,
        "steps": f"{p.step}/{p.max_steps}",
        "loss": f"loss {p.loss:.5g}",
        "params": ", ".join(first + ["…"] * (len(p.names) > 3)),
    }


def progress_display(progress: Any) -> Any:
    """A context whose value takes a `FitProgress`: the user's function, a bar's, or None."""
    return reporter(progress, bar_of("fit", ("steps", "loss", "params"), _bar_columns))


@dataclass
class FitRun:
    """A fit in progress.

    - `show`: a function of the progress, or None. `began`: when, for the seconds shown.
    - `checkpoint`: a file or None, recognised by `identity`. `resume`: its position, until the
      first stage has continued from it.
    """

    problem: FitProblem
    max_steps: int
    tolerance: float
    show: Callable[[FitProgress], None] | None
    began: float
    checkpoint: str | os.PathLike[str] | None
    identity: str
    records: list[Record] = field(default_factory=list)
    resume: Position | None = None
    save_time: float = field(default_factory=time.monotonic)

    def __post_init__(self):
        if self.checkpoint is not None:
            file = self.checkpoint = user_path("checkpoint", self.checkpoint)
            if not file.parent.is_dir():
                raise FileNotFoundError(
                    f"there is no directory for checkpoint={str(file)!r}: create it."
                )
            if file.is_dir():
                raise IsADirectoryError(
                    f"checkpoint={str(file)!r} is a directory: give the path of a file in it."
                )
            if file.exists():
                user_file("checkpoint", file)
                self.resume, self.records = _read_checkpoint(file, self.identity)

    @property
    def left(self) -> int:
        """How many steps remain."""
        return self.max_steps - len(self.records)

    def task(self, stage: int, horizon: float, tolerance: float, limit: int | None) -> StageTask:
        """The next stage, of at most `limit` steps, which continues from the checkpoint once."""
        resume, self.resume = self.resume, None
        count = 0 if resume is None else resume.done
        steps = count + self.left
        if limit is not None:
            steps = min(max(limit, count), steps)
        return StageTask(stage, horizon, steps, tolerance, self.watch, resume)

    def watch(self, record: Record, position: Position) -> None:
        """A step was taken."""
        x = np.asarray(self.problem.space.to_x(jnp.asarray(record.x[: self.problem.size])))
        self.records.append(record._replace(x=x))
        if self.checkpoint is not None and time.monotonic() - self.save_time > _INTERVAL:
            try:
                _write_checkpoint(self.checkpoint, self.identity, position, self.records)
            except OSError as error:  # no reason to lose the fit as well
                warnings.warn(
                    f"the checkpoint {self.checkpoint} cannot be written. The fit continues and "
                    "tries again later. If an earlier checkpoint exists, it is unchanged. Cause: "
                    f"{error}.",
                    stacklevel=user_level(),
                )
            self.save_time = time.monotonic()
        if self.show is not None:
            numbers = len(self.records), self.max_steps, record.stage, record.horizon, record.loss
            names, seconds = list(self.problem.space.names), time.monotonic() - self.began
            self.show(FitProgress(*numbers, x, names, seconds))

    def history(self) -> dict[str, np.ndarray]:
        """The records as arrays."""
        columns = _columns(self.records)
        return Table({**columns, "x": columns["x"].reshape(-1, self.problem.size)})


def _columns(records: list[Record]) -> dict[str, np.ndarray]:
    return {name: np.array([getattr(r, name) for r in records]) for name in Record._fields}


def identity(problem: FitProblem, u: np.ndarray, *settings_of_call: Any) -> str:
    """Hash by which a checkpoint is recognised: data, names, start and settings."""
    # The repr of an optax optimiser does not contain its numbers: its functions read them.
    marks = reads(problem.core.model, *settings_of_call)
    read = [(name, mark) for name, mark in marks if mark[0] == "value"]
    settings = repr((problem.space.names, problem.loss, *settings_of_call, read))
    settings = re.sub(r" at 0x[0-9a-f]+", "", settings)
    groups = [(g.ts, g.values, g.mask, g.whiten, g.t0, g.period, g.events) for g in problem.groups]
    steps = [(group.num_steps, group.block) for group in problem.groups]
    arrays = eqx.filter((u, problem.space, problem.core.model, groups), eqx.is_array_like)
    digest = hashlib.sha256((settings + repr(steps)).encode())
    for leaf in jax.tree.leaves(arrays):
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()


def _write_checkpoint(path: Any, identity: str, position: Position, records: list[Record]) -> None:
    header = {"identity": identity, **vars(position)}
    arrays = {name: header.pop(name) for name in _VECTORS}
    for name in _LISTS:
        arrays |= {f"{name}.{i}": np.asarray(x) for i, x in enumerate(header[name])}
        header[name] = len(header[name])
    arrays |= {f"record.{name}": column for name, column in _columns(records).items()}
    publish_npz(path, _FORMAT, header, arrays)


def _read_checkpoint(path: Any, identity: str) -> tuple[Position, list[Record]]:
    header, arrays = read_npz(path, _FORMAT, "checkpoint of a fit")
    same_fit(header.get("identity") == identity, "data, model, parameters, start or settings")
    fields = {name: header[name] for name in Position.__dataclass_fields__ if name in header}
    fields |= {name: arrays[name] for name in _VECTORS}
    fields |= {name: [arrays[f"{name}.{i}"] for i in range(header[name])] for name in _LISTS}
    # As numbers of Python: records of a continued fit go into the next checkpoint with new ones.
    *plain, xs = (arrays[f"record.{name}"] for name in Record._fields)
    rows = zip(*(column.tolist() for column in plain), xs, strict=True)
    return Position(**fields), [Record(*row) for row in rows]
