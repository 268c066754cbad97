"""Parts of small scenes for tests."""

BLOCK = """
gravity = [0.0, 0.0, 0.0]
needs = ["bulging"]
[object]
shape = { box = [0.06, 0.06, 0.03] }
resolution = 0.02
young_modulus = 5e4
poisson_ratio = 0.3
[probe]
shape = { sphere = 0.02 }
"""
SPRUNG = """
resolution = 0.03
tier = "linear"
young_modulus = { loguniform = [2e4, 2e5] }
[probe]
shape = { sphere = 0.01 }
mount_stiffness = 500.0
"""  # after the shape of the object
CAMERA = """
[camera]
width = 64
height = 48
distance = 0.25
"""
TWO_OBJECTS = """
[dataset]
objects = 2
views = 1
splits = { train = 1, test = 1 }
"""
