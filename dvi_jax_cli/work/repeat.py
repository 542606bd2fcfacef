"""How to repeat the work of a TOML file: its command, and its text where the file is not there."""

import json
import math
import re
import shlex
import tomllib
from pathlib import Path
from typing import Any

from .._show import json_types

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")


def plain(value: Any) -> Any:
    """Values of a JSON file, with numbers in place of the texts of those that are not finite."""
    if isinstance(value, dict):
        return {name: plain(x) for name, x in value.items()}
    if isinstance(value, list):
        return [plain(x) for x in value]
    return float(value) if value in ("inf", "-inf", "nan") else value


def repetition(kind: str, contents: dict[str, Any], place: Path) -> dict[str, Any]:
    """The fields `command`, `remarks` and `config` of a chapter.

    - `contents`: the values of the file (`config`) and its path, under the name of its `kind`.
    - `place`: folder of the results; the command writes to another one next to it.
    """
    name, values = str(contents[kind]), contents["config"]
    option = "--store" if kind == "sweep" else "--out"
    folder = str(place.with_name(f"{place.stem}-again{place.suffix}"))
    command = shlex.join(["dvi-jax", kind, name, option, folder])
    try:
        text = Path(name).read_text(encoding="utf-8-sig")
        is_same = repr(plain(json_types(tomllib.loads(text), str))) == repr(values)
    except (OSError, ValueError):
        text, is_same = "", False
    if is_same:
        remark = f"{name} still has the values that were used:"
    elif text:
        remark = f"{name} has other values now. Those that were used are the following:"
    else:
        remark = f"There is no file {name} in the directory where this page was made. "
        remark += "Change to the directory of the first call, or save the following text as such:"
    remarks = [remark]
    if re.search(r'"[^"]+\.py:\w+"', json.dumps(values)):
        remarks.insert(0, "The Python files that the TOML file names must be in its folder.")
    return {
        "command": command,
        "remarks": remarks,
        "config": text if is_same else toml_text(values),
    }


def toml_text(table: dict[str, Any], path: tuple[str, ...] = ()) -> str:
    """A table as the text of a TOML file: first its values, then its tables."""
    parts = {name: x for name, x in table.items() if isinstance(x, dict)}
    lines = [f"[{'.'.join(map(_key, path))}]"] if path else []
    lines += [f"{_key(name)} = {_value(x)}" for name, x in table.items() if name not in parts]
    texts = [toml_text(x, (*path, name)) for name, x in parts.items()]
    return "\n".join([*lines, *("\n" + text.rstrip("\n") for text in texts)]).lstrip("\n") + "\n"


def _key(name: str) -> str:
    return name if _BARE_KEY.fullmatch(name) else _value(name)


def _value(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_key(name)} = {_value(x)}" for name, x in value.items()) + "}"
    if isinstance(value, list):
        return f"[{', '.join(map(_value, value))}]"
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
