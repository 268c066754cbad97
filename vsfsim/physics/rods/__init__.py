"""Plants as trees of geometrically exact beams, touched by the rigid capsules of an arm."""
