"""Random systems and runs, each checked against the same map in plain arrays on XLA."""
