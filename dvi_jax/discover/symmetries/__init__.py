"""Symmetries: conditions, search, gauges, Noether's identity."""
