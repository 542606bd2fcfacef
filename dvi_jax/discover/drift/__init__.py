"""Orders to which something is conserved, measured along trajectories."""
