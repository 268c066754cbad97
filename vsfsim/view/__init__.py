"""A page to look at a dataset or a scene: one HTML file that needs no network, no server and no GL library here."""
