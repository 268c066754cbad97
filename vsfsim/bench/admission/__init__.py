"""Which results may be ranked: scores are computed again, and data are compared with the task's record."""
