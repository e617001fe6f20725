"""Whether LiDAR fits the pictures, the path and itself, and which other reading of the recording fits better.

Three things are measured on a few frames, for each way to read the recording:

- A LiDAR point is seen by two pictures of a camera between which the vehicle has moved. If its distance and place are
  right, both have the same contrast there: brightness against its surroundings, in which exposure cancels. What the
  correlation over all points lacks to 1 is the *lack*.
- A step in LiDAR's distance lies on an edge of the picture. The strength of the picture's edges at such points, over
  the picture's mean, is the *edge*.
- What a sweep met lies on the surfaces that a later sweep met from some metres further. The mean distance between
  them is how far sweeps are *apart*.

A `Reading` changes one thing: an axis, a unit, an angle, a clock, the way the scanner turns. Its gain is the logarithm
of the product in which all three improve; edges count by their cube, since shifted ones lose a tenth only. The reading
of the largest gain is named if it is above `CLEAR`. `docs/robustness.md` has what good and wrong recordings give.

Beside that, each LiDAR point's distance is searched along its ray by comparing the pictures' patches; LiDAR's distance
over the one found is the *ratio*, by which a wrong unit is known.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int, UInt8
from scipy.spatial import KDTree

from edge_depth_nerf.base.files import read_distance_png, read_image
from edge_depth_nerf.base.numbers import spread_over
from edge_depth_nerf.cameras import Camera
from edge_depth_nerf.cameras.rays import rays
from edge_depth_nerf.cameras.transforms import Transform, rigid
from edge_depth_nerf.lidar import Sweep
from edge_depth_nerf.lidar.scans import columns_told
from edge_depth_nerf.lidar.trajectory import Trajectory
from edge_depth_nerf.lidar.world import offsets_s
from edge_depth_nerf.process.reading import downscale_image, downscale_mask, read_depth, read_if_whole
from edge_depth_nerf.process.readings import (
    CLEAR_SMALL,
    OFF,
    Reading,
    mountings,
    of_maps,
    of_path,
    of_scans,
    small,
    turn,
)
from edge_depth_nerf.process.recording import RecordedCamera, RecordedPicture, RecordedSweep, Recording

_CONTRAST_PX, _EDGES_PX = 320, 704
"""Pictures are averaged down until the longer side is about so long, for contrast and for edges."""
_PAIRS = 6
"""So many pairs of pictures of a camera, spread over the drive."""
_TRIED = 60
"""They are chosen from so many, spread over the drive: where the vehicle stands there is none."""
_MOVED_M = 0.5
"""How far the camera has moved at least between the pictures of a pair."""
_APART_S = 0.2
"""A scan further in time from a picture does not belong to it."""
_POINTS = 3000
"""So many points of a scan are seen."""
_SWEEPS_MOVED_M = 6.0
"""So far the vehicle has moved between two sweeps: what was measured ahead is then measured beside it."""
_SWEEP_POINTS = (2500, 60_000)
"""So many points of a sweep are held against so many of the other."""
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
_FITTING = 0.3
"""And only if the lack that it leaves is less."""
_LOG_RATIOS = np.linspace(-1.8, 1.8, 91)
"""Distances are searched from a sixth of LiDAR's to six times them."""
_LEAST_LACK = 0.03
"""Less is noise."""
_MOST_BY_EDGES, _MOST_BY_SWEEPS = 0.15, 1.0
"""The logarithms of edges and of how far sweeps are apart change the gain by so much at most."""
_MOVES, _MOVES_SMALL = 0.6, 1 / 3
"""A reading fits only if its lack is less than this part of what it were if the camera had not moved; of small angles
and shifts the second, lest a pillar is taken for the next."""
_DOUBT = 0.3
"""`_best` searches for large faults only above this lack, above that of a camera that stands, or where the ratio is
off."""
_TRIED_WHOLE = 8
"""So many readings, the best on some of the pairs, are tried on all of them."""
_LEAST_GAINS, _LEAST_GAINS_WITH_SWEEPS = (0.25, 0.01), (0.05, 0.01, 0.4)
"""Of a small angle or shift, contrast must gain so much, and edges: on bare walls edges alone would fit by chance. Or
contrast, edges and sweeps the second."""
_REFINED = 3
"""So many of these, the best, are refined if they gain."""
_UNSEEN = 0.01
"""A scanner of which a camera's pictures see a smaller share of the points does not see what the camera sees."""
_FEWEST_RATIOS = 30
"""The median of fewer ratios says nothing."""
_SEARCHED = 800
"""So many points of a pair are searched for."""
_FAR_SHARE = 0.2
"""A scanner has so large a share of its points beyond reach only in another unit; in metres it is 0."""
_ONE_VALUE_SHARE = 0.01
"""In a depth map, so large a share of the largest value is no distance."""


