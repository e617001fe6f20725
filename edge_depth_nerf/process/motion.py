"""Distances from motion for a scene that is written: `motion/CAMERA/0000000123.png`.

Their standard deviations by parallax and confidence go to `motion_sigma/`, and what the neighbours' distances show at a
picture's pixels to `motion_around/`.

Held-out pictures take no part, and get an empty map. Sweeps and what is confirmed of them are kept in `.cache/motion`
until all maps are written, so that a stopped run resumes where it stopped.
"""

from __future__ import annotations

import functools
import hashlib
import io
import shutil
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from jaxtyping import Float32
from rich.console import Console

from edge_depth_nerf.base.checked_cache import content_of, write_checked
from edge_depth_nerf.base.console import progress_bars, run_jobs, say
from edge_depth_nerf.base.files import DISTANCE_STEPS_PER_METRE, load_archive, sha256_of
from edge_depth_nerf.scene.format import OWN_MOTION
from edge_depth_nerf.scene.put_maps import write_maps
from edge_depth_nerf.scene.reader import SceneFolder, ScenePicture
from edge_depth_nerf.stereo.consistency import LEAST_AGREEING, MotionDistance, seen_around
from edge_depth_nerf.stereo.motion import Motion
from edge_depth_nerf.stereo.sweep import Swept, padded
from edge_depth_nerf.stereo.views import View, view_of, working_factor

VERSION = 1
"""Of what is kept: raised when the same pictures give something else."""
FEWEST_PICTURES = 1 + LEAST_AGREEING
"""Fewer cannot confirm each other."""
_STANDS = "the vehicle stands or turns on the spot, or no two other pictures see the same places"
_SWEEPS_IN_MEMORY = 48
Maps = TypeVar("Maps", Swept, MotionDistance)
_SMOOTH = 0.05
"""Inverse distances that differ by less than this share are one surface: they are interpolated in larger maps."""


def add_motion(scene: SceneFolder, console: Console) -> None:
    """Find the distances of a scene's training pictures from motion and write them, or say why there are none.

    Raises:
        InputError: a picture or a mask cannot be used.
    """
    pictures = [picture for picture in scene.pictures if not picture.held_out]
    if len(pictures) < FEWEST_PICTURES:
        say(console, f"No distances from motion: {len(pictures)} training pictures are too few.", "yellow")
        return

    def view(index: int) -> View:
        """A picture as the sweep wants it."""
        one = pictures[index]
        return view_of(scene.rgb(one), scene.usable(one), one.lens, one.pose, scene.theta_max_rad)

    positions_m = np.stack([picture.position_m for picture in pictures])
    motion = Motion(positions_m, [picture.camera for picture in pictures], view)
    with console.status("Searching for neighbours of pictures …"):
        still = sum(len(motion.neighbours(index)) < LEAST_AGREEING for index in range(len(pictures)))
    if still == len(pictures):
        say(console, f"No distances from motion: {_STANDS}, in all training pictures.", "yellow")
        return
    store = SphereSweepCache(scene.folder / ".cache" / "motion", scene, pictures, motion)
    run_jobs([partial(store.make, index) for index in range(len(pictures))], "Sweeping pictures", console)
    run_jobs([partial(store.confirm, index) for index in range(len(pictures))], "Confirming distances", console)
    numbers = {picture.name: index for index, picture in enumerate(pictures)}
    shares: list[float] = []

    def around(index: int) -> Float32[np.ndarray, "_ _"]:
        neighbours = motion.neighbours(index)
        theirs = [store.confirmed(other).distance_m for other in neighbours]
        return seen_around(motion.view(index), [motion.view(other) for other in neighbours], theirs)

    def maps(layer: str) -> Iterator[tuple[str, Float32[np.ndarray, "_ _"]]]:
        for picture in scene.pictures:
            size, factor = (picture.lens.height, picture.lens.width), working_factor(picture.lens)
            index = numbers.get(picture.name)
            if index is None:
                map_ = np.zeros(size, np.float32)
            elif layer == "motion_around":
                map_ = enlarged(around(index), factor, size)
            elif layer == "motion_sigma":
                map_ = enlarged_sigma(store.confirmed(index), factor, size)
            else:
                distance_m, used = store.confirmed(index).distance_m, motion.view(index).used
                shares.append(float((distance_m > 0).sum() / max(1, used.sum())))
                map_ = enlarged(distance_m, factor, size)
            yield picture.name, map_

    source = {"kind": OWN_MOTION}
    with progress_bars(console) as progress:
        # a scene that has the distances has the others too
        for layer in ("motion_sigma", "motion_around", "motion"):
            write_maps(scene.folder, layer, maps(layer), source, progress, some_empty=True)
    shutil.rmtree(store.folder.parent, ignore_errors=True)
    said = f"Motion gives distances for {np.mean(shares):.0%} of the pixels inside the masks of training pictures"
    if still:
        said += f"; none for {still} of {len(shares)}: {_STANDS}"
    say(console, f"{said}.", "yellow" if still else None)


