"""A sweep on disk: labelled arrays in zarr, and a record of every task that is done.

Each task has one shard in each array. A shard is written under another name, forced to the disk and
renamed; then the task's record is, which names the shards with their sizes and checksums. A task
is done when its record is there, and the shards that it names: whatever dies, at whatever moment,
leaves done tasks whole and the others to be done again.
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

from .._files import TEMPORARY, publish
from .._results import STATUS_NAMES
from .claims import claim
from .identity import FORMAT, differences, digest
from .layout import STATUS, TASKS, make, shard, storable
from .plan import Plan, Task
from .sinks import Sink, StoreError as StoreError, as_store_error
from .variables import Variable

CLAIMS = ".claims"
_RESTORE = (
    "Restore the file from a backup, or copy it from a store that the same call of dvi.sweep makes "
    "elsewhere: that call may be stopped as soon as its progress is shown. The results are in the "
    "arrays beside the file."
)


class StoreMismatch(StoreError, ValueError):
    """A store that holds another sweep; `differing` names what differs."""

    def __init__(self, message: str, differing: list[str]):
        super().__init__(message)
        self.differing = differing


class Verification(NamedTuple):
    """What `verify` found: tasks that are sound, bad ones (number → what is wrong; they are open
    again), and how many are left to do."""

    sound: int
    bad: dict[int, str]
    todo: int


class Store(Sink):
    """The directory of a sweep."""

    def __init__(self, path: Path, attributes: Mapping[str, Any]):
        self.path = path
        self.attributes = attributes
        self.config = json.loads(attributes["config"])
        self.sha = attributes["config_sha256"]
        if digest(self.config) != self.sha:
            raise ValueError("the configuration does not have its checksum")
        dict(json.loads(attributes.get("units", "{}")))  # what is wrong is raised here
        self.plan = Plan(dict(self.config["dims"]), tuple(self.config["chunk"]))
        self.variables = {
            name: Variable(dtype, tuple(shape), tuple(dims))
            for name, (dtype, shape, dims) in self.config["variables"].items()
        }
        self._arrays: dict[str, Any] = {}

    # --- opening ----------------------------------------------------------------------------

    @classmethod
    def open(cls, path: str | os.PathLike) -> "Store":
        """The store in a directory.

        **Raises** `StoreError` where there is none, or none that this version can read.
        """
        path = _located(path)
        try:
            attributes = json.loads((path / "zarr.json").read_text())["attributes"]
            if not (path / TASKS).is_dir():
                raise StoreError(
                    f"{path}: the directory {TASKS}, with the records of tasks, is missing: was "
                    "the store copied without the names that begin with a point?"
                )
            if (found := attributes["dvi_jax_sweep"]) != FORMAT:
                raise StoreError(
                    f"{path}: the store has format {found}, this version reads {FORMAT}: use the "
                    f"version that made it ({attributes.get('dvi-jax', 'unknown')})."
                )
            store = cls(path, attributes)
        except FileNotFoundError:
            lost = f" The file was lost. {_RESTORE}" if (path / TASKS).is_dir() else ""
            raise StoreError(f"{path}: there is no sweep here (no zarr.json).{lost}") from None
        except OSError as error:
            raise StoreError(
                f"{path}: zarr.json cannot be read ({error.strerror or error}): look after its "
                "permissions and the disk."
            ) from None
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise StoreError(
                f"{path}: zarr.json cannot be read as that of a sweep ({error!r}): it is damaged "
                f"or was edited. {_RESTORE}"
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
        """The store of this very sweep in a directory, made if there is nothing there.

        **Raises** `StoreMismatch` if it holds another sweep; `StoreError` for a directory that
        holds something else, or cannot be written.
        """
        path = _located(path)
        if path.exists() and (not path.is_dir() or any(path.iterdir())):
            if not any((path / name).exists() for name in ("zarr.json", TASKS)):
                raise StoreError(
                    f"{path}: exists, and is no sweep: give a path that does not exist yet."
                )
        else:
            make(path, config, variables, coordinates, attributes)
        store = cls.open(path)
        if store.sha != digest(config):
            differing = differences(store.config, config)
            made = store.attributes
            raise StoreMismatch(
                f"{path} holds another sweep. Different are:\n  " + "\n  ".join(differing) + "\n"
                f"(made {made.get('created')} with dvi-jax {made.get('dvi-jax')}, jax "
                f"{made.get('jax')}). Give another store, or the arguments of that one.",
                differing,
            )
        if not os.access(path / TASKS, os.W_OK):
            raise StoreError(
                f"{path}: cannot be written by this user: results would be lost. Give another "
                "store, or change its permissions; dvi.open_sweep(path) reads it."
            )
        store._restore(coordinates)
        return store

    # --- arrays -------------------------------------------------------------------------------

    def array(self, name: str) -> Any:
        """The zarr array of one variable.

        **Raises** `StoreError` where the store does not describe it as its configuration does.
        """
        if name in self._arrays:
            return self._arrays[name]
        variable = self.variables[name]
        shape, dtype = (*self.plan.shape, *variable.shape), np.dtype(variable.dtype)
        try:
            found: Any = self._group()[name]
            if (found.shape, found.dtype) == (shape, dtype):
                self._arrays[name] = found
                return found
            seen = f"shape {found.shape} and dtype {found.dtype}, not {shape} and {dtype}"
        except Exception as error:  # whatever zarr says of metadata that are no longer its own
            seen = repr(error)
        raise StoreError(
            f"{self.path}: zarr.json does not describe the array {name!r} of this sweep ({seen}). "
            f"It is damaged or was edited. {_RESTORE}"
        )

    def read(self, name: str, number: int, where: tuple[Any, ...]) -> np.ndarray:
        """A part of a variable that lies in one task.

        **Raises** `StoreError` with the file for one that cannot be decoded.
        """
        try:
            return self.array(name).get_orthogonal_selection(where)
        except StoreError:
            raise
        except Exception as error:  # whatever a codec says of bytes that it cannot take
            raise StoreError(
                f"{self.shard_path(name, number)}: is damaged ({error}). Open its task again with "
                "dvi.open_sweep(path).verify(); then the same call of dvi.sweep computes it."
            ) from error

    def coordinates(self) -> dict[str, Any]:
        """name → (dims, values, attributes) of all coordinates.

        **Raises** `StoreError` for one that is missing or damaged.
        """
        names = [name for name, _ in self._group().arrays() if name not in self.variables]
        return {name: self._coordinate(name) for name in names}

    def _group(self) -> Any:
        import zarr

        return zarr.open_group(self.path, mode="r", zarr_format=3)

    def _coordinate(self, name: str) -> tuple[Any, np.ndarray, dict[str, Any]]:
        try:
            array: Any = self._group()[name]
            # One chunk. Of a chunk that is not there zarr would say that it is full of zeros.
            file = self.path.joinpath(name, "c", *("0" for _ in array.shape))
            if not file.exists():
                raise FileNotFoundError(errno.ENOENT, "no such file", str(file))
            values: Any = array[:]
        except Exception as error:  # whatever a codec says of bytes that it cannot take
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
                    group: Any = zarr.open_group(self.path, mode="r+", zarr_format=3)
                    group[name][...] = storable(values)

    # --- tasks --------------------------------------------------------------------------------

    def record_path(self, number: int) -> Path:
        return self.path / TASKS / f"{number // 1000:06d}" / f"{number:09d}.json"

    def record(self, number: int) -> dict[str, Any] | None:
        """What was committed of a task that is done. None: it has no record, a damaged one, or one
        that names a shard which is not there in full."""
        found = self._written(number)
        return found if found is not None and self._lacking(number, found) is None else None

    def _lacking(self, number: int, record: Mapping[str, Any]) -> Path | None:
        """The first shard of a task that is missing or has another size than its record says."""
        for name in self.variables:
            file = self.shard_path(name, number)
            try:
                is_there = file.stat().st_size == record["shards"][name]["bytes"]
            except OSError:
                is_there = False
            if not is_there:
                return file
        return None

    def _written(self, number: int) -> dict[str, Any] | None:
        """The record of a task as it was written; None if there is none or it is damaged."""
        try:
            text = self.record_path(number).read_bytes()
        except OSError:
            return None
        body, _, checksum = text.rstrip(b"\n").rpartition(b"\n")
        if checksum != _crc32(body).encode():
            return None
        try:
            found, task = json.loads(body), self.plan.task(number)
            counts = found["statuses"]
            is_of_task = (
                (found["config_sha256"], found["task"]) == (self.sha, number)
                and (tuple(found["start"]), tuple(found["size"])) == (task.start, task.size)
                and all(
                    found["shards"][name].keys() >= {"bytes", "crc32"} for name in self.variables
                )
                and counts.keys() <= set(STATUS_NAMES)
                and sum(counts.values()) == task.lanes
            )
        except (AttributeError, KeyError, TypeError, ValueError):  # edited, with its checksum
            return None
        return found if is_of_task else None

    def _records(self) -> dict[int, Path]:
        """Number of a task → the file of its record. Other files, such as those that macOS leaves
        beside each file, are nobody's record."""
        named = (f for f in (self.path / TASKS).glob("*/*.json") if f.stem.isdecimal())
        found = {int(f.stem): f for f in named}
        mine = (i for i in sorted(found) if i < self.plan.num_tasks)
        return {i: found[i] for i in mine if found[i] == self.record_path(i)}

    def done(self):
        """The numbers of finished tasks, in order. Warns of those that have lost a file."""
        written = ((i, self._written(i)) for i in self._records())
        lacking = {i: self._lacking(i, found) for i, found in written if found is not None}
        if lost := [file for file in lacking.values() if file is not None]:
            warnings.warn(
                f"{self.path}: {len(lost)} of the finished tasks lack a file (missing or of "
                f"another size: {lost[0]}). They count as not computed; the same call of "
                "dvi.sweep computes them again.",
                stacklevel=2,
            )
        return [i for i, file in lacking.items() if file is None]

    def is_done(self, number):
        return self.record(number) is not None

    @contextlib.contextmanager
    def claimed(self, task) -> Iterator[bool]:
        with claim(self.path / CLAIMS, task.number) as mine:
            yield mine and not self.is_done(task.number)

    def shard_path(self, name: str, number: int) -> Path:
        place = self.plan.place(number)
        own = (0,) * len(self.variables[name].shape)
        return self.path.joinpath(name, "c", *(str(k) for k in (*place, *own)))

    def commit(self, task, results, facts):
        what = f"task {task.number} cannot be written"
        then = " What was finished before is kept; once there is room, the same call goes on."
        with as_store_error(self.path, what, then):
            self._commit(task, results, facts)

    def _commit(self, task: Task, results: Mapping[str, np.ndarray], facts: Mapping) -> None:
        shards = {}
        for name in sorted(results, key=lambda n: n == STATUS):
            content = shard(self.plan, self.variables[name], task, results[name])
            publish(self.shard_path(name, task.number), content)
            shards[name] = {"bytes": len(content), "crc32": _crc32(content)}
        record = {
            "task": task.number,
            "start": task.start,
            "size": task.size,
            "shards": shards,
            "config_sha256": self.sha,
            **facts,
        }
        body = json.dumps(record).encode()
        publish(self.record_path(task.number), body + f"\n{_crc32(body)}\n".encode())

    # --- looking after it ---------------------------------------------------------------------

    def verify(self, progress: Any = None) -> Verification:
        """Read every shard of every task that is done, and compare it with its record. The records
        of bad ones are taken away, so that the next run does these tasks again."""
        bad: dict[int, str] = {}
        files = self._records()
        for n, (number, file) in enumerate(files.items()):
            wrong = self._what_is_wrong(number)
            if wrong:
                bad[number] = wrong
                file.unlink()
            if progress is not None:
                progress(n + 1, len(files))
        self._clear_away()
        sound = len(files) - len(bad)
        return Verification(sound, bad, self.plan.num_tasks - sound)

    def _what_is_wrong(self, number: int) -> str:
        record = self._written(number)
        if record is None:
            return "the record is damaged"
        for name in self.variables:
            known = record["shards"][name]
            try:
                content = self.shard_path(name, number).read_bytes()
            except OSError as error:
                return f"the shard of {name} cannot be read ({error.strerror})"
            if len(content) != known["bytes"]:
                return f"the shard of {name} has {len(content)} bytes"
            # Of the whole file: the codecs do not see that a shard is another task's.
            if _crc32(content) != known["crc32"]:
                return f"the shard of {name} has another checksum"
        return ""

    def _clear_away(self) -> None:
        """Remove what processes that died had begun to write: files older than any write takes."""
        before = time.time() - 3600
        for file in self.path.rglob(f"*{TEMPORARY}"):
            with contextlib.suppress(OSError):
                if file.stat().st_mtime < before:
                    file.unlink()


def _located(path: str | os.PathLike) -> Path:
    """A path in full.

    **Raises** `StoreError` for one that no directory can have.
    """
    try:
        found = Path(path).resolve()
        found.exists()
    except (OSError, ValueError, RuntimeError) as error:
        why = getattr(error, "strerror", None) or error
        raise StoreError(
            f"{os.fspath(path)!r:.80}: cannot be the path of a store ({why}): give the path of a "
            "directory."
        ) from None
    return found


def _crc32(content: bytes) -> str:
    return f"{zlib.crc32(content):08x}"