@dataclass(frozen=True)
class LidarFigures:
    """How a scanner's points, or depth maps, agree with a camera's pictures."""

    camera: str
    scanner: str
    correlation: float
    """Of contrast at points that two pictures see; 1 = all agrees."""
    edge: float | None
    """Strength of the picture's edges at LiDAR's, over the same when LiDAR's are shifted by 3°."""
    apart_m: float | None
    """Mean distance between surfaces of sweeps of the scanner, some metres apart."""
    ratio: float | None
    """LiDAR's distance over that of the pictures, median."""
    ratio_spread: float | None
    """Half of the logarithms of the ratios lie within so much of their median."""
    ratio_by_side: tuple[float | None, float | None, float | None]
    """Median ratio in the left, the middle and the right third of the picture."""


@dataclass(frozen=True)
class LidarCheck:
    """What is found of a recording."""

    figures: tuple[LidarFigures, ...]
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class _Points:
    """Some points of a sweep."""

    in_scanner: Float64[np.ndarray, "n 3"]
    offset_s: Float64[np.ndarray, "n"]
    sweep: RecordedSweep
    path: Trajectory

    def world(self, reading: Reading) -> Float64[np.ndarray, "n 3"]:
        """Where they are, read in another way."""
        # most readings of cameras keep the scans: found once
        return self._given if reading.keeps_scans else self._placed(reading)

    @cached_property
    def _given(self) -> Float64[np.ndarray, "n 3"]:
        return self._placed(Reading())

    def _placed(self, reading: Reading) -> Float64[np.ndarray, "n 3"]:
        offset_s = self.offset_s if reading.point_times is None else reading.point_times(self.offset_s)
        times_s = torch.from_numpy(self.sweep.time_s + reading.scans_later_s + offset_s)
        in_vehicle = torch.from_numpy(_moved(reading.scanner(self.sweep.to_vehicle), self.in_scanner))
        return (self.path if reading.path is None else reading.path(self.path)).to_world(in_vehicle, times_s).numpy()


@dataclass(frozen=True)
class _Scan:
    """Points of a sweep for each of the comparisons."""

    seen: _Points
    edges: _Points
    """The nearer side of steps in distance."""
    few: _Points
    many: _Points


@dataclass(frozen=True)
class _Pair:
    """Two pictures of a camera from different places."""

    pictures: tuple[RecordedPicture, RecordedPicture]
    contrasts: tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]
    edges: Float32[np.ndarray, "h2 w2"]
    """Of the first picture."""


@dataclass(frozen=True)
class _Fit:
    """How well a reading fits a camera: sums over its pairs."""

    lack: float
    still: float
    """The lack if the points were at the same pixels in both: as if the camera had not moved."""
    edge: float
    """0 without edges."""
    tells: bool
    """Whether enough points lie on things with contrast."""
    share: float
    """What part of a scan's points both pictures of a pair see."""


