"""Speed against accuracy: what is promised, how it is estimated, and what it does to a ranking of methods."""
