"""Where the results of a sweep go: arrays in memory, or a directory with arrays in zarr.

In a store each task has one shard in each array. A shard is written under another name, forced to
the disk and renamed. The task's record, which has the sizes and checksums of its shards, follows in
the same way. A task is done when its record and the shards listed there exist. If a process dies,
at any moment, finished tasks are therefore whole and the others are computed again.
"""

import contextlib
import errno
import json
import os
import time
import warnings
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..base.files import TEMPORARY, content_of, publish, user_folder
from ..base.keywords import user_level
from ..base.machine import machine_memory
from ..base.results import STATUS_NAMES
from .claims import claim
from .identity import FORMAT, differences, digest
from .layout import STATUS, TASKS, StoreError as StoreError, as_store_error, make, shard, storable
from .plan import SweepPlan, SweepTask
from .variables import Variable

CLAIMS = ".claims"

_SHARE = 0.5  # Fraction of the memory of the machine that results in memory may take
_RESTORE = (
    "If this is a store, its zarr.json was damaged or lost, but the results are in other files: "
    "restore it from a backup, or copy it from a new store (the same call with another path, "
    "stopped after its first task)."
)


class StoreMismatch(StoreError, ValueError):
    """Raised for the store of another sweep; `differing` lists the differences."""

    def __init__(self, message: str, differing: list[str]):
        super().__init__(message)
        self.differing = differing


class Verification(NamedTuple):
    """Result of `verify`: number of sound tasks; bad ones (number → damage), which count as not
    computed from then on; number of tasks that have to be computed."""

    sound: int
    bad: dict[int, str]
    todo: int


class MemorySink:
    """Results as arrays in memory. **Raises** `ValueError` if they are too large for it."""

    def __init__(self, plan: SweepPlan, variables: Mapping[str, Variable]):
        _check_memory(plan.lanes * sum(variable.bytes for variable in variables.values()))
        self.plan, self.variables = plan, dict(variables)
        shape = plan.shape
        self.arrays = {n: np.full(shape + v.shape, v.fill, v.dtype) for n, v in variables.items()}
        self._done_tasks: set[int] = set()

    def done_tasks(self):
        return set(self._done_tasks)

    def is_done(self, number: int) -> bool:
        return number in self._done_tasks

    def claim(self, task: SweepTask) -> contextlib.AbstractContextManager[bool]:
        return contextlib.nullcontext(True)

    def commit(self, task: SweepTask, results: Mapping[str, np.ndarray], facts: Mapping) -> None:
        for name, x in results.items():
            self.arrays[name][task.box] = x
        self._done_tasks.add(task.number)


