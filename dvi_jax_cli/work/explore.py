"""The system of the command explore: of the library, of a Python file, or of a run file."""

from pathlib import Path
from typing import Any

from dvi_jax.explorer import Explorer
from dvi_jax.explorer.packages import require_panel
from dvi_jax.explorer.subject import Subject

from .._errors import as_input_error, require, user_path
from .schema import RunFile, SystemFile
from .system import Source, find_source
from .table import read_file


def explorer_of(text: str) -> Explorer:
    """The page of a system. **Raises** `InputError`."""
    with as_input_error("explore", "a Python with these packages", ImportError):
        require_panel()
    start: dict[str, Any] = {}
    if text.endswith(".toml"):
        path = user_path("SYSTEM", text)
        file, _ = read_file(path, RunFile)
        source = find_source(file, path.parent)
        start = {"method": source.method(file.method)}
        folder = path.parent
    else:
        name, _, inner = text.rpartition(":")
        path = user_path("SYSTEM", name or text)
        folder = path.parent if inner and name else Path()
        file = SystemFile(system=f"{path.name}:{inner}" if name else text)
        source = find_source(file, folder)
    if not start:
        rule = "a dvi.systems.Problem, a function that returns one, or a run file with [state]"
        defect = f"{text} is a dvi.System, which has no initial condition"
        require(source.problem is not None, "SYSTEM", defect, rule)
    start |= {"h": source.h, "epsilon": source.epsilon, "args": source.args}
    start |= {name: source.array(name) for name in ("q0", "p0")}
    source.check_start(start["q0"], start["p0"], start["args"])
    target = source.problem if source.problem is not None else source.system
    rule = "a system with an initial condition and without noise"
    with as_input_error("SYSTEM", rule):
        subject = Subject(target, start, _lines(source, folder), file.system, source.name)
    return Explorer(subject)


def _lines(source: Source, folder: Path) -> str:
    """Python code that defines `problem`."""
    file, _, name = source.file.system.rpartition(":")
    if not file:
        return f"problem = dvi.systems.{name}()"
    target = source.loader.load("system", source.file.system)
    is_made = target is source.problem or target is source.system
    call = name if is_made else f"{name}()"
    module = Path(file).with_suffix("").as_posix().replace("/", ".")
    lines = [f"import sys\n\nsys.path.insert(0, {str(folder.resolve())!r})"]
    return "\n".join([*lines, f"from {module} import {name}  # noqa: E402\n", f"problem = {call}"])
