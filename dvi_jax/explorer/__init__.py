"""A page on this machine on which a system is explored: sliders, sections, orbit diagrams."""

from ._explore import Explorer as Explorer, explore as explore
