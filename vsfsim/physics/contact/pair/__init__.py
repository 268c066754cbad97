"""Contact of two deformable surfaces: an object, and the soft surface of a sensor that is carried along."""
