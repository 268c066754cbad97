"""The continuous VSF: networks and grids fitted to dense contact forces."""
