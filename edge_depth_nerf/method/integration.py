"""The depth prior: LiDAR and monocular distance integrated into one dense map, and how far each pixel is trusted.

All maps are H×W, metres along the ray. `lidar_m` is D (0 = no LiDAR point), `mono_m` D̂ (0 = no estimate), `valid` the
pixels that may be used at all (True = use). A pixel outside
`valid`, or whose d̂ is not a finite positive number, gives no weight and gets none; outside the picture there is
nothing. Where the prior is 0 there is none. A LiDAR distance that is not finite or not positive counts as none.

Eq. 7   g  = exp(-(k² + l²) / 2σ_s²) · exp(-(d̂[i,j] - d̂[i+k,j+l])² / 2σ_d²),   k, l in -r .. r, kernel 2r + 1
Eq. 5   d̃ = (1/η) Σ g · (α d 1(d > 0) + (1-α) d̂ 1(d = 0))                       d, d̂ read at [i+k, j+l]
Eq. 6   η = Σ g · (α 1(d > 0) + (1-α) 1(d = 0))

Distances from motion, m, are a third source. They and the monocular ones share the estimate's part of Eq. 5, by the
weight ρ that the measured errors of both give:

        (1-α) d̂ 1(d = 0)  becomes  (1-α) (ρ m + (1-ρ) d̂) 1(d = 0)

where a pixel has both, and the one it has elsewhere. This d̂, of both, is also what g compares. Without motion nothing
changes.

Eq. 5 averages distances of pixels that are not at the same distance: on a slope, or beside an edge, that is an error.
normalise "residual" averages d̂ alone, and then what LiDAR adds to it:

        s  = (1/Σ g) Σ g d̂
        d̃  = s exp(Σ g 1(d > 0) ln(d/s) / max(Σ g 1(d > 0), n)),   all read at [i+k, j+l], n = least_returns

Nothing here is differentiated: the prior is data. Compiled loops (`integration_numba`) integrate on the CPU, torch on a
GPU (`integrate_by_torch`, which tests compare the loops with); both in float64, which keeps the ratios of weights up to
37 sigma_depth_m.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.pictures import is_distance

INTEGRATED = "integrated"
"""The depth source of LiDAR and monocular distance together, and of that from motion where there is any; every other is
the name of one source alone."""
MOTION_RELATIVE_ERROR, MONO_RELATIVE_ERROR = 0.03, 0.1
"""Standard deviations of estimates as parts of the distance, where nothing was measured."""
FLOOR_M = 0.05
"""Standard deviation that LiDAR, its calibration and its alignment leave of a prior, metres."""
Kernel = Literal["edge-aware", "spatial-gaussian"]
Normalise = Literal["pooled", "residual"]

CPU_STRIP_PIXELS = 1 << 16
"""On the CPU a map is integrated in strips of about so many pixels: the work that a thread takes at a time."""
WINDOW_NUMBERS = 1 << 22
"""torch integrates as many rows at a time as have about so many pixels in their windows: 34 MB for each of some seven
numbers of theirs."""
LOWEST_EXPONENT = -700.0
"""Distance factors (Eq. 7) of lower exponents are 0: float64 ends at -745, the last of it with few digits."""


def check_choice(where: str, value: str, choices: object) -> None:
    """Refuse a value that the Literal type `choices` does not list.

    Raises:
        InputError: names `where`, the value and what is allowed.
    """
    allowed = get_args(choices)
    if value not in allowed:
        raise InputError(f"{where} is {value!r}; expected one of {', '.join(map(repr, allowed))}.")


def check_number(where: str, value: float, low: float, high: float = math.inf) -> None:
    """Refuse a number that is not finite, or not from `low` to `high`.

    Raises:
        InputError: names `where`, the number and what is expected.
    """
    if not (math.isfinite(value) and low <= value <= high):
        expected = f"a finite number from {low:g}" + (f" to {high:g}" if high < math.inf else "")
        raise InputError(f"{where} is {value}; expected {expected}.")


@dataclass(frozen=True)
class IntegrationOptions:
    """How two distance maps become one; the defaults are the paper's.

    Raises:
        InputError: a field is out of its range; the message names field, value and what was expected.
    """

    alpha: float = 0.7
    """pooled: weight of a LiDAR point; a monocular value has 1 - alpha. 0 to 1 (Eq. 5)."""
    kernel_size: int = 9
    """Width of the square window in pixels, odd (Eq. 7)."""
    sigma_space_px: float = 3.0
    """Standard deviation of the kernel over the picture, pixels (Eq. 7)."""
    sigma_depth_m: float = 1.0
    """Standard deviation of the kernel over distance, metres (Eq. 7)."""
    sigma_depth_growth_per_m: float = 0.0
    """The standard deviation over distance is at least this factor times the square of the distance at the centre,
    because the distances of neighbouring ground pixels differ by the square of their distance over the camera's height.
    0: Eq. 7."""
    kernel: Kernel = "edge-aware"
    """edge-aware: Eq. 7. spatial-gaussian: Eq. 7 without its distance factor."""
    normalise: Normalise = "pooled"
    """pooled: Eq. 5. residual: the monocular map is averaged alone, and LiDAR points correct it around them by their
    relative difference from it."""
    least_returns: float = 2.0
    """residual: where the LiDAR points of a window together weigh less than this many points at its centre, they count
    in proportion. With 0.1 a single point corrects its whole window, and makes a square."""
    keep_returns: bool = False
    """Keep a LiDAR point's distance (d̃ = d, spread 0, monocular share 0) instead of averaging it with its window."""

    def __post_init__(self) -> None:
        check_number("alpha", self.alpha, 0.0, 1.0)
        check_number("sigma_space_px", self.sigma_space_px, 1e-3)
        check_number("sigma_depth_m", self.sigma_depth_m, 1e-3)
        check_number("sigma_depth_growth_per_m", self.sigma_depth_growth_per_m, 0.0)
        if not (self.kernel_size >= 1 and self.kernel_size % 2 == 1):
            raise InputError(f"kernel_size is {self.kernel_size}; expected an odd whole number of pixels from 1.")
        check_number("least_returns", self.least_returns, 0.1)
        check_choice("kernel", self.kernel, Kernel)
        check_choice("normalise", self.normalise, Normalise)


