"""Tools of a dynamicist: what trajectories say of the motion."""

from .actions import Actions as Actions, actions as actions
from .diffusion import (
    InvariantDiffusion as InvariantDiffusion,
    invariant_diffusion as invariant_diffusion,
)
from .frequencies import (
    Frequencies as Frequencies,
    FrequencyDiffusion as FrequencyDiffusion,
    frequencies as frequencies,
    frequency_diffusion as frequency_diffusion,
)
from .results import (
    FREQUENCY_RESULTS as FREQUENCY_RESULTS,
    SECTION_RESULTS as SECTION_RESULTS,
    FrequencyError as FrequencyError,
    SectionError as SectionError,
)
from .sections import (
    PoincareSection as PoincareSection,
    Return as Return,
    ReturnMap as ReturnMap,
    bifurcation as bifurcation,
    poincare_section as poincare_section,
    stroboscope as stroboscope,
)
from .tangent import tangent_map as tangent_map
from .torus import (
    FundamentalFrequencies as FundamentalFrequencies,
    fundamental_frequencies as fundamental_frequencies,
)
