"""How sharp a new view can be that is made from one picture: a picture moved by a part of a pixel, from itself.

    python benchmarks/picture_limit.py DRIVE... --by 5

DRIVE is a rendered drive with large pictures (`edge-depth-nerf synthesize --size 1280`). Its noise-free pictures are
averaged over squares of `--by` by `--by` pixels, twice: the second time the squares begin half a square further right
and down. The second picture is what a camera sees that is turned by half a pixel. It is interpolated from the first
one, without any error of geometry, and compared with the average itself, inside the mask.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
import torch
from scipy.ndimage import shift

from edge_depth_nerf.method.metrics import masked_psnr, masked_ssim

ORDERS = {"linear": 1, "cubic": 3}
"""Of the splines between pixels."""


def averaged(picture: np.ndarray, by: int, begin: int) -> np.ndarray:
    """Means over squares of `by` by `by` pixels, the first of which begins at (begin, begin)."""
    rows, columns = ((side - by) // by for side in picture.shape[:2])
    part = picture[begin : begin + rows * by, begin : begin + columns * by]
    return part.reshape(rows, by, columns, by, -1).mean(axis=(1, 3))


def limits(picture: np.ndarray, mask: np.ndarray, by: int) -> dict[str, float]:
    """PSNR, dB, and SSIM of a picture of 0..1, moved by by // 2 of its pixels and interpolated from itself."""
    begin = by // 2
    given, wanted = averaged(picture, by, 0), averaged(picture, by, begin)
    # pixels that the interpolation reaches are inside, too
    inside = np.all([averaged(mask[..., None].astype(np.float32), by, at)[..., 0] == 1 for at in (0, begin)], axis=0)
    inside = cv2.erode(inside.astype(np.uint8), np.ones((5, 5), np.uint8), borderType=cv2.BORDER_CONSTANT).astype(bool)
    found = {}
    for name, order in ORDERS.items():
        moved = shift(given, (-begin / by, -begin / by, 0), order=order, mode="nearest").clip(0, 1)
        one, other, mask_of_both = torch.from_numpy(moved), torch.from_numpy(wanted), torch.from_numpy(inside)
        found[f"{name} PSNR"] = float(masked_psnr(one, other, mask_of_both))
        found[f"{name} SSIM"] = float(masked_ssim(one, other, mask_of_both))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("drives", type=Path, nargs="+")
    parser.add_argument("--by", type=int, default=5)
    options = parser.parse_args()
    for drive in options.drives:
        found = []
        for path in sorted(drive.glob("truth/*/image_0?/rgb/*.png")):
            camera = path.parent.parent.name
            picture = cv2.imread(str(path))
            mask = cv2.imread(str(drive / "truth" / "masks" / f"{camera}.png"), cv2.IMREAD_GRAYSCALE)
            assert picture is not None and mask is not None, path
            found.append(limits(picture.astype(np.float32) / 255, mask > 0, options.by))
        means = {name: np.mean([each[name] for each in found]) for name in found[0]}
        side = picture.shape[1] // options.by
        words = ", ".join(f"{name} {value:.3f}" for name, value in means.items())
        print(
            f"{drive.name}: {len(found)} pictures of {side} px, moved by {options.by // 2 / options.by:.2f} px: {words}"
        )


if __name__ == "__main__":
    main()
