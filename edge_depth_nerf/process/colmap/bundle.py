"""Bundle adjustment by pycolmap: the vehicle's poses and points, with the given poses held softly.

The rig of each frame is rigid, and lenses are fixed. COLMAP's own priors hold only the positions of single cameras and
nothing of a turn. So each frame has six more cameras at the vehicle's origin, which look along its axes. Each looks at
a fixed point of the world that lies, by the given pose, in the middle of its picture. A vehicle that turns by θ or
shifts by t moves these points out of the middle by f·θ and f·t / ρ, where ρ is their distance. f and ρ are chosen so
that this is in units of the standard deviations. The same robust loss applies to features and poses.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64

from edge_depth_nerf.cameras import Camera
from edge_depth_nerf.cameras.transforms import Transform, rigid
from edge_depth_nerf.poses.tracks import Tracks
from edge_depth_nerf.process.colmap.models import colmap_lens

_AXES = np.concatenate((np.eye(3), -np.eye(3)))
_ANCHOR_SIGHTS = 2
"""COLMAP wants points that are seen twice; the anchors' one camera sees each of them so often."""
_SIGHTS_ACROSS = 4
"""So many of the six cameras see a turn about an axis, or a shift along it."""
_MOST_ROUNDS = 50


@dataclass(frozen=True)
class Softness:
    """Standard deviations of the given poses."""

    position_m: float
    """Of each coordinate of the vehicle's origin."""
    turn_rad: float
    """About each axis."""


@dataclass(frozen=True)
class Shot:
    """A picture on the rig of its frame."""

    lens: Camera
    """At the picture's size."""
    frame: int
    """Index of the frame."""
    to_vehicle: Transform
    """From its camera to the vehicle's pose at the frame's time."""


def adjust_bundle(
    pycolmap: Any,
    shots: Sequence[Shot],
    tracks: Tracks,
    points: Float64[np.ndarray, "points 3"],
    start: Float64[np.ndarray, "frames 4 4"],
    given: Float64[np.ndarray, "frames 4 4"],
    softness: Softness,
) -> Float64[np.ndarray, "frames 4 4"]:
    """Find the poses, vehicle to world, that agree best with the features and softly with the given poses.

    The search begins with the poses `start`, and with `points`, the places of what `tracks` see. Tracks count `shots`.
    """
    # COLMAP works best near the origin
    origin = rigid(np.eye(3), given[:, :3, 3].mean(0))
    shift = np.linalg.inv(origin)
    bundle = _Bundle(pycolmap, shots, shift @ start, shift @ given, softness)
    bundle.add_points(tracks, points - origin[:3, 3])
    bundle.solve()
    return origin @ bundle.vehicle_to_world()


