"""Monocular maps of a source that this project did not train, made metric: by ready-made networks, or by file.

Metric maps stay unchanged, except that views of one picture are made to agree. Others are fitted to LiDAR: each picture
to its own LiDAR points, because a map of unknown scale has another scale in every picture. A picture with too few
points takes scale and shift of the drive, from training pictures. So nothing of a held-out picture enters another one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields

import numpy as np
from jaxtyping import Bool, Float32

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.method.alignment import LEAST_POINTS
from edge_depth_nerf.mono.relative import (
    WRONG_WAY,
    Kind,
    Layer,
    Line,
    Samples,
    blend,
    fit_lines,
    rank_correlation,
    take_samples,
)
from edge_depth_nerf.scene.reader import SceneFolder, ScenePicture

_SAMPLES = 3000
_SAMPLES_FOR_THE_DRIVE = 300
"""LiDAR points of a picture, and so many other pixels."""


@dataclass
class FittedMaps:
    """The maps of a scene, made metric one after another.

    Raises:
        InputError: maps of unknown scale, and a camera without LiDAR to fit them to.
    """

    scene: SceneFolder
    kind: Kind
    layers: Callable[[ScenePicture], Sequence[Layer]]
    """What a picture's views say."""
    by_the_drive: list[str] = field(default_factory=list)
    """Pictures that took the drive's fit so far."""

    def __post_init__(self) -> None:
        if self.kind == "metric":
            return
        for camera, pictures in self.scene.cameras().items():
            # most often the first will do
            if not any(not picture.held_out and self._lidar_points(picture) >= LEAST_POINTS for picture in pictures):
                raise self._no_lidar(camera)

    def __iter__(self) -> Iterator[tuple[ScenePicture, Float32[np.ndarray, "h w"]]]:
        """Give H×W metres along the ray of all pictures; those with few LiDAR points come last."""
        waiting: list[ScenePicture] = []
        drive: dict[str, list[Samples]] = {}
        right, wrong = 0, list[InputError]()
        for picture in self.scene.pictures:
            if self.kind == "metric":
                layers, samples = self._seen(picture)
                yield picture, self._blended(picture, layers, _agreeing(samples, self.kind))
                continue
            seen = self._seen(picture) if self._lidar_points(picture) >= LEAST_POINTS else None
            if seen is None or seen[1].lidar_points < LEAST_POINTS:
                waiting.append(picture)
                continue
            layers, samples = seen
            if (fault := self._wrong_way(picture, samples)) is not None:
                # a network may fail on one picture: that has no map then
                wrong.append(fault)
                if len(wrong) > max(right, 2):
                    raise wrong[0]
                yield picture, np.zeros((picture.lens.height, picture.lens.width), np.float32)
                continue
            right += 1
            if not picture.held_out:
                drive.setdefault(picture.camera, []).append(_thinned(samples))
            yield picture, self._blended(picture, layers, fit_lines(samples, self.kind))
        if wrong and len(wrong) >= right:
            raise wrong[0]
        if waiting and not self.scene.split_known:
            raise InputError(
                f"{self.scene.path}: {waiting[0].name} has fewer than {LEAST_POINTS} LiDAR points, so its map "
                "needs the fit of training pictures; but the scene does not say which these are. Add "
                "train_filenames, val_filenames and test_filenames, or use a source of metric maps."
            )
        of_drive: dict[str, list[Line]] = {}
        for picture in waiting:
            if picture.camera not in drive:
                raise self._no_lidar(picture.camera)
            if picture.camera not in of_drive:
                of_drive[picture.camera] = fit_lines(Samples.joined(drive[picture.camera]), self.kind)
            layers, samples = self._seen(picture)
            lines = fit_lines(samples, self.kind, of_drive[picture.camera])
            self.by_the_drive.append(picture.name)
            yield picture, self._blended(picture, layers, lines)

    def _no_lidar(self, camera: str) -> InputError:
        return InputError(
            f"{self.scene.path}: no training picture of {camera} has {LEAST_POINTS} LiDAR points where its map has "
            f"values, so {self.kind} maps, of unknown scale, cannot be made metric. Process the drive with "
            "its sweeps, or use a source of metric maps."
        )

    def _seen(self, picture: ScenePicture) -> tuple[Sequence[Layer], Samples]:
        layers = self.layers(picture)
        return layers, take_samples(layers, self.scene.lidar_m(picture), self.scene.usable(picture), _SAMPLES)

    def _lidar_points(self, picture: ScenePicture) -> int:
        if "lidar" not in picture.files:
            return 0
        return int((self.scene.usable(picture) & (self.scene.lidar_m(picture) > 0)).sum())

    def _blended(
        self, picture: ScenePicture, layers: Sequence[Layer], lines: Sequence[Line]
    ) -> Float32[np.ndarray, "h w"]:
        return blend(layers, lines, self.kind, (picture.lens.height, picture.lens.width))

    def _wrong_way(self, picture: ScenePicture, samples: Samples) -> InputError | None:
        """Find depth that is declared disparity, or the other way round."""
        lidar_points = np.flatnonzero(samples.lidar_m > 0)
        best = np.where(samples.seen, samples.weight, -1)[:, lidar_points].argmax(0)
        values, cosine = samples.values[best, lidar_points], samples.cosine[best, lidar_points]
        known = np.isfinite(values)
        z = (samples.lidar_m[lidar_points] * cosine)[known]
        found = rank_correlation(values[known], z) * (-1 if self.kind == "inverse" else 1)
        # without a correlation nothing is known
        if not found < WRONG_WAY:
            return None
        other = "relative (or metric)" if self.kind == "inverse" else "inverse"
        return InputError(
            f"{picture.name}: its map {'rises' if self.kind == 'inverse' else 'falls'} where LiDAR's distance rises "
            f"(rank correlation {abs(found):.2f}), so it is not {self.kind}. Declare it {other}."
        )


def agreed(layers: Sequence[Layer], usable: Bool[np.ndarray, "h w"], kind: Kind) -> Float32[np.ndarray, "h w"]:
    """Blend views of one picture that were made to agree, without LiDAR: metres along the ray, or up to one scale."""
    samples = take_samples(layers, np.zeros(usable.shape, np.float32), usable, _SAMPLES)
    rows, columns = usable.shape
    return blend(layers, _agreeing(samples, kind), kind, (rows, columns))


def _agreeing(samples: Samples, kind: Kind) -> list[Line]:
    start = [Line()] * len(samples.values)
    if len(start) == 1:
        return start
    return fit_lines(samples, kind, start if kind == "metric" else None)


def _thinned(samples: Samples) -> Samples:
    rng = np.random.default_rng(0)
    has_lidar = samples.lidar_m > 0
    chosen = np.concatenate(
        [rng.permutation(np.flatnonzero(each))[:_SAMPLES_FOR_THE_DRIVE] for each in (has_lidar, ~has_lidar)]
    )
    return Samples(*(getattr(samples, each.name)[..., chosen] for each in fields(Samples)))
