"""Detail of training pictures: what it adds to views, from where, and when it is rendered again."""

from copy import deepcopy

import numpy as np
import pytest
import torch
from balls import pose
from models import pipeline_of
from nerfstudio.model_components.renderers import background_color_override_context
from scenes import FLIP, RADIUS_M, fisheye, pinhole, transforms, view, write_scene

from edge_depth_nerf.compare.evaluation import ViewEvaluator, shifted_views
from edge_depth_nerf.method.detail import carried, detail_of, pictures_that_see, seen_from
from edge_depth_nerf.plugin import detail as plugin_detail
from edge_depth_nerf.plugin.detail import TrainingDetail, detail_shown, with_appearance_of
from edge_depth_nerf.plugin.evaluation import evaluated
from edge_depth_nerf.plugin.exposure import Gains

GREY = 0.5
LENSES = {"fisheye": [fisheye(64, 56)], "both": [fisheye(64, 56), pinhole(64, 56)]}


# ---- the formulas ---------------------------------------------------------------------------------------------------
def at(x: float, angle: float = 0.0) -> np.ndarray:
    """A camera-to-world matrix, OpenCV axes: beside the ball's middle, turned about y."""
    return pose(x, turn_rad=angle)


def opengl(pose: np.ndarray) -> torch.Tensor:
    return torch.tensor((pose @ FLIP)[:3], dtype=torch.float32)


def seen(lens, pose: np.ndarray):
    """Truth, distance, rays (origins, directions) and usable pixels of a view, flat."""
    colours, distance, _ = view(lens, pose)
    directions, valid = lens.unproject(lens.pixel_centres())
    world = torch.nan_to_num(directions).reshape(-1, 3).float() @ torch.tensor(pose[:3, :3].T).float()
    return (
        torch.tensor(colours / 255.0).float(),
        torch.tensor(distance).float(),
        torch.tensor(pose[:3, 3]).float().expand(len(world), 3),
        world,
        valid,
    )


def grey_detail(lens, pose: np.ndarray, usable: torch.Tensor | None = None, shift: float = 1.0):
    """Detail of a picture that was rendered grey at its true distances, times `shift`."""
    colours, distance, _, _, valid = seen(lens, pose)
    counts = valid if usable is None else valid & usable
    return detail_of(lens, opengl(pose), colours, colours - GREY, distance * shift, counts)


@pytest.mark.parametrize("lens", [fisheye(64, 56), pinhole(64, 56)], ids=["fisheye", "pinhole"])
def test_a_picture_looks_up_its_own_pixels(lens):
    pose = at(0.4, 0.3)
    colours, distance, origins, directions, valid = seen(lens, pose)
    inside = valid.flatten()
    points = (origins + directions * distance.reshape(-1, 1))[inside]
    place, to_points, from_picture = seen_from(lens, opengl(pose), points)
    pixels = (place + 1) / 2 * torch.tensor([64.0, 56.0])
    torch.testing.assert_close(pixels, lens.pixel_centres().reshape(-1, 2).float()[inside], atol=2e-3, rtol=0)
    torch.testing.assert_close(to_points, directions[inside], atol=1e-5, rtol=0)
    torch.testing.assert_close(from_picture, distance.flatten()[inside], atol=1e-4, rtol=1e-5)
    added = carried(origins[inside], directions[inside], distance.flatten()[inside], [grey_detail(lens, pose)])
    # one picture, same direction, same distance: weight 1 of 1.1
    expected = (colours.reshape(-1, 3)[inside] - GREY) / 1.1
    torch.testing.assert_close(added, expected, atol=4e-3, rtol=0)


def test_what_a_picture_does_not_see_or_may_not_show_adds_nothing():
    lens, pose = fisheye(64, 56), at(0.5)
    _, distance, origins, directions, valid = seen(lens, pose)

    def added(*details):
        return carried(origins, directions, distance.flatten(), details)[valid.flatten()]

    assert float(added(grey_detail(lens, at(0.2))).abs().mean()) > 0.05
    assert float(added().abs().max()) == 0
    # something hides the wall from the picture; it may not be used; it looks the other way
    assert float(added(grey_detail(lens, at(0.2), shift=0.7)).abs().max()) < 1e-6
    assert float(added(grey_detail(lens, at(0.2), usable=torch.zeros(56, 64, dtype=torch.bool))).abs().max()) == 0
    narrow = pinhole(64, 56)
    behind = carried(origins[:1], -directions[:1], distance.flatten()[:1], [grey_detail(narrow, at(0.2))])
    assert float(behind.abs().max()) == 0


