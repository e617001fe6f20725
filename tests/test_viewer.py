"""What the viewer shows: in numbers, on the server's side, and in a browser."""

import math
import socket
import threading
import time
from collections.abc import Callable, Iterator
from copy import deepcopy
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import jaxtyping
import numpy as np
import pytest
import torch
from models import pipeline_of, shrink
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.configs.method_configs import all_methods
from nerfstudio.viewer.render_state_machine import RenderAction, RenderStateMachine
from nerfstudio.viewer.utils import CameraState, get_camera, parse_object
from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO, Viewer
from nerfstudio.viewer.viewer_elements import ViewerControl, ViewerElement
from scenes import RADIUS_M, copy_sample_drive, fisheye, pinhole, write_scene
from torch._subclasses.fake_tensor import FakeTensorMode
from waiting import until

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import as_people_count
from edge_depth_nerf.base.pictures import SIGMA, colour_distance
from edge_depth_nerf.cameras import KannalaBrandt
from edge_depth_nerf.plugin.coarse_to_fine import LONGEST_START_S, CoarseToFine
from edge_depth_nerf.plugin.viewer import AZIMUTHS, RINGS, DriveLayers, lens_cap, rim_rad

pytestmark = pytest.mark.slow

METHOD = "edge-depth-nerf-lite"
TIMEOUT_S = 120


# ---- lenses ----------------------------------------------------------------------------------------------------------
def test_the_rim_of_an_equidistant_lens():
    """r = f·θ; wider than tall, so that the picture's edge, its corners and theta_max each are the rim somewhere."""
    camera = KannalaBrandt(100, 60, 25.0, 25.0, 48.0, 31.0, 0.0, 0.0, 0.0, 0.0)
    azimuth = 2 * np.pi * np.arange(AZIMUTHS) / AZIMUTHS
    cosine, sine = np.cos(azimuth), np.sin(azimuth)
    with np.errstate(divide="ignore"):
        across = np.where(cosine > 0, (100 - 48) / cosine, -48 / cosine) / 25
        along = np.where(sine > 0, (60 - 31) / sine, -31 / sine) / 25
    limit = 1.7
    expected = np.minimum(np.minimum(np.abs(across), np.abs(along)), limit)
    assert {True, False} == set((expected == limit).tolist())
    assert np.abs(rim_rad(camera, limit) - expected).max() <= 1.01 * limit / 720


@pytest.mark.parametrize("camera", [fisheye(), pinhole()], ids=["fisheye", "pinhole"])
def test_a_cap_is_the_picture_on_the_sphere(camera):
    corners, pixels, triangles = lens_cap(camera, math.radians(100))
    assert corners.shape == ((RINGS + 1) * AZIMUTHS, 3) and np.allclose(np.linalg.norm(corners, axis=1), 1)
    assert triangles.min() == 0 and triangles.max() == len(corners) - 1
    # the rays of those pixels lead there
    rays, valid = camera.unproject(torch.from_numpy(pixels))
    assert valid[:-AZIMUTHS].all()
    assert np.nanmax(np.abs(rays.numpy() - corners)) < 1e-6
    # the triangles leave no gap: their areas add up to the cap's, which follows from the rim
    edges = corners[triangles[:, 1:]] - corners[triangles[:, :1]]
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1).sum() / 2
    exact = (1 - np.cos(rim_rad(camera, math.radians(100)))).mean() * 2 * np.pi
    assert area == pytest.approx(exact, rel=0.02)


def test_a_lens_that_sees_behind_itself_has_a_cap_beyond_the_half_sphere():
    camera = KannalaBrandt(200, 200, 50.0, 50.0, 100.0, 100.0, 0.0, 0.0, 0.0, 0.0)
    assert np.degrees(rim_rad(camera, math.radians(110))) == pytest.approx(110, abs=0.2)
    assert lens_cap(camera, math.radians(110))[0][:, 2].min() == pytest.approx(math.cos(math.radians(110)), abs=0.01)


def test_names_with_numbers_are_in_order():
    names = ["frame_10.png", "frame_9.png", "frame_1.png", "0003.png"]
    assert sorted(names, key=lambda name: as_people_count(Path(name))) == [names[3], names[2], names[1], names[0]]


# ---- outputs ---------------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    return write_scene(tmp_path_factory.mktemp("scene"), [fisheye(24, 20)])


