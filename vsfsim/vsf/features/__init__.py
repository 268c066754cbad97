"""Visual features of particles."""
