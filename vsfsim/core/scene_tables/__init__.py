"""The tables of a scene file that are not shapes, bodies or materials: what each holds, and how it is read."""
