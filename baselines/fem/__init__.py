"""Methods that use the simulator's solver as their model of touch."""