def test_the_pictures_that_see_most_come_first_and_blind_ones_never():
    lens = pinhole(64, 56)
    _, distance, origins, directions, _ = seen(lens, at(0.0))
    pictures = [(lens, opengl(at(0.1, angle))) for angle in (np.pi, 0.5, 0.0, -0.2)]
    found = pictures_that_see(origins, directions, distance.flatten(), pictures, 8)
    assert found[0] == 2 and sorted(found) == [1, 2, 3]
    assert pictures_that_see(origins, directions, distance.flatten(), pictures, 2) == found[:2]
    assert pictures_that_see(origins, directions, distance.flatten(), [], 2) == []


def test_pictures_are_chosen_that_together_see_a_view():
    """Of eight alike and one that looks elsewhere, one is of each kind before a second of the same."""
    lens, turn = pinhole(64, 56), np.pi / 2
    both = [seen(lens, at(0.0, angle)) for angle in (0.0, turn)]
    origins, directions = (torch.cat([each[place] for each in both]) for place in (2, 3))
    distance = torch.cat([each[1].flatten() for each in both])
    pictures = [*((lens, opengl(at(0.01 * number))) for number in range(8)), (lens, opengl(at(0.5, turn)))]
    assert set(pictures_that_see(origins, directions, distance, pictures, 2)) == {0, 8}


def test_undefined_rays_get_nothing_and_take_nothing_from_others():
    """nerfstudio's rays at the rim of a lens can be no numbers."""
    lens, pose = fisheye(64, 56), at(0.5)
    _, distance, origins, directions, valid = seen(lens, pose)
    distance, broken = distance.flatten(), directions.clone()
    broken[0] = torch.nan
    pictures = [(lens, opengl(at(0.2)))]
    assert pictures_that_see(origins, broken, distance, pictures, 8) == [0]
    details = [grey_detail(lens, at(0.2))]
    added, whole = (carried(origins, each, distance, details) for each in (broken, directions))
    assert torch.equal(added[0], torch.zeros(3)) and torch.equal(added[1:], whole[1:])
    assert float(whole[valid.flatten()].abs().max()) > 0.1
    # nor does an exposure that is nearly 0
    white, ones = torch.full((56, 64, 3), 1e6), torch.ones(56, 64)
    huge = detail_of(lens, opengl(at(0.2)), torch.ones(56, 64, 3), white, ones, valid)
    assert float(carried(origins, directions, distance, [huge]).abs().max()) <= 1


# ---- exposures ------------------------------------------------------------------------------------------------------
def test_a_picture_that_is_its_rendering_exposed_shows_nothing_beyond():
    generator = torch.Generator().manual_seed(0)
    exposure = Gains(4)
    with torch.no_grad():
        for parameter in exposure.parameters():
            parameter.normal_(0, 1.0, generator=generator)
    rendered = torch.rand(6, 8, 3, generator=generator)
    with torch.no_grad():
        exposed = exposure(rendered.view(-1, 3), torch.full((48,), 2)).view(6, 8, 3)
        assert float((exposed - rendered).abs().max()) > 0.05
        torch.testing.assert_close(exposure.beyond(exposed, rendered, 2), torch.zeros(6, 8, 3), atol=1e-5, rtol=0)
        # what is added before the exposure is found
        more = torch.rand(6, 8, 3, generator=generator)
        exposed = exposure((rendered + more).view(-1, 3), torch.full((48,), 2)).view(6, 8, 3)
        torch.testing.assert_close(exposure.beyond(exposed, rendered, 2), more, atol=1e-5, rtol=1e-4)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """One that no test changes, with what trainings keep beside it."""
    return write_scene(tmp_path_factory.mktemp("scene"))


