"""A KITTI-360 drive on disk: which of its frames are complete, and checks of every file before the work begins.

Files are checked by their sizes and headers alone, so that a drive of thousands of frames takes seconds.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edge_depth_nerf.cameras import MEI
from edge_depth_nerf.errors import InputError
from edge_depth_nerf.files import read_mask
from edge_depth_nerf.lidar import check_sweep_size
from edge_depth_nerf.process.kitti360_calibration import Kitti360Rig, read_timestamps
from edge_depth_nerf.process.options import Kitti360Options
from edge_depth_nerf.process.png import PngHeader, read_png_header
from edge_depth_nerf.process.scene import Skipped
from edge_depth_nerf.process.transforms import Transform

FISHEYE_CAMERAS = ("image_02", "image_03")
"""The cameras that can be read: left, right."""


@dataclass(frozen=True)
class FrameFiles:
    """The files that one picture's maps are made from."""

    image: Path
    sweep: Path
    mask: Path | None
    mono: Path | None
    truth_distance: Path | None
    truth_rgb: Path | None

    @property
    def paths(self) -> tuple[Path, ...]:
        """All that there are."""
        found = (self.image, self.sweep, self.mask, self.mono, self.truth_distance, self.truth_rgb)
        return tuple(path for path in found if path is not None)


