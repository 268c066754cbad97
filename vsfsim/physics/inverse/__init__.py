"""Which moduli explain forces that were read: derivatives of the solver's equilibria, and fits that use them."""
