"""From a scene to touches to a dataset."""
