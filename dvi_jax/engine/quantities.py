"""Numbers with units and masked numbers are refused: an array would drop the unit or mask."""

from typing import Any

import numpy as np


def refuse_unit_or_mask(name: str, value: Any) -> None:
    """Refuse a quantity of astropy or pint called `name`, and an array with masked numbers.

    **Raises** `TypeError` for a unit, `ValueError` for a mask.
    """
    if np.ma.is_masked(value):
        where = np.argwhere(np.ma.getmaskarray(value))[0].tolist()
        raise ValueError(
            f"{name} is a masked array with a masked number"
            + (f" at index {where}" if where else "")
            + ", which would be used like any other: give an array without masked numbers."
        )
    unit = None
    if hasattr(value, "to_value"):
        unit = getattr(value, "unit", None)
    elif hasattr(value, "magnitude"):
        unit = getattr(value, "units", None)
    if unit is not None:
        raise TypeError(
            f"{name} has the unit {str(unit) or '1'!r}, and numbers are taken here: it would be "
            "lost. dvi_jax.interop.integrate(..., units=...) takes quantities of astropy and "
            "converts them; or divide by the unit that the run is in."
        )
