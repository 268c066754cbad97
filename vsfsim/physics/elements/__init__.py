"""One element a file: energy, forces, stiffness."""
