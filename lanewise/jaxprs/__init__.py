"""Jaxprs: what JAX traced, and what depends on what."""
