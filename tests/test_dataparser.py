from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import CameraType
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from PIL import Image
from scenes import SAMPLE_DRIVE, fisheye, pinhole, transforms, write_scene

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_json, write_distance_png, write_mask, write_png
from edge_depth_nerf.cameras import Pinhole
from edge_depth_nerf.plugin.dataparser import FisheyeDepthDataParserConfig, default_metres_per_unit
from edge_depth_nerf.plugin.dataset import FisheyeDepthDataset
from edge_depth_nerf.plugin.pose_refinement import FRAMES, PoseRefinerConfig


def parse(folder, split="train", **options):
    return FisheyeDepthDataParserConfig(data=folder, **options).setup().get_dataparser_outputs(split)


def edit(folder, change):
    with transforms(folder) as meta:
        change(meta)


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    """A scene that no test changes."""
    return write_scene(tmp_path_factory.mktemp("shared"))


def test_positions_are_metres_over_metres_per_unit(shared):
    meta = read_json(shared / "transforms.json")
    outputs = parse(shared, metres_per_unit=20.0, center_method="none")
    expected = [f["transform_matrix"] for f in meta["frames"] if f["file_path"] in meta["train_filenames"]]
    expected = np.array(expected)[:, :3]
    expected[:, :, 3] /= 20
    assert np.allclose(outputs.cameras.camera_to_worlds, expected, atol=1e-6)
    assert outputs.metadata["metres_per_unit"] == 20
    assert outputs.dataparser_scale == pytest.approx(1 / 20)
    # maps follow the pictures
    names = [path.name for path in outputs.image_filenames]
    assert names == [f"{i:04d}.png" for i in (0, 1, 2, 3, 5, 6, 7, 8)]
    for layer in ("image", "lidar", "mono", "truth_distance", "truth_rgb"):
        assert [picture.files[layer].name for picture in outputs.metadata["pictures"]] == names
    assert len(parse(shared, "test").image_filenames) == 1


def test_both_cameras_of_a_frame_share_its_pose_adjustment():
    outputs = parse(SAMPLE_DRIVE)
    assert [*Counter(outputs.metadata[FRAMES]).values()] == [2] * 11
    optimizer = PoseRefinerConfig(mode="SO3xR3").setup(num_cameras=22, device="cpu")
    optimizer.settle(outputs.metadata[FRAMES], outputs.metadata["metres_per_unit"])
    assert optimizer.pose_adjustment.shape == (11, 6)


def test_folders_of_other_peoples_splits_are_no_cameras(tmp_path):
    """As nerfstudio's own data sets have them: nothing tells which of their pictures were taken together."""
    folder = write_scene(tmp_path)
    with transforms(folder) as meta:
        for frame in meta["frames"]:
            del frame["lidar_file_path"]
            split = "train" if frame["file_path"] in meta["train_filenames"] else "test"
            moved = Path("images", split, Path(frame["file_path"]).name)
            (folder / moved).parent.mkdir(parents=True, exist_ok=True)
            (folder / frame["file_path"]).rename(folder / moved)
            for names in (meta["train_filenames"], meta["val_filenames"], meta["test_filenames"]):
                names[:] = [str(moved) if name == frame["file_path"] else name for name in names]
            frame["file_path"] = str(moved)
    held_out = FisheyeDepthDataset(parse(folder, "test"))
    assert not held_out.of_held_out_cameras and "lidar_distance_m" in held_out[0]
    of_training = parse(folder).metadata[FRAMES]
    assert len({*of_training, *(picture.frame for picture in held_out.pictures)}) == len(of_training) + len(held_out)


def test_folders_with_equal_names_are_cameras(tmp_path):
    folder = write_scene(tmp_path, frames=6, split=False)
    with transforms(folder) as meta:
        for index, frame in enumerate(meta["frames"]):
            moved = Path("images", ("front", "left")[index % 2], f"{index // 2}.png")
            (folder / moved).parent.mkdir(parents=True, exist_ok=True)
            (folder / frame["file_path"]).rename(folder / moved)
            frame["file_path"] = str(moved)
    pictures = parse(folder, eval_mode="all").metadata["scene"].pictures
    assert [(picture.camera, picture.frame) for picture in pictures] == [
        (f"images/{name}", number) for name in ("front", "left") for number in range(3)
    ]


def test_lists_may_spell_names_otherwise(tmp_path):
    folder = write_scene(tmp_path)
    with transforms(folder) as meta:
        meta["train_filenames"] = [f"./{name}" for name in meta["train_filenames"]]
    assert len(parse(folder).image_filenames) == 8


