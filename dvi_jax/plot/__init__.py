"""Pictures in one style, readable in print and for colour-blind people.

Every function returns the `Axes` it drew on, one or an array of them; `save` writes a figure, and
`animate` writes a film. Keywords that many of them share:

- `labels`: one name for each orbit. `title`: of the picture.
- `colour`: a number for each orbit, shown by a bar with `colour_label`; NaN is grey. None: each
  orbit has a colour of its own.
- `units`: name of a quantity, such as "q" or "t" → its unit.
- `ax`: the `Axes` to draw on, as many as there are panels; None: a new figure.
"""

from matplotlib import pyplot as plt  # noqa: F401 (plot.plt.close closes a figure)

from .elements import elements as elements
from .films import animate as animate
from .fits import (
    fit_against_data as fit_against_data,
    fit_corner as fit_corner,
    fit_residuals as fit_residuals,
    learning_curve as learning_curve,
)
from .orbits import orbit as orbit, phase_portrait as phase_portrait, trajectory as trajectory
from .orders import (
    balance as balance,
    drift_bound as drift_bound,
    drift_orders as drift_orders,
    drift_surface as drift_surface,
    work_precision as work_precision,
)
from .rings import tune_map as tune_map, twiss as twiss
from .sections import bifurcation as bifurcation, section as section
from .series import (
    changes as changes,
    conserved as conserved,
    indicator as indicator,
    invariants as invariants,
)
from .solar import ephemeris_comparison as ephemeris_comparison, planet_orbits as planet_orbits
from .spectra import frequency_map as frequency_map, spectrum as spectrum
from .style import COLOURS as COLOURS, DASHES as DASHES, save as save, style as style
from .sweeps import failure_map as failure_map, slope_map as slope_map, sweep_map as sweep_map
