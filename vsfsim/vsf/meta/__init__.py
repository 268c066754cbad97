"""The structured prior of SBML and its training."""
