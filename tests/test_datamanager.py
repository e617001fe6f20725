import dataclasses
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManager
from scenes import fisheye, pinhole, transforms, write_scene

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_distance_png, write_distance_png, write_mask
from edge_depth_nerf.method.error_model import read_calibration
from edge_depth_nerf.method.integration import IntegrationOptions
from edge_depth_nerf.method.prior import PriorOptions, make_prior, ray_angles
from edge_depth_nerf.mono.calibration import calibrate_scene, find_calibration
from edge_depth_nerf.plugin import datamanager as datamanager_module
from edge_depth_nerf.plugin.datamanager import FisheyeDepthDataManagerConfig
from edge_depth_nerf.plugin.dataparser import FisheyeDepthDataParserConfig
from edge_depth_nerf.plugin.dataset import FisheyeDepthDataset
from edge_depth_nerf.scene.put_maps import write_maps
from edge_depth_nerf.scene.reader import read_scene


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    """A scene that no test changes, with what trainings keep beside it."""
    return write_scene(tmp_path_factory.mktemp("shared"))


def weighted(value: float) -> PriorOptions:
    """A prior that differs from others in its weight of LiDAR."""
    return PriorOptions(integration=IntegrationOptions(alpha=value))


def manager(folder, test_mode="val", parser=None, **options):
    parser = FisheyeDepthDataParserConfig(data=folder, **(parser or {}))
    return FisheyeDepthDataManagerConfig(dataparser=parser, **options).setup(test_mode=test_mode)


def test_a_batch_carries_colour_prior_and_rays_of_its_pixels(shared):
    data = manager(shared, train_num_rays_per_batch=500)
    rays, batch = data.next_train(0)
    dataset = data.train_dataset
    options = data.config.prior
    assert data.config.source_of_prior({"lidar", "mono"}) == "integrated"
    scene = read_scene(shared)
    by_name = {picture.files["image"].name: picture for picture in scene.pictures}
    pictures = [by_name[path.name] for path in dataset.image_filenames]
    calibration = find_calibration(scene, options)
    priors = [
        make_prior(
            {layer: dataset.distance_m(i, layer) for layer in ("lidar", "mono")},
            dataset.mask(i),
            "integrated",
            options,
            calibration,
            ray_angles(pictures[i].lens, pictures[i].up_in_camera),
        )
        for i in range(len(dataset))
    ]
    picture, row, column = batch["indices"].T
    assert len(set(picture.tolist())) == len(dataset)
    for n in range(len(picture)):
        i, r, c = int(picture[n]), int(row[n]), int(column[n])
        assert dataset.mask(i)[r, c]
        assert abs(batch["prior_distance_m"][n].item() - priors[i].distance_m[r, c]) <= 1 / 512 + 1e-6
        assert abs(batch["prior_sigma_m"][n].item() - priors[i].sigma_m[r, c]) <= 1 / 512 + 1e-6
        assert torch.equal((batch["image"][n] * 255).round().to(torch.uint8), torch.from_numpy(dataset.rgb(i)[r, c]))
    # the rays of nerfstudio's camera are those of our lens, turned by the pose
    directions, _ = fisheye().unproject(torch.stack([column + 0.5, row + 0.5], dim=-1).double())
    poses = dataset.cameras.camera_to_worlds[picture].double()
    in_world = (poses[:, :, :3] @ (directions * torch.tensor([1.0, -1.0, -1.0]))[..., None])[..., 0]
    assert torch.allclose(rays.directions.double(), in_world, atol=1e-5)
    assert torch.isfinite(rays.directions).all()


