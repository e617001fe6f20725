"""Camera models in torch, each with its own range of validity, and the fit of one to another."""

from edge_depth_nerf.cameras.fit import CameraFit, fit_kannala_brandt, host_residual
from edge_depth_nerf.cameras.models import MEI, Camera, KannalaBrandt, Pinhole
from edge_depth_nerf.cameras.wide import EUCM, DoubleSphere, OCam

__all__ = [
    "EUCM",
    "MEI",
    "Camera",
    "CameraFit",
    "DoubleSphere",
    "KannalaBrandt",
    "OCam",
    "Pinhole",
    "fit_kannala_brandt",
    "host_residual",
]
