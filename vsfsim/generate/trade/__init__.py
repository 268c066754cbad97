"""Speed against accuracy: what a cheaper simulation of the same touches costs their readings."""