@pytest.fixture(scope="module")
def pipeline(scene):
    return pipeline_of(scene, "test")


def view_of(pipeline) -> Cameras:
    return pipeline.datamanager.eval_dataset.cameras[:1]


def test_distance_and_its_uncertainty_are_metres(pipeline):
    pipeline.eval()
    outputs = pipeline.model.get_outputs_for_camera(view_of(pipeline))
    assert all(torch.isfinite(value).all() for value in outputs.values())
    scale = pipeline.model.metres_per_unit
    assert scale != 1
    assert torch.allclose(outputs["distance"], outputs["depth"] * scale)
    assert outputs["distance_uncertainty"].shape == outputs["expected_depth"].shape == outputs["depth"].shape
    # no wider than a distribution on two points, the near and the far plane
    assert 0 < outputs["distance_uncertainty"].min() and outputs["distance_uncertainty"].max() < 500
    coloured = (outputs["distance_coloured"].numpy() * 255).round().astype(np.uint8)
    assert np.array_equal(coloured, colour_distance(outputs["distance"][..., 0].numpy()))
    # nerfstudio's renderer divides by the scale what is called depth
    assert not [name for name in outputs if "distance" in name and "depth" in name]


def test_uncertainty_is_of_the_weights_that_colour_the_ray(pipeline):
    """Taken apart again: the field's own weights, and the spread of many ends drawn by them."""
    model = pipeline.model.eval()
    rays = view_of(pipeline).generate_rays(camera_indices=0)[10, 10:12]
    kept = {}
    original = model.field.render

    def rendered(*args, **kwargs):
        kept["rendered"] = original(*args, **kwargs)
        return kept["rendered"]

    model.field.render = rendered
    samples = {}
    sampler = model.proposal_sampler.forward

    def sampled(*args, **kwargs):
        result = sampler(*args, **kwargs)
        samples["final"] = result[0]
        return result

    model.proposal_sampler.forward = sampled
    try:
        with torch.no_grad():
            outputs = model(rays)
    finally:
        model.field.render, model.proposal_sampler.forward = original, sampler
    rng = np.random.default_rng(0)
    frustums = samples["final"].frustums
    for ray in range(2):
        weights = kept["rendered"].weights[ray].double().numpy()
        starts, ends = frustums.starts[ray, :, 0].numpy(), frustums.ends[ray, :, 0].numpy()
        chosen = rng.choice(len(weights), 200_000, p=weights / weights.sum())
        drawn = starts[chosen] + (ends - starts)[chosen] * rng.random(200_000)
        expected_m = drawn.std() * model.metres_per_unit
        assert float(outputs["distance_uncertainty"][ray]) == pytest.approx(expected_m, rel=0.02)


@pytest.mark.parametrize("kind", [CameraType.FISHEYE, CameraType.EQUIRECTANGULAR, CameraType.PERSPECTIVE])
@pytest.mark.parametrize("implementation", ["fused", "torch"])
def test_previews_of_any_size_are_whole(scene, kind, implementation):
    """An odd fisheye picture has its principal point on a pixel's centre, where nerfstudio's ray is 0/0."""
    pipeline = pipeline_of(scene, "test", implementation=implementation)
    pipeline.eval()
    pose = view_of(pipeline).camera_to_worlds[0]
    camera = get_camera(CameraState(fov=1.5, aspect=1.0, c2w=pose, camera_type=kind), 9, 9)
    assert bool(camera.generate_rays(camera_indices=0).directions.isnan().any()) == (kind is CameraType.FISHEYE)
    outputs = pipeline.model.get_outputs_for_camera(camera)
    assert all(torch.isfinite(value).all() for value in outputs.values())
    assert float(camera.cx) == 4.5  # the caller's camera is left as it was


# ---- layers ----------------------------------------------------------------------------------------------------------
def in_scene_m(pipeline, points: np.ndarray) -> np.ndarray:
    outputs = pipeline.datamanager.train_dataset._dataparser_outputs
    transform = outputs.dataparser_transform.numpy().astype(float)
    return (points / outputs.dataparser_scale - transform[:, 3]) @ transform[:, :3]


