"""The depth prior: LiDAR and monocular distance integrated into one dense map, and how far each pixel is trusted.

All maps are H×W, metres along the ray, any leading batch dimensions; maps of a batch do not mix. `lidar_m` is
D (0 = no return), `mono_m` D̂ (0 = no estimate), `valid` the pixels that may be used at all (True = use).
A pixel outside `valid`, or whose d̂ is not a finite positive number, gives no weight and gets none; outside the
picture there is nothing. Where the prior is 0 there is none. A return that is not finite or not positive is none.

Eq. 7   g  = exp(-(k² + l²) / 2σ_s²) · exp(-(d̂[i,j] - d̂[i+k,j+l])² / 2σ_d²),   k, l in -r .. r, kernel 2r + 1
Eq. 5   d̃ = (1/η) Σ g · (α d 1(d > 0) + (1-α) d̂ 1(d = 0))                       d, d̂ read at [i+k, j+l]
Eq. 6   η = Σ g · (α 1(d > 0) + (1-α) 1(d = 0))

Nothing here is differentiated: the prior is data. CPU and CUDA tensors; work is done in float32, or in float64
for float64 maps, for sums over returns and where the weights of a window may all be tiny.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from edge_depth_nerf.errors import InputError

Integration = Literal["edge-aware", "spatial-gaussian"]
Normalise = Literal["pooled", "per-source"]
RangeGuide = Literal["mono", "lidar"]
DepthSource = Literal["integrated", "lidar", "mono"]
SigmaMode = Literal["constant", "image", "spread", "combined"]

CPU_STRIP_PIXELS = 1 << 16
"""On the CPU a map is integrated in strips of about so many pixels, whose sums then stay in the cache."""


def _check_choice(where: str, value: str, choices: object) -> None:
    """Refuse a value that the Literal type `choices` does not list.

    Raises:
        InputError: names `where`, the value and what is allowed.

    """
    allowed = get_args(choices)
    if value not in allowed:
        raise InputError(f"{where} is {value!r}; expected one of {', '.join(map(repr, allowed))}.")


def _check_number(where: str, value: float, low: float, high: float = math.inf) -> None:
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
    """Weight of a LiDAR return against 1 - alpha of a monocular value, 0 to 1 (Eq. 5)."""
    kernel_size: int = 9
    """Width of the square window in pixels, odd (Eq. 7)."""
    sigma_space_px: float = 3.0
    """Standard deviation of the kernel over the picture, pixels (Eq. 7)."""
    sigma_depth_m: float = 1.0
    """Standard deviation of the kernel over distance, metres (Eq. 7)."""
    integration: Integration = "edge-aware"
    """edge-aware: Eq. 7. spatial-gaussian: Eq. 7 without its distance factor (the rival of Table 4)."""
    normalise: Normalise = "pooled"
    """pooled: Eq. 5, each pixel of the window counts. per-source: alpha weighs the two sources, not their counts."""
    keep_returns: bool = False
    """Keep a return as it is (d̃ = d, spread 0, monocular share 0) instead of averaging it with its window."""
    range_guide: RangeGuide = "mono"
    """What the window's d̂ is compared with: d̂ at the centre (Eq. 7), or LiDAR at the centre where it has a return
    (the paper's prose)."""

    def __post_init__(self) -> None:
        _check_number("alpha", self.alpha, 0.0, 1.0)
        _check_number("sigma_space_px", self.sigma_space_px, 1e-3)
        _check_number("sigma_depth_m", self.sigma_depth_m, 1e-3)
        if not (self.kernel_size >= 1 and self.kernel_size % 2 == 1):
            raise InputError(f"kernel_size is {self.kernel_size}; expected an odd whole number of pixels from 1.")
        _check_choice("integration", self.integration, Integration)
        _check_choice("normalise", self.normalise, Normalise)
        _check_choice("range_guide", self.range_guide, RangeGuide)


@dataclass(frozen=True)
class IntegratedDepth:
    """A prior for every pixel; all three maps are 0 where there is none."""

    distance_m: Float[Tensor, "*batch h w"]
    """d̃, metres along the ray."""
    spread_m: Float[Tensor, "*batch h w"]
    """Weighted standard deviation, metres, of the values that were averaged into d̃ (weights as in Eq. 5)."""
    mono_share: Float[Tensor, "*batch h w"]
    """The part of d̃'s weight that came from monocular values, 0 to 1; LiDAR gave the rest."""


def _check_maps(function: str, **maps: Tensor | None) -> None:
    shapes = {name: tuple(tensor.shape) for name, tensor in maps.items() if tensor is not None}
    if len(set(shapes.values())) > 1 or any(len(shape) < 2 for shape in shapes.values()):
        found = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
        raise InputError(f"{function}: found {found}; expected maps of one shape (*batch, height, width).")


def _is_distance(distance_m: Tensor) -> Tensor:
    return torch.isfinite(distance_m) & (distance_m > 0)


def integrate_depth(
    lidar_m: Float[Tensor, "*batch h w"],
    mono_m: Float[Tensor, "*batch h w"],
    valid: Bool[Tensor, "*batch h w"],
    options: IntegrationOptions | None = None,
) -> IntegratedDepth:
    """Average LiDAR and monocular distances over an edge-aware window (Eq. 5 to 7).

    `spread_m` is the weighted standard deviation of the very values that were averaged, from sums of their
    differences to the centre's d̂ (so that 80 m do not swallow 8 cm).

    normalise "per-source" first divides each source's weights by the sum of its spatial weights alone, then lets
    alpha weigh the two: how many pixels a source has in the window no longer counts, how well they agree with the
    centre still does. (Were each source divided by its whole weight, a lone return behind an edge would get the
    full alpha, and the edges would be gone.) A source that is alone in the window gets all.

    Args:
        lidar_m: D, metres along the ray, 0 = no return.
        mono_m: D̂, metres along the ray, 0 = no estimate.
        valid: True where the pixel may be used.
        options: the defaults are the paper's.

    Returns:
        Three maps in float32, or in float64 if either input was; 0 where there is no prior.

    Raises:
        InputError: the maps differ in shape.

    """
    options = options or IntegrationOptions()
    _check_maps("integrate_depth", lidar_m=lidar_m, mono_m=mono_m, valid=valid)
    flat = (math.prod(mono_m.shape[:-2]), *mono_m.shape[-2:])
    dtype = _work_dtype(lidar_m, mono_m)
    result = torch.zeros(3, *flat, dtype=dtype, device=mono_m.device)
    inputs = (tensor.detach().reshape(flat) for tensor in (lidar_m, mono_m, valid))
    for i, (lidar, mono, usable) in enumerate(zip(*inputs, strict=True)):
        usable = usable & _is_distance(mono)
        if not usable.any():
            continue
        # nothing outside the bounding box of the usable pixels gives or gets a weight
        rows, columns = usable.any(1).nonzero(), usable.any(0).nonzero()
        box = (slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1))
        with _one_thread():
            maps = _integrate_map(lidar[box].to(dtype), mono[box].to(dtype), usable[box], options)
        result[(slice(None), i, *box)] = maps
    distance_m, spread_m, mono_share = result.reshape(3, *mono_m.shape)
    return IntegratedDepth(distance_m, spread_m, mono_share)


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Let torch use one thread on the CPU.

    The work is ten thousand operations of some ten microseconds: split over threads they gain nothing, and where
    other work wants the cores each waits for its slowest part (measured: ten times longer). A thread that finds
    one thread set leaves it at that, so that concurrent calls cannot restore a wrong number.
    """
    threads = torch.get_num_threads()
    if threads == 1:
        yield
        return
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _work_dtype(*maps: Tensor) -> torch.dtype:
    return torch.float64 if any(tensor.dtype == torch.float64 for tensor in maps) else torch.float32


def _integrate_map(lidar: Tensor, mono: Tensor, usable: Tensor, options: IntegrationOptions) -> Tensor:
    """Integrate one map: [h, w] each to [3, h, w], rows as the fields of IntegratedDepth."""
    returns = usable & _is_distance(lidar)
    mono = torch.where(usable, mono, 0)
    lidar_guide = options.integration == "edge-aware" and options.range_guide == "lidar"
    guide = torch.where(returns, lidar, mono) if lidar_guide else mono
    if lidar_guide or options.alpha == 0:
        # Elsewhere a window holds a return (whose sums are float64) or its own centre, whose distance factor is 1.
        # Here all weights may be tiny: float64 keeps their ratios up to 37 sigma_depth_m, float32 only to 13.
        mono, guide = mono.double(), guide.double()

    height, width = mono.shape
    radius = int(options.kernel_size) // 2
    from_lidar = _lidar_sums(lidar, mono, guide, returns, options)
    padded_mono, padded_weight = (
        torch.nn.functional.pad(image, (radius,) * 4) for image in (mono, (usable & ~returns).to(mono.dtype))
    )
    result = torch.empty(3, height, width, dtype=lidar.dtype, device=mono.device)
    strip = max(1, CPU_STRIP_PIXELS // width) if mono.device.type == "cpu" else height
    for top in range(0, height, strip):
        rows, padded_rows = slice(top, top + strip), slice(top, top + strip + 2 * radius)
        from_mono = _mono_sums(padded_mono[padded_rows], padded_weight[padded_rows], guide[rows], options)
        result[:, rows] = _combine(from_lidar[:, rows], from_mono, guide[rows], options).to(result.dtype)
    result *= usable
    if options.keep_returns:
        result[0] = torch.where(returns, lidar, result[0])
        result[1:] *= ~returns
    return result


def _shifts(options: IntegrationOptions) -> list[tuple[int, int, float]]:
    """List the window's k, l with their spatial weight (Eq. 7, first factor)."""
    radius = int(options.kernel_size) // 2
    steps = range(-radius, radius + 1)
    return [(k, l, math.exp(-0.5 * (math.hypot(k, l) / options.sigma_space_px) ** 2)) for k in steps for l in steps]


