"""Features matched between pictures of known lenses, and how far each lies from its epipolar curve, in pixels.

Two poses and a ray span the epipolar plane. A ray of the other picture that sees the same point lies in it; through a
fisheye the plane is seen as a curve. Let n be the plane's normal, d(p) the ray of a feature at pixel p, and J = ∂d/∂p.
To first order, the feature's distance from that curve is |n·d| / |Jᵀn| (Sampson's distance of one picture, Hartley &
Zisserman, Multiple View Geometry, 11.4.3). This holds for every lens. It measures the errors of a turn, and of the
direction of a shift; the length of a shift leaves no trace.

Features are OpenCV's SIFT, compared by Hellinger's distance (Arandjelović & Zisserman, CVPR 2012), mutually nearest and
clearly nearer than the second. Pixels have their centres at +0.5, camera axes are OpenCV's, transforms 4×4 in metres.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int, UInt8

from edge_depth_nerf.base.numbers import spread_over
from edge_depth_nerf.cameras import Camera
from edge_depth_nerf.cameras.transforms import Transform

MOST_FEATURES = 3000
"""Of a picture, those of the most contrast."""
LARGEST_SIDE_PX = 1400
"""Larger pictures are made smaller before the search for features."""
RATIO = 0.8
"""A match must be nearer than this part of the second nearest (Lowe, IJCV 2004)."""
ROUNDING = 1e-5
"""Squared distances of unit descriptors below this are rounding: their products are float32 sums of 128 terms."""
LEAST_BASELINE_M = 0.05
"""Pictures taken nearer to each other have no epipolar plane to speak of."""
LEAST_FROM_EPIPOLE_RAD = np.radians(3.0)
"""Rays nearer to the epipole than this see the plane turn about them."""
LEAST_MATCHES = 20
"""The median of fewer matches says nothing."""
_BORDER_PX = 4
"""Features nearer to the edge of a mask look at what is masked."""
MEASURED_FRAMES = 100
"""So many frames of each camera, spread over the drive, are used."""


@dataclass(frozen=True)
class PosedPicture:
    """A picture, where it was taken, and how to read it."""

    camera: str
    frame: int
    lens: Camera
    """At the picture's size."""
    camera_to_world: Transform
    """Camera axes as OpenCV's."""
    read_rgb: Callable[[], UInt8[np.ndarray, "h w 3"]]
    """Reads the picture; called once for each picture."""
    read_usable: Callable[[], Bool[np.ndarray, "h w"]] | None = None
    """Reads where it may be used (no vehicle, nothing that moves, within the lens); None = everywhere."""


@dataclass(frozen=True)
class Sights:
    """Where features were seen in one picture."""

    pixels: Float64[np.ndarray, "n 2"]
    """In the picture at its own size."""
    rays: Float64[np.ndarray, "n 3"]
    """Unit directions in the camera's frame."""
    ray_per_pixel: Float64[np.ndarray, "n 3 2"]
    """How the ray changes with the pixel, radians per pixel."""

    def __len__(self) -> int:
        return len(self.pixels)

    def __getitem__(self, index: Int[np.ndarray, "m"] | Bool[np.ndarray, "n"]) -> Sights:
        """Some of them."""
        return Sights(self.pixels[index], self.rays[index], self.ray_per_pixel[index])


@dataclass(frozen=True)
class Features:
    """What was found in one picture."""

    sights: Sights
    descriptors: Float32[np.ndarray, "n 128"]
    """Unit vectors, whose products are Hellinger's."""


@dataclass(frozen=True)
class Matches:
    """What two pictures, given by their indices, have in common."""

    first: int
    second: int
    index: Int[np.ndarray, "m 2"]
    """Which feature of each."""
    in_first: Sights
    in_second: Sights

    def __len__(self) -> int:
        return len(self.index)

    def taken(self, kept: Bool[np.ndarray, "m"]) -> Matches:
        """Some of them."""
        return Matches(self.first, self.second, self.index[kept], self.in_first[kept], self.in_second[kept])


