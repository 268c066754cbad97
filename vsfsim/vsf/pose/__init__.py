"""The pose of a known object from an estimate of stiffness."""
