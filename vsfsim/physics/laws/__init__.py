"""Laws of solid materials: energy, stress and tangent at a point, for any solid element."""
