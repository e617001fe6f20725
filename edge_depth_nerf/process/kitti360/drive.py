"""A KITTI-360 drive on disk: which of its frames are complete, and checks of every file before the work begins.

Files are checked by their sizes and headers alone, so that a drive of thousands of frames takes seconds.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.masks.semantics import check_label_header, label_path
from edge_depth_nerf.process.kitti360.calibration import Kitti360Rig, read_timestamps
from edge_depth_nerf.process.options import Kitti360Options
from edge_depth_nerf.scene.checks import Tolerance, check_distance, check_size, require_folder
from edge_depth_nerf.scene.writer import Skipped, ranges, summarise

FISHEYE_CAMERAS = ("image_02", "image_03")
"""The cameras that can be read: left, right."""


@dataclass(frozen=True)
class FrameFiles:
    """A picture and what its maps are made from, under the names that a `RecordedPicture` has for them."""

    path: Path
    mask: Path | None
    semantics: Path | None
    mono: Path | None
    truth_distance: Path | None
    truth_rgb: Path | None


class Kitti360Drive:
    """The drive that some options name.

    Raises:
        FileNotFoundError: a folder is missing.
        InputError: an option is out of its range.

    """

    def __init__(self, options: Kitti360Options) -> None:
        options.check()
        names = options.cameras
        if not (len(set(names)) == len(names) > 0 and set(names) <= set(FISHEYE_CAMERAS)):
            raise InputError(f"--cameras {' '.join(names)}: expected image_02, image_03 or both.")
        root, sequence = options.root, options.sequence
        self.options = options
        self.calibration = root / "calibration"
        self.poses = root / "data_poses" / sequence / "poses.txt"
        self.sweeps = root / "data_3d_raw" / sequence / "velodyne_points" / "data"
        self.images = root / "data_2d_raw" / sequence
        self.truth = root / "truth" / sequence
        self.has_truth = self.truth.is_dir()

        require_folder(root, "--root takes the data set's folder, which holds calibration, data_2d_raw and so on")
        of_sequence = ["data_2d_raw", "data_3d_raw", *(["data_poses"] if options.poses == "recorded" else [])]
        for folder in ("calibration", *of_sequence):
            require_folder(root / folder, f"--root {root} is not the data set's folder, or a download is missing")
        for folder in of_sequence:
            require_folder(root / folder / sequence, "--sequence needs one of these names")
        for name in options.cameras:
            require_folder(self.image_folder(name), f"the pictures of {name} belong there; or leave out that camera")
        require_folder(self.sweeps, "the LiDAR sweeps belong there")
        for option, folder in (("--mono", options.mono), ("--frame-masks", options.frame_masks)):
            if folder is not None:
                for name in options.cameras:
                    require_folder(folder / name, f"{option} needs a folder with one folder per camera")

    def image_folder(self, camera: str) -> Path:
        """Where the pictures of a camera lie."""
        return self.images / camera / "data_rgb"

    def timestamps_file(self, camera: str) -> Path:
        """Where the times of a camera's pictures are, if anywhere."""
        return self.images / camera / "timestamps.txt"

    def select(self, posed: Collection[int] | None) -> tuple[list[tuple[str, int]], list[Skipped]]:
        """Choose the pictures (camera, frame) that have all they need, in order of frames.

        Args:
            posed: frames that have a pose; None = poses are still to be found.

        Raises:
            InputError: the options reach beyond the drive, or nothing that they ask for is complete.

        """
        options = self.options
        images = {name: _numbered(self.image_folder(name), ".png") for name in options.cameras}
        sweeps = self.sweep_numbers()
        present = set().union(*images.values())
        if not present:
            folders = ", ".join(str(self.image_folder(name)) for name in options.cameras)
            raise InputError(f"{folders}: no pictures with names like 0000000123.png in it.")
        there = f"the pictures of {options.sequence} are of frames {min(present)}"
        frames = options.chosen_frames(max(present), there)
        kept, skipped = [], []
        for frame in frames:
            if posed is not None and frame not in posed:
                skipped.append(Skipped(frame, None, "no pose"))
            elif frame not in sweeps:
                skipped.append(Skipped(frame, None, "no sweep"))
            else:
                kept += [(name, frame) for name in options.cameras if frame in images[name]]
                skipped += [Skipped(frame, name, "no picture") for name in options.cameras if frame not in images[name]]
        if not kept:

            def extent(frames: Collection[int]) -> str:
                return f"of frames {min(frames)} to {max(frames)}" if frames else "of no frame"

            has_poses = "" if posed is None else f"{self.poses} has poses {extent(posed)}, "
            raise InputError(
                f"none of frames {options.first} to {frames.stop - 1} can be used: {summarise(skipped)}. {has_poses}"
                f"{self.sweeps} has sweeps {extent(sweeps)}."
            )
        return kept, skipped

    def sweep_file(self, frame: int) -> Path:
        """The sweep of a frame."""
        return self.sweeps / f"{frame:010d}.bin"

    def sweep_numbers(self) -> set[int]:
        """Frames that have a sweep."""
        return _numbered(self.sweeps, ".bin")

    def check_files(
        self, rig: Kitti360Rig, kept: Sequence[tuple[str, int]], tolerance: Tolerance
    ) -> dict[tuple[str, int], FrameFiles]:
        """Find every file that will be read, and check its size or header; pictures that lack one are left out.

        Raises:
            FileNotFoundError: a mask, monocular or true map is missing, and may not be left out.
            InputError: a file is truncated, or not of its camera's size or kind, and may not be left out.

        """
        found = {}
        for name, frame in kept:
            with tolerance.of(frame, name):
                found[name, frame] = self._check_picture(rig, kept, name, frame)
        return found

    def _check_picture(self, rig: Kitti360Rig, kept: Sequence[tuple[str, int]], name: str, frame: int) -> FrameFiles:
        options = self.options
        camera, file, truth = rig.cameras[name], f"{frame:010d}.png", self.truth / name
        files = FrameFiles(
            path=self.image_folder(name) / file,
            mask=None if options.frame_masks is None else options.frame_masks / name / file,
            semantics=labels if (labels := label_path(options.root, options.sequence, name, frame)).is_file() else None,
            mono=None if options.mono is None else options.mono / name / file,
            truth_distance=truth / "distance" / file if self.has_truth else None,
            truth_rgb=truth / "rgb" / file if self.has_truth else None,
        )
        check_size(files.path, camera)
        for option, path in (("--mono", files.mono), ("--frame-masks", files.mask)):
            if path is not None and not path.is_file():
                frames = ranges([number for other, number in kept if other == name])
                raise FileNotFoundError(
                    f"{path}: no such file; {option} needs one for every frame taken ({frames} of {name}). Make "
                    f"the missing ones, choose other frames, or leave out {option}."
                )
        for path in (files.truth_distance, files.truth_rgb):
            if path is not None and not path.is_file():
                raise FileNotFoundError(
                    f"{path}: no such file; the drive's ground truth is incomplete. Synthesise the drive again, or "
                    f"move {self.truth} away to continue without it."
                )
        for path in (files.mask, files.truth_rgb):
            if path is not None:
                check_size(path, camera)
        if files.semantics is not None:
            check_size(files.semantics, camera)
            check_label_header(files.semantics)
        for path in (files.mono, files.truth_distance):
            if path is not None:
                check_distance(path, camera)
        return files

    def read_timestamps(self, camera: str, frames: Iterable[int]) -> list[float]:
        """Read the times of a camera's frames from 0 on, seconds since 1970; empty where the drive has no such file.

        Args:
            camera: such as image_02.
            frames: those that must be there.

        Raises:
            InputError: a line is not a time, or a frame has no line.

        """
        path = self.timestamps_file(camera)
        if not path.is_file():
            return []
        times = read_timestamps(path)
        for number, (before, time) in enumerate(pairwise(times), 2):
            if not time > before:
                raise InputError(
                    f"{path}, line {number}: not after the line before. Copy the file again from the data set, or move "
                    "it away: frames then count as 0.1 s apart."
                )
        if missing := [frame for frame in frames if frame >= len(times)]:
            raise InputError(
                f"{path}: ends after line {len(times)}, but frame {missing[0]} needs line {missing[0] + 1}. The file "
                "is truncated; copy it again from the data set."
            )
        return times


def _numbered(folder: Path, suffix: str) -> set[int]:
    return {int(entry.stem) for entry in folder.glob(f"*{suffix}") if re.fullmatch(r"\d{10}", entry.stem)}