def _range_weight(difference: Tensor, options: IntegrationOptions, out: Tensor | None = None) -> Tensor:
    """Eq. 7, second factor."""
    exponent = torch.mul(difference, difference, out=out).mul_(-0.5 / options.sigma_depth_m / options.sigma_depth_m)
    # exp is a hundred times slower where it underflows; the least weights become 1e-35, in float64 1e-304
    return exponent.clamp_(min=-80 if exponent.dtype == torch.float32 else -700).exp_()


# The sums of one source over the window of every pixel are kept as [4, h, w]:
#   Σ g,  Σ g x,  Σ g x²  and  Σ (spatial part of g),  with x = value - guide at the centre.
# The last is only wanted by normalise "per-source".


def _lidar_sums(
    lidar: Tensor, mono: Tensor, guide: Tensor, returns: Tensor, options: IntegrationOptions
) -> Float[Tensor, "4 h w"]:
    """Sum over the returns of each window, by spreading each return over its window: they are few."""
    radius = int(options.kernel_size) // 2
    padded_guide = torch.nn.functional.pad(guide.double(), (radius,) * 4)
    height, width = padded_guide.shape
    padded_guide = padded_guide.flatten()
    sums = torch.zeros(4, height * width, dtype=torch.float64, device=mono.device)
    row, column = returns.nonzero(as_tuple=True)
    source = (row + radius) * width + column + radius
    value, estimate = lidar[row, column].double(), mono[row, column].double()
    for k, l, spatial in _shifts(options):
        centre = source - (k * width + l)
        centre_guide = padded_guide[centre]
        if options.integration == "edge-aware":
            weight = _range_weight(estimate - centre_guide, options).mul_(spatial)
        else:
            weight = torch.full_like(value, spatial)
        x = value - centre_guide
        weighted = weight * x
        # within one shift no two returns have the same centre, so the order of addition cannot vary
        sums[0].index_add_(0, centre, weight)
        sums[1].index_add_(0, centre, weighted)
        sums[2].index_add_(0, centre, weighted.mul_(x))
        if options.normalise == "per-source":
            sums[3].index_add_(0, centre, torch.full_like(value, spatial))
    inside_rows, inside_columns = slice(radius, height - radius), slice(radius, width - radius)
    return sums.view(4, height, width)[:, inside_rows, inside_columns]


