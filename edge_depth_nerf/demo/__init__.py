"""`edge-depth-nerf demo`: the whole way once, from a raw drive to compared figures."""