def test_clouds_lie_where_the_wall_is(pipeline):
    """The scene is a ball with a wall; cameras stand and look in many ways."""
    layers = pipeline.layers
    lidar, prior = layers._lidar(), layers._prior()
    for cloud, within in ((lidar, 0.02), (prior, 0.8)):
        assert len(cloud.points) > 500
        radius = np.linalg.norm(in_scene_m(pipeline, cloud.points), axis=1)
        assert np.abs(np.median(radius) - RADIUS_M) < within / 4
        assert np.percentile(np.abs(radius - RADIUS_M), 95) < within
    wall = in_scene_m(pipeline, lidar.points)
    # the same wall has the same colours, from wherever it is seen
    expected = 127 + 120 * np.sin(wall / RADIUS_M * [3.0, 4.0, 5.0] + [0.0, 1.0, 2.0])
    assert np.abs(lidar.rgb - expected).mean() < 6
    assert np.allclose(lidar.height_m - lidar.height_m[0], wall[:, 2] - wall[0, 2], atol=1e-3)
    assert lidar.sigma_m is None and prior.sigma_m is not None and prior.sigma_m.min() > 0


def test_colours_of_clouds(pipeline):
    cloud = pipeline.layers._prior()
    assert cloud.sigma_m is not None
    assert np.array_equal(cloud.colours("picture"), cloud.rgb)
    by_sigma = cloud.colours("sigma").astype(int).sum(1)
    assert by_sigma[cloud.sigma_m.argmax()] > by_sigma[cloud.sigma_m.argmin()]
    assert np.array_equal(cloud.colours("sigma"), SIGMA.coloured(cloud.sigma_m, cloud.sigma_m > 0))
    lowest, highest = (cloud.colours("height")[index].astype(int) for index in
                       (cloud.height_m.argmin(), cloud.height_m.argmax()))  # fmt: skip
    assert lowest[2] > lowest[0] and highest[0] > highest[2]
    lidar = pipeline.layers._lidar()
    assert np.array_equal(lidar.colours("sigma"), lidar.colours("height"))


def test_nerfstudio_finds_the_layers(pipeline):
    assert parse_object(pipeline, ViewerControl, "Custom Elements") == [("Custom Elements/layers", pipeline.layers)]
    # they stand in a folder of their own, and not a second time among its elements
    assert not [path for path, _ in parse_object(pipeline, ViewerElement, "Custom Elements") if "/layers/" in path]
    # nothing of it is in a checkpoint
    assert not [name for name in pipeline.state_dict() if "layers.switches" in name or name.startswith("layers")]


def test_what_is_not_there_cannot_be_switched_on(tmp_path):
    pipeline = pipeline_of(write_scene(tmp_path, lidar=False, mono=False), "test", depth_loss="none")
    switches = pipeline.layers.switches
    assert {name: switch.disabled for name, switch in switches.items()} == {
        **{"lenses": False, "path": False, "lidar": True, "prior": True, "scan": True}
    }


def test_nothing_is_made_without_a_viewer(scene, monkeypatch):
    for name in ("_lidar", "_prior", "_scan", "_draw_lenses", "_draw_path"):
        monkeypatch.setattr(DriveLayers, name, lambda *_: pytest.fail("made"))
    pipeline_of(scene, "test")


# ---- from coarse to fine ---------------------------------------------------------------------------------------------
@pytest.fixture
def machine() -> CoarseToFine:
    """Of a browser that is 1.5 times as wide as high; nothing is rendered."""
    viewer: Any = SimpleNamespace(
        control_panel=SimpleNamespace(max_res=512),
        step=59,
        stats_markdown=SimpleNamespace(content="Step: 0  \nResolution: 0x0px"),
        make_stats_markdown=lambda step, res: f"Step: {step}  \nResolution: {res}",
    )
    return CoarseToFine(viewer, cast(Any, None))


def test_a_resting_browser_gets_finer_pictures_in_steps(machine):
    states = [machine.state]
    for _ in range(4):
        states.append(machine.transitions[states[-1]]["static"])
    assert states == ["low_static", "middle", "high", "high", "high"]
    assert machine.transitions["middle"]["move"] == machine.transitions["high"]["move"] == "low_move"


@pytest.mark.parametrize(
    ("rays_per_s", "heights"),
    # the least heights; seconds times speed = height² · 1.5; the panel's largest side
    [(1e3, [60, 100, 160, 341]), (2e4, [60, 115, 200, 341]), (1e7, [341, 341, 341, 341])],
)
def test_the_steps_take_what_the_machine_can(machine, rays_per_s, heights):
    machine._rays_per_s = rays_per_s
    sizes = []
    for machine.state in ("low_move", "low_static", "middle", "high"):
        sizes.append(machine._calculate_image_res(1.5))
    assert [height for height, _ in sizes] == heights
    assert all(abs(width - 1.5 * height) <= 1.5 and width <= 512 for height, width in sizes)


