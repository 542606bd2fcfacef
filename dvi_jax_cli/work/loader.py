"""Objects of the Python files that a TOML file names, and errors of these files in one line."""

import importlib.util
import os
import sys
import traceback
from pathlib import Path
from typing import Any

import jax

from .._errors import InputError, as_input_error, one_of, require, require_file

_RULE = '"file.py:name", a Python file in the folder of the TOML file and a name in it'


class Loader:
    """Objects named ``file.py:name``; every file is run once, however often it is named."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.modules: dict[Path, Any] = {}

    def load(self, key: str, text: str) -> Any:
        """The object that `text` names.

        **Raises** `InputError` with the key when the file or the name does not exist, or when
        running the file fails: with the line that failed.
        """
        file, _, name = text.rpartition(":")
        leaves = os.path.isabs(os.path.expanduser(file)) or ".." in Path(file).parts
        require(not leaves, key, f"{text!r} is not in the folder of the TOML file", _RULE)
        path = require_file(key, self.folder / file, _RULE)
        if path not in self.modules:
            self.modules[path] = self._run(key, text, path)
        module = self.modules[path]
        names = [n for n in vars(module) if not n.startswith("_")]
        rule = f"a name in that file: {one_of(names, name)}"
        require(hasattr(module, name), key, f"{file} has no {name!r}", rule)
        return getattr(module, name)

    def _run(self, key: str, text: str, path: Path) -> Any:
        spec = importlib.util.spec_from_file_location(f"dvi_jax_run_{path.stem}", path)
        if spec is None or spec.loader is None:
            raise InputError(key, f"{text!r}: {path.name} is not a Python file", _RULE)
        module = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = module  # dataclasses and pickle look their module up
        sys.path.insert(0, str(path.parent))  # so that it may import its neighbours
        prefix, rule = f"{text!r} cannot be imported: ", "a file that Python can import"
        kinds, line = (Exception, SystemExit), lambda error: in_one_line(error, path)
        try:
            with as_input_error(key, rule, *kinds, prefix=prefix, text=line):
                spec.loader.exec_module(module)
        finally:
            sys.path.remove(str(path.parent))
        return module


def in_one_line(error: BaseException, *files: Path) -> str:
    """An exception in one line, with the last place in the user's files that it came through."""
    kind = type(error).__name__
    if isinstance(error, SyntaxError):
        return f"{kind}: {error.msg} (line {error.lineno})"
    places = traceback.extract_tb(error.__traceback__)
    frames = [p for p in places if Path(p.filename) in files]
    where = f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else ""
    text = str(error)
    if any("args is None" in note for note in getattr(error, "__notes__", ())):
        text += ": if it is args that is None, write a table [args]"
    if isinstance(error, jax.errors.JAXTypeError | jax.errors.JAXIndexError):
        text = (
            "the arguments of a function are placeholders while it is compiled; write it with "
            "jax.numpy in place of math and numpy, jnp.where in place of if"
        )
    return f"{kind}: {text}{where}"
