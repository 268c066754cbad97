"""How each effector makes the one press of `vsfsim press`."""
