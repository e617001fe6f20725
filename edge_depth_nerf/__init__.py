"""Radiance fields of fisheye driving scenes with edge-aware integrated depth supervision."""

__version__ = "0.1.0"
