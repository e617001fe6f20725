"""`edge-depth-nerf inspect`: a scene as pictures, figures and warnings."""

from edge_depth_nerf.inspecting.command import inspect_scene

__all__ = ["inspect_scene"]
