"""What a rendered view is evaluated by: pictures inside a mask, and distances.

Pictures are `[h, w, 3]` in 0 to 1, masks `[h, w]` (True = evaluate the pixel), distances `[h, w]` in metres along the
ray. What lies outside the mask never counts, be it NaN. Each picture metric is one number a picture, always finite;
a mask that leaves nothing to evaluate is an error, not a number: check masks before a run, not in the middle of one.
nerfstudio's `psnr`, `ssim` and `lpips` are of the full frame; these are not.
"""

from __future__ import annotations

import functools
import logging
import math
from collections.abc import Callable
from pathlib import Path
from urllib.parse import urlparse

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torchvision.models import AlexNet_Weights

from edge_depth_nerf.base.errors import InputError

LOG = logging.getLogger(__name__)

SSIM_RADIUS_PX = 5
"""Radius of SSIM's Gaussian window (11 px, standard deviation 1.5 px, as in nerfstudio)."""
SSIM_SIZE_PX = 2 * SSIM_RADIUS_PX + 1
"""Side of that window."""

LEAST_SQUARED_ERROR = 1e-10
"""Below this mean squared error PSNR stays at 100 dB, so that equal pictures have a finite figure."""

EVALUATED_RANGE_M = (1.0, 60.0)
"""Depth errors are taken where the true distance lies in this range, metres."""


def _check_pictures(function: str, pred: Tensor, target: Tensor, mask: Tensor) -> None:
    if pred.ndim != 3 or pred.shape[-1] != 3 or pred.shape != target.shape or pred.shape[:2] != mask.shape:
        raise InputError(
            f"{function}: found pred {tuple(pred.shape)}, target {tuple(target.shape)}, mask {tuple(mask.shape)}; "
            "expected (h, w, 3) twice and (h, w)."
        )
    if not mask.any():
        raise InputError(f"{function}: the mask {tuple(mask.shape)} keeps no pixel; there is nothing to evaluate.")


def _blacked_out(picture: Tensor, mask: Tensor) -> Tensor:
    """[h, w, 3] to [1, 3, h, w], black outside the mask (a product would keep NaN)."""
    return torch.where(mask[..., None], picture, 0).movedim(-1, 0)[None]


def masked_psnr(
    pred: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"], mask: Bool[Tensor, "h w"]
) -> Float[Tensor, ""]:
    """Compute the peak signal-to-noise ratio over the mask's pixels, dB for a peak of 1; at most 100.

    Raises:
        InputError: shapes that do not fit, or an empty mask.
    """
    _check_pictures("masked_psnr", pred, target, mask)
    return -10 * torch.log10((pred[mask] - target[mask]).square().mean().clamp(min=LEAST_SQUARED_ERROR))


def _whole_windows(mask: Tensor) -> Tensor:
    """[h, w] to [h - 10, w - 10]: True where a whole window of SSIM lies in the mask."""
    if min(mask.shape) < SSIM_SIZE_PX:
        return mask.new_zeros(0)
    # a window fits where the largest of "outside" over it is still 0; without padding, so inside the picture
    return torch.nn.functional.max_pool2d((~mask).float()[None, None], SSIM_SIZE_PX, stride=1)[0, 0] == 0


def has_whole_window(mask: Bool[Tensor, "h w"]) -> bool:
    """Say whether SSIM can be taken inside a mask: whether one whole window, 11×11 px, lies in it."""
    return bool(_whole_windows(mask).any())


def masked_ssim(
    pred: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"], mask: Bool[Tensor, "h w"]
) -> Float[Tensor, ""]:
    """Compute structural similarity, averaged over the pixels whose whole window lies in the mask and the picture.

    With a mask that keeps everything this is SSIM without the picture's rim; torchmetrics (and so nerfstudio) fills
    the windows of the rim with reflections.

    Raises:
        InputError: shapes that do not fit, or a mask that is empty or nowhere as wide as the window.
    """
    _check_pictures("masked_ssim", pred, target, mask)
    fits = _whole_windows(mask)
    if not fits.any():
        raise InputError(
            f"masked_ssim: the mask {tuple(mask.shape)} has no {SSIM_SIZE_PX}×{SSIM_SIZE_PX} window inside; "
            "it is too thin, or the picture too small, for SSIM."
        )
    # torchmetrics takes a second and more to import; no command of nerfstudio's should wait for it at its start
    from torchmetrics.functional.image import structural_similarity_index_measure

    _, full = structural_similarity_index_measure(
        _blacked_out(pred, mask), _blacked_out(target, mask), data_range=1.0, return_full_image=True
    )
    inner = full[0, :, SSIM_RADIUS_PX:-SSIM_RADIUS_PX, SSIM_RADIUS_PX:-SSIM_RADIUS_PX]
    return inner[:, fits].mean()


def masked_lpips(
    pred: Float[Tensor, "h w 3"],
    target: Float[Tensor, "h w 3"],
    mask: Bool[Tensor, "h w"],
    network: Callable[[Tensor, Tensor], Tensor],
) -> Float[Tensor, ""]:
    """Compute LPIPS of the two pictures, both blacked out outside the mask, and clipped to 0 to 1 for the network.

    Raises:
        InputError: shapes that do not fit, or an empty mask.
    """
    _check_pictures("masked_lpips", pred, target, mask)
    pictures = (_blacked_out(picture, mask).clamp(0, 1) for picture in (pred, target))
    with torch.no_grad():
        return network(*pictures)


