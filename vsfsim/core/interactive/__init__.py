"""What a Python user meets: packages that can be called, figures and tables that a notebook shows."""