class Kitti360Drive:
    """The drive that some options name.

    Raises:
        FileNotFoundError: a folder is missing.
        InputError: an option is out of its range.

    """

    def __init__(self, options: Kitti360Options) -> None:
        _check_options(options)
        root, sequence = options.root, options.sequence
        self.options = options
        self.calibration = root / "calibration"
        self.poses = root / "data_poses" / sequence / "poses.txt"
        self.sweeps = root / "data_3d_raw" / sequence / "velodyne_points" / "data"
        self.images = root / "data_2d_raw" / sequence
        self.truth = root / "truth" / sequence
        self.has_truth = self.truth.is_dir()

        _require_folder(root, "--root takes the data set's folder, which holds calibration, data_2d_raw and so on")
        for folder in ("calibration", "data_2d_raw", "data_3d_raw", "data_poses"):
            _require_folder(root / folder, f"--root {root} is not the data set's folder, or a download is missing")
        for folder in ("data_2d_raw", "data_3d_raw", "data_poses"):
            _require_folder(root / folder / sequence, "--sequence takes the name of one of these")
        for name in options.cameras:
            _require_folder(self.image_folder(name), f"the pictures of {name} belong there; or leave out that camera")
        _require_folder(self.sweeps, "the LiDAR sweeps belong there")
        for option, folder in (("--mono", options.mono), ("--frame-masks", options.frame_masks)):
            if folder is not None:
                for name in options.cameras:
                    _require_folder(folder / name, f"{option} takes a folder with one folder a camera in it")

    def image_folder(self, camera: str) -> Path:
        """Where the pictures of a camera lie."""
        return self.images / camera / "data_rgb"

    def timestamps_file(self, camera: str) -> Path:
        """Where the times of a camera's pictures are, if anywhere."""
        return self.images / camera / "timestamps.txt"

    def ego_mask_file(self, camera: str) -> Path | None:
        """The mask of the vehicle for a camera."""
        given = self.options.ego_mask
        return given / f"{camera}.png" if given is not None and given.is_dir() else given

    def select(self, poses: dict[int, Transform]) -> tuple[list[tuple[str, int]], list[Skipped]]:
        """Choose the pictures (camera, frame) that have all they need, in order of frames.

        Raises:
            InputError: the options reach beyond the drive, or nothing that they ask for is complete.

        """
        options = self.options
        images = {name: _numbered(self.image_folder(name), ".png") for name in options.cameras}
        sweeps = _numbered(self.sweeps, ".bin")
        present = set().union(*images.values())
        if not present:
            folders = ", ".join(str(self.image_folder(name)) for name in options.cameras)
            raise InputError(f"{folders}: no pictures with names like 0000000123.png in it.")
        end = max(present)
        last = max(end, options.first)
        if options.frames is not None:
            last = options.first + (options.frames - 1) * options.stride
        if last > end:
            asked = "" if options.frames is None else f" --frames {options.frames} --stride {options.stride}"
            raise InputError(
                f"--first {options.first}{asked}: reaches frame {last}, but the pictures of {options.sequence} are of "
                f"frames {min(present)} to {end}. Ask for fewer frames, or leave out --frames to take all."
            )
        kept, skipped = [], []
        for frame in range(options.first, last + 1, options.stride):
            if frame not in poses:
                skipped.append(Skipped(frame, None, "no pose"))
            elif frame not in sweeps:
                skipped.append(Skipped(frame, None, "no sweep"))
            else:
                kept += [(name, frame) for name in options.cameras if frame in images[name]]
                skipped += [Skipped(frame, name, "no picture") for name in options.cameras if frame not in images[name]]
        if not kept:
            extent = f"of frames {min(sweeps)} to {max(sweeps)}" if sweeps else "of no frame"
            raise InputError(
                f"none of frames {options.first} to {last} can be used: {summarise(skipped)}. {self.poses} has poses "
                f"of frames {min(poses)} to {max(poses)}, {self.sweeps} has sweeps {extent}."
            )
        return kept, skipped

    def check_files(self, rig: Kitti360Rig, kept: Sequence[tuple[str, int]]) -> dict[tuple[str, int], FrameFiles]:
        """Find every file that will be read, and check its size or header.

        Raises:
            FileNotFoundError: a mask, monocular or true map is missing.
            InputError: a file is truncated, or not of its camera's size or kind.

        """
        options = self.options
        found = {}
        for name, frame in kept:
            camera, file, truth = rig.cameras[name], f"{frame:010d}.png", self.truth / name
            files = FrameFiles(
                image=self.image_folder(name) / file,
                sweep=self.sweeps / f"{frame:010d}.bin",
                mask=None if options.frame_masks is None else options.frame_masks / name / file,
                mono=None if options.mono is None else options.mono / name / file,
                truth_distance=truth / "distance" / file if self.has_truth else None,
                truth_rgb=truth / "rgb" / file if self.has_truth else None,
            )
            check_sweep_size(files.sweep)
            check_size(files.image, camera)
            for option, path in (("--mono", files.mono), ("--frame-masks", files.mask)):
                if path is not None and not path.is_file():
                    frames = _ranges([number for other, number in kept if other == name])
                    raise FileNotFoundError(
                        f"{path}: no such file; {option} needs one for every frame taken ({frames} of {name}). Make "
                        f"the missing ones, choose other frames, or leave out {option}."
                    )
            for path in (files.truth_distance, files.truth_rgb):
                if path is not None and not path.is_file():
                    raise FileNotFoundError(
                        f"{path}: no such file; the drive's truth is incomplete. Synthesise the drive again, or move "
                        f"{self.truth} away to go on without it."
                    )
            for path in (files.mask, files.truth_rgb):
                if path is not None:
                    check_size(path, camera)
            for path in (files.mono, files.truth_distance):
                if path is not None:
                    check_distance(path, camera)
            found[name, frame] = files
        return found

    def read_ego_mask(self, name: str, camera: MEI) -> NDArray[np.bool_] | None:
        """Read the mask of the vehicle for a camera, at the size of the raw pictures.

        Raises:
            FileNotFoundError: there is none for this camera.
            InputError: broken, or of another size.

        """
        path = self.ego_mask_file(name)
        if path is None:
            return None
        if not path.is_file():
            raise FileNotFoundError(
                f"{path}: no such file; --ego-mask takes a PNG, or a folder with a PNG for each camera "
                f"({', '.join(self.options.cameras)})."
            )
        mask = read_mask(path)
        if mask.shape != (camera.height, camera.width):
            raise InputError(_size_error(path, mask.shape[1], mask.shape[0], camera))
        return mask

    def read_timestamps(self, camera: str, frames: Iterable[int]) -> dict[int, float]:
        """Read the times of a camera's frames, seconds since 1970; empty where the drive has no such file.

        Raises:
            InputError: a line is not a time, or a frame has no line.

        """
        path = self.timestamps_file(camera)
        if not path.is_file():
            return {}
        times = read_timestamps(path)
        if missing := [frame for frame in frames if frame >= len(times)]:
            raise InputError(
                f"{path}: ends after line {len(times)}, but frame {missing[0]} needs line {missing[0] + 1}. The file "
                "is truncated; copy it again from the data set."
            )
        return {frame: times[frame] for frame in frames}