def masked_flip(
    pred: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"], mask: Bool[Tensor, "h w"]
) -> Float[Tensor, ""]:
    """Compute FLIP, the difference that a viewer sees when two pictures alternate: 0 = none, 1 = the largest.

    Both are blacked out outside the mask, whose pixels alone are averaged. A degree of the view is 67 pixels wide, as
    on a large monitor (FLIP's default). It is computed on the CPU, in about 3 µs a pixel.

    Raises:
        InputError: shapes that do not fit, or an empty mask.
    """
    _check_pictures("masked_flip", pred, target, mask)
    from flip_evaluator import evaluate  # loads a library of its own

    reference, test = (
        _blacked_out(each, mask)[0].movedim(0, -1).clamp(0, 1).cpu().float().contiguous().numpy()
        for each in (target, pred)
    )
    difference, *_ = evaluate(reference, test, "LDR", applyMagma=False, computeMeanError=False)
    return torch.from_numpy(difference)[..., 0][mask.cpu()].mean()


@functools.cache
def _say_once(message: str) -> None:
    LOG.warning(message)


def lpips_weights() -> tuple[Path, str]:
    """Say where AlexNet's weights lie if they are on this machine, and the address they come from."""
    url = AlexNet_Weights.IMAGENET1K_V1.url
    return Path(torch.hub.get_dir()) / "checkpoints" / Path(urlparse(url).path).name, url


def load_lpips() -> torch.nn.Module | None:
    """Build LPIPS (AlexNet, as nerfstudio has it) if AlexNet's weights lie in torch.hub's folder.

    Nothing is ever downloaded, and no figure comes from random weights: without the file the answer is None, and the
    log reports it once; likewise for a file that cannot be read. The module takes pictures `[1, 3, h, w]` in 0 to 1.
    """
    path, url = lpips_weights()
    if not path.is_file():
        _say_once(f"LPIPS is left out: no AlexNet weights at {path}. To get LPIPS, put the file of {url} there.")
        return None
    from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

    try:
        return LearnedPerceptualImagePatchSimilarity(net_type="alex", normalize=True).eval()
    except Exception as error:  # torch raises whatever its readers meet
        _say_once(f"LPIPS is left out: {path} cannot be read ({error}). Fetch {url} again.")
        return None


class DepthErrors:
    """Errors of rendered distances, pooled over the pixels of all pictures given (not averaged over pictures).

    A pixel is evaluated where its mask is True and its *true* distance lies in `EVALUATED_RANGE_M`; the prediction may
    be anything finite.
    """

    def __init__(self) -> None:
        self.pixels = 0
        self._relative = 0.0
        self._squared = 0.0
        self._close = 0

    def update(
        self, pred_distance_m: Float[Tensor, "h w"], true_distance_m: Float[Tensor, "h w"], mask: Bool[Tensor, "h w"]
    ) -> None:
        """Add a picture; one without any evaluated pixel adds nothing.

        Args:
            pred_distance_m: rendered distance, metres along the ray.
            true_distance_m: LiDAR or truth, metres along the ray, 0 = none.
            mask: True = evaluate.

        Raises:
            InputError: shapes that do not fit, or a prediction that is not finite at a evaluated pixel.
        """
        if not pred_distance_m.shape == true_distance_m.shape == mask.shape:
            raise InputError(
                f"DepthErrors.update: found pred_distance_m {tuple(pred_distance_m.shape)}, true_distance_m "
                f"{tuple(true_distance_m.shape)}, mask {tuple(mask.shape)}; expected one shape."
            )
        low, high = EVALUATED_RANGE_M
        evaluated = mask & (true_distance_m >= low) & (true_distance_m <= high)
        pred, true = pred_distance_m[evaluated].double(), true_distance_m[evaluated].double()
        broken = int((~torch.isfinite(pred)).sum())
        if broken:
            raise InputError(
                f"DepthErrors.update: {broken} of {pred.numel()} evaluated pixels have a prediction that is not "
                "finite; expected metres. Mask out rays that cannot be rendered."
            )
        difference = pred - true
        self.pixels += pred.numel()
        self._relative += float((difference.abs() / true).sum())
        self._squared += float(difference.square().sum())
        self._close += int(((pred < 1.25 * true) & (true < 1.25 * pred)).sum())

    def compute(self, prefix: str) -> dict[str, float]:
        """Give the pooled figures so far, under `prefix` ("lidar_", "truth_").

        Returns:
            `abs_rel` (mean of |pred - true| / true), `rmse_m` (metres), `delta_1_25` (the part, 0 to 1, of pixels
            with max(pred / true, true / pred) < 1.25) and `pixels`, all finite; nothing at all if no pixel was
            evaluated, so that no figure stands for an absent measurement.
        """
        if not self.pixels:
            return {}
        return {
            f"{prefix}abs_rel": self._relative / self.pixels,
            f"{prefix}rmse_m": math.sqrt(self._squared / self.pixels),
            f"{prefix}delta_1_25": self._close / self.pixels,
            f"{prefix}pixels": float(self.pixels),
        }