def test_surface_pixels_come_for_the_surface_where_the_prior_is_good(tmp_path):
    scene = write_scene(tmp_path)
    mono = scene / "mono" / "0000.png"
    distance = read_distance_png(mono)
    distance[:8] = 0  # sky, where that is above the horizon
    write_distance_png(mono, distance)
    data = manager(scene, train_num_rays_per_batch=100, surface_rays_per_batch=4000)
    _, batch = data.next_train(0)
    distance, sigma, sky = (batch[f"surface_{name}"][:, 0] for name in ("distance_m", "sigma_m", "sky"))
    assert 0 < len(sky) < 4000 and len(batch["surface_rays"]) == len(batch["surface_image"]) == len(sky)
    assert sky.any() and ((distance > 0) ^ sky).all()
    assert (sigma <= 0.1 + 0.05 * distance).all()
    picture, row, column = batch["surface_indices"].T
    names = [path.name for path in data.train_dataset.image_filenames]
    assert {names[number] for number in picture[sky]} == {"0000.png"} and (row[sky] < 8).all()
    for n in range(0, len(sky), 50):
        rgb = data.train_dataset.rgb(int(picture[n]))[int(row[n]), int(column[n])]
        assert torch.equal((batch["surface_image"][n] * 255).round().to(torch.uint8), torch.from_numpy(rgb))
    # the same pixels again after a training is taken up
    again, _ = (data._surface_sampler.draw(step) for step in (7, 8))
    other = manager(scene, train_num_rays_per_batch=100, surface_rays_per_batch=4000)
    other._surface_sampler._first = data._surface_sampler._first
    assert other._surface_sampler.draw(7) == again
    assert "surface_rays" not in manager(scene, surface_rays_per_batch=0).next_train(0)[1]


def test_on_a_gpu_a_batch_is_the_same_with_all_surface_pixels_and_which_are_of_use(shared, monkeypatch):
    data, other = (manager(shared, train_num_rays_per_batch=100, surface_rays_per_batch=400) for _ in range(2))
    for name in ("train_pixel_sampler", "_surface_sampler"):
        getattr(other, name)._first = getattr(data, name)._first
    # half of the pixels are too vague
    sigma_m = data.train_pixel_sampler.table.batch(0, 1000).prior_sigma_m
    monkeypatch.setattr(datamanager_module, "SURFACE_SIGMA_SHARE", 0.0)
    monkeypatch.setattr(datamanager_module, "SURFACE_SIGMA_M", float(sigma_m.median()))
    for step in range(3):
        rays, expected = data.next_train(step)
        other.set_next(step)
        found_rays, found = other.batch_of(other.packed())
        counts = found.pop("surface_counts")[:, 0]
        assert len(counts) == 400 and 0 < counts.sum() < 400
        pairs = [(rays, found_rays), (expected.pop("surface_rays"), found.pop("surface_rays")[counts])]
        for one, another in pairs:
            for name in ("origins", "directions", "pixel_area", "camera_indices"):
                assert torch.equal(getattr(one, name), getattr(another, name)), name
        assert set(found) == set(expected)
        for name, value in expected.items():
            assert torch.equal(found[name][counts] if name.startswith("surface_") else found[name], value), name
        assert other.pictures_of(torch.tensor([0])) == data.pictures_of(torch.tensor([0]))


def test_no_surface_pixels_come_where_every_prior_is_vague(shared):
    data = manager(shared, prior=PriorOptions(sigma_mode="constant", sigma_constant_m=100.0))
    assert data._surface_sampler is not None
    _, batch = data.next_train(0)
    assert (batch["prior_distance_m"] > 0).any() and not batch["sky"].any()
    assert not [name for name in batch if name.startswith("surface_")]


def test_held_out_maps_are_in_no_training_prior(tmp_path):
    """The prior of every training frame is made from its own files alone; held-out sweeps are not even opened."""
    scene = write_scene(tmp_path, frames=5)
    (scene / "lidar" / "0004.png").write_bytes(b"not a picture")
    data = manager(scene, eval_num_rays_per_batch=7)
    assert "0004.png" not in [path.name for path in data.train_dataset.image_filenames]
    rays, batch = data.next_eval(0)
    assert len(rays) == 7
    assert (batch["prior_distance_m"] == 0).all()


@pytest.mark.parametrize(
    "scene",
    [
        dict(frames=1, mask=False),
        dict(frames=4, cameras=[fisheye(), fisheye(24, 36)]),
        dict(frames=4, cameras=[pinhole(), pinhole(20, 24)], mask=False),
    ],
    ids=["one without mask", "mixed sizes", "pinhole of mixed sizes"],
)
def test_scenes_that_break_the_host_sampler(tmp_path, scene):
    data = manager(write_scene(tmp_path, **scene), train_num_rays_per_batch=256)
    for step in range(3):
        rays, batch = data.next_train(step)
        assert torch.isfinite(rays.directions).all() and torch.isfinite(rays.origins).all()
        for i, r, c in batch["indices"].tolist():
            assert data.train_dataset.mask(i)[r, c]


def test_the_host_sets_the_size_of_batches(shared):
    data = manager(shared)
    assert isinstance(data, VanillaDataManager)
    assert data.get_train_rays_per_batch() == 1024
    assert data.train_pixel_sampler is not None
    data.train_pixel_sampler.num_rays_per_batch = 33  # as nerfstudio's exporter does
    rays, batch = data.next_train(0)
    assert len(rays) == 33 and len(batch["image"]) == 33
    assert data.get_train_rays_per_batch() == 33


