"""The two papers: their claims and tables beside stored results, and the studies that ask them."""
