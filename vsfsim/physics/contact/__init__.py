"""Contact: signed distances, rigid bodies, friction, two deformable surfaces."""
