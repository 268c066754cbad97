"""The quasi-static solver: Newton, conjugate gradients, frames of a batch of touches."""
