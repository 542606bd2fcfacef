"""Machine code on disk, so that a process need not make what an earlier one has made.

The folder is ``$DVI_JAX_CACHE`` if that variable is set (``off`` switches the cache off), else
``dvi_jax`` in ``$XDG_CACHE_HOME`` or ``~/.cache``. Code is loaded only from a folder that belongs
to the user and that nobody else can write to. A file begins with a checksum of its name and of the
rest; one that is damaged is made again. Files are written under another name first, so that a
process never sees half of one; the oldest are removed when the folder grows beyond `LARGEST`.
"""

import contextlib
import functools
import hashlib
import os
import re
import stat
import tempfile
import warnings
from pathlib import Path
from typing import Any

from .switches import is_off

VARIABLE = "DVI_JAX_CACHE"

LARGEST = 256 * 2**20  # bytes that the folder may hold

# The first bytes of each file: other files in a folder that the user named are not taken for code.
_MARK = b"lanewise"


# The names of our files: the folder may be one in which the user has others.
_NAME = re.compile(r"[0-9a-f]{64}|\.new-.*")


def key(*parts: Any) -> str:
    """A name for what these parts determine."""
    return hashlib.sha256("\0".join(map(str, parts)).encode()).hexdigest()


def folder() -> Path | None:
    """The folder of machine code, None if the cache is switched off."""
    setting = os.environ.get(VARIABLE, "").strip()
    if is_off(setting):
        return None
    base = Path(os.environ.get("XDG_CACHE_HOME", "").strip())
    where = None
    try:
        if setting:
            where = Path(setting).expanduser()
        else:  # the standard ignores a relative one, also one that begins with ~
            where = (base if base.is_absolute() else Path.home() / ".cache") / "dvi_jax"
        nearest = next(part for part in (where, *where.absolute().parents) if part.exists())
        is_folder = nearest.is_dir()
    except (OSError, ValueError, RuntimeError):  # no home directory, or a name that cannot exist
        is_folder = False
    if not is_folder and setting:
        _warn_once(setting)
    return where if is_folder else None


@functools.cache
def _warn_once(setting: str) -> None:
    warnings.warn(
        f"{VARIABLE}={setting!r} is not a folder and cannot become one: machine code is not "
        f"stored, and each process makes it again. Give a folder, or {VARIABLE}=off.",
        stacklevel=2,
    )


def _is_safe(path: Path) -> bool:
    """Whether a folder belongs to the user and nobody else can write to it."""
    status = path.stat()
    if not hasattr(os, "getuid"):
        return True
    # Anybody who can write to the folder could make this process run any code.
    is_open = status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    return stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid() and not is_open


def read(name: str) -> bytes | None:
    """The code under a name, None if it is not stored, or if its file or folder is not safe."""
    where = folder()
    if where is None:
        return None
    path = where / name
    try:
        if not _is_safe(where):
            return None
        if not path.is_file():  # a pipe would block
            return None
        with path.open("rb") as file:
            # A file in a safe folder may still have been moved there by somebody else.
            if hasattr(os, "getuid") and os.fstat(file.fileno()).st_uid != os.getuid():
                return None
            content = file.read()
    except OSError:
        return None
    mark, check, code = content[:8], content[8:40], content[40:]
    if mark != _MARK or _checksum(name, code) != check:
        return None
    with contextlib.suppress(OSError):
        os.utime(path)  # the oldest are removed first: it was of use now
    return code


def _checksum(name: str, code: bytes) -> bytes:
    """The checksum of the code and its name: code that was stored under another name differs."""
    return hashlib.sha256(name.encode() + b"\0" + code).digest()


def write(name: str, code: bytes) -> None:
    """Store the code under a name, if the folder can be written and is safe."""
    where = folder()
    if where is None:
        return
    with contextlib.suppress(OSError):
        where.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not _is_safe(where):
            return
        # Renaming is atomic: another process reads the whole file or none.
        handle, temporary = tempfile.mkstemp(prefix=".new-", dir=where)
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(_MARK + _checksum(name, code) + code)
            os.replace(temporary, where / name)
        except OSError:
            os.unlink(temporary)
            raise
        _bound(where)


def _bound(where: Path) -> None:
    """Remove the files that were not used for longest, down to three quarters of `LARGEST`."""
    files = []
    for entry in filter(lambda entry: _NAME.fullmatch(entry.name), os.scandir(where)):
        with contextlib.suppress(OSError):
            status = entry.stat()
            files.append((status.st_mtime, status.st_size, entry.path))
    total = sum(size for _, size, _ in files)
    if total <= LARGEST:
        return
    # Far below the limit, so that not each new file starts a search.
    for _, size, path in sorted(files):
        with contextlib.suppress(OSError):
            os.unlink(path)
        total -= size
        if total <= LARGEST * 3 // 4:
            return
