"""Poses from the pictures alone by COLMAP, with LiDAR's scale."""