def test_nothing_is_integrated_for_rendering(shared, monkeypatch):
    monkeypatch.setattr(datamanager_module, "PriorCache", lambda *_: pytest.fail("integrated"))
    data = manager(shared, test_mode="inference")
    assert data.train_dataset[0]["image"].shape == (28, 32, 3)


@pytest.mark.parametrize(
    ("has", "source", "message"),
    [
        (dict(mono=False), "integrated", "no monocular maps.*estimate-depth.*depth-source"),
        (dict(mono=False), "mono", "no monocular"),
        (dict(lidar=False), "lidar", "no LiDAR"),
        (dict(lidar=False, mono=False), "integrated", "no LiDAR maps and no monocular maps"),
    ],
)
def test_a_source_that_is_not_there(tmp_path, has, source, message):
    with pytest.raises(InputError, match=message):
        manager(write_scene(tmp_path, frames=2, **has), depth_source=source)


@pytest.mark.parametrize(
    ("has", "source"), [(dict(mono=False), "lidar"), (dict(lidar=False), "mono"), (dict(), "integrated")]
)
def test_auto_takes_what_is_there(tmp_path, has, source):
    data = manager(write_scene(tmp_path, frames=4, **has))
    assert data.config.source_of_prior({"lidar", "mono"} - set(has)) == source
    assert (data.next_train(0)[1]["prior_distance_m"] > 0).any()


def test_a_held_out_mask_that_leaves_nothing_is_found_before_training(tmp_path):
    scene = write_scene(tmp_path)
    with transforms(scene) as meta:
        write_mask(scene / "masks" / "thin.png", np.arange(28)[:, None] * np.ones((1, 32)) == 3)
        meta["frames"][4]["mask_path"] = "masks/thin.png"
    with pytest.raises(InputError, match=r"thin\.png.*held-out picture 0004\.png"):
        manager(scene)


def test_two_processes_may_fill_one_cache(tmp_path):
    """Files appear whole: a second reader in the middle finds them or makes them itself."""
    scene = write_scene(tmp_path, frames=3)
    with ThreadPoolExecutor(3) as pool:
        tables = list(pool.map(lambda _: manager(scene).train_pixel_sampler.table, range(3)))
    assert len({table.share_with_prior for table in tables}) == 1
    assert len(list((scene / ".cache" / "prior").iterdir())) == 2


@pytest.mark.parametrize(
    ("options", "prior"),
    [
        ({}, " Prior: 100% of them; LiDAR {lidar:.0%}, monocular 100%; `edge-depth-nerf inspect {scene}` shows it."),
        ({"depth_source": "none"}, ""),
    ],
)
def test_one_line_tells_of_the_prior(shared, capsys, options, prior):
    data = manager(shared, **options)
    said = [line for line in capsys.readouterr().out.splitlines() if "training pictures" in line or "rior" in line]
    dataset = data.train_dataset
    masks = [dataset.mask(number) for number in range(len(dataset))]
    points = sum(int((dataset.distance_m(number, "lidar")[mask] > 0).sum()) for number, mask in enumerate(masks))
    pixels = sum(int(mask.sum()) for mask in masks)
    prior = prior.format(lidar=points / pixels, scene=shared)
    assert said == [f"8 training pictures, {pixels:,} pixels.{prior}"]


def test_the_calibration_of_training_pictures_is_found_or_made(tmp_path):
    scene = write_scene(tmp_path)
    made = calibrate_scene(scene)
    assert made.error_model is not None
    manager(scene)
    # the scene's own was taken, nothing was measured again
    assert not list((scene / ".cache").glob("mono_trust_*"))
    manager(scene, prior=PriorOptions(align="global"))
    (other,) = (scene / ".cache").glob("mono_trust_*")
    assert read_calibration(other).made_of != made.made_of


def test_the_literal_form_measures_nothing(shared, monkeypatch):
    monkeypatch.setattr("edge_depth_nerf.plugin.datamanager.find_calibration", lambda *_: pytest.fail("measured"))
    data = manager(shared, prior=PriorOptions("none", "constant", integration=IntegrationOptions()))
    assert (data.next_train(0)[1]["prior_distance_m"] > 0).any()