@dataclass(frozen=True)
class IntegratedDepth:
    """A prior for every pixel; all three maps are 0 where there is none."""

    distance_m: Float[Tensor, "h w"]
    """d̃, metres along the ray."""
    spread_m: Float[Tensor, "h w"]
    """Weighted standard deviation, metres, of the values that were averaged into d̃ (weights as in Eq. 5)."""
    mono_share: Float[Tensor, "h w"]
    """The part of d̃'s weight that came from monocular values, 0 to 1; LiDAR gave the rest. With normalise residual, 1
    less LiDAR's weight over least_returns."""


def check_maps(function: str, **maps: Tensor | NDArray) -> None:
    """Refuse maps that differ in shape, or have no rows and columns.

    Raises:
        InputError: names `function`, the maps and their shapes.
    """
    shapes = {name: tuple(pixels.shape) for name, pixels in maps.items()}
    if len(set(shapes.values())) > 1 or any(len(shape) != 2 for shape in shapes.values()):
        found = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
        raise InputError(f"{function}: found {found}; expected maps of one shape (height, width).")


def _is_distance(distance_m: Tensor) -> Tensor:
    return torch.isfinite(distance_m) & (distance_m > 0)


def join_estimates(
    mono_m: Float[np.ndarray, "h w"], motion_m: Float[np.ndarray, "h w"], motion_weight: float
) -> Float[np.ndarray, "h w"]:
    """Average monocular distances and those from motion, pixel by pixel: the d̂ of three sources.

    Args:
        mono_m: metres along the ray; 0, or not finite: none.
        motion_m: the same of motion.
        motion_weight: ρ, 0 to 1: motion's part where a pixel has both.

    Raises:
        InputError: the maps differ in shape, or the weight is out of its range.
    """
    check_maps("join_estimates", mono_m=mono_m, motion_m=motion_m)
    check_number("motion_weight", motion_weight, 0.0, 1.0)
    has_mono, has_motion = is_distance(mono_m), is_distance(motion_m)
    with np.errstate(invalid="ignore"):
        both = np.where(has_mono & has_motion, motion_weight * motion_m + (1 - motion_weight) * mono_m, mono_m)
    return np.where(has_motion & ~has_mono, motion_m, both)