class Store:
    """The directory of a sweep."""

    def __init__(self, path: Path, attributes: Mapping[str, Any]):
        self.path, self.attributes = path, attributes
        self.config = json.loads(attributes["config"])
        self.sha = attributes["config_sha256"]
        if digest(self.config) != self.sha:
            raise ValueError("config does not match config_sha256")
        dict(json.loads(attributes.get("units", "{}")))  # raises what is wrong with the units
        self.plan = SweepPlan(dict(self.config["dims"]), tuple(self.config["chunk"]))
        self.variables = {
            name: Variable(dtype, tuple(shape), tuple(dims))
            for name, (dtype, shape, dims) in self.config["variables"].items()
        }
        self._arrays: dict[str, Any] = {}

    # --- opening ----------------------------------------------------------------------------

    @classmethod
    def open(cls, path: str | os.PathLike) -> "Store":
        """The store in a directory. **Raises** `StoreError`."""
        path = _store_path(path)
        with as_store_error(path, "zarr.json cannot be read"):
            has_tasks = (path / TASKS).is_dir()
            if not (path / "zarr.json").exists():
                remedy = _RESTORE if has_tasks else "Check the path: there is no sweep here."
                raise StoreError(f"{path}: the file zarr.json does not exist. {remedy}")
            text = content_of(path / "zarr.json")
        if not has_tasks:
            raise StoreError(
                f"{path} has no directory {TASKS}, which a store must have: copy also the files "
                "whose names begin with a dot."
            )
        try:
            attributes = json.loads(text)["attributes"]
            if (file_format := attributes["dvi_jax_sweep"]) != FORMAT:
                raise StoreError(
                    f"{path}: the store has format {file_format!r}, but must have {FORMAT}. Use "
                    f"dvi-jax {attributes.get('dvi-jax', '(unknown version)')}, which made it."
                )
            store = cls(path, attributes)
        except (AttributeError, KeyError, TypeError, ValueError, RecursionError) as error:
            raise StoreError(
                f"{path}: zarr.json does not describe a sweep ({type(error).__name__}: {error}). "
                f"{_RESTORE}"
            ) from None
        for name in store.variables:
            store.array(name)
        return store

    @classmethod
    def open_or_make(
        cls,
        path: str | os.PathLike,
        config: Mapping[str, Any],
        variables: Mapping[str, Variable],
        coordinates: Mapping[str, Any],
        attributes: Mapping[str, Any],
    ) -> "Store":
        """The store of exactly this sweep, made if nothing is there. **Raises** `StoreError`."""
        path = _store_path(path)
        if not path.exists() or (path.is_dir() and not any(path.iterdir())):
            make(path, config, variables, coordinates, attributes)
        elif not any((path / name).exists() for name in ("zarr.json", TASKS)):
            raise StoreError(f"{path} exists but is not the store of a sweep: choose a new path.")
        store = cls.open(path)
        if store.sha != digest(config):
            source, differing = store.attributes, differences(store.config, config)
            raise StoreMismatch(
                f"{path} holds another sweep ({source.get('created')}, dvi-jax "
                f"{source.get('dvi-jax')}, jax {source.get('jax')}). Differences (there: in the "
                "store; now: in this call):" + "".join(f"\n  {line}" for line in differing) + "\n"
                "Use another path, or the arguments, functions and versions of that sweep.",
                differing,
            )
        if not os.access(path / TASKS, os.W_OK):
            raise StoreError(
                f"{path} cannot be written by this user: change its permissions. To read it call "
                "dvi.open_sweep."
            )
        store._restore(coordinates)
        return store

    # --- arrays -------------------------------------------------------------------------------

    def array(self, name: str) -> Any:
        """The zarr array of a variable. **Raises** `StoreError` where it is not as configured."""
        if name in self._arrays:
            return self._arrays[name]
        variable = self.variables[name]
        shape, dtype = (*self.plan.shape, *variable.shape), np.dtype(variable.dtype)
        try:
            array = self._group()[name]
            if (array.shape, array.dtype) != (shape, dtype):
                raise ValueError(f"shape {array.shape} and dtype {array.dtype}")
        except Exception as error:  # zarr has many errors for damaged metadata
            raise StoreError(
                f"{self.path}: zarr.json must describe the array {name!r} with shape {shape} and "
                f"dtype {dtype} ({type(error).__name__}: {error}). {_RESTORE}"
            ) from None
        self._arrays[name] = array
        return array

    def read(self, name: str, number: int, box: tuple[Any, ...]) -> np.ndarray:
        """A part of a variable that lies in one task. **Raises** `StoreError` if it is damaged."""
        array = self.array(name)
        try:
            return array.get_orthogonal_selection(box)
        except Exception as error:  # codecs have many errors for bytes that they cannot decode
            raise StoreError(
                f"{self.shard_path(name, number)} is damaged or cannot be read ({error}). Call "
                f"dvi.open_sweep({str(self.path)!r}).verify(), then repeat the sweep."
            ) from error

    def coordinates(self) -> dict[str, Any]:
        """name → (dims, values, attributes) of all coordinates. **Raises** `StoreError`."""
        names = [name for name, _ in self._group().arrays() if name not in self.variables]
        return {name: self._coordinate(name) for name in names}

    def _group(self, mode: Any = "r") -> Any:
        import zarr

        return zarr.open_group(self.path, mode=mode, zarr_format=3)

    def _coordinate(self, name: str) -> tuple[Any, np.ndarray, dict[str, Any]]:
        try:
            array = self._group()[name]
            # There is one chunk. zarr would read a missing chunk as zeros.
            file = self.path.joinpath(name, "c", *("0" for _ in array.shape))
            if not file.is_file():
                raise FileNotFoundError(errno.ENOENT, "no such file", str(file))
            values = array[:]
        except Exception as error:  # codecs have many errors for bytes that they cannot decode
            raise StoreError(
                f"{self.path}: the coordinate {name!r} cannot be read ({error}). The same call of "
                "dvi.sweep writes it again."
            ) from error
        if values.dtype.kind == "T":
            values = np.asarray(values.tolist())
        return getattr(array.metadata, "dimension_names", None), values, dict(array.attrs)

    def _restore(self, coordinates: Mapping[str, Any]) -> None:
        """Write coordinates again that are missing or damaged."""
        import zarr

        for name, (_, values, _) in coordinates.items():
            try:
                self._coordinate(name)
            except StoreError:
                with (
                    as_store_error(self.path, f"the coordinate {name!r} cannot be written again"),
                    zarr.config.set({"array.write_empty_chunks": True}),
                ):
                    self._group("r+")[name][...] = storable(values)

    # --- tasks --------------------------------------------------------------------------------

    def record_path(self, number: int) -> Path:
        return self.path / TASKS / f"{number // 1000:06d}" / f"{number:09d}.json"

    def shard_path(self, name: str, number: int) -> Path:
        place = (*self.plan.place(number), *(0 for _ in self.variables[name].shape))
        return self.path.joinpath(name, "c", *map(str, place))

    def record(self, number: int) -> dict[str, Any] | None:
        """The record of a task that is done, else None."""
        record = self._read_record(number)
        return None if record is None or self._damage(number, record, size_only=True) else record

    def _read_record(self, number: int) -> dict[str, Any] | None:
        """The record of a task as it was written; None if it is missing or damaged."""
        try:
            text = content_of(self.record_path(number))
        except OSError:
            return None
        body, _, checksum = text.rstrip(b"\n").rpartition(b"\n")
        if checksum != _crc32(body).encode():
            return None
        try:  # it may have been edited, together with its checksum
            record, task = json.loads(body), self.plan.task(number)
            head = self._head(task)
            counts, shards = record["statuses"], record["shards"]
            is_of_task = (
                {key: record[key] for key in head} == head
                and all(shards[name].keys() >= {"bytes", "crc32"} for name in self.variables)
                and counts.keys() <= set(STATUS_NAMES)
                and sum(counts.values()) == task.lanes
            )
        except (AttributeError, KeyError, TypeError, ValueError, RecursionError):
            return None
        return record if is_of_task else None

    def _head(self, task: SweepTask) -> dict[str, Any]:
        start, size = list(task.start), list(task.size)
        return {"task": task.number, "start": start, "size": size, "config_sha256": self.sha}

    def _damage(self, number: int, record: Mapping, size_only: bool) -> tuple[Path, str] | None:
        """The first shard of a task that differs from its record, and how."""
        for name in self.variables:
            file, facts = self.shard_path(name, number), record["shards"][name]
            try:
                size = file.stat().st_size
                content = b"" if size_only else content_of(file)
            except OSError as error:
                return file, f"the shard of {name} cannot be read ({error.strerror})"
            if size != facts["bytes"]:
                return file, f"the shard of {name} has {size} bytes"
            # The checksum of the whole file: the codecs would accept the shard of another task.
            if not size_only and _crc32(content) != facts["crc32"]:
                return file, f"the shard of {name} has another checksum"
        return None

    def _records(self) -> dict[int, Path]:
        """Number of a task → the file of its record. Other files, such as those that macOS creates
        next to each file, are ignored."""
        files = (f for f in (self.path / TASKS).glob("*/*.json") if f.stem.isdecimal())
        numbers = sorted((int(f.stem), f) for f in files)
        return {i: f for i, f in numbers if i < self.plan.num_tasks and f == self.record_path(i)}

    def done_tasks(self):
        """The numbers of finished tasks, in order. Warns of those that have lost a file."""
        records = {i: self._read_record(i) for i in self._records()}
        damages = {i: self._damage(i, x, size_only=True) for i, x in records.items() if x}
        if files := [damage[0] for damage in damages.values() if damage]:
            warnings.warn(
                f"{self.path}: for {len(files)} of {len(damages)} finished tasks, a file is "
                f"missing, unreadable or of the wrong size; the first is {files[0]}. These tasks "
                "count as not computed: dvi.sweep with the same arguments computes them again.",
                stacklevel=user_level(),
            )
        return [i for i, damage in damages.items() if not damage]

    def is_done(self, number: int) -> bool:
        return self.record(number) is not None

    @contextlib.contextmanager
    def claim(self, task: SweepTask) -> Iterator[bool]:
        with claim(self.path / CLAIMS, task.number) as mine:
            yield mine and not self.is_done(task.number)

    def commit(self, task: SweepTask, results: Mapping[str, np.ndarray], facts: Mapping) -> None:
        """Write the results of a task; it is done once this returns."""
        failure = f"task {task.number} cannot be written"
        remedy = " Then repeat the call: it continues after the finished tasks."
        shards = {}
        with as_store_error(self.path, failure, remedy):
            for name in sorted(results, key=lambda n: n == STATUS):
                content = shard(self.plan, self.variables[name], task, results[name])
                publish(self.shard_path(name, task.number), content)
                shards[name] = {"bytes": len(content), "crc32": _crc32(content)}
            body = json.dumps({**self._head(task), "shards": shards, **facts}).encode()
            publish(self.record_path(task.number), body + f"\n{_crc32(body)}\n".encode())

    def verify(self, progress: Any = None) -> Verification:
        """Compare every shard of every finished task with its record. Records of bad tasks are
        removed, so that the next run computes these tasks again."""
        bad: dict[int, str] = {}
        files = self._records()
        for n, (number, file) in enumerate(files.items()):
            record = self._read_record(number)
            damage = None if record is None else self._damage(number, record, size_only=False)
            if record is None or damage:
                bad[number] = damage[1] if damage else "the record is damaged"
                file.unlink()
            if progress is not None:
                progress(n + 1, len(files))
        # Files that processes which died had begun to write; no write takes an hour.
        latest = time.time() - 3600
        for file in self.path.rglob(f"*{TEMPORARY}"):
            with contextlib.suppress(OSError):
                if file.stat().st_mtime < latest:
                    file.unlink()
        sound = len(files) - len(bad)
        return Verification(sound, bad, self.plan.num_tasks - sound)


def _check_memory(size: int) -> None:
    """**Raises** `ValueError` if the results are too large for the memory of the machine."""
    memory = machine_memory()
    available = memory or 8 * 2**30
    if size > _SHARE * available:
        raise ValueError(
            f"the results need {size / 2**30:.2f} GiB, more than {_SHARE:.0%} of the "
            f"{available / 2**30:.2f} GiB of memory{'' if memory else ' (assumed)'}: give "
            "store=..., a directory."
        )


def _store_path(path: str | os.PathLike) -> Path:
    try:
        absolute = user_folder("store", path).resolve()
        absolute.exists()
    except NotADirectoryError as error:
        raise StoreError(str(error)) from None
    except (OSError, ValueError, RuntimeError) as error:
        raise StoreError(
            f"{os.fspath(path)!r:.80} cannot be the path of a store "
            f"({getattr(error, 'strerror', None) or error}): give a path that you may access."
        ) from None
    return absolute


def _crc32(content: bytes) -> str:
    return f"{zlib.crc32(content):08x}"
