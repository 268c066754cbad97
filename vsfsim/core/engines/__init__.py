"""Engines that make the parts of a work on other machines: Ray, Slurm, Kubernetes. None is needed for one machine."""