def _mono_sums(
    padded_mono: Tensor, padded_weight: Tensor, guide: Tensor, options: IntegrationOptions
) -> Float[Tensor, "4 h w"]:
    """Sum over the pixels of each window that have an estimate and no return (padded_weight 1, else 0)."""
    height, width = guide.shape
    radius = int(options.kernel_size) // 2
    sums = torch.zeros(4, height, width, dtype=guide.dtype, device=guide.device)
    x, g = torch.empty_like(guide), torch.empty_like(guide)
    for k, l, spatial in _shifts(options):
        window = (slice(radius + k, radius + k + height), slice(radius + l, radius + l + width))
        weight = padded_weight[window]
        torch.sub(padded_mono[window], guide, out=x)
        if options.integration == "edge-aware":
            torch.mul(_range_weight(x, options, out=g), weight, out=g)
        else:
            g.copy_(weight)
        sums[0].add_(g, alpha=spatial)
        g.mul_(x)
        sums[1].add_(g, alpha=spatial)
        sums[2].addcmul_(g, x, value=spatial)
        if options.normalise == "per-source":
            sums[3].add_(weight, alpha=spatial)
    return sums


def _combine(from_lidar: Tensor, from_mono: Tensor, guide: Tensor, options: IntegrationOptions) -> Tensor:
    """Weigh the sums of the two sources into [3, h, w]: distance, spread, monocular share (Eq. 5, Eq. 6)."""
    from_mono, guide = from_mono.double(), guide.double()
    lidar_factor, mono_factor = options.alpha, 1 - options.alpha
    if options.normalise == "per-source":
        lidar_factor, mono_factor = (
            torch.where(sums[3] > 0, factor / sums[3].clamp(min=torch.finfo(sums.dtype).tiny), 0)
            for factor, sums in ((lidar_factor, from_lidar), (mono_factor, from_mono))
        )
    eta, first, second = lidar_factor * from_lidar[:3] + mono_factor * from_mono[:3]
    # below this are only weights that _range_weight had to lift
    exists = eta > 1e-290
    eta = torch.where(exists, eta, 1)
    mean = first / eta
    spread = (second / eta - mean * mean).clamp_(min=0).sqrt_()
    share = mono_factor * from_mono[0] / eta
    return torch.stack([guide + mean, spread, share]) * exists