# ---- in the model ---------------------------------------------------------------------------------------------------
def grey_ball(pipeline, monkeypatch):
    """Let a model render the scene's ball in grey, at its true distance; give the numbers of rays that it rendered."""
    model, dataset, rendered = pipeline.model, pipeline.datamanager.train_dataset, []
    outputs = dataset._dataparser_outputs
    unit, to_scene = dataset.metadata["metres_per_unit"], outputs.dataparser_transform
    middle = to_scene[:3, 3] * outputs.dataparser_scale

    def forward(ray_bundle, batch=None):
        rendered.append(len(ray_bundle))
        beside = ray_bundle.origins - middle
        along = (ray_bundle.directions * beside).sum(-1)
        radius = RADIUS_M / unit
        depth = -along + (along.square() + radius**2 - beside.square().sum(-1)).sqrt()
        shape = (len(ray_bundle), 1)
        return {
            "rgb": torch.full((len(ray_bundle), 3), GREY),
            "depth": depth[:, None],
            "distance": depth[:, None] * unit,
            "distance_uncertainty": torch.ones(shape),
            "accumulation": torch.ones(shape),
            **{f"prop_depth_{number}": depth[:, None] for number in range(2)},
        }

    monkeypatch.setattr(model, "forward", forward)
    return rendered


def errors(pipeline, number: int = 0) -> tuple[float, float]:
    """Mean error of a held-out view inside the mask, without and with detail."""
    dataset = pipeline.datamanager.eval_dataset
    item, found = dataset[number], []
    for shown in (False, True):
        with evaluated(pipeline.model), detail_shown(shown):
            rgb = pipeline.model.get_outputs_for_camera(dataset.cameras[number : number + 1])["rgb"]
        found.append(float((rgb - item["image"])[item["mask"][..., 0]].abs().mean()))
    return found[0], found[1]


@pytest.mark.parametrize("lenses", LENSES)
def test_a_grey_model_shows_the_colours_of_its_training_pictures(tmp_path, monkeypatch, lenses):
    pipeline = pipeline_of(write_scene(tmp_path, LENSES[lenses], frames=17))  # pyrefly: ignore[bad-argument-type]
    grey_ball(pipeline, monkeypatch)
    before, after = errors(pipeline)
    assert before > 0.15 and after < 0.25 * before


def test_the_option_shows_it_and_is_off_by_default(scene, monkeypatch):
    for option in (False, True):
        pipeline = pipeline_of(scene, detail=True) if option else pipeline_of(scene)
        grey_ball(pipeline, monkeypatch)
        assert pipeline.model.config.detail is option and pipeline.detail.is_shown is option
        camera = pipeline.datamanager.eval_dataset.cameras[:1]
        with evaluated(pipeline.model):
            rgb = pipeline.model.get_outputs_for_camera(camera)["rgb"]
            with detail_shown(not option):
                other = pipeline.model.get_outputs_for_camera(camera)["rgb"]
        assert bool((rgb == GREY).all()) is not option and bool((other == GREY).all()) is option
        figures = pipeline.get_average_eval_image_metrics()
        assert (figures["masked_psnr"] > 14) is option


def test_training_never_shows_it_and_cut_views_do_not(scene, monkeypatch):
    pipeline = pipeline_of(scene, detail=True)
    rendered = grey_ball(pipeline, monkeypatch)
    model, camera = pipeline.model, pipeline.datamanager.eval_dataset.cameras[:1]
    model.train()
    assert (model.get_outputs_for_camera(camera)["rgb"] == GREY).all()
    with evaluated(model), background_color_override_context(torch.zeros(3)):
        assert (model.get_outputs_for_camera(camera)["rgb"] == GREY).all()
    assert sum(rendered) == 2 * 28 * 32


