"""What can touch an object: every file here is one effector, see `vsfsim.generate.effector`."""