def check_size(path: Path, camera: MEI) -> PngHeader:
    """Check that a PNG is whole, as far as its ends tell, and has its camera's size.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: it is not.

    """
    header = read_png_header(path)
    if (header.width, header.height) != (camera.width, camera.height):
        raise InputError(_size_error(path, header.width, header.height, camera))
    return header


def check_distance(path: Path, camera: MEI) -> None:
    """Check the same of a distance map.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: it is not, or not a distance map.

    """
    header = check_size(path, camera)
    if not header.is_distance:
        raise InputError(
            f"{path}: {header.bit_depth}-bit {header.colour}, expected a 16-bit grey PNG in units of 1/256 m. "
            "Other kinds have lost the distance; export the map again."
        )


def summarise(skipped: Iterable[Skipped]) -> str:
    """Group frames left out by the reason: "no pose: 0, 7-9"."""
    groups: dict[str, list[int]] = {}
    for item in skipped:
        reason = item.reason if item.camera is None else f"{item.reason} of {item.camera}"
        groups.setdefault(reason, []).append(item.frame)
    return "; ".join(f"{reason}: {_ranges(frames)}" for reason, frames in groups.items())


def _ranges(frames: Sequence[int]) -> str:
    runs: list[list[int]] = []
    for frame in frames:
        if runs and frame == runs[-1][1] + 1:
            runs[-1][1] = frame
        else:
            runs.append([frame, frame])
    return ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in runs)


def _size_error(path: Path, width: int, height: int, camera: MEI) -> str:
    return (
        f"{path}: {width}×{height} pixels, but its camera's calibration says {camera.width}×{camera.height}. Pictures, "
        "masks and maps are to have the size of the raw pictures; --downscale then reduces them together."
    )


def _numbered(folder: Path, suffix: str) -> set[int]:
    return {int(entry.stem) for entry in folder.glob(f"*{suffix}") if re.fullmatch(r"\d{10}", entry.stem)}


def _require_folder(folder: Path, remedy: str) -> None:
    if folder.is_dir():
        return
    parent = folder.parent
    while not parent.is_dir():
        parent = parent.parent
    there = sorted(entry.name for entry in parent.iterdir())
    listed = f"{', '.join(there[:12])}{' …' if len(there) > 12 else ''}" if there else "nothing"
    what = "is not a folder" if folder.exists() else "no such folder"
    raise FileNotFoundError(f"{folder}: {what}; {parent.resolve()} holds {listed}. {remedy[0].upper()}{remedy[1:]}.")


def _check_options(options: Kitti360Options) -> None:
    def require(fine: bool, option: str, found: object, expected: str) -> None:
        if not fine:
            raise InputError(f"--{option} {found}: expected {expected}.")

    require(options.first >= 0, "first", options.first, "the number of a frame, 0 or more")
    require(options.frames is None or options.frames > 0, "frames", options.frames, "1 or more")
    require(options.stride > 0, "stride", options.stride, "1 or more")
    require(options.downscale > 0, "downscale", options.downscale, "1 or more")
    holdout = options.holdout_every
    require(holdout == 0 or holdout >= 2, "holdout-every", holdout, "2 or more, or 0 to hold out none")
    require(0 < options.theta_max_deg <= 180, "theta-max-deg", options.theta_max_deg, "degrees above 0, up to 180")
    names = options.cameras
    distinct = len(set(names)) == len(names) > 0
    require(distinct and set(names) <= set(FISHEYE_CAMERAS), "cameras", " ".join(names), "image_02, image_03 or both")
