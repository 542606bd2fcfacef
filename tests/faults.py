"""A disk and a process that fail in the middle of a write."""

import builtins
import errno
from pathlib import Path

from dvi_jax.base import files as _files


class KilledError(BaseException):
    """The process ends here: nothing that it would have done afterwards is done."""


class _Cut:
    """A file of which only so many bytes are written before the fault."""

    def __init__(self, file, length, fault):
        self.file, self.length, self.fault = file, length, fault

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.file.close()

    def write(self, content):
        self.file.write(content[: self.length])
        raise self.fault


def in_write(monkeypatch, how, length, after=0):
    """Have the write of file number `after` fail at a byte: "full" (disk) or "killed" (process)."""
    faults = {
        "full": lambda: OSError(errno.ENOSPC, "No space left on device"),
        "killed": KilledError,
        "permission": lambda: PermissionError(errno.EACCES, "Permission denied"),
    }
    written = []

    def opened(path, *mode):
        file = builtins.open(path, *mode)  # noqa: SIM115
        written.append(path)
        return _Cut(file, length, faults[how]()) if len(written) > after else file

    monkeypatch.setattr(_files, "open", opened, raising=False)
    if how == "killed":
        monkeypatch.setattr(Path, "unlink", lambda path, **_: None)  # nobody tidies up
