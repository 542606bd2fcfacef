"""The search for conserved quantities, and its result."""
