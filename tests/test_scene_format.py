"""Scenes of other people, and what changes in a scene after its prior was calibrated."""

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from scenes import pinhole, transforms, write_scene

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import (
    read_distance_png,
    read_json,
    write_distance_png,
    write_json,
    write_mask,
    write_png,
)
from edge_depth_nerf.inspecting.shown_prior import ShownScene
from edge_depth_nerf.method.prior import PriorOptions
from edge_depth_nerf.mono.calibration import calibrate_scene, find_calibration, saved_calibration
from edge_depth_nerf.mono.estimate import estimate_depth
from edge_depth_nerf.mono.options import EstimateDepthOptions
from edge_depth_nerf.plugin.datamanager import FisheyeDepthDataManagerConfig
from edge_depth_nerf.plugin.dataparser import FisheyeDepthDataParserConfig
from edge_depth_nerf.scene.format import read_transforms
from edge_depth_nerf.scene.put_maps import write_maps
from edge_depth_nerf.scene.reader import read_scene, scene_of


def manager(folder: Path, parser: dict[str, Any] | None = None, **options: Any):
    config = FisheyeDepthDataParserConfig(data=folder, **(parser or {}))
    return FisheyeDepthDataManagerConfig(dataparser=config, **options).setup(test_mode="val")


def others_scene(folder: Path, npy: bool = False) -> Path:
    """A pinhole scene as nerfstudio's own tools write it: z-depth in millimetres under depth_file_path."""
    write_scene(folder, [pinhole(64, 56)], frames=5, mono=False, truth=False)
    meta = read_json(folder / "transforms.json")
    meta.pop("world_offset_m", None)
    scene = read_scene(folder)
    for frame in meta["frames"]:
        distance = read_distance_png(folder / frame["lidar_file_path"])
        rays = scene.pictures[0].lens.unproject(scene.pictures[0].lens.pixel_centres())[0].numpy()
        counts = np.rint(distance * rays[..., 2] * 1000).astype(np.uint16)
        file = folder / frame["lidar_file_path"]
        del frame["lidar_file_path"]
        if npy:
            np.save(file.with_suffix(".npy"), counts)
            frame["depth_file_path"] = f"lidar/{file.stem}.npy"
        else:
            write_png(file, counts)
    meta["depth_unit_scale_factor"] = 1e-3
    write_json(folder / "transforms.json", meta)
    return folder


def put_in(scene: Path, value: float = 5.0, **source: Any) -> None:
    pictures = read_scene(scene).pictures
    maps = ((p.name, np.full((p.lens.height, p.lens.width), value, np.float32)) for p in pictures)
    write_maps(scene, "mono", maps, {"trained_on": "scene", **source})


@pytest.mark.parametrize("npy", [False, True])
def test_monocular_maps_do_not_make_z_depth_a_distance(tmp_path: Path, npy: bool) -> None:
    folder = others_scene(tmp_path, npy)
    before = read_scene(folder)
    assert before.lidar_is_z_depth
    lidar = [before.lidar_m(picture) for picture in before.pictures]
    # everything lies on a ball of 6 m around the world's origin
    assert 4 < np.median(lidar[0][lidar[0] > 0]) < 8
    put_in(folder)
    after = read_scene(folder)
    assert after.lidar_is_z_depth and not after.own
    for picture, expected in zip(after.pictures, lidar, strict=True):
        np.testing.assert_array_equal(after.lidar_m(picture), expected)
        whole = after.maps(picture).lidar_m
        assert whole is not None
        np.testing.assert_array_equal(whole, expected)
    dataset = manager(folder).train_dataset
    by_name = {path.name: number for number, path in enumerate(dataset.image_filenames)}
    for picture, expected in zip(after.pictures, lidar, strict=True):
        if (number := by_name.get(Path(picture.name).name)) is not None:
            found = dataset.distance_m(number, "lidar")
            assert found is not None
            np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_what_the_host_says_of_the_unit_is_calibrated_by(tmp_path: Path) -> None:
    folder = others_scene(tmp_path)
    put_in(folder)
    options = PriorOptions()
    path = folder / "transforms.json"
    read = find_calibration(read_scene(folder), options)
    told = find_calibration(scene_of(read_transforms(path), path, depth_metres_per_count=2e-3), options)
    assert read.drive_fit is not None and told.drive_fit is not None
    assert told.drive_fit.log_scale == pytest.approx(read.drive_fit.log_scale + np.log(2), abs=0.01)
    assert told.made_of != read.made_of
    data = manager(folder, {"depth_unit_scale_factor": 2e-3})
    assert len(list((folder / ".cache").glob("mono_trust_*"))) == 2, "made by the host's unit, and found"
    prior_m = data.next_train(0)[1]["prior_distance_m"]
    assert 8 < float(prior_m[prior_m > 0].median()) < 16


