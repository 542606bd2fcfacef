"""Claims of tasks: while a process computes a task, it locks one byte of a file."""

import contextlib
import errno
import os
import threading
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ..base.keywords import user_level
from .layout import as_store_error

fcntl: Any = None
with contextlib.suppress(ImportError):  # on Windows processes do not share the tasks of a sweep
    import fcntl

_lock = threading.Lock()
# Never closed: a process that closes a file releases all its locks on it.
_handles: dict[Path, int] = {}
# The locks are those of a process; its threads see each other's claims here.
_mine: set[tuple[Path, int]] = set()


@contextlib.contextmanager
def claim(file: Path, number: int) -> Iterator[bool]:
    """Whether nobody else holds this number, for as long as the context lasts. The operating system
    releases the locks of a process that dies."""
    key = (file.resolve(), number)
    with _lock:
        mine = key not in _mine and _lock_byte(*key)
        if mine:
            _mine.add(key)
    try:
        yield mine
    finally:
        if mine:
            with _lock, contextlib.suppress(OSError):
                _mine.discard(key)
                if key[0] in _handles:
                    fcntl.lockf(_handles[key[0]], fcntl.LOCK_UN, 1, number)


def _lock_byte(file: Path, number: int) -> bool:
    """Whether this process could lock a byte. True, with a warning, where the file system has no
    locks: tasks may then be computed twice, with the same bits."""
    if fcntl is None:
        return True
    if file not in _handles:
        with as_store_error(file, "the lock file cannot be opened"):
            _handles[file] = os.open(file, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        fcntl.lockf(_handles[file], fcntl.LOCK_EX | fcntl.LOCK_NB, 1, number)
    except OSError as error:
        if error.errno in (errno.EACCES, errno.EAGAIN):  # another process holds it
            return False
        warnings.warn(
            f"{file.parent}: files cannot be locked here ({error.strerror or error}). If several "
            "processes work on this store, they may compute the same tasks. The results stay "
            "correct. To avoid repeated work, use one process.",
            stacklevel=user_level(),
        )
    return True
