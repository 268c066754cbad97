"""Comparisons of methods and the pages that show them."""