def sights_of(lens: Camera, pixels: Float64[np.ndarray, "n 2"]) -> tuple[Sights, Bool[np.ndarray, "n"]]:
    """The rays of some pixels of a lens, and whether it gives them rays at all."""
    # central differences over a pixel
    offsets = np.array([[0, 0], [0.5, 0], [-0.5, 0], [0, 0.5], [0, -0.5]])
    directions, valid = lens.unproject(torch.from_numpy(pixels[:, None] + offsets))
    rays = directions.numpy()
    per_pixel = np.stack((rays[:, 1] - rays[:, 2], rays[:, 3] - rays[:, 4]), -1)
    return Sights(pixels, rays[:, 0], per_pixel), valid.numpy().all(-1)


def find_features(picture: PosedPicture, most: int = MOST_FEATURES) -> Features:
    """Find SIFT features where a picture may be used.

    Raises:
        InputError: the picture or its mask cannot be read.
    """
    rgb = picture.read_rgb()
    height, width = rgb.shape[:2]
    usable = np.ones((height, width), bool) if picture.read_usable is None else picture.read_usable()
    size = np.array([width, height])
    smaller = np.maximum((size * min(1.0, LARGEST_SIDE_PX / max(size))).round().astype(int), 1)
    grey = cv2.resize(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), smaller.tolist(), interpolation=cv2.INTER_AREA)
    mask = cv2.resize(usable.astype(np.uint8), smaller.tolist(), interpolation=cv2.INTER_NEAREST)
    # the picture's own border is no edge of the mask: SIFT keeps away from it by itself
    reach = np.ones((2 * _BORDER_PX + 1, 2 * _BORDER_PX + 1), np.uint8)
    mask = cv2.erode(mask, reach)
    detector = cv2.SIFT_create(nfeatures=most, enable_precise_upscale=True)  # pyrefly: ignore[missing-attribute]
    found, descriptors = detector.detectAndCompute(grey, 255 * mask)
    if descriptors is None:
        found, descriptors = [], np.zeros((0, 128), np.float32)
    # OpenCV counts integer pixel centres
    pixels = (np.array([point.pt for point in found], np.float64).reshape(-1, 2) + 0.5) * (size / smaller)
    sights, valid = sights_of(picture.lens, pixels)
    # a place with two orientations is two features, and would be counted twice
    _, once = np.unique(pixels.round(2), axis=0, return_index=True)
    kept = np.sort(once)
    kept = kept[valid[kept]]
    hellinger = np.sqrt(descriptors[kept] / np.maximum(descriptors[kept].sum(-1, keepdims=True), 1e-9))
    return Features(sights[kept], hellinger.astype(np.float32))


def match_features(first: Features, second: Features) -> Int[np.ndarray, "k 2"]:
    """Pair the features of two pictures that are mutually the nearest, and clearly so: in both directions."""
    none = np.zeros((0, 2), np.int64)
    if min(len(first.sights), len(second.sights)) < 2:
        return none
    products = first.descriptors @ second.descriptors.T
    nearest, clear = _nearest(products)
    back, clear_back = _nearest(products.T)
    rows = np.arange(len(nearest))
    mutual = (back[nearest] == rows) & clear & clear_back[nearest] & (products[rows, nearest] > 0)
    return np.stack((rows[mutual], nearest[mutual]), -1)


def _nearest(products: Float32[np.ndarray, "n m"]) -> tuple[Int[np.ndarray, "n"], Bool[np.ndarray, "n"]]:
    """The nearest of each row, and whether it is clearly nearer than the second."""
    two = np.argpartition(products, -2, axis=-1)[:, -2:]
    values = np.take_along_axis(products, two, -1)
    first = values.argmax(-1)[:, None]
    # squared distances of unit vectors
    best = 2 - 2 * np.take_along_axis(values, first, -1)[:, 0]
    second = 2 - 2 * np.take_along_axis(values, 1 - first, -1)[:, 0]
    # float32 may see equal ones at slightly different distances, depending on the processor
    clear = (best < RATIO**2 * second) & (second > ROUNDING)
    return np.take_along_axis(two, first, -1)[:, 0], clear


