"""The work of the commands: TOML files, what they describe, reports. These files import JAX."""