def test_training_pictures_are_rendered_once_until_the_model_changes(scene, monkeypatch):
    pipeline = pipeline_of(scene)
    trained_step = pipeline.get_train_loss_dict
    state = deepcopy(pipeline.state_dict())
    original = pipeline.model.forward
    rendered = grey_ball(pipeline, monkeypatch)
    camera, pixels = pipeline.datamanager.eval_dataset.cameras[:1], 28 * 32

    def cost() -> float:
        rendered.clear()
        with evaluated(pipeline.model), detail_shown(True):
            pipeline.model.get_outputs_for_camera(camera)
        return sum(rendered) / pixels

    first = cost()
    assert 1 < first <= 1 + plugin_detail.PICTURES
    assert cost() == 1
    grey = pipeline.model.forward
    monkeypatch.setattr(pipeline.model, "forward", original)
    trained_step(0)
    monkeypatch.setattr(pipeline.model, "forward", grey)
    assert cost() == first
    pipeline.load_state_dict(state)
    assert cost() == first


def test_few_are_kept_where_pictures_are_large(scene, monkeypatch):
    pipeline = pipeline_of(scene)
    dataset = pipeline.datamanager.train_dataset
    assert TrainingDetail(pipeline.model, dataset).kept == plugin_detail.MOST_BYTES // (8 * 28 * 32)
    monkeypatch.setattr(plugin_detail, "MOST_BYTES", 1)
    detail = TrainingDetail(pipeline.model, dataset)
    assert detail.kept == plugin_detail.PICTURES + 1 and detail.of_picture.cache_info().maxsize == detail.kept
    with evaluated(pipeline.model):
        kept = detail.of_picture(0)
    held = sum(each.element_size() * each.nelement() for each in (kept.colours, kept.distance))
    assert held == plugin_detail.BYTES_A_PIXEL * 28 * 32


def test_detail_is_without_the_pictures_exposure(scene, monkeypatch):
    pipeline = pipeline_of(scene)
    grey_ball(pipeline, monkeypatch)
    straight = errors(pipeline)[1]
    gains = pipeline.model.exposure.log_gains
    gains.data = torch.randn(gains.shape, generator=torch.Generator().manual_seed(0)) * 0.3
    pipeline.detail.forget()
    assert errors(pipeline)[1] > 1.5 * straight
    # pictures taken with these gains
    dataset, factors = pipeline.datamanager.train_dataset, pipeline.model.exposure.gains.detach()
    original = dataset.rgb
    monkeypatch.setattr(dataset, "rgb", lambda number: original(number) * factors[number].numpy())
    pipeline.detail.forget()
    assert errors(pipeline)[1] == pytest.approx(straight, rel=0.01)


def test_overexposed_pixels_do_not_darken_what_is_bright(scene, monkeypatch):
    pipeline = pipeline_of(scene)
    grey_ball(pipeline, monkeypatch)
    dataset, gains = pipeline.datamanager.train_dataset, pipeline.model.exposure.log_gains
    gains.data[0] = 1.5
    gain = float(pipeline.model.exposure.gains[0, 0])
    assert 1 / gain < GREY
    # white, and below it, in a picture of a long exposure
    picture = np.full((28, 32, 3), 255, np.uint8)
    picture[14:] = 100
    monkeypatch.setattr(dataset, "rgb", lambda _: picture)
    usable = torch.from_numpy(dataset.mask(0))
    with evaluated(pipeline.model):
        colours = pipeline.detail.of_picture(0).colours
    above, below = colours[:, :14][:, usable[:14]], colours[:, 14:][:, usable[14:]]
    assert float(above.abs().max()) == 0 and above.numel() > 100
    torch.testing.assert_close(below, torch.full_like(below, 100 / 255 / gain - GREY), atol=1e-3, rtol=0)