def weight_of_errors(motion_error: float, mono_error: float) -> float:
    """Give the ρ of `join_estimates` that makes the mean's error least, if the errors of both are independent.

    Both are relative standard deviations.
    """
    return mono_error**2 / max(motion_error**2 + mono_error**2, 1e-12)


def integrate_depth(
    lidar_m: Float[Tensor, "h w"],
    mono_m: Float[Tensor, "h w"],
    valid: Bool[Tensor, "h w"],
    options: IntegrationOptions | None = None,
    device: torch.device | str | None = None,
) -> IntegratedDepth:
    """Average LiDAR and monocular distances over an edge-aware window (Eq. 5 to 7).

    `spread_m` is the weighted standard deviation of the very values that were averaged, from sums of their
    differences to the centre's d̂ (so that 80 m do not swallow 8 cm).

    With normalise "residual" it is the root of two squares: d̂'s spread in the window, and that of LiDAR's relative
    differences, by LiDAR's part of the weight.

    Args:
        lidar_m: D, metres along the ray, 0 = no LiDAR point.
        mono_m: D̂, metres along the ray, 0 = no estimate.
        valid: True where the pixel may be used.
        options: the defaults are the paper's.
        device: what computes; None: the maps' own.

    Returns:
        Three maps in float32, or in float64 if either input was, where the maps are; 0 where there is no prior.

    Raises:
        InputError: the maps differ in shape.
    """
    options = options or IntegrationOptions()
    check_maps("integrate_depth", lidar_m=lidar_m, mono_m=mono_m, valid=valid)
    dtype = _work_dtype(lidar_m, mono_m)
    device = mono_m.device if device is None else torch.device(device)
    lidar, mono = (pixels.detach().to(device, dtype) for pixels in (lidar_m, mono_m))
    usable = valid.to(device)
    # empty, not zeros: torch's own threads, once they have filled so many, spin for a while beside ours
    result = mono.new_empty(3, *mono.shape)
    integrate = _integrate_on_cpu if device.type == "cpu" else integrate_by_torch
    integrate(lidar, mono, usable, options, result)
    if options.keep_returns:
        points, none = usable & _is_distance(mono) & _is_distance(lidar), torch.zeros_like(lidar)
        result = torch.where(points, torch.stack([lidar, none, none]), result)
    return IntegratedDepth(*result.to(mono_m.device))


def _work_dtype(*maps: Tensor) -> torch.dtype:
    return torch.float64 if any(tensor.dtype == torch.float64 for tensor in maps) else torch.float32


def _along_axis(options: IntegrationOptions) -> list[float]:
    """List the spatial weights along one axis: Eq. 7's first factor is the product of two of them."""
    radius = int(options.kernel_size) // 2
    return [math.exp(-0.5 * (k / options.sigma_space_px) ** 2) for k in range(-radius, radius + 1)]


def _integrate_on_cpu(lidar: Tensor, mono: Tensor, valid: Tensor, options: IntegrationOptions, out: Tensor) -> None:
    """Integrate one map, [h, w] each, into [3, h, w], rows as the fields of IntegratedDepth."""
    # imported here, because Numba takes half a second to load
    from edge_depth_nerf.method.integration_numba import correct_rows, integrate_rows

    points, estimates, usable = (tensor.contiguous().numpy() for tensor in (lidar, mono, valid))
    kernel = (
        np.array(_along_axis(options)),
        # 0 makes Eq. 7's second factor 1
        options.sigma_depth_m**-2 if options.kernel == "edge-aware" else 0.0,
        float(options.sigma_depth_growth_per_m),
        LOWEST_EXPONENT,
    )
    result = [tensor.numpy() for tensor in out]
    if options.normalise == "pooled":
        share = float(options.alpha)
        _by_strips(functools.partial(integrate_rows, points, estimates, usable, *result, *kernel, share), mono)
        return
    smooth = [np.empty(mono.shape) for _ in range(3)]
    none = np.zeros_like(points)
    _by_strips(functools.partial(integrate_rows, none, estimates, usable, *smooth, *kernel, 0.0), mono)
    few = float(options.least_returns)
    _by_strips(functools.partial(correct_rows, points, estimates, *smooth[:2], *result, *kernel, few), mono)


