"""Recordings that are whole and wrong: what fits is named, with the right amount; good ones give no warning."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from edge_depth_nerf.base.files import read_distance_png, read_mask, write_mask
from edge_depth_nerf.lidar import Sweep
from edge_depth_nerf.lidar.scans import columns_told
from edge_depth_nerf.lidar.trajectory import Trajectory
from edge_depth_nerf.masks.lens import lens_circle
from edge_depth_nerf.process import lidar_checks
from edge_depth_nerf.process.lidar_checks import LidarCheck, check_lidar
from edge_depth_nerf.process.mask_checks import mask_warnings
from edge_depth_nerf.process.options import RigOptions
from edge_depth_nerf.process.path_checks import path_warnings
from edge_depth_nerf.process.readings import Reading, _axes
from edge_depth_nerf.process.recording import DepthFile, Recording
from edge_depth_nerf.process.rig import read_rig_recording
from edge_depth_nerf.synthetic.drive import synthesize_drive
from edge_depth_nerf.synthetic.options import SynthesizeOptions

pytestmark = pytest.mark.slow

Change = Callable[[Recording], Recording]


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("wrong") / "drive"
    synthesize_drive(SynthesizeOptions(root, "street", frames=11, size=128, layout="rig"))
    return root


@pytest.fixture(scope="module")
def whole(drive: Path) -> Recording:
    return read_rig_recording(RigOptions(root=drive, output=drive.parent / "unused"))


@pytest.fixture(scope="module")
def recording(whole: Recording) -> Recording:
    """One camera of it, which is enough."""
    return only(whole, "right")


def only(recording: Recording, *names: str) -> Recording:
    cameras = tuple(camera for camera in recording.cameras if camera.name in names)
    return replace(recording, cameras=cameras, pictures=tuple(one for one in recording.pictures if one.camera in names))


def shorter(recording: Recording, frames: range) -> Recording:
    """Nine sweeps, and pictures of some frames: enough for large faults, and half the work."""
    pictures = tuple(one for one in recording.pictures if one.frame in frames)
    return replace(recording, pictures=pictures, sweeps=recording.sweeps[:9])


@pytest.fixture(scope="module")
def brief(recording: Recording) -> Recording:
    return shorter(recording, range(0, 9, 2))


def checked(recording: Recording) -> LidarCheck:
    usable = {}
    for camera in recording.cameras:
        usable[camera.name] = lens_circle(camera.camera, 95.0)
        if camera.ego_mask is not None:
            usable[camera.name] &= read_mask(camera.ego_mask)
    return check_lidar(recording, usable)


def with_sweeps(change: Callable[[Sweep], Sweep]) -> Change:
    def changed(recording: Recording) -> Recording:
        sweeps = [replace(one, read=lambda one=one: change(one.read())) for one in recording.sweeps]
        return replace(recording, sweeps=tuple(sweeps))

    return changed


def moved(matrix: np.ndarray) -> Change:
    return with_sweeps(lambda sweep: replace(sweep, points_m=sweep.points_m @ torch.from_numpy(matrix).T))


def beside(metres: float) -> Change:
    """Points that lie further to the left: a scanner whose place is wrong."""
    return with_sweeps(lambda sweep: replace(sweep, points_m=sweep.points_m + torch.tensor([0.0, metres, 0.0])))


def turned(degrees: float) -> Change:
    return moved(Rotation.from_euler("z", degrees, degrees=True).as_matrix())


def rigid_turn(degrees: float) -> np.ndarray:
    found = np.eye(4)
    found[:3, :3] = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    return found


turned_5 = turned(5)


def pictures_later(seconds: float) -> Change:
    return lambda recording: replace(
        recording, pictures=tuple(replace(one, time_s=one.time_s + seconds) for one in recording.pictures)
    )


def inverted(recording: Recording) -> Recording:
    cameras = [replace(one, to_vehicle=np.linalg.inv(one.to_vehicle)) for one in recording.cameras]
    return replace(recording, cameras=tuple(cameras))


def scanner_inverted(recording: Recording) -> Recording:
    sweeps = [replace(one, to_vehicle=np.linalg.inv(one.to_vehicle)) for one in recording.sweeps]
    return replace(recording, sweeps=tuple(sweeps))


# ---- LiDAR -------------------------------------------------------------------------------------------------------
def test_a_good_drive_gives_no_warning(whole: Recording) -> None:
    found = checked(shorter(whole, range(2, 6)))
    assert found.warnings == ()
    assert [one.camera for one in found.figures] == ["left", "right", "front"]
    for one in found.figures:
        assert one.correlation > 0.9 and one.edge is not None and one.edge > 1
        assert one.apart_m is not None and one.apart_m < 0.05
        assert one.ratio is None or one.ratio == pytest.approx(1, abs=0.06)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (turned(90), "roof is turned by -90° about its z axis"),
        (moved(np.diag([1.0, -1, 1])), r"roof is given in other axes, where \(x, -y, z\) is x, y, z"),
        (moved(np.eye(3) * 3.28084), r"the points of roof in feet\? metres_per_unit = 0.3048"),
        (beside(0.6), r"roof sits -0\.[4-7]\d m further along its y axis"),
        (inverted, "to_vehicle of right is inverted"),
        (scanner_inverted, "to_vehicle of roof is inverted"),
    ],
)
def test_what_is_wrong_is_named(brief: Recording, change: Change, said: str) -> None:
    (warning,) = checked(change(brief)).warnings
    assert re.search(said, warning), warning


def test_half_a_turn_is_named() -> None:
    assert [said for axes, said in _axes() if np.array_equal(np.diag(axes), [-1, -1, 1, 1])] == [
        "turned by 180° about its z axis"
    ]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (turned_5, "roof is turned by -5.0° about its z axis"),
        (
            pictures_later(0.1),
            r"the clock of (roof .* add 0\.(09|1[0-2])|right .* add -0\.(09|1[0-2])) to its time_offset_s",
        ),
    ],
)
def test_small_faults_are_named_with_their_amount(recording: Recording, change: Change, said: str) -> None:
    (warning,) = checked(change(recording)).warnings
    assert re.search(said, warning), warning
    if change is turned_5:
        rows = np.array(ast.literal_eval(re.search(r"to_vehicle = (\[.*\])\)", warning)[1]))  # pyright: ignore
        assert np.allclose(rows, recording.sweeps[0].to_vehicle @ rigid_turn(-5), atol=0.01)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (None, None),
        (pictures_later(0.3), r"the clock of (roof .* add 0\.(29|3[0-2])|right .* add -0\.(29|3[0-2])) to its"),
        (beside(0.6), r"roof sits -0\.[4-7]\d m further along its y axis|right sits -0\.[4-7]\d m"),
    ],
)
def test_noisy_pictures_name_small_faults(
    recording: Recording, brief: Recording, monkeypatch: pytest.MonkeyPatch, change: Change | None, said: str | None
) -> None:
    """Contrast then never agrees well."""
    noise, read = np.random.default_rng(0), lidar_checks.read_image

    def noisy(path: Path) -> np.ndarray:
        clean = read(path)
        return (clean + noise.normal(0, 50, clean.shape)).clip(0, 255).astype(np.uint8)

    monkeypatch.setattr(lidar_checks, "read_image", noisy)
    found = checked(brief if change is None else change(recording))
    assert len(found.warnings) == (said is not None)
    assert said is None or re.search(said, found.warnings[0]), found.warnings
    assert said is not None or found.figures[0].correlation < 0.85


@pytest.mark.parametrize(
    ("by_contrast", "by_edges", "by_sweeps", "clear"),
    [(0.3, 0.05, 0.0, True), (0.1, 0.05, 0.5, True), (0.1, 0.05, 0.0, False), (0.1, 0.0, 0.5, False)],
)
def test_a_small_fault_is_told_by_contrast_and_edges_or_with_sweeps(
    by_contrast: float, by_edges: float, by_sweeps: float, clear: bool
) -> None:
    gains = {"by_contrast": by_contrast, "by_edges": by_edges, "by_sweeps": by_sweeps}
    reading = Reading(both=True, clear=0.2)
    assert lidar_checks._Candidate(reading, "roof", (), np.eye(4), 1.0, **gains, lack=0.1, still=0.5).clear is clear


def test_point_times_that_count_backwards_are_named(brief: Recording) -> None:
    def backwards(sweep: Sweep) -> Sweep:
        assert sweep.offset_s is not None
        return replace(sweep, offset_s=sweep.offset_s.max() + sweep.offset_s.min() - sweep.offset_s)

    (warning,) = checked(with_sweeps(backwards)(brief)).warnings
    assert "the point times of roof count backwards" in warning


def test_what_tells_nothing_is_not_judged(recording: Recording) -> None:
    assert recording.trajectory is not None
    assert checked(replace(recording, sweeps=())) == LidarCheck((), ())
    first = replace(recording, pictures=recording.pictures[:1])
    assert checked(first) == LidarCheck((), ())


@pytest.mark.parametrize("count", [3, 4, 5, 6])
def test_columns_of_a_file_are_told(tmp_path: Path, recording: Recording, count: int) -> None:
    points = recording.sweeps[0].read()
    rng = np.random.default_rng(0)
    more = np.stack((points.reflectance, rng.integers(0, 32, len(points.reflectance)), 0 * points.reflectance), -1)
    columns = np.concatenate((points.points_m.numpy(), more), 1)[:, :count]
    path = tmp_path / "scan.bin"
    columns[rng.permutation(len(columns))].astype("<f4").tofile(path)
    assert columns_told(path) == count


def test_the_real_drive(real_data: Path) -> None:
    recording = read_rig_recording(RigOptions(root=real_data / "kitti360_drive", output=Path("unused")))
    found = checked(recording)
    assert found.warnings == () and found.figures[0].correlation > 0.9
    assert found.figures[0].ratio == pytest.approx(1, abs=0.05)
    sweeps = []
    for one in recording.sweeps:
        assert one.timing is not None
        sweeps.append(replace(one, timing=replace(one.timing, clockwise=False)))
    (warning,) = checked(replace(recording, sweeps=tuple(sweeps))).warnings
    assert "roof turns the other way: change its direction" in warning


# ---- depth maps --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("factor", "kind", "said"),
    [
        (1.0, "distance", None),
        (1000 / 256, "distance", "multiply metres_per_count by 0.2"),
        (1.0, "z_depth", "hold distance: set kind"),
    ],
)
def test_depth_maps_are_held_against_the_pictures(brief: Recording, factor: float, kind: str, said: str | None) -> None:
    pictures = [
        replace(one, depth=DepthFile(one.truth_distance, factor / 256, kind))  # pyright: ignore[reportArgumentType]
        for one in brief.pictures
    ]
    found = checked(replace(brief, pictures=tuple(pictures), sweeps=()))
    assert len(found.warnings) == (said is not None)
    assert said is None or said in found.warnings[0]


def test_a_largest_value_that_stands_for_none_is_noticed(recording: Recording, tmp_path: Path) -> None:
    pictures = []
    for one in recording.pictures:
        assert one.truth_distance is not None
        metres = read_distance_png(one.truth_distance)
        path = tmp_path / one.truth_distance.name
        cv2.imwrite(str(path), np.where((metres > 0) & (metres < 65), metres * 1000, 65535).astype(np.uint16))
        pictures.append(replace(one, depth=DepthFile(path, 0.001, "distance")))
    (warning,) = checked(replace(recording, pictures=tuple(pictures), sweeps=())).warnings
    assert "have one value, 65.5" in warning and "write 0 there" in warning


# ---- poses -------------------------------------------------------------------------------------------------------
def with_path(recording: Recording, change: Callable[[np.ndarray], np.ndarray]) -> Recording:
    path = recording.trajectory
    assert path is not None
    return replace(recording, trajectory=Trajectory(path.times_s, change(path.vehicle_to_world.copy())))


def placed(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[np.ndarray], np.ndarray]:
    def changed(poses: np.ndarray) -> np.ndarray:
        poses[:, :3, 3] = change(poses[:, :3, 3])
        return poses

    return changed


def of_path(recording: Recording) -> list[str]:
    (camera,) = recording.cameras
    assert camera.ego_mask is not None
    said, _ = path_warnings(recording, {camera.name: lens_circle(camera.camera, 95.0) & read_mask(camera.ego_mask)})
    return said


def w_first(poses: np.ndarray) -> np.ndarray:
    given = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    poses[:, :3, :3] = Rotation.from_quat(given[:, [3, 0, 1, 2]]).as_matrix()
    return poses


def degrees(places: np.ndarray) -> np.ndarray:
    return places / [73e3, 111e3, 1] + [8.4, 49, 0]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda poses: poses, None),
        (placed(lambda places: places * 1000), "in millimetres: metres_per_unit = 0.001"),
        (placed(degrees), "degrees of longitude and latitude"),
        (placed(lambda places: places * 0), "never moves"),
        (w_first, "the poses' quaternions begin with w"),
    ],
)
def test_poses_no_vehicle_has_are_named(
    recording: Recording, change: Callable[[np.ndarray], np.ndarray], said: str | None
) -> None:
    found = of_path(with_path(recording, change))
    assert len(found) == (said is not None), found
    assert said is None or said in found[0]


def test_poses_of_a_sensor_are_named(recording: Recording) -> None:
    (camera,) = recording.cameras
    (warning,) = of_path(with_path(recording, lambda poses: poses @ camera.to_vehicle))
    assert "on its side" in warning and 'the poses are those of right: poses.of = "right"' in warning


def test_a_path_with_a_jump_is_named(recording: Recording) -> None:
    def jump(places: np.ndarray) -> np.ndarray:
        return places + 20 * (np.arange(len(places)) > len(places) // 2)[:, None]

    (warning,) = of_path(with_path(recording, placed(jump)))
    assert "The given path breaks between" in warning


def test_a_mounting_in_millimetres_is_named(recording: Recording) -> None:
    (camera,) = recording.cameras
    to_vehicle = camera.to_vehicle.copy()
    to_vehicle[:3, 3] *= 1000
    (warning,) = of_path(replace(recording, cameras=(replace(camera, to_vehicle=to_vehicle),)))
    assert "to_vehicle of right puts it" in warning and "millimetres" in warning


# ---- masks -------------------------------------------------------------------------------------------------------
def test_given_masks_are_held_against_the_pictures(whole: Recording, tmp_path: Path) -> None:
    lenses = {camera.name: lens_circle(camera.camera, 95.0) for camera in whole.cameras}
    assert mask_warnings(whole, lenses) == []
    recording = only(whole, "right")
    (camera,) = recording.cameras
    assert camera.ego_mask is not None
    keep, path = read_mask(camera.ego_mask), tmp_path / "mask.png"

    def said(mask: np.ndarray) -> str:
        write_mask(path, mask)
        (warning,) = mask_warnings(replace(recording, cameras=(replace(camera, ego_mask=path),)), lenses)
        return warning

    assert "Is it inverted?" in said(~keep)
    keep[: int(0.7 * len(keep))] = False
    assert "of the lens" in said(keep)