def enlarged(distance_m: Float32[np.ndarray, "_ _"], factor: int, size: tuple[int, int]) -> Float32[np.ndarray, "_ _"]:
    """Bring distances to a picture's size (height, width): interpolated on surfaces, else the nearest; 0 = none."""
    if factor == 1:
        return distance_m
    kept = distance_m > 0
    inverse = np.where(kept, 1 / np.where(kept, distance_m, 1), np.nan).astype(np.float32)
    whole = (inverse.shape[1] * factor, inverse.shape[0] * factor)
    nearest = np.asarray(cv2.resize(inverse, whole, interpolation=cv2.INTER_NEAREST))
    between = np.asarray(cv2.resize(inverse, whole, interpolation=cv2.INTER_LINEAR))
    # comparisons with NaN are false
    inverse = np.where(np.abs(between - nearest) <= _SMOOTH * nearest, between, nearest)
    return padded(np.nan_to_num(1 / inverse), size, 0.0)


def enlarged_sigma(found: MotionDistance, factor: int, size: tuple[int, int]) -> Float32[np.ndarray, "_ _"]:
    """Bring the distances' standard deviations to a picture's size (height, width): the nearest; 0 = none."""
    result = padded(found.sigma_m.repeat(factor, 0).repeat(factor, 1), size, 0.0)
    # a file has steps, the least of which still says that there is one
    return np.where(result > 0, np.maximum(result, np.float32(1 / DISTANCE_STEPS_PER_METRE)), result)


class SphereSweepCache:
    """The sweeps of a scene's pictures and what is confirmed of them: on disk, the last sweeps in memory too."""

    def __init__(self, root: Path, scene: SceneFolder, pictures: list[ScenePicture], motion: Motion) -> None:
        """Make a folder in `root` for these pictures, in `motion`'s order, and remove those of other ones."""
        self.folder = root / _made_of(scene, pictures)
        self._motion = motion
        self._swept = functools.lru_cache(_SWEEPS_IN_MEMORY)(self._sweep)
        for other in root.glob("*"):
            if other != self.folder:
                shutil.rmtree(other, ignore_errors=True)

    def make(self, index: int) -> None:
        """Sweep a picture, unless that is done."""
        self._sweep(index)

    def _sweep(self, index: int) -> Swept:
        return _kept(self.folder / f"{index:06d}.npz", Swept, partial(self._motion.sweep, index))

    def confirm(self, index: int) -> None:
        """Confirm a picture's sweep, and keep that on disk alone."""
        self.confirmed(index)

    def confirmed(self, index: int) -> MotionDistance:
        """What neighbours confirm of a picture's sweep; kept."""
        confirm = partial(self._motion.confirm, index, self._swept)
        return _kept(self.folder / f"{index:06d}.confirmed.npz", MotionDistance, confirm)


def _kept(path: Path, kind: type[Maps], make: Callable[[], Maps]) -> Maps:
    """Maps of a picture from its file; those that are lost are made, and kept."""
    content = content_of(path, VERSION)
    if content is not None:
        return kind(**load_archive(content))
    maps, archive = make(), io.BytesIO()
    np.savez(archive, **vars(maps))
    write_checked(path, VERSION, lambda file: file.write(archive.getbuffer()))
    return maps


def _made_of(scene: SceneFolder, pictures: list[ScenePicture]) -> str:
    """Key of pictures, masks, lenses and poses: by what is in the files, since each run writes masks again."""
    digest = hashlib.sha256(repr(scene.theta_max_rad).encode())
    content = functools.cache(sha256_of)
    for picture in pictures:
        contents = [content(picture.files[layer]) for layer in ("image", "mask") if layer in picture.files]
        pose = picture.rotation.tolist(), picture.position_m.tolist()
        digest.update(repr((picture.name, contents, picture.lens, pose)).encode())
    return digest.hexdigest()[:16]
