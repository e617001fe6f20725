"""From a recorded sweep to points in the world.

A scanner turns while the vehicle drives: at 10 m/s its points are up to half a metre off if they are taken as measured
all at once. So each point is moved by the vehicle's pose at the point's own time. The file gives this time, or it
follows from the point's azimuth.

A camera above the scanner looks over the upper edge of the scanner's field. If a tree reaches that edge, no LiDAR point
of the tree hides what the camera sees behind its upper part. So what reaches the edge is taken to continue above it, as
far as the camera looks over.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from edge_depth_nerf.lidar.projection import transform_points
from edge_depth_nerf.lidar.sweeps import Sweep, SweepTiming
from edge_depth_nerf.lidar.trajectory import Trajectory

_SPACING = 1.4
"""How much further apart than evenly spread the LiDAR points are where they are sparse: scanners have fewer beams than
firings (0.43° by 0.2° for KITTI-360's)."""

_STRAY = 1e-3
"""Share of points that may lie beyond the scanner's field; one beam of 64 has 16 times as many."""
_TOP_RAD = math.radians(0.6)
"""Points within this of the highest one are of the highest beam or two."""
_STEPS_UP = 6
"""Points on the way up from each of those."""


@dataclass(frozen=True)
class WorldSweep:
    """A sweep's points in the world."""

    points_m: Float[Tensor, "points 3"]
    """World, float64."""
    spacing_m: Float[Tensor, "points"]
    """How far apart neighbouring points are where each point was measured, across its beam; float32."""
    spacing_rad: float
    """The same as an angle at the scanner."""
    world_to_scanner: Float64[np.ndarray, "4 4"]
    """At the sweep's own time."""
    elevation_rad: tuple[float, float]
    """Lowest and highest direction of the points, from the scanner's horizontal plane."""
    offset_s: Float[Tensor, "points"]
    """When each was measured, counted from the sweep's own time; 0 where that is unknown or not requested."""


def sweep_in_world(
    sweep: Sweep,
    time_s: float,
    scanner_to_vehicle: Float64[np.ndarray, "4 4"],
    trajectory: Trajectory,
    timing: SweepTiming | None,
    *,
    deskew: bool = True,
) -> WorldSweep:
    """Express a sweep in the world.

    Args:
        sweep: as recorded, in the scanner's frame.
        time_s: its own time, on the trajectory's clock.
        scanner_to_vehicle: where the scanner sits.
        trajectory: where the vehicle is.
        timing: when which azimuth is measured; times from the file come first. None and no times = all at once.
        deskew: False takes all points as measured at the sweep's own time.
    """
    offset_s = offsets_s(sweep, timing, deskew)
    in_vehicle = transform_points(torch.from_numpy(scanner_to_vehicle), sweep.points_m)
    vehicle_to_world = trajectory.at(np.array([time_s], np.float64))[0]

    range_m = sweep.points_m.norm(dim=-1)
    sine = sweep.points_m[:, 2] / range_m
    # a stray point, off drops or dust, is not the edge of the scanner's field
    low, high = (float(limit) for limit in np.quantile(sine.numpy(), (_STRAY, 1 - _STRAY)))
    # the directions between two elevations fill 2π·(sin high - sin low) steradians
    spacing_rad = _SPACING * math.sqrt(2 * math.pi * max(high - low, 1e-3) / len(range_m))
    return WorldSweep(
        points_m=trajectory.to_world(in_vehicle, time_s + offset_s),
        spacing_m=(range_m * spacing_rad).float(),
        spacing_rad=spacing_rad,
        world_to_scanner=np.linalg.inv(vehicle_to_world @ scanner_to_vehicle),
        elevation_rad=(float(np.arcsin(low)), float(np.arcsin(high))),
        offset_s=offset_s,
    )


def offsets_s(sweep: Sweep, timing: SweepTiming | None, deskew: bool) -> Float[Tensor, "points"]:
    """When each point was measured, counted from the sweep's own time, float64; arguments as of `sweep_in_world`."""
    if deskew and sweep.offset_s is not None:
        return sweep.offset_s
    if deskew and timing is not None:
        return timing.offsets_s(sweep.points_m)
    return torch.zeros(len(sweep.points_m), dtype=torch.float64)


def above_field(
    sweep: WorldSweep, viewpoint_in_world: Float64[np.ndarray, "3"]
) -> tuple[Float[Tensor, "points 3"], Float[Tensor, "points"]]:
    """Continue what the sweep's highest beams met, up to the height of a viewpoint above the scanner.

    Gives points in the world and their spacing as of a `WorldSweep`; none where the viewpoint is not above the scanner.
    """
    world_to_scanner = torch.from_numpy(sweep.world_to_scanner)
    height_m = transform_points(world_to_scanner, torch.from_numpy(viewpoint_in_world))[2].item()
    in_scanner = transform_points(world_to_scanner, sweep.points_m)
    elevation_rad = torch.atan2(in_scanner[:, 2], in_scanner[:, :2].norm(dim=-1))
    top = elevation_rad > sweep.elevation_rad[1] - _TOP_RAD
    if height_m <= 0:
        top &= False
    steps = [height_m * (step + 1) / _STEPS_UP for step in range(_STEPS_UP)]
    raised = torch.cat([in_scanner[top] + torch.tensor([0.0, 0.0, up], dtype=torch.float64) for up in steps])
    spacing_m = sweep.spacing_m[top].clamp(min=_SPACING * height_m / _STEPS_UP).repeat(_STEPS_UP)
    return transform_points(torch.linalg.inv(world_to_scanner), raised), spacing_m