class _Bundle:
    def __init__(
        self,
        pycolmap: Any,
        shots: Sequence[Shot],
        start: Float64[np.ndarray, "frames 4 4"],
        given: Float64[np.ndarray, "frames 4 4"],
        softness: Softness,
    ) -> None:
        self.pycolmap = pycolmap
        self.model = pycolmap.Reconstruction()
        self.config = pycolmap.BundleAdjustmentConfig()
        self.frame_count = len(given)
        self.reach_m = softness.position_m / softness.turn_rad
        focal = 1 / (softness.turn_rad * math.sqrt(_SIGHTS_ACROSS * _ANCHOR_SIGHTS))
        self.shots, self.pixels = shots, [np.zeros((0, 2))] * len(shots)
        self.start, self.given, self.focal = start, given, focal
        # the frame of the first of the six cameras is COLMAP's frame of the rig
        self.to_rig = _looking_along(_AXES[0])

    def add_points(self, tracks: Tracks, points: Float64[np.ndarray, "points 3"]) -> None:
        """Add all that is seen: the rigs with their pictures first, as COLMAP wants it."""
        colmap = self.pycolmap
        order = np.argsort(tracks.picture, kind="stable")
        numbers = np.zeros(len(order), np.int64)
        by_picture = np.split(order, np.searchsorted(tracks.picture[order], np.arange(1, len(self.shots))))
        for index, rows in enumerate(by_picture):
            self.pixels[index] = tracks.sights.pixels[rows]
            numbers[rows] = np.arange(len(rows))
        of_frame: list[list[int]] = [[] for _ in range(self.frame_count)]
        for index, shot in enumerate(self.shots):
            of_frame[shot.frame].append(index)
        for frame_number in range(self.frame_count):
            self._add_frame(frame_number, of_frame[frame_number])
        ends = np.concatenate([[0], np.cumsum(np.bincount(tracks.track, minlength=len(points)))])
        for number, point in enumerate(points):
            track = colmap.Track()
            rows = range(ends[number], ends[number + 1])
            track.add_elements([colmap.TrackElement(int(tracks.picture[r]) + 1, int(numbers[r])) for r in rows])
            self.model.add_point3D(point, track)

    def _add_frame(self, frame_number: int, pictures: Sequence[int]) -> None:
        """Add a rig, its pictures, and what holds it."""
        colmap, model = self.pycolmap, self.model
        rig = colmap.Rig(rig_id=frame_number + 1)
        images, anchors = [], []
        first = len(self.shots) + 1 + frame_number * len(_AXES)
        for number, axis in enumerate(_AXES):
            camera = colmap.Camera(
                camera_id=first + number, model="SIMPLE_PINHOLE", width=2, height=2, params=[self.focal, 1, 1]
            )
            model.add_camera(camera)
            if number == 0:
                rig.add_ref_sensor(camera.sensor_id)
            else:
                self._add_sensor(rig, camera, _looking_along(axis) @ np.linalg.inv(self.to_rig))
            seen = np.ones((_ANCHOR_SIGHTS, 2))
            images.append(self._image(f"axis {frame_number} {number}", seen, camera, frame_number))
            anchors.append(self.given[frame_number][:3, :3] @ axis * self.reach_m + self.given[frame_number][:3, 3])
        for index in pictures:
            shot, lens = self.shots[index], colmap_lens(self.shots[index].lens)
            camera = colmap.Camera(
                camera_id=index + 1,
                model=lens.model,
                width=shot.lens.width,
                height=shot.lens.height,
                params=list(lens.parameters),
            )
            model.add_camera(camera)
            self._add_sensor(rig, camera, np.linalg.inv(self.to_rig @ shot.to_vehicle))
            images.append(self._image(f"picture {index}", self.pixels[index], camera, frame_number))
        model.add_rig(rig)
        frame = colmap.Frame(frame_id=frame_number + 1, rig_id=frame_number + 1)
        for image in images:
            frame.add_data_id(image.data_id)
        model.add_frame(frame)
        for image in images:
            model.add_image(image)
            self.config.add_image(image.image_id)
            self.config.set_constant_cam_intrinsics(image.camera_id)
        rig_from_world = self.to_rig @ np.linalg.inv(self.start[frame_number])
        model.frame(frame_number + 1).rig_from_world = colmap.Rigid3d(rig_from_world[:3])
        model.register_frame(frame_number + 1)
        for number, anchor in enumerate(anchors):
            track = colmap.Track()
            track.add_elements([colmap.TrackElement(first + number, sight) for sight in range(_ANCHOR_SIGHTS)])
            self.config.add_constant_point(model.add_point3D(anchor, track))

    def _add_sensor(self, rig: Any, camera: Any, from_rig: Transform) -> None:
        rig.add_sensor(camera.sensor_id, self.pycolmap.Rigid3d(from_rig[:3]))
        self.config.set_constant_sensor_from_rig_pose(camera.sensor_id)

    def _image(self, name: str, pixels: Float64[np.ndarray, "n 2"], camera: Any, frame_number: int) -> Any:
        image = self.pycolmap.Image(name=name, keypoints=pixels, camera_id=camera.camera_id, image_id=camera.camera_id)
        image.frame_id = frame_number + 1
        return image

    def solve(self) -> None:
        """Move poses and points."""
        colmap = self.pycolmap
        options = colmap.BundleAdjustmentOptions()
        options.print_summary = False
        options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = False
        options.refine_sensor_from_rig = False
        options.ceres.loss_function_type = colmap.LossFunctionType.SOFT_L1
        # threads would add numbers up in another order each time
        options.ceres.solver_options.num_threads = 1
        options.ceres.solver_options.max_num_iterations = _MOST_ROUNDS
        options.ceres.solver_options.function_tolerance = 1e-6
        colmap.create_default_bundle_adjuster(options, self.config, self.model).solve()

    def vehicle_to_world(self) -> Float64[np.ndarray, "frames 4 4"]:
        """The present poses."""
        poses = np.tile(np.eye(4), (self.frame_count, 1, 1))
        for frame_number in range(self.frame_count):
            poses[frame_number, :3] = self.model.frame(frame_number + 1).rig_from_world.matrix()
        return np.linalg.inv(poses) @ self.to_rig


def _looking_along(axis: Float64[np.ndarray, "3"]) -> Transform:
    """From the vehicle to a camera at its origin that looks along an axis."""
    x = np.roll(axis, 1)
    return rigid(np.stack((x, np.cross(axis, x), axis)))
