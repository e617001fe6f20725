"""nerfstudio's classes with our kernels: the same parameters, names and numbers."""
