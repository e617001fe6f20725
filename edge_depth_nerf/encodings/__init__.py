"""The multiresolution hash grid in fused kernels: nerfstudio's encoding, the same numbers, several times faster."""
