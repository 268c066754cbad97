"""A hash of grid cells for procedural textures: no random state, the same number on every device."""

import warp as wp

import vsfsim.physics.runtime  # noqa: F401  starts Warp quietly


@wp.func
def cell_hash(x: int, y: int, z: int) -> float:
    """A fixed number from 0 to 1 for the cell with these indices."""
    h = wp.uint32(x) * wp.uint32(73856093) ^ wp.uint32(y) * wp.uint32(19349663) ^ wp.uint32(z) * wp.uint32(83492791)
    h = (h ^ (h >> wp.uint32(16))) * wp.uint32(2146121005)
    h = (h ^ (h >> wp.uint32(13))) * wp.uint32(1540483477)
    h = h ^ (h >> wp.uint32(16))
    return float(h >> wp.uint32(8)) / 16777216.0