def test_a_split_by_names_needs_such_names(tmp_path):
    folder = write_scene(tmp_path, split=False)
    with pytest.raises(InputError, match="--eval-mode filename needs names of pictures with train or eval in them"):
        parse(folder, eval_mode="filename")


BENT = Pinhole(32, 28, 20.0, 20.5, 16.0, 14.0, 0.01, 0.02, 1e-3, 2e-3, 0.03, 0.01)


@pytest.mark.parametrize("camera", [fisheye(), BENT])
def test_lenses_keep_their_kind_and_all_their_terms(tmp_path, camera):
    outputs = parse(write_scene(tmp_path, [camera], frames=2))
    kind = CameraType.FISHEYE if camera.model == "KANNALA_BRANDT" else CameraType.PERSPECTIVE
    assert (outputs.cameras.camera_type == kind.value).all()
    pixels = camera.pixel_centres()
    expected, valid = camera.unproject(pixels)
    ours, _ = FisheyeDepthDataset(outputs).pictures[0].lens.unproject(pixels)
    assert torch.allclose(ours[valid], expected[valid], atol=1e-6)
    rays = outputs.cameras[0].generate_rays(camera_indices=0, coords=pixels.flip(-1).float())
    in_world = (ours * torch.tensor([1.0, -1.0, -1.0])) @ outputs.cameras.camera_to_worlds[0].double()[:, :3].T
    assert torch.allclose(rays.directions.double()[valid], in_world[valid], atol=1e-5)


def test_the_default_scale_says_metres():
    line = np.array([[0.0, 0, 0], [60, 3, 0]])
    assert default_metres_per_unit(line) == 30  # half of 60 m
    assert default_metres_per_unit(line / 10) == 10  # never under 10 m
    assert default_metres_per_unit(line * 10) == 128  # 4 · 128 / 2048 = 0.25 m, the coarsest cell allowed


@pytest.mark.parametrize("applied", [None, [[0, 1, 0, 3], [1, 0, 0, 0], [0, 0, -1, 0]]])
def test_positions_of_utm_keep_their_millimetres(tmp_path, applied):
    scene, offset = write_scene(tmp_path), np.array([448_000.0, 5_428_000.0, 110.0])
    near = parse(scene, metres_per_unit=20.0).cameras.camera_to_worlds

    def move(meta):
        for frame in meta["frames"]:
            for row, shift in zip(frame["transform_matrix"], offset, strict=False):
                row[3] += shift
        if applied is not None:
            meta.update(applied_transform=applied, applied_scale=2.0)

    edit(scene, move)
    far = parse(scene, metres_per_unit=20.0).cameras.camera_to_worlds
    between = [20 * (poses[:, :, 3] - poses[:1, :, 3]) for poses in (near, far)]
    assert np.allclose(between[0], between[1], atol=1e-4) and np.allclose(near[:, :, :3], far[:, :, :3], atol=1e-6)
    assert between[0].abs().max() > 1


def test_the_crop_of_a_fisheye_is_kept(tmp_path):
    scene = write_scene(tmp_path, mask=False)
    whole = FisheyeDepthDataset(parse(scene)).mask(0)
    edit(scene, lambda meta: meta.update(fisheye_crop_radius=9.0))
    cropped = FisheyeDepthDataset(parse(scene)).mask(0)
    row, column = np.indices(whole.shape) + 0.5
    height, width = whole.shape
    assert np.array_equal(cropped, whole & (np.hypot(row - height / 2, column - width / 2) <= 9))
    assert 0 < cropped.sum() < whole.sum()


def test_no_orientation_turns_a_picture(tmp_path):
    """As in nerfstudio's own reader, to whose pixels poses and lenses belong."""
    scene = write_scene(tmp_path)
    path = scene / "images/0000.png"
    pixels = FisheyeDepthDataset(parse(scene)).rgb(0)
    exif = Image.Exif()
    exif[0x112] = 3
    Image.fromarray(pixels).save(path, exif=exif.tobytes())
    dataset = FisheyeDepthDataset(parse(scene))
    assert np.array_equal(dataset.rgb(0), pixels)
    assert np.array_equal(dataset.get_numpy_image(0), pixels)


