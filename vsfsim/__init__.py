"""vsfsim: simulated touch of heterogeneous deformable objects, and a benchmark of stiffness estimators."""

__version__ = "0.1.0"