def _by_strips(integrate: Callable[[int, int], None], mono: Tensor) -> None:
    """Call a loop with the first row and the one after the last of each strip of a map.

    Threads of our own share the rows out: they wait for each other without spinning, and unlike Numba's they
    allow concurrent callers and forked processes. There are as many as torch may use.
    """
    from edge_depth_nerf.method.integration_numba import TILE

    height, width = mono.shape
    edges = [*range(0, height, max(1, CPU_STRIP_PIXELS // max(TILE, width))), height]
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        list(pool.map(integrate, edges, edges[1:]))


def integrate_by_torch(
    lidar: Float[Tensor, "h w"],
    mono: Float[Tensor, "h w"],
    valid: Bool[Tensor, "h w"],
    options: IntegrationOptions,
    out: Float[Tensor, "3 h w"],
) -> None:
    """Integrate one map on any device, some rows at a time; distances are metres along the ray.

    `out` gets the fields of IntegratedDepth, one after the other.
    """
    if not out.numel():
        return
    usable = valid & _is_distance(mono)
    points = usable & _is_distance(lidar)
    centres = torch.where(usable, mono, 0).double()
    if options.normalise == "pooled":
        values = torch.where(points, lidar.double(), centres)
        maps = torch.stack([centres, values, (usable & ~points).double(), points.double()])
        result = _in_windows(_averaged, maps, options)
    else:
        smooth = _in_windows(_averaged, torch.stack([centres, centres, usable.double(), 0 * centres]), options)
        residual = torch.where(points, lidar.double() / smooth[0], 1).log()
        corrections = _in_windows(_corrections, torch.stack([centres, residual, points.double()]), options)
        result = _corrected(smooth, corrections)
    out.copy_(result * usable)


def _in_windows(
    of_windows: Callable[[Tensor, Tensor, IntegrationOptions], Tensor],
    maps: Float[Tensor, "maps h w"],
    options: IntegrationOptions,
) -> Float[Tensor, "3 h w"]:
    """Compute something of each pixel's window and centre, some rows at a time; the first map is what g compares."""
    size = int(options.kernel_size)
    # of each pixel its window, without a copy: [maps, h, w, kernel, kernel]
    windows = torch.nn.functional.pad(maps, (size // 2,) * 4).unfold(1, size, 1).unfold(2, size, 1)
    rows = max(1, WINDOW_NUMBERS // max(1, size * size * maps.shape[2]))
    parts = zip(windows.split(rows, 1), maps[0].split(rows), strict=True)
    return torch.cat([of_windows(some, centres, options) for some, centres in parts], 1)


def _weights(
    mono: Float[Tensor, "h w k k"], centres: Float[Tensor, "h w"], options: IntegrationOptions
) -> Float[Tensor, "h w k k"]:
    """Give g of Eq. 7."""
    along_axis = centres.new_tensor(_along_axis(options))
    space = along_axis[:, None] * along_axis
    if options.kernel == "spatial-gaussian":
        return space.expand_as(mono)
    centre = centres[..., None, None]
    sigma_m = (options.sigma_depth_growth_per_m * centre.square()).clamp(min=options.sigma_depth_m)
    exponent = -0.5 * ((mono - centre) / sigma_m).square()
    return torch.where(exponent > LOWEST_EXPONENT, exponent.exp() * space, 0)


def _averaged(
    windows: Float[Tensor, "4 h w k k"], centres: Float[Tensor, "h w"], options: IntegrationOptions
) -> Float[Tensor, "3 h w"]:
    """Give d̃, spread and monocular share of pixels, by Eq. 5 to 7; 0 where η is."""
    mono, values, is_mono, is_lidar = windows
    g = _weights(mono, centres, options)
    of_mono = g * is_mono * (1 - options.alpha if options.normalise == "pooled" else 1.0)
    weights = of_mono + g * is_lidar * options.alpha
    eta = weights.sum((-2, -1))
    some = eta > 0
    share = weights / torch.where(some, eta, 1)[..., None, None]
    # from the centre, so that 80 m do not swallow 8 cm
    centre = centres[..., None, None]
    mean = (share * (values - centre)).sum((-2, -1))
    variance = (share * (values - centre - mean[..., None, None]).square()).sum((-2, -1))
    mono_share = of_mono.sum((-2, -1)) / torch.where(some, eta, 1)
    return torch.stack([centres + mean, variance.sqrt(), mono_share]) * some


def _corrections(
    windows: Float[Tensor, "3 h w k k"], centres: Float[Tensor, "h w"], options: IntegrationOptions
) -> Float[Tensor, "3 h w"]:
    """Give mean and variance of the LiDAR points' ln(d/s) in windows, and their part of the weight, 0 to 1."""
    mono, residual, is_lidar = windows
    weights = _weights(mono, centres, options) * is_lidar
    total = weights.sum((-2, -1))
    share = weights / torch.where(total > 0, total, 1)[..., None, None]
    mean = (share * residual).sum((-2, -1))
    variance = (share * (residual - mean[..., None, None]).square()).sum((-2, -1))
    part = total / total.clamp(min=options.least_returns)
    return torch.stack([mean, variance, part])


def _corrected(smooth: Float[Tensor, "3 h w"], corrections: Float[Tensor, "3 h w"]) -> Float[Tensor, "3 h w"]:
    mean, variance, part = corrections
    distance_m = smooth[0] * (part * mean).exp()
    spread_m = (smooth[1].square() + part * variance * distance_m.square()).sqrt()
    return torch.stack([distance_m, spread_m, 1 - part])


def select_prior(
    depth_source: str,
    maps: Mapping[str, Float[Tensor, "h w"] | None],
    valid: Bool[Tensor, "h w"],
    options: IntegrationOptions | None = None,
    device: torch.device | str | None = None,
) -> IntegratedDepth:
    """Give the prior made of LiDAR and monocular distance (`integrate_depth`) or of one source alone (Table 3).

    LiDAR alone is D where it has a point, spread 0 and monocular share 0; any other source alone is an estimate: its
    map, spread 0 and share 1.

    Args:
        depth_source: integrated, or the name of a source.
        maps: distance in metres by source, 0 = none; those that are not needed may be missing or None.
        valid: where the picture may be used.
        options: of the integration.
        device: what integrates; None: the maps' own.

    Raises:
        InputError: the source needs a map that is not there, or the maps differ in shape.
    """
    needed = ("lidar", "mono") if depth_source == INTEGRATED else (depth_source,)
    found = {name: pixels for name, pixels in maps.items() if name in needed and pixels is not None}
    if missing := [name for name in needed if name not in found]:
        raise InputError(
            f"depth_source {depth_source!r} needs {' and '.join(missing)} distance maps, which the scene does not "
            "have; add them, or choose a depth_source that the scene has."
        )
    if depth_source == INTEGRATED:
        return integrate_depth(found["lidar"], found["mono"], valid, options, device)
    source = found[depth_source]
    check_maps("select_prior", source=source, valid=valid)
    exists = valid & _is_distance(source)
    distance_m = torch.where(exists, source.detach(), 0).to(_work_dtype(source))
    zero = torch.zeros_like(distance_m)
    return IntegratedDepth(distance_m, zero, zero if depth_source == "lidar" else exists.to(distance_m.dtype))


def combined_sigma_m(prior: IntegratedDepth, mono_m: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Give σ̂, the standard deviation that Eq. 4 grants the prior, where its error was not measured.

    σ̂² = spread² + (MONO_RELATIVE_ERROR · d̂ · monocular share)² + FLOOR_M².

    Args:
        prior: what `integrate_depth` or `select_prior` gave.
        mono_m: d̂; it may be anything where the prior has no monocular share.

    Returns:
        Metres, positive where there is a prior and 0 where there is none.
    """
    exists = prior.distance_m > 0
    # d̂ may be NaN where there is no prior
    mono_error = torch.where(exists, mono_m, 0) * prior.mono_share * MONO_RELATIVE_ERROR
    sigma = (prior.spread_m.square() + mono_error.square() + FLOOR_M**2).sqrt()
    return torch.where(exists, sigma, 0)
