"""Datasets in the formats of others: LeRobot, Croissant, WebDataset, openvsf; and recordings of real robots."""
