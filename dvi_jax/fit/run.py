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

_FORMAT = 1


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
        if checkpoint is not None and not Path(checkpoint).parent.is_dir():
            raise FileNotFoundError(f"there is no directory for the checkpoint {checkpoint}.")
        if checkpoint is not None and Path(checkpoint).is_dir():
            raise IsADirectoryError(f"checkpoint must be a file, {checkpoint} is a directory.")
        if checkpoint is not None and Path(checkpoint).exists():
            self.resume, self.records = _read_checkpoint(checkpoint, identity)

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
            self._show(
                FitProgress(
                    len(self.records), self.max_steps, record.stage, record.horizon, record.loss,
                    x, list(self.problem.space.names), time.monotonic() - self.began,
                )
            )  # fmt: skip

    def history(self) -> dict[str, np.ndarray]:
        """The records as arrays."""
        names = ("stage", "horizon", "loss", "step", "accepted")
        found = {name: np.array([getattr(r, name) for r in self.records]) for name in names}
        return {**found, "x": np.array([r.x for r in self.records]).reshape(-1, self.problem.size)}


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
    arrays = {"base": at.base, "scale": at.scale, "z": at.z}
    arrays |= {f"leaf.{i}": x for i, x in enumerate(at.leaves)}
    arrays |= {f"extra.{i}": np.asarray(x) for i, x in enumerate(at.extra)}
    for name in ("stage", "horizon", "loss", "step", "accepted", "x"):
        arrays[f"record.{name}"] = np.array([getattr(r, name) for r in records])
    about = {
        "identity": identity, "stage": at.stage, "horizon": at.horizon,
        "done": at.done, "memory": list(at.memory), "status": at.status,
        "leaves": len(at.leaves), "extra": len(at.extra),
    }  # fmt: skip
    publish_npz(path, _FORMAT, about, arrays)


def _read_checkpoint(path: Any, identity: str) -> tuple[Position, list[Record]]:
    about, arrays = read_npz(path, _FORMAT, "checkpoint of a fit")
    if about.get("identity") != identity:
        raise ValueError(
            f"the checkpoint {path} is of another fit (data, parameters, their start or settings "
            "differ). Give another file, or remove this one to begin anew."
        )
    position = Position(
        about["stage"], about["horizon"], about["done"], arrays["base"], arrays["scale"],
        arrays["z"], [arrays[f"leaf.{i}"] for i in range(about["leaves"])],
        [arrays[f"extra.{i}"] for i in range(about["extra"])],
        tuple(about["memory"]), about["status"],
    )  # fmt: skip
    columns = [arrays[f"record.{n}"] for n in ("stage", "horizon", "loss", "step", "accepted", "x")]
    records = [
        Record(int(s), float(h), float(value), float(step), bool(a), x)
        for s, h, value, step, a, x in zip(*columns, strict=True)
    ]
    return position, records
