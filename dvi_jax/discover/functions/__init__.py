"""Bases of functions, and points at which they are compared."""