def test_small_pictures_are_enlarged_smoothly(machine, monkeypatch):
    sent = []
    monkeypatch.setattr(RenderStateMachine, "_send_output_to_viewer", lambda _, outputs, static: sent.append(outputs))
    ramp = torch.linspace(0, 1, 40)[None, :, None].expand(30, 40, 3)
    machine._send_output_to_viewer({"rgb": ramp, "gl_z_buf_depth": ramp[..., :1].double()})
    (outputs,) = sent
    assert outputs["rgb"].shape == (512, 683, 3) and outputs["gl_z_buf_depth"].shape == (512, 683, 1)
    assert outputs["gl_z_buf_depth"].dtype == torch.float64
    assert float(outputs["rgb"].diff(dim=1).max()) < 1 / 40 / 10  # no squares
    # what was rendered, and the step of the model, also where nothing is trained
    assert machine.viewer.stats_markdown.content == "Step: 59  \nResolution: 40x30px"
    machine._send_output_to_viewer({"rgb": torch.zeros(512, 600, 3)})
    assert sent[1]["rgb"].shape == (512, 600, 3)


def test_the_speed_of_a_gpu_counts_what_was_only_asked_for(machine, monkeypatch):
    with FakeTensorMode():
        outputs = {"rgb": torch.empty(20, 30, 3, device="cuda")}
    waited_for = []

    def present(device: torch.device) -> Any:
        waited_for.append(device.type)
        return SimpleNamespace(synchronize=lambda: time.sleep(0.05))

    monkeypatch.setattr(RenderStateMachine, "_render_img", lambda *_: outputs)
    monkeypatch.setattr(torch.cuda, "current_stream", present)
    assert machine._render_img(reported(0.0)) is outputs
    assert waited_for == ["cuda"] and 0 < machine._rays_per_s <= 600 / 0.05


def test_complete_pictures_alone_have_detail_and_none_during_a_training(machine, pipeline, monkeypatch):
    detail, rendered = pipeline.detail, []

    def render(*_) -> dict[str, torch.Tensor]:
        rendered.append(detail.is_shown)
        return {"rgb": torch.zeros(20, 30, 3)}

    monkeypatch.setattr(RenderStateMachine, "_render_img", render)
    layers = pipeline.layers
    monkeypatch.setattr(layers, "viewer", SimpleNamespace(trainer=None), raising=False)
    machine._shows_detail = layers.shows_detail
    # the training's own setting does not matter here
    monkeypatch.setattr(pipeline.model.config, "detail", True)
    states = ("low_move", "low_static", "middle", "high")
    assert not layers.detail.value
    for value in (False, True):
        layers.detail.value = value
        for machine.state in states:
            machine._render_img(reported(0.0))
    layers.viewer.trainer = SimpleNamespace(training_state="training")
    machine._render_img(reported(0.0))
    layers.viewer.trainer.training_state = "completed"
    machine._render_img(reported(0.0))
    assert rendered == [False] * 7 + [True, False, True]
    # a picture with detail says nothing of the machine's speed
    speed = machine._rays_per_s
    machine._render_img(reported(0.0))
    assert rendered[-1] and machine._rays_per_s == speed
    assert detail.is_shown


def test_the_switch_of_detail_begins_as_the_training_has_it(scene):
    assert [pipeline_of(scene, "test", detail=on).layers.detail.value for on in (False, True)] == [False, True]


def test_a_movement_ends_a_fine_picture_and_no_other(machine):
    for number, (machine.state, machine._is_rendering) in enumerate(
        [("low_move", True), ("middle", False), ("high", False)]
    ):
        machine.action(RenderAction("move", reported(number)))
        assert not machine.interrupt_render_flag
    for number, machine.state in enumerate(("low_static", "middle", "high"), start=10):
        machine._is_rendering, machine.next_action = True, None
        machine.action(RenderAction("move", reported(number)))
        assert machine.interrupt_render_flag, machine.state


