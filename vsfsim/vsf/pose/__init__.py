"""Where a known object lies, from an estimate of stiffness."""
