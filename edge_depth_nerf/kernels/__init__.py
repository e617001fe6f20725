"""nerfacto's parts in fused kernels: the same numbers as nerfstudio's, several times faster."""