def reported(x: float, aspect: float = 1.5) -> CameraState:
    c2w = torch.eye(4, dtype=torch.float64)[:3]
    c2w[0, 3] = x
    return CameraState(1.3, aspect, c2w, CameraType.PERSPECTIVE)


def asked(machine: CoarseToFine) -> tuple[str, float, float] | None:
    """What is rendered next: the action, the place and the aspect ratio."""
    action = machine.next_action
    return (action.action, float(action.camera_state.c2w[0, 3]), action.camera_state.aspect) if action else None


def test_a_browser_that_changes_its_size_does_not_move(machine):
    machine.action(RenderAction("move", reported(0.0)))
    assert machine.next_action.action == "move"
    for aspect in (1.4, 1.3):  # before it is rendered: the movement, as the browser is now
        machine.action(RenderAction("move", reported(0.0, aspect)))
        assert asked(machine) == ("move", 0.0, aspect)
    for aspect, machine.state in ((1.2, "low_move"), (1.1, "low_static"), (1.0, "middle")):
        machine._is_rendering, machine.next_action = True, None
        machine.action(RenderAction("move", reported(1e-7, aspect)))  # as it was rounded on its way
        assert asked(machine) == ("static", 1e-7, aspect)
        assert not machine.interrupt_render_flag, machine.state
    machine.next_action = None
    machine.action(RenderAction("move", reported(1e-7, 1.0)))  # nerfstudio, of a switch in its panel
    assert asked(machine) == ("move", 1e-7, 1.0) and machine.interrupt_render_flag
    machine.next_action = None
    machine.action(RenderAction("move", reported(0.1, 1.2)))
    assert asked(machine) == ("move", 0.1, 1.2) and machine.interrupt_render_flag


@pytest.mark.parametrize("report", ["move", "static"])
def test_a_finished_picture_is_rendered_again_in_another_shape(machine, monkeypatch, report):
    monkeypatch.setattr(RenderStateMachine, "_render_img", lambda *_: {"rgb": torch.zeros(341, 512, 3)})
    machine.action(RenderAction("move", reported(0.0)))
    machine.state, machine.next_action = "high", None
    machine._render_img(reported(0.0))
    for aspect, expected in ((1.505, "static"), (1.4, "step")):
        machine.next_action = None
        machine.action(RenderAction(report, reported(0.0, aspect)))
        assert (asked(machine) or ("",))[0] == expected and not machine.interrupt_render_flag
    assert machine.transitions["high"]["step"] == "high"  # nothing coarse comes in between


def test_the_middle_step_comes_twice_if_it_underrated_the_machine(machine, monkeypatch):
    def rendered(seconds: float) -> str:
        clock = iter([0.0, seconds])
        monkeypatch.setattr(time, "perf_counter", lambda: next(clock))
        machine.state = "middle"
        machine._render_img(reported(0.0))
        return machine.transitions["middle"]["static"]

    monkeypatch.setattr(RenderStateMachine, "_render_img", lambda *_: {"rgb": torch.zeros(160, 240, 3)})
    assert rendered(seconds=1.0) == "middle"  # three seconds are enough for 277 px
    assert rendered(seconds=2.9) == "high"
    assert rendered(seconds=1.0) == "middle"
    monkeypatch.setattr(RenderStateMachine, "_render_img", lambda *_: {"rgb": torch.zeros(341, 512, 3)})
    assert rendered(seconds=0.1) == "high"  # it is the full size


def test_where_a_browser_opened_is_not_rendered(machine, monkeypatch):
    """It still reports that view when it was sent to another one."""
    machine.viewer.get_camera_state = lambda _: reported(5.0)
    monkeypatch.setattr(machine, "start", lambda: None)
    now_s = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now_s)
    machine.begin(reported(0.0))
    assert asked(machine) == ("rerender", 5.0, 1.5)
    machine.next_action = None
    machine.action(RenderAction("move", reported(0.0)))
    assert machine.next_action is None
    machine.action(RenderAction("static", reported(0.0, 1.2)))
    assert asked(machine) == ("static", 5.0, 1.2)
    machine.next_action = None
    machine.action(RenderAction("move", reported(5.0)))  # what the browser says twice while it opens
    assert asked(machine) == ("static", 5.0, 1.5)
    machine.next_action = None
    machine.action(RenderAction("move", reported(6.0)))  # the user, at once
    assert asked(machine) == ("move", 6.0, 1.5)
    now_s += LONGEST_START_S + 1
    machine.next_action = None
    machine.action(RenderAction("move", reported(0.0)))  # and back there, later
    assert asked(machine) == ("move", 0.0, 1.5)