def test_detail_is_seen_from_where_training_has_moved_the_cameras(tmp_path, monkeypatch):
    scene = write_scene(tmp_path)
    right = pipeline_of(scene)
    grey_ball(right, monkeypatch)
    straight = errors(right)[1]
    with transforms(scene) as meta:
        # training pictures are said to be 0.8 m beside where they were taken, every other one to the other side
        train = set(meta["train_filenames"])
        signs = iter([1.0, -1.0] * len(train))
        moved = {name: next(signs) for name in sorted(train)}
        for frame in meta["frames"]:
            frame["transform_matrix"][1][3] += 0.8 * moved.get(frame["file_path"], 0.0)
    wrong = pipeline_of(scene, poses="SO3xR3")
    grey_ball(wrong, monkeypatch)
    assert errors(wrong)[1] > 1.3 * straight
    optimizer = wrong.model.camera_optimizer
    names = [f"images/{file.name}" for file in wrong.datamanager.train_dataset.image_filenames]
    back = wrong.datamanager.train_dataset._dataparser_outputs.dataparser_transform[:3, 1]
    with torch.no_grad():
        offs = torch.stack([-0.8 * moved[name] * back for name in names])
        optimizer.pose_adjustment[:, :3] = (offs - offs.mean(dim=0)) / optimizer.config.sigma_m
    wrong.detail.forget()
    assert errors(wrong)[1] < 1.05 * straight


@pytest.mark.parametrize("implementation", ["fused", "torch"])
def test_with_an_embedding_a_picture_is_rendered_as_it_looks(scene, implementation):
    pipeline = pipeline_of(scene, exposure="embedding", depth_loss="none", implementation=implementation)
    model, camera = pipeline.model, pipeline.datamanager.train_dataset.cameras[:1]
    weight = model.field.embedding_appearance.embedding.weight
    with torch.no_grad():
        weight.normal_(0, 20.0)
    with evaluated(model):
        usual = model.rendered_alone(camera)["rgb"]
        with with_appearance_of(model.field, 2):
            third = model.rendered_alone(camera)["rgb"]
        with with_appearance_of(model.field, 3):
            fourth = model.rendered_alone(camera)["rgb"]
        assert torch.equal(model.rendered_alone(camera)["rgb"], usual)
        # a mean of one picture is that picture's
        weight[:] = weight[2].clone()
        torch.testing.assert_close(model.rendered_alone(camera)["rgb"], third)
    assert float((third - usual).abs().max()) > 0.01 and float((third - fourth).abs().max()) > 0.01


# ---- evaluated ------------------------------------------------------------------------------------------------------
def test_views_are_evaluated_with_detail_beside_those_without(tmp_path, monkeypatch):
    scene = write_scene(tmp_path / "scene", frames=17)
    with transforms(scene) as meta:
        for frame in meta["frames"]:
            frame["camera"] = "only"
        held_out = next(frame for frame in meta["frames"] if frame["file_path"] == meta["test_filenames"][0])
        files = {key: held_out[key] for key in ("truth_rgb_file_path", "truth_distance_file_path")}
        meta["shifted_views"] = {"1": [{"camera": "only", "transform_matrix": held_out["transform_matrix"], **files}]}
    pipeline = pipeline_of(scene)
    grey_ball(pipeline, monkeypatch)
    told: list[int] = []
    evaluator = ViewEvaluator(pipeline, lambda: told.append(1))
    beside = shifted_views(pipeline.datamanager.eval_dataset)
    plain, _ = evaluator.held_out(tmp_path / "views")
    plain |= evaluator.shifted(beside)
    found = evaluator.with_detail(tmp_path / "views", beside)
    for name in ("masked_psnr", "truth_masked_psnr", "shifted_1m_masked_psnr"):
        assert found[f"detail_{name}"] > plain[name] + 6, name
    assert all("masked_" in name for name in found)
    count = len(pipeline.datamanager.eval_dataset)
    assert len(told) == 2 * (count + 1)
    assert len([*(tmp_path / "views").glob("eval_detail_*.png")]) == count
    assert len([*(tmp_path / "views").glob("eval_img_*.png")]) == count


def test_neighbours_show_what_a_grey_view_lacks():
    lens, pose = fisheye(64, 56), at(0.5)
    colours, distance, origins, directions, valid = seen(lens, pose)
    around = [grey_detail(lens, at(x)) for x in (0.2, 0.8)]
    added = carried(origins, directions, distance.flatten(), around).view(56, 64, 3)
    inside = valid & (lens.pixel_centres() - torch.tensor([32.0, 28.0])).norm(dim=-1).lt(20)
    before, after = (GREY - colours)[inside].abs().mean(), (GREY + added - colours)[inside].abs().mean()
    assert after < 0.1 * before
