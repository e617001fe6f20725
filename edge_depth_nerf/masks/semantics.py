"""KITTI-360's semantic labels: which pixels show things that move, and which the sky.

A label map is an 8-bit PNG of one channel that holds label ids (not Cityscapes' train ids). KITTI-360 keeps them in

    data_2d_semantics/train/SEQ/image_0k/semantic/0000000123.png

and ships them for the perspective cameras image_00 and image_01 alone: for the fisheye cameras image_02 and image_03
there are none (its authors, kitti360Scripts issues 1 and 97). Maps of the same ids from a segmentation network,
put in the same place at the size of the fisheye pictures, are read like its own.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.png import read_png_bytes, read_png_header
from edge_depth_nerf.masks.regions import dilated

CLASSES = (
    *("unlabeled", "ego vehicle", "rectification border", "out of roi", "static", "dynamic", "ground", "road"),
    *("sidewalk", "parking", "rail track", "building", "wall", "fence", "guard rail", "bridge", "tunnel", "pole"),
    *("polegroup", "traffic light", "traffic sign", "vegetation", "terrain", "sky", "person", "rider", "car"),
    *("truck", "bus", "caravan", "trailer", "train", "motorcycle", "bicycle", "garage", "gate", "stop"),
    *("smallpole", "lamp", "trash bin", "vending machine", "box", "unknown construction", "unknown vehicle"),
    "unknown object",
)
"""Names of KITTI-360's classes by their label id, 0 to 44: Cityscapes' and eleven more. (kitti360Scripts,
helpers/labels.py.)"""

UNLABELLED = 255
"""Also no label: what many networks write where they have none."""

MARGIN = 1 / 200
"""What moves is hidden with a margin, as a share of the picture's longer side (7 of 1400 pixels): labels end a few
pixels beside the outline, and motion blurs it."""


def label_path(root: Path, sequence: str, camera: str, frame: int) -> Path:
    """Where the labels of a frame lie, if there are any, in the data set's folder `root`."""
    return root / "data_2d_semantics" / "train" / sequence / camera / "semantic" / f"{frame:010d}.png"


def check_label_header(path: Path) -> None:
    """Check that a file can be a label map, without decoding it.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: not a whole 8-bit PNG of one channel.
    """
    header = read_png_header(path)
    if header.bit_depth != 8 or header.colour != "grey":
        raise InputError(
            f"{path}: found {header.bit_depth}-bit {header.colour}, expected an 8-bit PNG of one channel with "
            "KITTI-360's label ids. Take the files in semantic/, not those in semantic_rgb/ or instance/."
        )


def read_labels(path: Path) -> UInt8[np.ndarray, "h w"]:
    """Read a label map.

    Returns:
        Label ids: places in `CLASSES`, or `UNLABELLED`.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: not a whole 8-bit PNG of one channel, or with ids that no class has.
    """
    check_label_header(path)
    labels = cv2.imdecode(np.frombuffer(read_png_bytes(path), np.uint8), cv2.IMREAD_UNCHANGED)
    if labels is None or labels.ndim != 2:
        raise InputError(f"{path}: cannot be decoded as a picture. Copy or make the file again.")
    unknown = np.setdiff1d(labels, [*range(len(CLASSES)), UNLABELLED])
    if unknown.size:
        raise InputError(
            f"{path}: holds {', '.join(map(str, unknown[:5]))}, which are not ids of KITTI-360's classes (0 to "
            f"{len(CLASSES) - 1}, {UNLABELLED} = none). Write the labels as ids."
        )
    return labels


def check_classes(classes: Iterable[str]) -> list[int]:
    """Find the ids of classes.

    Raises:
        InputError: there is no such class; lists those there are.
    """
    ids = []
    for name in classes:
        if name not in CLASSES:
            raise InputError(f"{name!r} is no class of KITTI-360's; expected some of {', '.join(CLASSES)}.")
        ids.append(CLASSES.index(name))
    return ids


def keep_static(labels: UInt8[np.ndarray, "h w"], classes: Iterable[str]) -> Bool[np.ndarray, "h w"]:
    """Mask out things that move, with a margin.

    Returns:
        True = use the pixel.

    Raises:
        InputError: there is no such class.
    """
    return ~dilated(np.isin(labels, check_classes(classes)), MARGIN * max(labels.shape))


def sky(labels: UInt8[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Where the labels say sky."""
    return labels == CLASSES.index("sky")
