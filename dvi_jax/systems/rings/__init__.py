"""Storage rings: lattices of magnets as maps, with gradients and invariants."""

from ._beams import beam_beam as beam_beam, space_charge as space_charge
from ._damping import (
    in_phase as in_phase,
    radiating as radiating,
    radiation_integrals as radiation_integrals,
    tapered as tapered,
)
from ._elements import (
    Element as Element,
    aperture as aperture,
    bend as bend,
    cavity as cavity,
    corrector as corrector,
    drift as drift,
    lens as lens,
    marker as marker,
    multipole as multipole,
    octupole as octupole,
    quadrupole as quadrupole,
    sextupole as sextupole,
    solenoid as solenoid,
)
from ._envelope import Equilibrium as Equilibrium, equilibrium as equilibrium
from ._feeddown import feed_down as feed_down
from ._losses import beam_pipe as beam_pipe
from ._nonlinear import (
    FrequencyMap as FrequencyMap,
    detuning as detuning,
    dynamic_aperture as dynamic_aperture,
    frequency_map as frequency_map,
    momentum_aperture as momentum_aperture,
    resonance_driving_terms as resonance_driving_terms,
)
from ._optics import (
    Optics as Optics,
    closed_orbit as closed_orbit,
    matrix as matrix,
    one_turn as one_turn,
    optics as optics,
)
from ._peers import from_latticejson as from_latticejson, from_madx as from_madx
from ._problem import Turn as Turn, problem as problem
from ._readers import from_at as from_at, load as load
from ._ring import Ring as Ring
from ._save import save as save
from ._touschek import touschek_lifetime as touschek_lifetime
from ._track import Tracked as Tracked, track as track
