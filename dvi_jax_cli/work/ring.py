"""The keys of a ring in a TOML file."""
# pyright: reportInvalidTypeForm=false

from typing import Literal

from .table import Number, Text, TomlTable, key


class RingFile(TomlTable):
    """A storage ring from a file that pyAT can read."""

    file: Text = key(..., "the path of a lattice file, from the folder of this one")
    planes: Literal["x", "xy", "xyz"] = key("xyz", '"x", "xy" or "xyz"')
    delta: Number = key(0.0, "a finite number: δ if planes is not xyz")
    symplectic: bool = key(False, "true or false")
    use: Text | None = key(None, "the name of a sequence or line in the file")
    model: Literal["paraxial", "exact"] | None = key(None, '"paraxial" or "exact"')