def match_pictures(
    pictures: Sequence[PosedPicture], pairs: Sequence[tuple[int, int]], most: int = MOST_FEATURES
) -> Iterator[Matches]:
    """Match pairs of pictures; the poses are not used.

    Each picture is read once, when its first pair comes; its features are dropped after its last one. So pairs in the
    order of the drive need little memory.

    Raises:
        InputError: a picture or its mask cannot be read.
    """
    last = {index: number for number, pair in enumerate(pairs) for index in pair}
    features: dict[int, Features] = {}
    for number, (first, second) in enumerate(pairs):
        for index in (first, second):
            if index not in features:
                features[index] = find_features(pictures[index], most)
        found = match_features(features[first], features[second])
        yield Matches(first, second, found, features[first].sights[found[:, 0]], features[second].sights[found[:, 1]])
        for index in {first, second}:
            if last[index] == number:
                del features[index]


def epipolar_distance_px(
    matches: Matches, first_to_world: Transform, second_to_world: Transform
) -> Float64[np.ndarray, "m"]:
    """How far matched features lie from each other's epipolar curves: the mean of both pictures, pixels.

    NaN where the poses say nothing: with a baseline below 5 cm, and within 3° of the epipole.
    """
    baseline = second_to_world[:3, 3] - first_to_world[:3, 3]
    length = float(np.linalg.norm(baseline))
    if length < LEAST_BASELINE_M or not len(matches):
        return np.full(len(matches), np.nan)
    towards = baseline / length
    seen = (matches.in_first, first_to_world[:3, :3]), (matches.in_second, second_to_world[:3, :3])
    distances = [
        _from_curve_px(sights, rotation, np.cross(towards, other.rays @ other_rotation.T))
        for (sights, rotation), (other, other_rotation) in (seen, seen[::-1])
    ]
    return (distances[0] + distances[1]) / 2


def _from_curve_px(
    sights: Sights, rotation: Float64[np.ndarray, "3 3"], normal: Float64[np.ndarray, "m 3"]
) -> Float64[np.ndarray, "m"]:
    """How far features lie from planes, given by the baseline's product with the other pictures' rays."""
    sine = np.linalg.norm(normal, axis=-1)
    clear = sine > np.sin(LEAST_FROM_EPIPOLE_RAD)
    in_camera = normal / np.where(clear, sine, 1)[:, None] @ rotation
    off = np.abs((in_camera * sights.rays).sum(-1))
    slope = np.linalg.norm(np.einsum("mi,mij->mj", in_camera, sights.ray_per_pixel), axis=-1)
    return np.where(clear & (slope > 0), off / np.where(slope > 0, slope, 1), np.nan)


@dataclass(frozen=True)
class EpipolarAgreement:
    """How well the poses of two pictures of one camera agree with what both see."""

    camera: str
    first: int
    """The earlier frame."""
    second: int
    """The later frame."""
    median_px: float
    """Median of the distances of matched features from their epipolar curves; NaN for fewer than twenty."""


def along_drive(pictures: Sequence[PosedPicture], most: int = MEASURED_FRAMES) -> list[EpipolarAgreement]:
    """Hold the poses of a drive against features matched between successive pictures of each camera, in any order.

    Pairs begin at `most` frames of each camera, spread over the drive. There is one result for each pair between whose
    pictures the vehicle moved by 5 cm or more, by camera and frame.

    Raises:
        InputError: a picture or its mask cannot be read.
    """
    pairs: list[tuple[int, int]] = []
    for camera in dict.fromkeys(picture.camera for picture in pictures):
        ordered = sorted((p.frame, i) for i, p in enumerate(pictures) if p.camera == camera)
        steps = list(itertools.pairwise(index for _, index in ordered))
        pairs += [steps[start] for start in spread_over(len(ordered), most) if start < len(steps)]
    places = [picture.camera_to_world[:3, 3] for picture in pictures]
    moved = [pair for pair in pairs if np.linalg.norm(places[pair[1]] - places[pair[0]]) >= LEAST_BASELINE_M]
    found = []
    for matches in match_pictures(pictures, moved):
        first, second = pictures[matches.first], pictures[matches.second]
        distances_px = epipolar_distance_px(matches, first.camera_to_world, second.camera_to_world)
        known = distances_px[np.isfinite(distances_px)]
        median_px = float(np.median(known)) if len(known) >= LEAST_MATCHES else float("nan")
        found.append(EpipolarAgreement(first.camera, first.frame, second.frame, median_px))
    return found
