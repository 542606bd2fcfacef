"""Machine code: compilation, cache, calls from XLA."""
