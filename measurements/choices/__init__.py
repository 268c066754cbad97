"""Settings of methods, chosen on objects that no task asks."""
