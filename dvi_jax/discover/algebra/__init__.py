"""Null spaces of series, Taylor coefficients, changes above rounding."""
