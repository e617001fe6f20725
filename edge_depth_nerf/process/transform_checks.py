"""Whether LiDAR lies on what the pictures show: what a transform that is given the wrong way round looks like.

A scan's LiDAR points are projected into two pictures of one camera between which the vehicle has moved. If the
transforms of scanner and camera are right, both pictures have the same contrast at a point: brightness against its
surroundings, in which exposure cancels. Its correlation over all points is measured with the given transforms, with the
camera's inverted, with the scanner's inverted, and with both inverted. On rendered drives of all layouts and on a real
one it is 0.79 to 0.96 with the right ones, and 0.89 at most with one of them inverted. Coverage alone proves nothing:
with an inverted transform LiDAR covers a tenth to a third of the pictures, too. A comparison of LiDAR's edges with the
pictures' edges shows less: their agreement is one to two standard deviations above that of shifted ones.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, UInt8
from scipy.ndimage import map_coordinates
from torch import Tensor

from edge_depth_nerf.base.files import read_image
from edge_depth_nerf.cameras import Camera
from edge_depth_nerf.cameras.transforms import Transform
from edge_depth_nerf.lidar import project_points, transform_points
from edge_depth_nerf.lidar.world import sweep_in_world
from edge_depth_nerf.process.reading import downscale_image, downscale_mask, read_if_whole
from edge_depth_nerf.process.recording import RecordedCamera, RecordedSweep, Recording

_WORKING_PX = 320
"""Pictures are averaged down until the longer side is about so long."""
_PAIRS = 3
"""So many pairs of pictures of a camera, spread over the drive."""
_TRIED = 60
"""They are chosen from so many, spread over the drive: where the vehicle stands there is none."""
_MOVED_M = 0.5
"""How far the camera has moved at least between the pictures of a pair."""
_APART_S = 0.2
"""A scan further in time from a picture does not belong to it."""
_MOST_POINTS = 40_000
"""So many points of a scan are used."""
_SURROUNDINGS_PX = 4.0
"""Scale of what contrast is measured against."""
_DARK_LEVELS = 8.0
"""Added to a brightness before its logarithm is taken: near black there is nothing but noise."""
_STRONGEST = 0.5
"""Contrast, as a logarithm, is limited to this."""
_FEWEST = 400
"""Fewer LiDAR points seen in both pictures say nothing."""
_FAINTEST = 0.02
"""Pictures with less contrast at the LiDAR points (root mean square) say nothing."""
_LESS_DOUBT = 0.6
"""An inverse fits clearly better if its correlation lacks this share, or less, of what the given one lacks to 1 …"""
_FITS = 0.6
"""… and is at least this."""
_NO_FIT = 0.3
"""A correlation below this is no fit, if `_FITS` is reached by the same pictures in another way."""


@dataclass(frozen=True)
class ContrastAgreement:
    """How well a scanner's points agree with a camera's pictures; correlations, at most 1."""

    camera: str
    scanner: str
    given: float
    """With both transforms as given."""
    inverted: dict[str, float]
    """With the inverse of what is named: "camera", "scanner" or "both"."""
    still: float
    """Of the pictures with each other, as if nothing moved between them."""

    @property
    def better(self) -> str | None:
        """What is to be inverted: "camera", "scanner" or "both"; None if nothing else fits clearly better."""
        best = max(self.inverted, key=lambda name: self.inverted[name])
        clearly = self.inverted[best] >= _FITS and 1 - self.inverted[best] < _LESS_DOUBT * (1 - self.given)
        return best if clearly else None

    @property
    def fits(self) -> bool:
        """Whether the given transforms fit at all, as far as the pictures can tell."""
        return self.given >= _NO_FIT or self.still < _FITS


@dataclass(frozen=True)
class _Pair:
    """Two pictures of a camera from different places."""

    time_s: float
    """When the first one was taken."""
    contrasts: tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]
    vehicle_to_world: tuple[Transform, Transform]
    motion: Transform | None
    """From the first camera to the second, where the pictures have poses of their own."""

    def to_second(self, to_vehicle: Transform) -> Transform:
        """From the first camera to the second, if the camera sits like this on the vehicle."""
        if self.motion is not None:
            return self.motion
        first, second = (pose @ to_vehicle for pose in self.vehicle_to_world)
        return np.linalg.inv(second) @ first


def agreements(recording: Recording, usable: Mapping[str, Bool[np.ndarray, "h w"]]) -> list[ContrastAgreement]:
    """Compare each scanner's points with each camera's pictures, a few of them.

    Args:
        recording: with the vehicle's path. Files that cannot be read are passed over.
        usable: of each camera at its pictures' size, True where they may be used.

    Returns:
        Those that can be told: of cameras that move, of pictures with contrast.
    """
    found = []
    scanners = dict.fromkeys(sweep.scanner for sweep in recording.sweeps)
    for camera in recording.cameras if scanners else ():
        factor = max(1, round(max(camera.camera.width, camera.camera.height) / _WORKING_PX))
        inner = cv2.erode(downscale_mask(usable[camera.name], factor).astype(np.uint8), np.ones((9, 9)))
        pairs = _pairs(recording, camera, factor)
        small = camera.camera.downscaled(factor)
        for scanner in scanners:
            sweeps = [sweep for sweep in recording.sweeps if sweep.scanner == scanner]
            one = _agreement(recording, camera, small, inner > 0, pairs, sweeps)
            if one is not None:
                found.append(one)
    return found


def _pairs(recording: Recording, camera: RecordedCamera, factor: int) -> list[_Pair]:
    """Pictures spread over the drive, each with the next one from another place."""
    assert recording.trajectory is not None
    pictures = sorted((one for one in recording.pictures if one.camera == camera.name), key=lambda one: one.time_s)
    if not pictures:
        return []
    vehicle = recording.trajectory.at(np.array([picture.time_s for picture in pictures]))
    poses = [
        to_world @ camera.to_vehicle if picture.camera_to_world is None else picture.camera_to_world
        for picture, to_world in zip(pictures, vehicle, strict=True)
    ]
    places = np.array([pose[:3, 3] for pose in poses]).reshape(-1, 3)
    pairs = []
    for first in np.unique(np.linspace(0, len(pictures) - 1, _TRIED).astype(int)).tolist():
        far = np.flatnonzero(np.linalg.norm(places[first + 1 :] - places[first], axis=-1) >= _MOVED_M)
        pairs += [(first, first + 1 + int(far[0]))] if len(far) else []
    found = []
    for index in np.unique(np.linspace(0, len(pairs) - 1, _PAIRS).astype(int)) if pairs else ():
        first, second = pairs[index]
        both = [read_if_whole(partial(read_image, pictures[one].path)) for one in (first, second)]
        if both[0] is None or both[1] is None:
            continue
        own = pictures[first].camera_to_world is not None
        found.append(
            _Pair(
                time_s=pictures[first].time_s,
                contrasts=(_contrast(downscale_image(both[0], factor)), _contrast(downscale_image(both[1], factor))),
                vehicle_to_world=(vehicle[first], vehicle[second]),
                motion=np.linalg.inv(poses[second]) @ poses[first] if own else None,
            )
        )
    return found


def _contrast(picture: UInt8[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w"]:
    """Logarithm of the brightness against its surroundings."""
    light = np.log(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.float32) + np.float32(_DARK_LEVELS))
    light = cv2.GaussianBlur(light, (0, 0), 0.8)
    around = cv2.GaussianBlur(light, (0, 0), _SURROUNDINGS_PX)
    return np.clip(light - around, -_STRONGEST, _STRONGEST)


def _agreement(
    recording: Recording,
    camera: RecordedCamera,
    small: Camera,
    usable: Bool[np.ndarray, "h w"],
    pairs: Sequence[_Pair],
    sweeps: Sequence[RecordedSweep],
) -> ContrastAgreement | None:
    """Measure one scanner against one camera."""
    assert recording.trajectory is not None
    contrasts: defaultdict[str, list[tuple[np.ndarray, np.ndarray]]] = defaultdict(list)
    for pair in pairs:
        recorded = min(sweeps, key=lambda sweep: abs(sweep.time_s - pair.time_s))
        sweep = read_if_whole(recorded.read) if abs(recorded.time_s - pair.time_s) <= _APART_S else None
        if sweep is None:
            continue
        for turned, named in ((False, ("given", "camera")), (True, ("scanner", "both"))):
            scanner_to_vehicle = np.linalg.inv(recorded.to_vehicle) if turned else recorded.to_vehicle
            world = sweep_in_world(sweep, recorded.time_s, scanner_to_vehicle, recording.trajectory, recorded.timing)
            every = max(1, len(world.points_m) // _MOST_POINTS)
            world_to_vehicle = torch.from_numpy(np.linalg.inv(pair.vehicle_to_world[0]))
            in_vehicle = transform_points(world_to_vehicle, world.points_m[::every])
            for name, to_vehicle in zip(named, (camera.to_vehicle, np.linalg.inv(camera.to_vehicle)), strict=True):
                in_first = transform_points(torch.from_numpy(np.linalg.inv(to_vehicle)), in_vehicle)
                values = _seen_twice(
                    in_first, world.spacing_m[::every], pair.to_second(to_vehicle), small, usable, pair.contrasts
                )
                contrasts[name].append((values[0], values[1]))
                if name == "given":
                    contrasts["still"].append((values[0], values[2]))
    measured = {name: _correlation(values) for name, values in contrasts.items()}
    still, _ = measured.pop("still", (0.0, False))
    if not any(tells for _, tells in measured.values()):
        return None
    found = {name: correlation if tells else 0.0 for name, (correlation, tells) in measured.items()}
    return ContrastAgreement(camera.name, sweeps[0].scanner, found.pop("given"), found, still)


def _correlation(values: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[float, bool]:
    """Correlation of two contrasts, without the means: contrast has none. 0 without LiDAR points.

    Also whether it tells something: there are enough LiDAR points, on things with contrast.
    """
    first, second = (np.concatenate(parts).astype(np.float64) for parts in zip(*values, strict=True))
    squares = float(first @ first), float(second @ second)
    tells = len(first) >= _FEWEST and min(squares) > len(first) * _FAINTEST**2
    return float(first @ second) / max(math.sqrt(squares[0] * squares[1]), 1e-9), tells


def _seen_twice(
    in_first: Float[Tensor, "points 3"],
    spacing_m: Float[Tensor, "points"],
    first_to_second: Transform,
    camera: Camera,
    usable: Bool[np.ndarray, "h w"],
    contrasts: tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"]],
) -> tuple[Float32[np.ndarray, "seen"], ...]:
    """Contrast at LiDAR points that both see: in the first, in the second, in the second where the first has them."""
    visible = project_points(in_first.float(), camera, spacing_m=spacing_m).point_index
    points = in_first[visible[visible >= 0]]
    in_second = transform_points(torch.from_numpy(first_to_second), points)
    places, both = [], torch.ones(len(points), dtype=torch.bool)
    for seen in (points, in_second):
        pixels, valid = camera.project(seen.float())
        both &= valid & camera.inside(pixels)
        places.append(pixels)
    first, second = (place[both].numpy().astype(np.float32) - np.float32(0.5) for place in places)
    share = usable.astype(np.float32)
    kept = (_sampled(share, first) > 0.99) & (_sampled(share, second) > 0.99)
    first, second = first[kept], second[kept]
    return _sampled(contrasts[0], first), _sampled(contrasts[1], second), _sampled(contrasts[1], first)


def _sampled(picture: Float32[np.ndarray, "h w"], places: Float32[np.ndarray, "n 2"]) -> Float32[np.ndarray, "n"]:
    """Values of a picture at places (column, row), pixel centres at whole numbers, linearly between them."""
    return map_coordinates(picture, places.T[::-1], order=1, mode="nearest")


def agreement_notices(found: Sequence[ContrastAgreement]) -> list[str]:
    """Say which transforms seem to be wrong; nothing for those that fit."""
    notices = []
    for which, fix in (
        ("camera", "that camera's transform to the vehicle"),
        ("scanner", "that scanner's transform to the vehicle"),
        ("both", "each of these transforms to the vehicle"),
    ):
        if wrong := [one for one in found if one.better == which]:
            figures = ", ".join(
                f"{one.inverted[which]:.2f} instead of {one.given:.2f} for {one.camera} with {one.scanner}"
                for one in wrong
            )
            kinds = ("camera", "scanner") if which == "both" else (which,)
            names = " and ".join(", ".join(dict.fromkeys(getattr(one, kind) for one in wrong)) for kind in kinds)
            notices.append(
                f"LiDAR points do not lie on the objects in the pictures. With the inverse of {fix} ({names}) the "
                f"pictures agree better at the LiDAR points (correlation {figures}). Is to_vehicle "
                "inverted?"
            )
    unfit = [one for one in found if one.better is None and not one.fits]
    if unfit:
        named = ", ".join(f"{one.camera} with {one.scanner} ({one.given:.2f})" for one in unfit)
        notices.append(
            "LiDAR points do not lie on the objects in the pictures, and no inverse of a transform fits, either: "
            f"{named}; 1 means that the pictures agree at the LiDAR points. Check to_vehicle, the clocks "
            "and the poses."
        )
    return notices
