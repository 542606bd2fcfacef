"""A page on this machine on which a system is explored: sliders, sections, orbit diagrams."""
