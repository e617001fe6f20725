"""The recording car's sensors: KITTI-360's published calibration, scaled to any picture size, and its files.

Frames, all right-handed, metres: camera (x right, y down, z forward), pose = vehicle (x forward, y right, z down),
velodyne (x forward, y left, z up). Cameras image_02 and image_03 look sideways, left and right. The numbers are
those of KITTI-360's calibration folder (Liao, Xie & Geiger, PAMI 2022), given there as text: the files written
here repeat them digit by digit, but for gamma and the principal point, which belong to the picture size.

The pose's origin is the GPS/IMU unit, 0.93 m above the road as on KITTI's car (Geiger et al., IJRR 2013, fig. 3):
the fisheye cameras are then 2.0 m and the Velodyne 1.77 m above the road.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edge_depth_nerf.base.files import write_text
from edge_depth_nerf.cameras import MEI

CAMERAS = ("image_02", "image_03")
"""The fisheye cameras: left, right."""

POSE_HEIGHT_M = 0.93
"""Height of the pose's origin above the road."""

FULL_SIZE_PX = 1400
"""Width and height of KITTI-360's fisheye pictures."""

_CAM_TO_POSE = {
    "image_00": "0.0371783278 -0.0986182135 0.9944306009 1.5752681039 "
    "0.9992675562 -0.0053553387 -0.0378902567 0.0043914093 "
    "0.0090621821 0.9951109327 0.0983468786 -0.6500000000",
    "image_01": "0.0194000864 -0.1051529641 0.9942668106 1.5977241400 "
    "0.9997374956 -0.0100836652 -0.0205732716 0.5981494900 "
    "0.0121891942 0.9944049345 0.1049297370 -0.6488433108",
    "image_02": "0.9995185086 0.0041276589 -0.0307524527 0.7264036936 "
    "-0.0307926666 0.0100608424 -0.9994751579 -0.1499658517 "
    "-0.0038160970 0.9999408692 0.0101830998 -1.0686400091",
    "image_03": "-0.9996821702 0.0005703407 -0.0252038325 0.7016842127 "
    "-0.0252033830 0.0007820814 0.9996820384 0.7463650950 "
    "0.0005898709 0.9999995315 -0.0007674583 -1.0751978255",
}

_CAM0_TO_VELO = (
    "0.04307104361 -0.08829286498 0.995162929 0.8043914418 "
    "-0.999004371 0.007784614041 0.04392796942 0.2993489574 "
    "-0.01162548558 -0.9960641394 -0.08786966659 -0.1770225824"
)

_FULL_SIZE = {
    "image_02": MEI(
        width=FULL_SIZE_PX,
        height=FULL_SIZE_PX,
        fx=1.3363220825849971e03,
        fy=1.3357883350012958e03,
        cx=7.1694323510126321e02 + 0.5,
        cy=7.0576498308221585e02 + 0.5,
        xi=2.2134047507854890e00,
        k1=1.6798235660113681e-02,
        k2=1.6548773243373522e00,
        p1=4.2223943394772046e-04,
        p2=4.2462134260997584e-04,
    ),
    "image_03": MEI(
        width=FULL_SIZE_PX,
        height=FULL_SIZE_PX,
        fx=1.4854388981875156e03,
        fy=1.4849477411748708e03,
        cx=6.9888316784030962e02 + 0.5,
        cy=6.9814541887723055e02 + 0.5,
        xi=2.5535139132482758e00,
        k1=4.9370396274089505e-02,
        k2=4.5068455478645308e00,
        p1=1.3477698472982495e-03,
        p2=-7.0340482615055284e-04,
    ),
}
"""KITTI-360 counts integer pixel centres, so a half is added."""


def _matrix(numbers: str) -> NDArray[np.float64]:
    rows = np.array(numbers.split(), np.float64).reshape(3, 4)
    return np.vstack((rows, (0.0, 0.0, 0.0, 1.0)))


CAMERA_TO_POSE = {name: _matrix(numbers) for name, numbers in _CAM_TO_POSE.items()}
"""4×4, for image_00 to image_03."""

VELO_TO_POSE = CAMERA_TO_POSE["image_00"] @ np.linalg.inv(_matrix(_CAM0_TO_VELO))
"""4×4, by way of camera 0, as the calibration files give it."""


def camera(name: str, size_px: int) -> MEI:
    """The MEI camera `name` for pictures of `size_px`×`size_px`, pixel centres at +0.5."""
    full, scale = _FULL_SIZE[name], size_px / FULL_SIZE_PX
    focal_and_centre = {key: getattr(full, key) * scale for key in ("fx", "fy", "cx", "cy")}
    return replace(full, width=size_px, height=size_px, **focal_and_centre)


def write_calibration(folder: Path, size_px: int) -> None:
    """Write image_02.yaml, image_03.yaml, calib_cam_to_pose.txt and calib_cam_to_velo.txt as KITTI-360 does."""
    for name in CAMERAS:
        mei = camera(name, size_px)
        write_text(
            folder / f"{name}.yaml",
            "%YAML:1.0\n---\nmodel_type: MEI\n"
            f"camera_name: {name}\nimage_width: {size_px}\nimage_height: {size_px}\n"
            f"mirror_parameters:\n   xi: {mei.xi:.16e}\n"
            f"distortion_parameters:\n   k1: {mei.k1:.16e}\n   k2: {mei.k2:.16e}\n"
            f"   p1: {mei.p1:.16e}\n   p2: {mei.p2:.16e}\n"
            f"projection_parameters:\n   gamma1: {mei.fx:.16e}\n   gamma2: {mei.fy:.16e}\n"
            f"   u0: {mei.cx - 0.5:.16e}\n   v0: {mei.cy - 0.5:.16e}\n",
        )
    write_text(
        folder / "calib_cam_to_pose.txt", "".join(f"{name}: {numbers}\n" for name, numbers in _CAM_TO_POSE.items())
    )
    write_text(folder / "calib_cam_to_velo.txt", _CAM0_TO_VELO + "\n")
