"""Paths that users give, and files that are written whole or not at all."""

import contextlib
import errno
import io
import json
import os
import stat
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .checks import instance

TEMPORARY = ".tmp"
"""Suffix of files that are still being written."""


def user_path(name: str, path: Any) -> Path:
    """A path that a user gives as the argument `name`: ``~`` is the home directory, as in a shell.

    **Raises** `TypeError` for another type, `ValueError` for ``~name`` of an unknown user and for a
    path that cannot exist.
    """
    instance(name, path, str | os.PathLike, "a path, a string or a pathlib.Path")
    try:
        expanded = Path(path).expanduser()
        with contextlib.suppress(FileNotFoundError, NotADirectoryError, PermissionError):
            expanded.stat()  # raises for names that are too long or have a NUL
    except (OSError, ValueError, RuntimeError) as error:
        cause = getattr(error, "strerror", None) or str(error).rstrip(".")
        raise ValueError(
            f"{name}={os.fspath(path)!r:.100} cannot be a path ({cause}). ~ means the home "
            "directory, ~name that of a user; ./~name is the file of this name."
        ) from None
    return expanded


def user_file(name: str, path: Any) -> Path:
    """The path of an existing file that a user gives. **Raises** as `user_path`;
    `FileNotFoundError`; `ValueError` for a directory, a pipe or a device."""
    file = user_path(name, path)
    if not file.is_file():
        if not file.exists():
            cause = f"{name}: there is no file at the path"
            raise FileNotFoundError(errno.ENOENT, cause, str(file))
        raise ValueError(f"{name} must be a file, but '{file}' is a {kind_of_file(file)}.")
    return file


def user_folder(name: str, path: Any) -> Path:
    """The path of a directory that a user gives, which exists or can be made.

    **Raises** as `user_path`; `NotADirectoryError` if the path or a part of it is something else.
    """
    folder = user_path(name, path)
    nearest = next(part for part in (folder, *folder.absolute().parents) if part.exists())
    if not nearest.is_dir():
        raise NotADirectoryError(
            f"{name} must be a directory, but '{nearest}' is a {kind_of_file(nearest)}: give "
            "another path."
        )
    return folder


def kind_of_file(path: Path) -> str:
    """What is at a path, in words."""
    mode = path.stat().st_mode
    # Other kinds are rare: one word serves them all.
    kinds = {stat.S_IFDIR: "directory", stat.S_IFREG: "file", stat.S_IFIFO: "pipe"}
    return kinds.get(stat.S_IFMT(mode), "device or socket")


def content_of(path: Path) -> bytes:
    """The bytes of a file. **Raises** `OSError`, also for a pipe, which could block for ever."""
    if not stat.S_ISREG(path.stat().st_mode):
        raise OSError(errno.EINVAL, f"it is a {kind_of_file(path)}, not a file", str(path))
    return path.read_bytes()


def writable_path(path: Any) -> Path:
    """The path of a file to be written. **Raises** as `user_path`; `FileNotFoundError`."""
    file = user_path("path", path)
    if not file.parent.is_dir():
        cause = f"the file '{file.name}' cannot be written: there is no directory '{file.parent}'."
        raise FileNotFoundError(cause)
    return file


def publish(path: Path, content: bytes) -> None:
    """Write a file whole or not at all; it is on the disk once this returns."""
    # Under another name in the same folder, then renamed: only within one file system is a rename
    # atomic. The name is unique, because several processes may write one file.
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}{TEMPORARY}")
    parents = _make_folders(path.parent)
    try:
        with open(temporary, "wb") as file:
            file.write(content)
            file.flush()
            # Without it a rename may reach the disk before the content: an empty file after a
            # power failure.
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise
    for folder in (path.parent, *parents):
        sync(folder)


def _make_folders(folder: Path) -> list[Path]:
    """Make a folder and its parents; the folders that have new entries, to be synced."""
    folders = []
    while not folder.exists():
        folders.append(folder)
        folder = folder.parent
    for new in reversed(folders):
        new.mkdir(exist_ok=True)  # another process may have been faster
    return [new.parent for new in folders]


_reserved: dict[Path, list[Path]] = {}
"""A directory of results that are not yet written → what was made for it, innermost first."""


def reserve(folder: Path) -> None:
    """Make a directory for results before the work begins, so that it fails early."""
    new = _reserved.setdefault(folder, [])
    while not folder.exists():
        new.append(folder)
        folder = folder.parent
    for part in reversed(new):
        part.mkdir(exist_ok=True)


def release(*folders: Path) -> None:
    """Remove what `reserve` has made for these directories, or for all, where it is still empty."""
    for folder in folders or tuple(_reserved):
        for part in _reserved.pop(folder, ()):
            with contextlib.suppress(OSError):  # it has files
                part.rmdir()


def sync(folder: Path) -> None:
    """Write the entries of a folder to the disk."""
    if os.name == "nt":  # where folders cannot be opened
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def publish_npz(
    path: str | os.PathLike[str], form: int, header: Mapping[str, Any], arrays: Mapping[str, Any]
) -> None:
    """Write a JSON header and arrays into one file (NumPy's npz), whole or not at all.

    - `form`: number of the format, which `read_npz` compares.

    **Raises** `FileNotFoundError` without a directory for it, `OSError` for a file that cannot be
    written; an older file of that name is then unchanged.
    """
    path, content = writable_path(path), io.BytesIO()
    header = {"format": form, "holds": sorted(arrays), **header}  # so that a lost array is noticed
    np.savez(content, about=np.array(json.dumps(header)), **arrays)
    try:
        publish(path, content.getvalue())
    except OSError as error:
        raise OSError(
            error.errno, f"{error.strerror or error}: give another path", str(path)
        ) from error


def read_npz(
    path: str | os.PathLike[str], form: int, kind: str
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Header and arrays of a file of `publish_npz`; `kind` names its content in messages.
    **Raises** `FileNotFoundError`; `ValueError` for a damaged or another file, or another form."""
    path = user_file(kind, path)
    try:
        # Without pickles: loading one would execute code from the file.
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        header = json.loads(str(arrays.pop("about")))
        number = header["format"]
        # The directory of a zip file has no checksum: a flipped bit there can hide an array.
        if set(header.get("holds", arrays)) != set(arrays):
            raise ValueError("an array is missing in it")
    except PermissionError:
        raise
    except Exception as error:  # zipfile and NumPy raise many types for damaged bytes
        raise ValueError(
            f"'{path}' is damaged, or not the file of a {kind} ({type(error).__name__}: "
            f"{str(error).split('. ')[0]}). Check the path, or compute again."
        ) from None
    if number != form:
        raise ValueError(
            f"'{path}' has the format {number!r}, but this version of dvi_jax reads {form!r}: use "
            "the version that wrote it, or compute again."
        )
    return header, arrays