# ---- the viewer itself, during a training ---------------------------------------------------------------------------
@pytest.fixture(scope="module")
def training(tmp_path_factory) -> Iterator[SimpleNamespace]:
    """A training of the sample drive that goes on while it is looked at; `trainer`, `viewer`, `layers`."""
    folder = tmp_path_factory.mktemp("viewer")
    copy_sample_drive(folder / "scene")
    config = deepcopy(all_methods[METHOD])
    config.data = config.pipeline.datamanager.data = folder / "scene"
    config.output_dir, config.timestamp, config.experiment_name = folder, "run", "viewer"
    config.max_num_iterations, config.steps_per_save = 100_000, 100_000
    config.pipeline.datamanager.train_num_rays_per_batch = 128
    shrink(config.pipeline.model, 8, 14)
    config.logging.local_writer.enable = False
    assert config.vis == "viewer"
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        config.viewer.websocket_port = probe.getsockname()[1]
    config.viewer.default_composite_depth = False  # the first steps' fog would hide what is switched on
    config.viewer.quit_on_train_completion = True
    config.get_base_dir().mkdir(parents=True)
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    thread = threading.Thread(target=trainer.train, daemon=True)
    thread.start()
    until(lambda: trainer.step > 5)
    yield SimpleNamespace(
        trainer=trainer, viewer=trainer.viewer_state, layers=trainer.pipeline.layers, scene=folder / "scene"
    )
    trainer.shutdown()
    thread.join(TIMEOUT_S)
    assert not thread.is_alive()


@pytest.mark.parametrize("switched_on", [False, True])
def test_pausing_a_training_asks_for_a_picture_with_detail(training, monkeypatch, switched_on):
    layers, asked = training.trainer.pipeline.layers, []
    monkeypatch.setattr(Viewer, "_trigger_rerender", lambda viewer: asked.append(viewer))
    # the switch itself would ask, too, from a thread of its own
    monkeypatch.setattr(layers, "detail", SimpleNamespace(value=switched_on))
    ours = [each for each in training.viewer.pause_train._impl.update_cb if each.__module__ == layers.__module__]
    assert len(ours) == 1
    ours[0](None)
    assert asked == ([training.viewer] if switched_on else [])


def seen(training, layer: str) -> bool | None:
    """Whether the server has a layer's node shown; None where it has none."""
    frame = training.layers._frames.get(layer)
    return None if frame is None else frame.visible


def nodes(training, layer: str) -> list[str]:
    known = training.viewer.viser_server.scene._handle_from_node_name
    return [name for name in known if name.startswith(f"/drive/{layer}/")]


def test_it_listens_on_this_machine_alone(training):
    server = training.viewer.viser_server
    assert server.get_host() == "127.0.0.1"
    # on Linux another of this machine's own addresses, which a server on every interface answers at
    with pytest.raises(OSError), socket.create_connection(("127.0.0.2", server.get_port()), timeout=5):
        pass
    with socket.create_connection(("127.0.0.1", server.get_port()), timeout=5):
        pass


def test_pictures_are_off_at_first_and_the_path_is_on(training):
    until(lambda: bool(seen(training, "path")))
    handles = training.viewer.viser_server.scene._handle_from_node_name
    assert not nodes(training, "lenses") and handles["/cameras"].visible is False
    training.layers.switches["lenses"].value = True
    until(lambda: bool(seen(training, "lenses")))
    count = len(training.trainer.pipeline.datamanager.train_dataset)
    assert len(nodes(training, "lenses")) == count == 22
    assert {name.rpartition("/")[2] for name in nodes(training, "path")} == {"image_02", "image_03"}
    # nerfstudio's pyramids give way
    assert handles["/cameras"].visible is False
    poses = training.trainer.pipeline.datamanager.train_dataset.cameras.camera_to_worlds
    for index in (0, 13):
        ours, theirs = handles[f"/drive/lenses/{index:05d}"], training.viewer.camera_handles[index]
        assert np.allclose(ours.position, poses[index, :, 3] * VISER_NERFSTUDIO_SCALE_RATIO, atol=1e-5)
        assert np.allclose(ours.position, theirs.position, atol=1e-5)
        assert min(np.abs(ours.wxyz - theirs.wxyz).max(), np.abs(ours.wxyz + theirs.wxyz).max()) < 1e-5


