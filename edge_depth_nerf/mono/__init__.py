"""Monocular depth: networks, alignment to LiDAR, and how far it is trusted."""
