"""A check for numbers with units and masked numbers."""

from typing import Any

import numpy as np


def refuse_unit_or_mask(name: str, value: Any) -> None:
    """**Raises** `TypeError` for a quantity of astropy or pint, `ValueError` for an array with
    masked numbers."""
    # Both are accepted by np.asarray, which drops the unit or the mask without a warning.
    if np.ma.is_masked(value):
        where = np.argwhere(np.ma.getmaskarray(value))[0].tolist()
        raise ValueError(
            f"{name} is a masked array with a masked number"
            + (f" at index {where}" if where else "")
            + ", which would be used as if it were valid: give an array without masked numbers."
        )
    unit = None
    if hasattr(value, "to_value"):
        unit = getattr(value, "unit", None)
    elif hasattr(value, "magnitude"):
        unit = getattr(value, "units", None)
    if unit is not None:
        raise TypeError(
            f"{name} has the unit {str(unit) or '1'!r}, but numbers without units are required "
            f"here. Divide {name} by the unit of the run, or call dvi_jax.interop.integrate(..., "
            "units=...), which accepts quantities of astropy and converts them."
        )
