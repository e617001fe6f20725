"""LiDAR: sweeps and their projection. Pure: tensors in, tensors out; no nerfstudio."""

from edge_depth_nerf.lidar.projection import Projection, project_points, transform_points
from edge_depth_nerf.lidar.sweeps import MAX_RANGE_M, MIN_RANGE_M, Sweep, SweepTiming

__all__ = [
    "MAX_RANGE_M",
    "MIN_RANGE_M",
    "Projection",
    "Sweep",
    "SweepTiming",
    "project_points",
    "transform_points",
]
