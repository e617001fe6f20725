"""Camera models in torch, each with its own range of validity, and the fit of one to another."""

from edge_depth_nerf.cameras.fit import CameraFit, fit_kannala_brandt, host_residual
from edge_depth_nerf.cameras.models import MEI, Camera, KannalaBrandt, Pinhole, camera_from_dict

__all__ = [
    "MEI",
    "Camera",
    "CameraFit",
    "KannalaBrandt",
    "Pinhole",
    "camera_from_dict",
    "fit_kannala_brandt",
    "host_residual",
]