@pytest.mark.parametrize("layer", ["lidar", "prior"])
def test_clouds_are_made_when_first_switched_on_while_training_goes_on(training, layer):
    switch = training.layers.switches[layer]
    assert not nodes(training, layer) and seen(training, layer) is None
    before = training.trainer.step
    switch.value = True
    until(lambda: bool(seen(training, layer)) and not switch.gui_handle.disabled)
    assert nodes(training, layer) == [f"/drive/{layer}/points"]
    switch.value = False
    until(lambda: seen(training, layer) is False)
    until(lambda: training.trainer.step > before + 2)


def test_the_buttons_of_a_training_are_those_of_its_state(training):
    viewer = training.viewer
    assert viewer.pause_train.visible and not (viewer.hide_images.visible or viewer.show_images.visible)
    training.layers.end_training()
    assert not (viewer.pause_train.visible or viewer.resume_train.visible)
    viewer.pause_train.visible = True


def test_a_browser_that_leaves_stops_neither_the_training_nor_other_browsers(training, monkeypatch):
    viewer, server, moves = training.viewer, training.viewer.viser_server, []
    camera = SimpleNamespace(on_update=moves.append, wxyz=(1, 0, 0, 0), position=(0, 0, 0), fov=1.0, aspect=1.0)
    client: Any = SimpleNamespace(client_id=77, camera=camera)
    monkeypatch.setattr(RenderStateMachine, "start", lambda _: None)
    viewer.handle_new_client(client)
    viewer.handle_disconnect(client)
    moves[0](camera)  # begun before it left, as are a film's preview and a step of the training
    until(lambda: not server._websock_server._atomic_lock.locked())
    monkeypatch.setattr(server, "get_clients", lambda: {77: client})
    viewer._trigger_rerender()
    # the training asks, too, and goes on
    announced = viewer.last_step
    until(lambda: viewer.last_step > announced and training.trainer.step > viewer.last_step)


def test_a_file_that_went_away_is_said_and_the_switch_goes_back(training, capsys, monkeypatch):
    def broken(_):
        raise InputError("lidar/7.png: cannot be decoded. Make it again.")

    monkeypatch.setattr(DriveLayers, "_lidar", broken)
    kept = training.layers._frames.pop("lidar", None)
    try:
        switch = training.layers.switches["lidar"]
        switch.value = True
        until(lambda: switch.value is False and not switch.gui_handle.disabled)
        assert "lidar/7.png: cannot be decoded" in " ".join(capsys.readouterr().out.split())
    finally:
        if kept is not None:
            training.layers._frames["lidar"] = kept


# ---- in a browser ----------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def page(browser, training, request):
    """The viewer in a browser without a network, looking at the drive from above; the training waits."""
    # nerfstudio ends a rendering by an exception in any line, which a checker would take for a wrong type
    jaxtyping.config.update("jaxtyping_disable", True)
    request.addfinalizer(lambda: jaxtyping.config.update("jaxtyping_disable", False))
    server = training.viewer.viser_server
    here = f"http://127.0.0.1:{server.get_port()}"
    page = browser.new_page(viewport={"width": 900, "height": 620})
    page.route("**", lambda route: route.continue_() if route.request.url.startswith(here) else route.abort())
    page.goto(here)
    page.wait_for_selector("text=Output type", timeout=TIMEOUT_S * 1000)
    training.viewer.control_panel._max_res.value = 128
    training.trainer.training_state = "paused"
    until(lambda: bool(server.get_clients()), wait=lambda seconds: page.wait_for_timeout(1000 * seconds))
    look_from_above(training)
    yield page
    training.trainer.training_state = "training"


def look_from_above(training) -> None:
    places = training.trainer.pipeline.datamanager.train_dataset.cameras.camera_to_worlds[:, :, 3].numpy()
    centre = places.mean(0) * VISER_NERFSTUDIO_SCALE_RATIO
    for client in training.viewer.viser_server.get_clients().values():
        client.camera.position = tuple(centre + np.array([-4.0, -3.0, 4.0]))
        client.camera.look_at = tuple(centre)


def canvas(page) -> np.ndarray:
    import cv2

    png = page.screenshot(clip={"x": 0, "y": 60, "width": 570, "height": 550})
    return cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(int)