def test_a_plain_nerfstudio_scene_counts_as_lidar_and_z_becomes_distance(tmp_path):
    """nerfstudio's own scenes: millimetres of z-depth under depth_file_path."""
    camera = pinhole()
    scene = write_scene(tmp_path, [camera], lidar=False, mono=False, truth=False)
    z_depth_m = 2.0

    def add_depth(meta):
        del meta["depth_unit_scale_factor"]
        for frame in meta["frames"]:
            name = frame["file_path"].replace("images", "depth")
            write_png(scene / name, np.full((camera.height, camera.width), 1000 * z_depth_m, np.uint16))
            frame["depth_file_path"] = name

    edit(scene, add_depth)
    dataset = FisheyeDepthDataset(parse(scene))
    distance = dataset.distance_m(0, "lidar")
    directions, _ = camera.unproject(camera.pixel_centres())
    assert distance is not None
    assert np.allclose(distance, z_depth_m / directions[..., 2].numpy(), rtol=1e-5)
    assert distance.max() > 1.2 * z_depth_m  # the corner's ray is longer
    taken_as_distance = FisheyeDepthDataset(parse(scene, depth_kind="distance")).distance_m(0, "lidar")
    assert taken_as_distance is not None and np.allclose(taken_as_distance, z_depth_m)


def test_the_mask_ends_where_the_lens_does(tmp_path):
    """Without any mask file, rays beyond theta_max are not valid."""
    scene = write_scene(tmp_path, mask=False, theta_max_deg=60.0)
    outputs = parse(scene)
    assert outputs.mask_filenames is None
    dataset = FisheyeDepthDataset(outputs)
    directions, known = fisheye().unproject(fisheye().pixel_centres())
    theta_deg = np.degrees(np.arccos(np.clip(torch.nan_to_num(directions[..., 2]).numpy(), -1, 1)))
    mask = dataset[0]["mask"][..., 0].numpy()
    assert np.array_equal(mask, known.numpy() & (theta_deg <= 60))
    assert 0 < mask.sum() < mask.size
    # the scene's own lies within it
    masked = FisheyeDepthDataset(parse(write_scene(tmp_path / "masked", theta_max_deg=60.0))).mask(0)
    assert not masked[-5:].any() and np.array_equal(masked[:-5], mask[:-5])


def test_an_item_evaluates(shared):
    item = FisheyeDepthDataset(parse(shared, "test"))[0]
    height, width = fisheye().height, fisheye().width
    assert {key: tuple(value.shape) for key, value in item.items() if key != "image_idx"} == {
        "image": (height, width, 3),
        "mask": (height, width, 1),
        "lidar_distance_m": (height, width, 1),
        "truth_distance_m": (height, width, 1),
        "truth_rgb": (height, width, 3),
    }
    lidar_points = item["lidar_distance_m"] > 0
    assert torch.allclose(item["lidar_distance_m"][lidar_points], item["truth_distance_m"][lidar_points])


@pytest.mark.parametrize("what", ["images", "lidar", "masks", "mono", "truth/distance"])
def test_another_size_is_named(tmp_path, what):
    scene = write_scene(tmp_path)
    target = next((scene / what).iterdir())
    if what == "masks":
        write_mask(target, np.ones((9, 9), bool))
    elif what == "images":
        write_png(target.with_name("0000.png"), np.zeros((9, 9, 3), np.uint8))
    else:
        write_distance_png(target.with_name("0000.png"), np.ones((9, 9)))
    dataset = FisheyeDepthDataset(parse(scene))
    with pytest.raises(InputError, match=r"9×9.*32×28"):
        dataset[0]
        dataset.distance_m(0, "mono")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda meta: meta.update(camera_model="MEI"), "camera_model is 'MEI'.*OPENCV_FISHEYE"),
        (lambda meta: meta["frames"][5].pop("fl_x"), "0005.png: fl_x is None, expected a number"),
        (lambda meta: meta["test_filenames"].append("images/x.png"), "test_filenames names images/x.png"),
        (lambda meta: [frame.update(frame=3) for frame in meta["frames"]], "frame 3 is in train_.* and in val_"),
        (lambda meta: meta.update(train_filenames=[]), "names no pictures in train_filenames. Give all of"),
        (lambda meta: meta["frames"][1].pop("mono_file_path"), "mono_file_path is given for 8 of 9.*0001.png"),
    ],
)
def test_bad_scenes(tmp_path, change, message):
    scene = write_scene(tmp_path)
    edit(scene, change)
    with pytest.raises(InputError, match=message):
        parse(scene)


