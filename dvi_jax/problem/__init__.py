"""The problem of the user: systems, and what makes a discrete Hamiltonian."""