CHANGES: dict[str, Callable[[dict[str, Any]], object]] = {
    "lens": lambda meta: [frame.update(fl_x=frame["fl_x"] * 1.2) for frame in meta["frames"]],
    "position": lambda meta: meta["frames"][0]["transform_matrix"][0].__setitem__(3, 9.0),
    "angle": lambda meta: meta.update(theta_max_deg=50.0),
}


def test_another_geometry_or_map_makes_a_calibration_stale(tmp_path: Path) -> None:
    scene = write_scene(tmp_path)
    calibrate_scene(scene)
    assert saved_calibration(read_scene(scene), PriorOptions()) is not None
    meta = read_json(scene / "transforms.json")
    for name, change in CHANGES.items():
        with transforms(scene) as changed:
            change(changed)
        assert saved_calibration(read_scene(scene), PriorOptions()) is None, name
        # what inspect draws is never made by a stale one
        assert ShownScene(read_scene(scene)).calibration is None, name
        write_json(scene / "transforms.json", meta)
    assert saved_calibration(read_scene(scene), PriorOptions()) is not None
    path = read_scene(scene).pictures[0].files["lidar"]
    content = path.read_bytes()
    # a text chunk's letter: another file of the same length would do as well
    path.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    assert saved_calibration(read_scene(scene), PriorOptions()) is None


def test_pictures_that_no_list_names_are_not_trained_on(tmp_path: Path) -> None:
    scene = write_scene(tmp_path, frames=12)
    with transforms(scene) as meta:
        names = [frame["file_path"] for frame in meta["frames"]]
        meta |= {"train_filenames": names[:4], "val_filenames": names[5:6], "test_filenames": names[5:6]}
    assert [picture.name for picture in read_scene(scene).pictures if not picture.held_out] == names[:4]
    assert len(calibrate_scene(scene).frames) == 4


def test_a_picture_that_is_masked_whole_gets_an_empty_map(tmp_path: Path) -> None:
    scene = write_scene(tmp_path)
    with transforms(scene) as meta:
        write_mask(scene / "masks/none.png", np.zeros((28, 32), bool))
        meta["frames"][2]["mask_path"] = "masks/none.png"
    put_in(scene)
    empty = [
        not read_distance_png(scene / f["mono_file_path"]).any() for f in read_json(scene / "transforms.json")["frames"]
    ]
    assert empty == [number == 2 for number in range(9)]


def test_without_lidar_a_network_is_believed_where_it_was_taught(tmp_path: Path) -> None:
    scene = write_scene(tmp_path, frames=5, lidar=False)
    everywhere = manager(scene).train_pixel_sampler.table.share_with_prior
    put_in(scene, field_deg=[-20.0, 3.0])
    below = manager(scene).train_pixel_sampler.table.share_with_prior
    put_in(scene, field_deg=[-20.0, 3.0], trained_on="elsewhere")
    elsewhere = manager(scene).train_pixel_sampler.table.share_with_prior
    assert everywhere == elsewhere == 1.0
    assert 0.1 < below < 0.6


def test_a_frame_near_the_least_number_of_points_is_reported_as_the_prior_has_it(tmp_path: Path) -> None:
    scene = write_scene(tmp_path)
    picture = read_scene(scene).pictures[0]
    lidar = read_scene(scene).lidar_m(picture)
    mono = read_distance_png(picture.files["mono"])
    rows, columns = np.nonzero((lidar > 0) & (mono > 0) & read_scene(scene).maps(picture).usable)
    few = np.zeros_like(lidar)
    few[rows[:54], columns[:54]] = lidar[rows[:54], columns[:54]]
    write_distance_png(picture.files["lidar"], few)
    (found,) = [frame for frame in calibrate_scene(scene).frames if frame.frame == picture.name]
    assert found.returns == 54 and found.fit_of == "frame"


def test_maps_of_unknown_scale_take_no_drives_fit_where_the_split_is_unknown(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "scene", [pinhole(64, 56)], frames=4, mono=False, split=False)
    first = read_scene(scene).pictures[0]
    for picture in read_scene(scene).pictures:
        target = tmp_path / "maps" / picture.camera / f"{Path(picture.name).stem}.npy"
        target.parent.mkdir(parents=True, exist_ok=True)
        np.save(target, read_distance_png(picture.files["truth_distance"]))
    write_png(first.files["lidar"], np.zeros((56, 64), np.uint16))
    options = EstimateDepthOptions((scene,), maps=tmp_path / "maps", maps_kind="relative", maps_along="ray")
    with pytest.raises(InputError, match="does not say which these are"):
        estimate_depth(options, Console(file=io.StringIO()))
