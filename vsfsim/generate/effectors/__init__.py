"""What touches: a rigid probe, a bubble, an arm, behind one protocol."""