def test_a_turned_scene_has_the_same_prior(tmp_path):
    """The world's up is the drive's, whatever axes nerfstudio is told to choose."""
    scene = write_scene(tmp_path)
    calibrated = calibrate_scene(scene)
    dataclasses.replace(calibrated, field_rad=(-0.2, 0.3)).write(scene / "mono_trust.json")
    shares = []
    for method in ("none", "up"):
        data = manager(scene, parser={"orientation_method": method})
        shares.append(data.train_pixel_sampler.table.share_with_prior)
    assert shares[0] == pytest.approx(shares[1], abs=2e-3)
    assert 0.1 < shares[0] < 0.9


def test_the_second_training_reads_no_picture(tmp_path, monkeypatch):
    scene = write_scene(tmp_path, frames=3)
    first = manager(scene).train_pixel_sampler.table
    with monkeypatch.context() as patch:
        patch.setattr(FisheyeDepthDataset, "rgb", lambda *_: pytest.fail("read a picture"))
        again = manager(scene).train_pixel_sampler.table
        assert torch.equal(first.batch(0, 500).indices, again.batch(0, 500).indices)
        assert len(list((scene / ".cache" / "pixels").glob("*.npy"))) == 2  # training, held out
        with pytest.raises(pytest.fail.Exception):
            manager(scene, prior=PriorOptions(align="global"))
        (scene / "images" / "0002.png").touch()
        with pytest.raises(pytest.fail.Exception):
            manager(scene)


def test_a_scene_that_cannot_be_written_trains(tmp_path):
    scene = write_scene(tmp_path, frames=3)
    (scene / ".cache").write_text("in the way")
    data = manager(scene)
    assert (data.next_train(0)[1]["prior_distance_m"] > 0).any()
    assert len(data.next_eval(0)[0]) > 0
    assert (scene / ".cache").read_text() == "in the way"


def test_only_the_tables_used_last_are_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(datamanager_module, "KEPT_TABLES", 3)
    scene = write_scene(tmp_path, frames=2)
    for alpha in (0.5, 0.6, 0.7):
        manager(scene, prior=weighted(alpha))
    folder = scene / ".cache" / "pixels"
    assert len(list(folder.iterdir())) == 3
    # held out, 0.6, 0.7
    before = {path.name for path in folder.glob("*.npy")}
    manager(scene, prior=weighted(0.6))
    assert {path.name for path in folder.glob("*.npy")} == before


def test_a_resumed_training_goes_on_with_the_next_pixels(shared):
    torch.manual_seed(3)
    undisturbed = manager(shared)
    drawn = [undisturbed.next_train(step)[1]["indices"] for step in range(6)]
    torch.manual_seed(3)
    resumed = manager(shared)
    assert torch.equal(resumed.next_train(4)[1]["indices"], drawn[4])
    assert torch.equal(resumed.next_train(5)[1]["indices"], drawn[5])
    # nerfstudio's exporter always says step 0, and wants other rays each time
    assert not torch.equal(resumed.next_train(0)[1]["indices"], drawn[5])
    torch.manual_seed(4)
    assert not torch.equal(manager(shared).next_train(0)[1]["indices"], drawn[0])


def test_what_motion_sees_has_a_prior_and_is_no_sky(tmp_path):
    scene = write_scene(tmp_path)
    folder = read_scene(scene)
    for picture in folder.pictures:
        path = picture.files["mono"]
        distance = read_distance_png(path)
        distance[:8] = 0
        write_distance_png(path, distance)

    def motion():
        for picture in folder.pictures:
            truth = folder.distance_m(picture, "truth_distance")
            assert truth is not None
            yield picture.name, truth

    def parts(data):
        batch = data.next_train(0)[1]
        upper = batch["indices"][:, 1] < 8
        return batch["sky"][upper], batch["prior_distance_m"][upper]

    options = {"train_num_rays_per_batch": 4000, "prior": PriorOptions(sigma_mode="combined")}
    sky, prior = parts(manager(scene, **options))
    assert sky.any() and not prior.any()
    write_maps(scene, "motion", motion(), {"kind": "for a test"})
    data = manager(scene, **options)
    assert "motion" in data.train_dataset.sources()
    sky_with, prior_with = parts(data)
    assert prior_with.all() and not sky_with.any()
    without = dataclasses.replace(options["prior"], motion=False)
    sky_without, prior_without = parts(manager(scene, **{**options, "prior": without}))
    assert sky_without.any() and not prior_without.any()