def select_prior(
    depth_source: DepthSource,
    lidar_m: Float[Tensor, "*batch h w"] | None,
    mono_m: Float[Tensor, "*batch h w"] | None,
    valid: Bool[Tensor, "*batch h w"],
    options: IntegrationOptions | None = None,
) -> IntegratedDepth:
    """Give the prior made of both sources (`integrate_depth`) or of one alone (the rivals of Table 3).

    LiDAR alone is D where it has a return, spread 0 and monocular share 0; monocular alone is D̂, spread 0 and
    share 1. Each asks only for the map it uses; the other may be None.

    Raises:
        InputError: the source needs a map that is None, or the maps differ in shape.

    """
    _check_choice("depth_source", depth_source, DepthSource)
    missing = [
        name
        for name, tensor, other in (("lidar", lidar_m, "mono"), ("mono", mono_m, "lidar"))
        if tensor is None and depth_source != other
    ]
    if missing:
        raise InputError(
            f"depth_source {depth_source!r} needs {' and '.join(missing)} distance maps, and there are none; "
            "add them to the scene, or choose the depth_source that the scene has."
        )
    if depth_source == "integrated":
        assert lidar_m is not None and mono_m is not None
        return integrate_depth(lidar_m, mono_m, valid, options)
    source = lidar_m if depth_source == "lidar" else mono_m
    assert source is not None
    _check_maps("select_prior", source=source, valid=valid)
    exists = valid & _is_distance(source)
    distance_m = torch.where(exists, source.detach(), 0).to(_work_dtype(source))
    zero = torch.zeros_like(distance_m)
    return IntegratedDepth(distance_m, zero, zero if depth_source == "lidar" else exists.to(distance_m.dtype))


def sigma_m(
    prior: IntegratedDepth,
    mode: SigmaMode,
    *,
    mono_m: Float[Tensor, "*batch h w"] | None = None,
    constant_m: float = 1.0,
    mono_relative_error: float = 0.1,
    floor_m: float = 0.05,
) -> Float[Tensor, "*batch h w"]:
    """Give σ̂, the standard deviation that Eq. 4 grants the prior, for every pixel.

    constant   `constant_m`.
    image      one number a map: the standard deviation of d̃ over the map's pixels that have a prior, the literal
               reading of Eq. 4.
    spread     the spread of what was averaged. Over smooth monocular maps it claims centimetres where the error
               is metres: for ablation.
    combined   σ̂² = spread² + (mono_relative_error · d̂ · monocular share)² + floor_m².

    `image` and `spread` are at least `floor_m`, so that no pixel claims to be exact.

    Args:
        prior: what `integrate_depth` or `select_prior` gave.
        mode: see above.
        mono_m: D̂, for `combined`; may be None for a prior of LiDAR alone.
        constant_m: metres.
        mono_relative_error: standard deviation of d̂ as a part of d̂.
        floor_m: metres; about what LiDAR, its calibration and its alignment leave.

    Returns:
        Metres, positive where there is a prior and 0 where there is none.

    Raises:
        InputError: an unknown mode, a constant out of range, or `combined` without mono_m for a prior with a
            monocular share.

    """
    _check_choice("sigma mode", mode, SigmaMode)
    _check_number("constant_m", constant_m, 1e-3)
    _check_number("mono_relative_error", mono_relative_error, 0.0)
    _check_number("floor_m", floor_m, 1e-3)
    distance = prior.distance_m
    exists = distance > 0
    if mode == "constant":
        sigma = torch.full_like(distance, constant_m)
    elif mode == "image":
        count = exists.sum((-2, -1), keepdim=True).clamp(min=1)
        mean = distance.double().sum((-2, -1), keepdim=True) / count
        variance = torch.where(exists, distance - mean, 0).square().sum((-2, -1), keepdim=True) / count
        sigma = variance.sqrt().clamp(min=floor_m).to(distance.dtype).expand_as(distance)
    elif mode == "spread":
        sigma = prior.spread_m.clamp(min=floor_m)
    else:
        if mono_m is None:
            if prior.mono_share.any():
                raise InputError("sigma_m: mode 'combined' needs mono_m for a prior with a monocular share.")
            mono_m = torch.zeros_like(distance)
        _check_maps("sigma_m", mono_m=mono_m, distance_m=distance)
        # d̂ may be NaN where there is no prior
        mono_error = torch.where(exists, mono_m.detach(), 0) * prior.mono_share * mono_relative_error
        sigma = (prior.spread_m.square() + mono_error.square() + floor_m**2).sqrt()
    return torch.where(exists, sigma, 0)