def _moved(transform: Transform, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    return points @ transform[:3, :3].T + transform[:3, 3]


def _inverse(pose: Transform) -> Transform:
    """The inverse of a rotation and a translation; NumPy's takes a millisecond where threads are many."""
    return rigid(pose[:3, :3].T, -pose[:3, :3].T @ pose[:3, 3])


def _sampled(picture: Float32[np.ndarray, "h w"], places: Float[np.ndarray, "... 2"]) -> Float32[np.ndarray, "..."]:
    """Values of a picture at places (column, row), pixel centres at +0.5, linearly between them."""
    flat = np.ascontiguousarray(places.reshape(1, -1, 2) - 0.5, np.float32)
    rows = -(-flat.shape[1] // 8192)
    padded = np.pad(flat, ((0, 0), (0, rows * 8192 - flat.shape[1]), (0, 0))).reshape(rows, 8192, 2)
    if not rows:
        return np.zeros(places.shape[:-1], np.float32)
    found = cv2.remap(picture, padded, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)  # pyrefly: ignore
    return found.reshape(-1)[: flat.shape[1]].reshape(places.shape[:-1])


def _log_light(picture: UInt8[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w"]:
    light = np.log(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.float32) + np.float32(_DARK_LEVELS))
    return cv2.GaussianBlur(light, (0, 0), 0.8)


def _contrast(picture: UInt8[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w"]:
    """Logarithm of the brightness against its surroundings."""
    light = _log_light(picture)
    return np.clip(light - cv2.GaussianBlur(light, (0, 0), _SURROUNDINGS_PX), -_STRONGEST, _STRONGEST)


def _edges(picture: UInt8[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w"]:
    """Strength of the edges."""
    light = _log_light(picture)
    slope = np.hypot(cv2.Sobel(light, cv2.CV_32F, 1, 0), cv2.Sobel(light, cv2.CV_32F, 0, 1))
    return cv2.GaussianBlur(np.minimum(slope, 1.5), (0, 0), 1.0)


def _steps(points: Float64[np.ndarray, "n 3"]) -> np.ndarray:
    """Points that a neighbour of their ring lies far behind: indices."""
    range_m = np.linalg.norm(points, axis=-1)
    elevation = np.arctan2(points[:, 2], np.linalg.norm(points[:, :2], axis=-1))
    azimuth, ring = np.arctan2(points[:, 1], points[:, 0]), np.floor(elevation / np.radians(0.4))
    order = np.lexsort((azimuth, ring))
    found = np.zeros(len(order), bool)
    for side in (1, -1):
        after = np.roll(order, -side)
        near = (ring[after] == ring[order]) & (np.abs(azimuth[after] - azimuth[order]) < np.radians(0.6))
        found |= near & (range_m[after] > 1.15 * range_m[order] + 0.5)
    return order[found]


def _pairs_apart(places: Float64[np.ndarray, "n 3"], far_m: float) -> list[tuple[int, int]]:
    """Some of the places, spread over the drive, each with the next one that is so far away: indices."""
    pairs = []
    for first in spread_over(len(places), _TRIED):
        far = np.flatnonzero(np.linalg.norm(places[first + 1 :] - places[first], axis=-1) >= far_m)
        pairs += [(first, first + 1 + int(far[0]))] if len(far) else []
    return pairs


class _View:
    """A camera of the recording, with the pictures that are compared."""

    def __init__(self, recording: Recording, camera: RecordedCamera, usable: Bool[np.ndarray, "h w"]) -> None:
        path = recording.trajectory
        assert path is not None
        self.camera, self._path = camera, path
        side = max(camera.camera.width, camera.camera.height)
        self._factors = [max(1, round(side / px)) for px in (_CONTRAST_PX, _EDGES_PX)]
        self.small, self._finer = (camera.camera.downscaled(factor) for factor in self._factors)
        self.usable, self._finer_usable = (
            cv2.erode(downscale_mask(usable, factor).astype(np.float32), np.ones((9, 9))) for factor in self._factors
        )
        # most readings leave the path as it is
        self._given = lru_cache(None)(lambda *times_s: path.at(np.array(times_s)))
        self.pairs = self._pairs(recording)

    def _pairs(self, recording: Recording) -> list[_Pair]:
        """Pictures spread over the drive, each with the next one from another place."""
        pictures = [one for one in recording.pictures if one.camera == self.camera.name]
        pictures.sort(key=lambda one: one.time_s)
        places = np.array([recording.pose(picture)[:3, 3] for picture in pictures]).reshape(-1, 3)
        pairs = _pairs_apart(places, _MOVED_M)
        found = []
        for index in spread_over(len(pairs), _PAIRS):
            first, second = (pictures[one] for one in pairs[index])
            read = [read_if_whole(partial(read_image, picture.path)) for picture in (first, second)]
            if read[0] is None or read[1] is None:
                continue
            contrasts = [_contrast(downscale_image(picture, self._factors[0])) for picture in (read[0], read[1])]
            edges = _edges(downscale_image(read[0], self._factors[1]))
            inner = self._finer_usable > 0
            edges /= max(float(edges[inner].mean()) if inner.any() else 1.0, 1e-6)
            found.append(_Pair((first, second), (contrasts[0], contrasts[1]), edges))
        return found

    def poses(self, pair: _Pair, reading: Reading) -> tuple[Transform, Transform]:
        """Camera to world, of both pictures."""
        times_s = [picture.time_s + reading.pictures_later_s for picture in pair.pictures]
        vehicles = self._given(*times_s) if reading.path is None else reading.path(self._path).at(np.array(times_s))
        first, second = (vehicle @ reading.camera(self.camera.to_vehicle) for vehicle in vehicles)
        own = [picture.camera_to_world for picture in pair.pictures]
        if own[0] is not None and own[1] is not None:
            # pictures' own poses say how the camera moved, and the vehicle's path where LiDAR is
            second = first @ _inverse(own[0]) @ own[1]
        return first, second

    def seen(
        self, pair: _Pair, world: Float64[np.ndarray, "n 3"], reading: Reading
    ) -> tuple[Float64[np.ndarray, "m 3"], tuple[Float64[np.ndarray, "m 2"], Float64[np.ndarray, "m 2"]]]:
        """Points that both pictures of a pair see, in the first camera, and their pixels in both."""
        pixels, in_first, kept = [], world, np.ones(len(world), bool)
        for number, pose in enumerate(self.poses(pair, reading)):
            in_camera = _moved(_inverse(pose), world)
            found, inside = _projected(self.small, in_camera)
            kept &= inside
            kept[kept] = _sampled(self.usable, found[kept]) > 0.99
            if number == 0:
                in_first = in_camera
                kept[kept] = _in_front(found[kept], np.linalg.norm(in_camera[kept], axis=-1))
            pixels.append(found)
        return in_first[kept], (pixels[0][kept], pixels[1][kept])

    def edge(self, pair: _Pair, world: Float64[np.ndarray, "n 3"], reading: Reading) -> tuple[float, int]:
        """Sum of the edges' strength at points of the world, and how many there are."""
        in_camera = _moved(_inverse(self.poses(pair, reading)[0]), world)
        pixels, inside = _projected(self._finer, in_camera)
        inside[inside] = _sampled(self._finer_usable, pixels[inside]) > 0.99
        return float(_sampled(pair.edges, pixels[inside]).sum()), int(inside.sum())


def _projected(
    camera: Camera, points: Float64[np.ndarray, "n 3"]
) -> tuple[Float64[np.ndarray, "n 2"], Bool[np.ndarray, "n"]]:
    pixels, valid = camera.project(torch.from_numpy(points))
    return pixels.numpy(), (valid & camera.inside(pixels)).numpy()


def _in_front(pixels: Float[np.ndarray, "n 2"], distance_m: Float[np.ndarray, "n"]) -> Bool[np.ndarray, "n"]:
    """Leave out what a far nearer point hides: in the same square of six pixels."""
    _, square = np.unique(pixels // 6 @ (1, 100_000), return_inverse=True)
    nearest = np.full(len(pixels), np.inf)
    np.minimum.at(nearest, square, distance_m)
    return distance_m < 1.3 * nearest[square]


def _fit(values: Sequence[np.ndarray], edges: Sequence[tuple[float, int]], asked: int) -> _Fit:
    """Of contrasts in the first picture, in the second, and in the second at the first's pixels."""
    first, second, still = np.concatenate(values, 1).astype(np.float64) if values else np.zeros((3, 0))
    power = float(first @ first)
    tells = len(first) >= _FEWEST and min(power, float(second @ second)) > len(first) * _FAINTEST**2
    strength, count = np.sum(edges, 0) if edges else (0.0, 0)

    def lack(other: np.ndarray) -> float:
        return max(1 - float(first @ other) / max(math.sqrt(power * float(other @ other)), 1e-9), _LEAST_LACK)

    edge = float(strength) / count if count >= _FEWEST / 4 else 0.0
    lacks = (lack(second), lack(still)) if tells else (1.0, 1.0)
    return _Fit(*lacks, edge, tells, len(first) / max(1, asked))


class _Source:
    """A scanner, or the depth maps, and the readings of it."""

    def __init__(self, recording: Recording, name: str) -> None:
        assert recording.trajectory is not None
        self.name, self._path = name, recording.trajectory
        self.sweeps = sorted((one for one in recording.sweeps if one.scanner == name), key=lambda one: one.time_s)
        self._times_s = np.array([one.time_s for one in self.sweeps])
        self._scans: dict[object, _Scan | None] = {}
        self._maps: dict[object, tuple[np.ndarray, np.ndarray]] = {}

    def scan(self, recorded: RecordedSweep) -> _Scan | None:
        """Read a sweep, once."""
        if recorded.path not in self._scans:
            read = read_if_whole(recorded.read)
            self._scans[recorded.path] = None if read is None else _scan(read, recorded, self._path)
        return self._scans[recorded.path]

    def fit(self, view: _View, pairs: Iterable[_Pair], reading: Reading) -> _Fit:
        """How well a reading of this fits a camera."""
        values, edges, asked = [], [], 0
        for pair in pairs:
            world = self.points(view, pair, reading)
            if world is None:
                continue
            asked += len(world)
            _, pixels = view.seen(pair, world, reading)
            of_pictures = [_sampled(c, p) for c, p in zip(pair.contrasts, pixels, strict=True)]
            values.append(np.stack([*of_pictures, _sampled(pair.contrasts[1], pixels[0])]))
            if (scan := self.nearest(pair, reading)) is not None:
                edges.append(view.edge(pair, scan.edges.world(reading), reading))
        return _fit(values, edges, asked)

    def nearest(self, pair: _Pair, reading: Reading) -> _Scan | None:
        """The sweep of a pair's first picture, if there is one."""
        time_s = pair.pictures[0].time_s + reading.pictures_later_s - reading.scans_later_s
        apart_s = np.abs(self._times_s - time_s)
        return self.scan(self.sweeps[apart_s.argmin()]) if apart_s.min(initial=math.inf) <= _APART_S else None

    def points(self, view: _View, pair: _Pair, reading: Reading) -> Float64[np.ndarray, "n 3"] | None:
        """What is seen of the world by a pair."""
        if pair.pictures[0].depth is not None:
            return self._of_map(view, pair, reading)
        scan = self.nearest(pair, reading)
        return None if scan is None else scan.seen.world(reading)

    def _of_map(self, view: _View, pair: _Pair, reading: Reading) -> Float64[np.ndarray, "n 3"]:
        picture = pair.pictures[0]
        assert picture.depth is not None
        if picture.path not in self._maps:
            read = read_if_whole(partial(read_depth, picture.depth, view.camera.camera))
            distance_m = np.zeros(0) if read is None else read.ravel()
            known = np.random.default_rng(0).permutation(np.flatnonzero(distance_m))[:_POINTS]
            directions = rays(view.camera.camera).directions.reshape(-1, 3)[known]
            self._maps[picture.path] = distance_m[known].astype(np.float64), directions.astype(np.float64)
        distance_m, directions = self._maps[picture.path]
        if reading.to_distance is not None:
            distance_m = reading.to_distance(distance_m, directions[:, 2])
        return _moved(view.poses(pair, reading)[0], distance_m[:, None] * directions)

    @cached_property
    def _two_sweeps(self) -> list[tuple[_Points, _Points]]:
        """Pairs of sweeps between which the vehicle has moved."""
        pairs = _pairs_apart(self._path.at(self._times_s)[:, :3, 3], _SWEEPS_MOVED_M)
        found = []
        for index in spread_over(len(pairs), 3):
            scans = [self.scan(self.sweeps[one]) for one in pairs[index]]
            if scans[0] is not None and scans[1] is not None:
                found.append((scans[0].few, scans[1].many))
        return found

    def apart_m(self, reading: Reading) -> float | None:
        """Mean distance between the upright surfaces of sweeps, at most half a metre each."""
        found = []
        for few, many in self._two_sweeps:
            points, others = few.world(reading), many.world(reading)
            distance_m, nearest = KDTree(others).query(points, 10, distance_upper_bound=1.0)
            met = np.isfinite(distance_m).all(-1)
            around = others[np.asarray(nearest)[met]]
            middle = around.mean(1)
            off = around - middle[:, None]
            sizes, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", off, off))
            surface = (sizes[:, 0] < 0.05 * sizes[:, 1]) & (sizes[:, 1] > 0.05 * sizes[:, 2])
            surface &= np.abs(axes[:, 2, 0]) < 0.5
            along = np.abs(((points[met] - middle) * axes[:, :, 0]).sum(-1))
            found.append(np.minimum(along[surface], 0.5))
        apart = np.concatenate(found) if found else np.zeros(0)
        return float(apart.mean()) if len(apart) >= 100 else None


def _scan(read: Sweep, recorded: RecordedSweep, path: Trajectory) -> _Scan:
    points = read.points_m.double().numpy()
    offset_s = offsets_s(read, recorded.timing, deskew=True).double().numpy()
    order = np.random.default_rng(0).permutation(len(points))

    def some(index: np.ndarray) -> _Points:
        return _Points(points[index], offset_s[index], recorded, path)

    few, many = (some(order[:count]) for count in _SWEEP_POINTS)
    return _Scan(some(order[:_POINTS]), some(_steps(points)), few, many)


@dataclass(frozen=True)
class _Candidate:
    """A reading of one scanner, or of one camera, and how well it fits."""

    reading: Reading
    sensor: str
    views: tuple[_View, ...]
    """Those that it concerns."""
    given: Transform
    """From the scanner to the vehicle; of maps the camera's."""
    gain: float = -math.inf
    gains: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Its parts by contrast, edges and sweeps, before edges are cubed."""
    lack: float = 1.0
    before: float = 1.0
    """The mean lack as given."""
    still: float = 1.0
    """The mean lack if the camera had not moved."""

    @property
    def clear(self) -> bool:
        """Whether it is named."""
        if not self.reading.both:
            return self.gain >= self.reading.clear and self.lack < _FITTING
        told = any(
            all(gain >= least for gain, least in zip(self.gains, asked, strict=False))
            for asked in (_LEAST_GAINS, _LEAST_GAINS_WITH_SWEEPS)
        )
        return self.gain >= self.reading.clear and self.lack < min(_FITTING, _MOVES_SMALL * self.still) and told


def _of_point_times(source: _Source) -> list[Reading]:
    """Other times of a sweep's points, where they have times."""
    timing = source.sweeps[0].timing if source.sweeps else None
    scan = source.scan(source.sweeps[0]) if source.sweeps else None
    if scan is None or not scan.few.offset_s.any():
        return []
    offset_s = scan.few.offset_s
    turn_s = float(np.ptp(offset_s)) if timing is None else timing.turn_s
    middle_s = float(offset_s.min()) + turn_s / 2 if timing is None else 0.0

    def other_half(given: np.ndarray) -> np.ndarray:
        return np.where(given < middle_s, given + turn_s / 2, given - turn_s / 2)

    backwards = "the point times of {name} count backwards: change their sign, or timestamp"
    off = "the point times of {name} are off by half a turn"
    if timing is not None:
        backwards = "{name} turns the other way: change its direction"
        off = "the scans of {name} begin on the other side: add 180 to start_azimuth_deg"
    corrected = "the points of {name} are corrected for the vehicle's motion already: set corrected_to"
    return [
        Reading(backwards, point_times=lambda given: 2 * middle_s - given, clear=CLEAR_SMALL),
        Reading(off, point_times=other_half, clear=CLEAR_SMALL),
        Reading(corrected, point_times=lambda given: np.full_like(given, middle_s), clear=CLEAR_SMALL),
    ]


# ---- the judgement -----------------------------------------------------------------------------------------------


def check_lidar(recording: Recording, usable: Mapping[str, Bool[np.ndarray, "h w"]]) -> LidarCheck:
    """Hold LiDAR, or depth maps, against the pictures, the path and itself.

    Args:
        recording: with the vehicle's path. Files that cannot be read are passed over.
        usable: of each camera at its pictures' size, True where they may be used.

    Raises:
        InputError: no scan of a scanner can be read.
    """
    views = [_View(recording, camera, usable[camera.name]) for camera in recording.cameras]
    figures: list[LidarFigures] = []
    warnings: list[str] = []
    sources = [(name, views) for name in dict.fromkeys(sweep.scanner for sweep in recording.sweeps)]
    with_maps = [view for view in views if view.pairs and view.pairs[0].pictures[0].depth is not None]
    for name, seen_by in (*sources, *((view.camera.name, [view]) for view in with_maps)):
        found, said = _evaluated(_Source(recording, name), seen_by)
        figures += found
        warnings += said
    return LidarCheck(tuple(figures), tuple(dict.fromkeys(warnings)))


def _file_warnings(source: _Source, views: Sequence[_View]) -> list[str]:
    """What the files themselves show: points beyond reach, other columns, maps that hold one value where none is."""
    looked_at = [source.sweeps[index] for index in spread_over(len(source.sweeps), 3)]
    found = []
    for recorded in looked_at[:1]:
        if recorded.columns is not None and (told := columns_told(recorded.path)) != recorded.columns:
            found.append(
                f"{recorded.path}: its numbers repeat every {told}, but it is read with {recorded.columns} columns. "
                f"Name all {told} in columns of lidars.{source.name}."
            )
    read = [sweep for one in looked_at if (sweep := read_if_whole(one.read)) is not None]
    if looked_at and not read:
        # none can be read: say why before anything long
        looked_at[0].read()
    far = [sweep.too_far / (sweep.too_far + len(sweep.points_m)) for sweep in read]
    if far and np.median(far) > _FAR_SHARE:
        found.append(
            f"{np.median(far):.0%} of the points of {source.name} lie beyond 255 m: are they in another unit? Set "
            "metres_per_unit to 0.01 for centimetres, 0.001 for millimetres, 0.0254 for inches."
        )
    for view in views:
        depth = view.pairs[0].pictures[0].depth if view.pairs else None
        raw = None if depth is None else read_if_whole(partial(read_distance_png, depth.path, depth.metres_per_count))
        if depth is None or raw is None or not raw.any():
            continue
        share = float((raw == raw.max()).mean())
        if share > _ONE_VALUE_SHARE:
            found.append(
                f"{depth.path}: {share:.0%} of its pixels have one value, {raw.max():.4g} m, the largest. If this "
                "stands for no distance, write 0 there."
            )
    return found


def _evaluated(source: _Source, views: Sequence[_View]) -> tuple[list[LidarFigures], list[str]]:
    if of_files := _file_warnings(source, views):
        return [], of_files
    given = {view: source.fit(view, view.pairs, Reading()) for view in views if view.pairs}
    apart_m = source.apart_m(Reading())
    figures = [_figures(source, view, fit, apart_m) for view, fit in given.items()]
    off = [one for one in figures if one.ratio is not None and abs(math.log(one.ratio)) > math.log(OFF)]
    known = sum(one.ratio is not None for one in figures)
    doubt = len(off) * 2 > known or any(fit.lack > min(_DOUBT, fit.still) for fit in given.values())
    best = _best(source, given, apart_m, doubt) if _may_gain(given, apart_m) >= CLEAR_SMALL else []
    if best:
        return figures, [_said(best)]
    poor = [one for one in figures if one.ratio is not None and one.correlation < 1 - _DOUBT]
    unfit = [one for one in poor if one in off or one.correlation < _FITTING]
    # of a scanner that looks ahead, a camera that looks back sees nothing
    unseen = bool(given) and all(fit.share < _UNSEEN for fit in given.values())
    said = [
        f"No point of {source.name} lies in any picture: check to_vehicle (in metres?), the clocks, and the times of "
        "its points."
    ]
    return figures, (said if unseen else []) + [
        f"{one.scanner} does not lie on what {one.camera} shows: its distances are {one.ratio:.2f} times those of the "
        f"pictures (median), and contrast agrees by {one.correlation:.2f} only (1 is best). No other reading that was "
        "tried fits. Check to_vehicle, the clocks, the units and the poses."
        for one in unfit
    ]


def _may_gain(given: Mapping[_View, _Fit], apart_m: float | None) -> float:
    """The largest gain that any reading could have; 0 where nothing tells how well the given one fits."""
    told = [fit for fit in given.values() if fit.tells or fit.share < _UNSEEN]
    gains = [math.log(fit.lack / _LEAST_LACK) + (3 * _MOST_BY_EDGES if fit.edge else 0) for fit in told]
    return max(gains, default=0.0) + (0.0 if apart_m is None or not told else _MOST_BY_SWEEPS)


def _best(source: _Source, given: dict[_View, _Fit], apart_m: float | None, doubt: bool) -> list[_Candidate]:
    """The readings that fit clearly better: one of the scanner or the path, or one for each camera."""
    views = tuple(given)
    if not source.sweeps:
        of_all = of_maps()
    else:
        of_all = [*small("scanner"), *_of_point_times(source)]
        of_all += [*mountings("scanner"), *of_scans()] if doubt else []
    of_all += of_path() if doubt else []
    to_vehicle = source.sweeps[0].to_vehicle if source.sweeps else views[0].camera.to_vehicle
    tried = [_Candidate(reading, source.name, views, to_vehicle) for reading in of_all]
    for view in views:
        of_camera = [*small("camera"), *(mountings("camera") if doubt else [])]
        tried += [_Candidate(reading, view.camera.name, (view,), to_vehicle) for reading in of_camera]
    some = {view: view.pairs[1::3] or view.pairs for view in views}
    given_of_some = {view: source.fit(view, pairs, Reading()) for view, pairs in some.items()}
    first = [_tried(source, one, given_of_some, None, some) for one in tried]
    chosen = sorted(first, key=lambda one: -one.gain)[:_TRIED_WHOLE]
    chosen += [one for one in first if one.reading.point_times is not None and one not in chosen]
    whole = sorted((_tried(source, one, given, apart_m) for one in chosen), key=lambda one: -one.gain)
    # an angle between those tried fits only once it is found
    whole[:_REFINED] = [_refined(source, one, given, apart_m) if one.gain > 0 else one for one in whole[:_REFINED]]
    whole = [one for one in whole if one.clear]
    if not whole:
        return []
    best = max(whole, key=lambda one: one.gain)
    if len(best.views) == len(views) and best.sensor == source.name:
        return [best]
    of_cameras = [one for one in whole if one.sensor != source.name]
    return list({one.sensor: one for one in sorted(of_cameras, key=lambda one: one.gain)}.values())


def _tried(
    source: _Source,
    candidate: _Candidate,
    given: dict[_View, _Fit],
    apart_m: float | None,
    some: Mapping[_View, Sequence[_Pair]] | None = None,
) -> _Candidate:
    """Try a reading, on some or all pairs of pictures, and with `apart_m` on sweeps."""
    reading, unfit = candidate.reading, replace(candidate, gain=-math.inf)
    fits = [given[view] for view in candidate.views]
    others = [source.fit(view, some[view] if some else view.pairs, reading) for view in candidate.views]
    # points that are seen, but on nothing with contrast, tell nothing
    told = [(b, a) for b, a in zip(fits, others, strict=True) if b.tells or (a.tells and b.share < _UNSEEN)]
    if not told:
        return unfit
    before, lack, still = (
        float(np.mean(each)) for each in zip(*((b.lack, a.lack, a.still) for b, a in told), strict=True)
    )
    if lack > _MOVES * still:
        return unfit
    by_contrast, by_sweeps = math.log(before / lack), 0.0
    steps = [math.log(a.edge / b.edge) for b, a in told if a.edge > 0 and b.edge > 0]
    step = float(np.clip(np.mean(steps), -_MOST_BY_EDGES, _MOST_BY_EDGES)) if steps else 0.0
    gain = by_contrast + 3 * step
    of_sweeps = candidate.sensor == source.name and not reading.scales
    if apart_m is not None and of_sweeps and gain > -0.2 and (other_m := source.apart_m(reading)) is not None:
        by_sweeps = float(np.clip(math.log(apart_m / other_m), -_MOST_BY_SWEEPS, _MOST_BY_SWEEPS))
    gains = by_contrast, step, by_sweeps
    return replace(candidate, gain=gain + by_sweeps, gains=gains, lack=lack, before=before, still=still)


def _refined(source: _Source, best: _Candidate, given: dict[_View, _Fit], apart_m: float | None) -> _Candidate:
    """Find the amount of a reading that has one."""
    step = best.reading.step
    for _ in range(3):
        if best.reading.finer is None:
            break
        amounts = [best.reading.amount + side * step for side in (1, -1)]
        # what it has to gain stays that of its kind
        kind = {"both": best.reading.both, "clear": best.reading.clear}
        others = [replace(best, reading=replace(best.reading.finer(amount), **kind)) for amount in amounts]
        best = max([best, *(_tried(source, one, given, apart_m) for one in others)], key=lambda one: one.gain)
        step /= 2
    return best


def _said(best: Sequence[_Candidate]) -> str:
    fits = ", and ".join(one.reading.said.replace("{name}", one.sensor) + _corrected(one) for one in best)
    then, given = (
        ", ".join(f"{1 - lack:.2f}" for lack in lacks)
        for lacks in zip(*((b.lack, b.before) for b in best), strict=True)
    )
    return (
        f"LiDAR does not lie on what the pictures show. It does if {fits} (contrast at its points agrees by {then} "
        f"then, by {given} as given)."
    )


def _corrected(best: _Candidate) -> str:
    """The transform to the vehicle that a small turn or offset of a sensor asks for."""
    reading, (view, *_) = best.reading, best.views
    if not reading.both or reading.scans_later_s or reading.pictures_later_s:
        return ""
    found = reading.camera(view.camera.to_vehicle) if best.sensor == view.camera.name else reading.scanner(best.given)
    rows = ", ".join(f"[{', '.join(f'{number:.5g}' for number in row)}]" for row in found)
    return f" (to_vehicle = [{rows}])"


def _figures(source: _Source, view: _View, fit: _Fit, apart_m: float | None) -> LidarFigures:
    shifted = (
        [source.fit(view, view.pairs, turn("scanner", "z")(side)).edge for side in (3.0, -3.0)] if fit.edge else []
    )
    logs, sides = _ratios(source, view)
    median = float(np.median(logs)) if len(logs) >= _FEWEST_RATIOS else None
    thirds = [logs[sides == third] for third in range(3)]
    return LidarFigures(
        view.camera.name,
        source.name,
        1 - fit.lack,
        fit.edge / max(float(np.mean(shifted)), 1e-6) if shifted else None,
        apart_m,
        None if median is None else math.exp(median),
        None if median is None else float(np.median(np.abs(logs - median))),
        tuple(math.exp(np.median(part)) if len(part) >= _FEWEST_RATIOS else None for part in thirds),  # pyrefly: ignore
    )


def _ratios(source: _Source, view: _View) -> tuple[np.ndarray, np.ndarray]:
    """Logarithms of LiDAR's distance over that at which the pictures' patches agree, and the third of the picture."""
    found, sides = [np.zeros(0)], [np.zeros(0, int)]
    patch = np.stack(np.meshgrid(np.arange(-2.0, 3), np.arange(-2.0, 3)), -1).reshape(-1, 2)
    for pair in view.pairs[1::2]:
        world = source.points(view, pair, Reading())
        if world is None:
            continue
        in_first, (first, _) = view.seen(pair, world, Reading())
        in_first, first = in_first[:_SEARCHED], first[:_SEARCHED]
        poses = view.poses(pair, Reading())
        to_second = _inverse(poses[1]) @ poses[0]
        tried = in_first[:, None] * np.exp(-_LOG_RATIOS)[:, None]
        in_second = _moved(to_second, tried.reshape(-1, 3)).reshape(tried.shape)
        pixels, inside = _projected(view.small, in_second.reshape(-1, 3))
        pixels, inside = pixels.reshape(*tried.shape[:2], 2), inside.reshape(tried.shape[:2])
        # what comes nearer gets larger
        larger = np.linalg.norm(tried, axis=-1) / np.linalg.norm(in_second, axis=-1).clip(1e-6)
        one = _sampled(pair.contrasts[0], first[:, None] + patch)
        other = _sampled(
            pair.contrasts[1], np.nan_to_num(pixels)[:, :, None] + larger.clip(0.25, 4)[..., None, None] * patch
        )
        one, other = one - one.mean(-1, keepdims=True), other - other.mean(-1, keepdims=True)
        size = np.linalg.norm(one, axis=-1)[:, None] * np.linalg.norm(other, axis=-1)
        alike = np.where(inside, (one[:, None] * other).sum(-1) / np.maximum(size, 0.05), -1.0)
        best = alike.argmax(-1)
        far = np.abs(_LOG_RATIOS - _LOG_RATIOS[best][:, None]) > 0.25
        second = np.where(far, alike, -1.0).max(-1)
        middle = len(_LOG_RATIOS) // 2
        moves = np.linalg.norm(pixels[:, middle + 10] - pixels[:, middle - 10], axis=-1)
        sure = (alike.max(-1) > 0.9) & (alike.max(-1) - second > 0.15) & (moves > 3)
        found.append(_LOG_RATIOS[best[sure]] + _peak(alike[sure], best[sure]) * (_LOG_RATIOS[1] - _LOG_RATIOS[0]))
        sides.append((first[sure, 0] / view.small.width * 3).astype(int))
    return np.concatenate(found), np.concatenate(sides)


def _peak(values: Float[np.ndarray, "n k"], best: Int[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Where a parabola through the largest value and its neighbours has its maximum, in steps from the largest."""
    padded = np.pad(values, ((0, 0), (1, 1)), mode="edge")
    before, middle, after = (padded[np.arange(len(best)), best + side] for side in range(3))
    return np.clip(0.5 * (before - after) / np.minimum(before - 2 * middle + after, -1e-9), -0.5, 0.5)
