"""Numerical methods without mechanics: root solvers, devices, checks of functions."""
