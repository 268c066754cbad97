"""Plants under an arm: where they are touched, how they look, and the truth about them."""
