"""The gate of the solver: fixed presses, with every mechanism and without some (`vsfsim measure solver --without`)."""