def settled(page, shows: Callable[[np.ndarray], bool] = lambda _: True) -> np.ndarray:
    """The viewport once it holds still and shows what it should: what was asked of it may not have begun yet."""
    pictures = [canvas(page)]

    def still() -> bool:
        pictures.append(canvas(page))
        return bool((np.abs(pictures[-1] - pictures[-2]).max(-1) > 30).mean() < 1e-3) and shows(pictures[-1])

    until(still, wait=lambda seconds: page.wait_for_timeout(10_000 * seconds))
    return pictures[-1]


def changed(one: np.ndarray, other: np.ndarray) -> int:
    return int((np.abs(one - other).max(-1) > 40).sum())


def test_the_page_shows_the_scene(page, training):
    picture = settled(page)
    assert picture.std(axis=(0, 1)).max() > 5  # not blank
    for label in ("Lenses", "Path", "LiDAR points", "Depth prior", "Rendered scan", "Detail of training pictures"):
        assert page.get_by_label(label).count() == 1, label
    until(lambda: "distance_coloured" in training.viewer.control_panel._output_render.options)


def test_a_browser_begins_at_a_training_camera(browser, page, training):
    server = training.viewer.viser_server
    known = set(server.get_clients())
    other = browser.new_page(viewport={"width": 500, "height": 400})
    other.goto(f"http://127.0.0.1:{server.get_port()}")
    until(lambda: bool(set(server.get_clients()) - known), wait=lambda seconds: other.wait_for_timeout(1000 * seconds))
    (number,) = set(server.get_clients()) - known
    dataset = training.trainer.pipeline.datamanager.train_dataset
    pose = dataset.cameras.camera_to_worlds[5].double().numpy()  # of eleven of the first camera
    assert dataset.image_filenames[5].parent == dataset.image_filenames[0].parent
    camera = server.get_clients()[number].camera
    # a client is known before the thread that moves its camera has run
    until(lambda: np.allclose(camera.position, pose[:, 3] * VISER_NERFSTUDIO_SCALE_RATIO, atol=1e-5))
    state = training.viewer.get_camera_state(server.get_clients()[number])
    assert np.allclose(state.c2w, pose, atol=1e-5)
    assert isinstance(training.viewer.render_statemachines[number], CoarseToFine)
    assert training.viewer.step > 5
    assert f"Step: {training.viewer.step} " in training.viewer.stats_markdown.content
    other.close()


def test_a_switch_works(page, training):
    layer = "lidar"
    box = page.get_by_label("LiDAR points")
    begun = bool(training.layers.switches[layer].value)
    before = settled(page)

    def turn(shown: bool, shows: Callable[[np.ndarray], bool]) -> np.ndarray:
        box.click()
        until(
            lambda: training.layers.switches[layer].value is shown and seen(training, layer) is shown,
            wait=lambda seconds: page.wait_for_timeout(1000 * seconds),
        )
        page.mouse.move(300, 300)
        return settled(page, shows)

    other = turn(not begun, lambda picture: changed(before, picture) > 150)
    turn(begun, lambda picture: changed(before, picture) < changed(before, other) / 3)


def test_outputs_and_the_fisheye_preview(page, training):
    def saturation(picture: np.ndarray) -> float:
        return float((picture.max(-1) - picture.min(-1)).mean())

    plain = settled(page)
    training.viewer.control_panel._output_render.value = "distance_coloured"
    settled(page, lambda picture: saturation(picture) > saturation(plain) + 20)
    training.viewer.control_panel._output_render.value = "rgb"
    settled(page, lambda picture: changed(plain, picture) < 5000)

    page.get_by_text("Render", exact=True).first.click()
    page.get_by_label("Camera type").click()
    page.get_by_text("Fisheye", exact=True).click()
    for _ in range(2):
        page.get_by_text("Add Keyframe").click()
        page.wait_for_timeout(1000)
    page.get_by_text("Preview Render").click()
    until(
        lambda: (
            training.viewer.render_tab_state.preview_render
            and training.viewer.render_tab_state.preview_camera_type == "Fisheye"
        ),
        wait=lambda seconds: page.wait_for_timeout(1000 * seconds),
    )
    settled(page, lambda picture: picture[150:400].std() > 5 and changed(plain, picture) > 5000)
