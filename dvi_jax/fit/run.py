"""What is common to all stages of a fit: the steps that are left, its history, its file."""

import hashlib
import os
import re
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._files import publish_npz, read_npz
from .optimise import Position, Record
from .problem import Problem
from .progress import FitProgress

_EVERY = 5.0
"""Seconds between checkpoints."""

_FORMAT = 2

_VECTORS = ("base", "scale", "z")
_LISTS = ("leaves", "extra")
_COLUMNS = ("stage", "horizon", "loss", "step", "accepted", "x")
"""What a checkpoint has of `Position` and of each `Record` as arrays."""


class Run:
    """The steps of a fit as they are taken: kept, shown, written to a checkpoint."""

    def __init__(
        self,
        problem: Problem,
        max_steps: int,
        tolerance: float,
        show: Callable[[FitProgress], None] | None,
        began: float,
        checkpoint: str | os.PathLike[str] | None,
        identity: str,
    ):
        self.problem, self.max_steps, self.tolerance = problem, max_steps, tolerance
        self._show, self.began, self._file, self._identity = show, began, checkpoint, identity
        self.records: list[Record] = []
        self.resume: Position | None = None
        self._saved = time.monotonic()
        if checkpoint is not None:
            file = Path(checkpoint)
            if not file.parent.is_dir():
                raise FileNotFoundError(f"there is no directory for the checkpoint {file}.")
            if file.is_dir():
                raise IsADirectoryError(f"checkpoint must be a file, {file} is a directory.")
            if file.exists():
                self.resume, self.records = _read_checkpoint(file, identity)

    @property
    def left(self) -> int:
        """How many steps may still be taken."""
        return self.max_steps - len(self.records)

    def take_resume(self) -> Position | None:
        """The position to go on from, once."""
        found, self.resume = self.resume, None
        return found

    def watch(self, record: Record, position: Position) -> None:
        """A step was taken."""
        x = np.asarray(self.problem.space.to_x(jnp.asarray(record.x[: self.problem.size])))
        record.x = x
        self.records.append(record)
        if self._file is not None and time.monotonic() - self._saved > _EVERY:
            try:
                _write_checkpoint(self._file, self._identity, position, self.records)
            except OSError as error:  # no reason to lose the fit as well
                warnings.warn(
                    f"the checkpoint cannot be written ({error}). The fit goes on and tries again; "
                    "a checkpoint that was written before is unchanged.",
                    stacklevel=2,
                )
            self._saved = time.monotonic()
        if self._show is not None:
            of_step = len(self.records), self.max_steps, record.stage, record.horizon, record.loss
            names, seconds = list(self.problem.space.names), time.monotonic() - self.began
            self._show(FitProgress(*of_step, x, names, seconds))

    def history(self) -> dict[str, np.ndarray]:
        """The records as arrays."""
        found = {name: np.array([getattr(r, name) for r in self.records]) for name in _COLUMNS}
        return {**found, "x": found["x"].reshape(-1, self.problem.size)}


def identity(problem: Problem, u: np.ndarray, *of: Any) -> str:
    """What a checkpoint is known by: data, names, start and settings."""
    settings = re.sub(r" at 0x[0-9a-f]+", "", repr((problem.space.names, problem.loss, *of)))
    digest = hashlib.sha256(settings.encode())
    digest.update(np.ascontiguousarray(u).tobytes())
    known = eqx.filter((problem.space, problem.core.model), eqx.is_array_like)
    for leaf in jax.tree.leaves(known):
        digest.update(np.ascontiguousarray(leaf).tobytes())
    for group in problem.groups:
        for array in (group.ts, group.values, group.seen, group.whiten, group.t0):
            digest.update(np.ascontiguousarray(array).tobytes())
        digest.update(repr((group.num_steps, group.block)).encode())
    return digest.hexdigest()


def _write_checkpoint(path: Any, identity: str, at: Position, records: list[Record]) -> None:
    about = {"identity": identity, **vars(at)}
    arrays = {name: about.pop(name) for name in _VECTORS}
    for name in _LISTS:
        arrays |= {f"{name}.{i}": np.asarray(x) for i, x in enumerate(about[name])}
        about[name] = len(about[name])
    arrays |= {f"record.{n}": np.array([getattr(r, n) for r in records]) for n in _COLUMNS}
    publish_npz(path, _FORMAT, about, arrays)


def _read_checkpoint(path: Any, identity: str) -> tuple[Position, list[Record]]:
    about, arrays = read_npz(path, _FORMAT, "checkpoint of a fit")
    if about.get("identity") != identity:
        raise ValueError(
            f"the checkpoint {path} is of another fit (data, parameters, their start or settings "
            "differ). Give another file, or remove this one to begin again."
        )
    position = Position(
        *(about[name] for name in ("stage", "horizon", "done")),
        *(arrays[name] for name in _VECTORS),
        *([arrays[f"{name}.{i}"] for i in range(about[name])] for name in _LISTS),
        memory=tuple(about["memory"]),
        status=about["status"],
    )
    columns = [arrays[f"record.{n}"] for n in _COLUMNS]
    return position, [
        Record(int(s), float(h), float(loss), float(step), bool(a), x)
        for s, h, loss, step, a, x in zip(*columns, strict=True)
    ]
