"""Methods run in a process of their own, which receives copies of what they may see and nothing else."""