def test_what_is_missing_is_named_before_training(tmp_path):
    with pytest.raises(FileNotFoundError, match="edge-depth-nerf process"):
        parse(tmp_path)
    scene = write_scene(tmp_path)
    for value in (0.0, -3.0, float("nan")):
        with pytest.raises(InputError, match="metres_per_unit"):
            parse(scene, metres_per_unit=value)
    (scene / "lidar" / "0003.png").unlink()
    with pytest.raises(FileNotFoundError, match=r"lidar.0003\.png"):
        parse(scene)


def test_arrays_of_other_tools_say_none_in_many_ways_and_are_named_where_truncated(tmp_path):
    scene = write_scene(tmp_path, lidar=False, mono=False, truth=False)
    values = np.full((28, 32, 1), 2000.0, np.float32)
    values[0, :4, 0] = np.inf, np.nan, -1, 0
    np.save(scene / "depth.npy", values)

    def change(meta):
        for frame in meta["frames"]:
            frame["depth_file_path"] = "depth.npy"
        meta["depth_unit_scale_factor"] = 1e-3

    edit(scene, change)
    for factor, metres in ((1.0, 2000.0), (None, 2.0)):
        dataset = FisheyeDepthDataset(parse(scene, depth_unit_scale_factor=factor))
        found = dataset.distance_m(0, "lidar")
        assert found is not None and found.shape == (28, 32)
        assert found[0, :5].tolist() == pytest.approx([0, 0, 0, 0, metres])
    path = scene / "depth.npy"
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(InputError, match=r"depth\.npy"):
        dataset.distance_m(0, "lidar")


def test_a_principal_point_on_a_pixel_centre_has_a_ray(tmp_path):
    """OpenCV's convention of an even size; nerfstudio's ray of that pixel is 0/0."""
    scene = write_scene(tmp_path)
    edit(scene, lambda meta: [frame.update(cx=15.5, cy=13.5) for frame in meta["frames"]])
    rays = parse(scene).cameras.generate_rays(0)
    assert rays.directions[13, 15].isfinite().all() and rays.directions.norm(dim=-1)[13, 15] == pytest.approx(1)


@pytest.mark.parametrize("of_all", [False, True])
def test_distortion_may_be_a_list(tmp_path, of_all):
    """nerfstudio's other key; what the scene gives for all goes before what a picture gives, as in nerfstudio."""
    scene, values = write_scene(tmp_path), [0.03, -0.002, 1e-3, 2e-4, 3e-4, -1e-3]

    def change(meta):
        for frame in [] if of_all else meta["frames"]:
            for key in ("k1", "k2", "k3", "k4", "p1", "p2"):
                del frame[key]
            frame["distortion_params"] = values
        if of_all:
            meta.update(distortion_params=values, fl_x=8.0)

    edit(scene, change)
    outputs = parse(scene)
    ours = FisheyeDepthDataset(outputs).pictures[0].lens.to_dict()
    assert [ours[key] for key in ("k1", "k2", "k3", "k4", "p1", "p2")] == values
    assert outputs.cameras.distortion_params[0].tolist() == pytest.approx(values)
    assert ours["fx"] == outputs.cameras.fx[0] == (8.0 if of_all else 9.0)


def test_a_plain_scene_of_one_picture(tmp_path):
    scene = write_scene(tmp_path, frames=1, split=False)
    for split in ("train", "test"):
        assert len(parse(scene, split).image_filenames) == 1


def test_a_frame_is_trained_on_or_held_out_with_all_its_cameras(tmp_path):
    """Two cameras a frame: what `process` writes is taken, a split through a frame is not."""
    scene = write_scene(tmp_path, frames=10)

    def pair(meta):
        for number, frame in enumerate(meta["frames"]):
            frame["frame"] = number // 2
        names = [frame["file_path"] for frame in meta["frames"]]
        meta["train_filenames"] = names[:4] + names[6:]
        meta["val_filenames"] = meta["test_filenames"] = names[4:6]

    edit(scene, pair)
    assert len(parse(scene).image_filenames) == 8
    edit(scene, lambda meta: meta["train_filenames"].append(meta["test_filenames"][0]))
    with pytest.raises(InputError, match="frame 2 is in train_filenames and in val_filenames"):
        parse(scene)
    edit(scene, lambda meta: meta.update({f"{split}_filenames": meta["train_filenames"] for split in ("val", "test")}))
    assert len(parse(scene, "test").image_filenames) == 9  # nothing held out


def test_another_parser_is_refused(shared):
    outputs = NerfstudioDataParserConfig(data=shared).setup().get_dataparser_outputs("train")
    with pytest.raises(InputError, match="fisheye-depth-data"):
        FisheyeDepthDataset(outputs)
