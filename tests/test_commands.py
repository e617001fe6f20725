"""nerfstudio's own commands on our method and our scene, as a user gives them: offline, on the CPU."""

import gzip
import shutil
import socket
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from host_commands import in_one_process
from nerfstudio.utils.eval_utils import eval_setup
from scenes import fisheye, write_scene

from edge_depth_nerf.base.files import read_json

pytestmark = pytest.mark.slow

METHOD = "edge-depth-nerf-lite"
SMALL = (
    *("--pipeline.datamanager.train-num-rays-per-batch", "128", "--pipeline.model.num-levels", "4"),
    *("--pipeline.model.log2-hashmap-size", "12", "--logging.local-writer.max-log-size", "0", "--vis", "tensorboard"),
    *("--pipeline.model.proposal-net-args-list.0.log2-hashmap-size", "10"),
    *("--pipeline.model.proposal-net-args-list.1.log2-hashmap-size", "10"),
)
LOOK = """
import os, runpy, sys, threading, time, urllib.request
from pathlib import Path

def look():
    page = ""
    while not page:
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{sys.argv[-1]}", timeout=5) as answer:
                page = answer.read().decode()
        except OSError:
            time.sleep(0.1)
    print("the page begins:", page[:100].lower(), flush=True)
    os.kill(os.getpid(), 2)

threading.Thread(target=look, daemon=True).start()
sys.argv[0] = str(Path(sys.executable).with_name("ns-viewer"))
try:
    runpy.run_path(sys.argv[0], run_name="__main__")
except KeyboardInterrupt:
    print("Ctrl-C", flush=True)
"""
"""`ns-viewer`, which does not end by itself, is looked at and ended."""


TRAIN = """
import runpy, sys
from pathlib import Path
from edge_depth_nerf.plugin.trainer import EdgeDepthTrainer

save = EdgeDepthTrainer.save_checkpoint

def save_and_stop(trainer, step):
    save(trainer, step)
    if step == 20:
        sys.exit()

EdgeDepthTrainer.save_checkpoint = save_and_stop
sys.argv[0] = str(Path(sys.executable).with_name("ns-train"))
try:
    runpy.run_path(sys.argv[0], run_name="__main__")
finally:
    EdgeDepthTrainer.save_checkpoint = save
"""
"""`ns-train` that gets no further than its fourth checkpoint, and leaves what a killed one does."""


@pytest.fixture(scope="module")
def torch_home(tmp_path_factory) -> Path:
    """nerfstudio's own methods demand AlexNet's weights; random ones do to see whether they read our scene."""
    from torchvision.models import alexnet

    home = tmp_path_factory.mktemp("torch_home")
    checkpoints = home / "hub" / "checkpoints"
    checkpoints.mkdir(parents=True)
    with torch.device("meta"):
        weights = alexnet(weights=None).state_dict()
    # the classifier, which is large, is one number
    made = {name: torch.randn(1 if "classifier" in name else each.shape) for name, each in weights.items()}
    made = {name: each.expand(weights[name].shape) for name, each in made.items()}
    torch.save(made, checkpoints / "alexnet-owt-7be5be79.pth")
    return home


def commands_of(killed_run: Path, scene: Path, outputs: Path) -> dict[str, list[object]]:
    """Words of the commands that are run in one process, each with an output folder of its name."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    load = ("--load-config", killed_run / "config.yml")
    train = ("--output-dir", outputs / "host", "--machine.device-type", "cpu", "--timestamp", "run")
    own = ("--experiment-name", "host", "--max-num-iterations", 3, "--pipeline.model.implementation", "torch")
    data = ("fisheye-depth-data", "--data", scene)
    return {
        "killed": [
            *("python", outputs / "train.py", METHOD, "--data", scene, "--output-dir", killed_run.parents[2]),
            *("--experiment-name", "killed", "--timestamp", "run", "--max-num-iterations", 100000),
            *("--steps-per-save", 5, *SMALL),
        ],
        "eval": ["ns-eval", *load, "--output-path", outputs / "eval" / "figures.json"],
        "dataset": [
            *("ns-render", "dataset", *load, "--output-path", outputs / "dataset", "--split", "test"),
            *("--rendered-output-names", "rgb", "depth", "raw-depth", "distance_coloured", "--image-format", "png"),
        ],
        "interpolate": [
            *("ns-render", "interpolate", *load, "--interpolation-steps", 2, "--pose-source", "train"),
            *("--output-path", outputs / "interpolate" / "film.mp4"),
        ],
        "pointcloud": [
            *("ns-export", "pointcloud", *load, "--output-dir", outputs / "pointcloud", "--num-points", 500),
            *("--num-rays-per-batch", 256, "--normal-method", "open3d", "--save-world-frame", "True"),
            *("--remove-outliers", "False", "--reorient-normals", "False"),
        ],
        "resumed": [
            *("ns-train", METHOD, "--data", scene, "--output-dir", outputs / "resumed"),
            *("--experiment-name", "resumed", "--timestamp", "run", "--max-num-iterations", 7),
            *("--load-dir", killed_run / "nerfstudio_models", *SMALL),
        ],
        "depth-nerfacto": [
            *("ns-train", "depth-nerfacto", *train, *own, *SMALL, "--pipeline.model.is-euclidean-depth", "True"),
            *data,
        ],
        "viewer": [
            *("python", outputs / "look.py", "--load-config", killed_run / "config.yml"),
            *("--viewer.websocket-host", "127.0.0.1", "--viewer.websocket-port", port),
        ],
    }


@pytest.fixture(scope="module")
def outputs(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("outputs")


@pytest.fixture(scope="module")
def killed_run(outputs, done) -> Path:
    done("killed")
    return outputs / "killed" / METHOD / "run"


@pytest.fixture(scope="module")
def done(torch_home, outputs) -> Callable[[str], tuple[str, Path]]:
    """Asserts that a command ended well; returns what it said and where it wrote."""
    scene = write_scene(outputs / "scene", [fisheye(24, 20)], frames=13)
    commands = commands_of(outputs / "killed" / METHOD / "run", scene, outputs)
    for name in commands:
        (outputs / name).mkdir()
    (outputs / "train.py").write_text(TRAIN)
    (outputs / "look.py").write_text(LOOK)
    ended_well = in_one_process(commands, outputs, {"depth-nerfacto": {"TORCH_HOME": str(torch_home)}})
    return lambda name: (ended_well(name), outputs / name)


def last_step(run: Path) -> int:
    return max(int(path.stem[5:]) for path in (run / "nerfstudio_models").glob("step-*.ckpt"))


def test_a_killed_run_gives_figures(done):
    figures = read_json(done("eval")[1] / "figures.json")["results"]
    for name in ("psnr", "ssim", "masked_psnr", "masked_ssim", "truth_masked_psnr", "lidar_abs_rel", "truth_abs_rel"):
        assert np.isfinite(figures[name]), name
    assert figures["lidar_pixels"] > 20


def test_what_is_loaded_is_what_was_saved(killed_run):
    """nerfstudio falls back to a lenient load without a word; so every tensor is compared."""
    _, pipeline, checkpoint, _ = eval_setup(killed_run / "config.yml", test_mode="inference")
    saved = torch.load(checkpoint, map_location="cpu", weights_only=True)["pipeline"]
    loaded = pipeline.state_dict()
    assert set(saved) == set(loaded)
    assert all(torch.equal(saved[name], loaded[name]) for name in saved)


def test_a_killed_run_is_taken_up_again(killed_run, done):
    step = last_step(killed_run)
    assert step == 20
    said, output = done("resumed")
    assert f"step-{step:09d}.ckpt" in said.replace("\n", "")
    resumed = output / "resumed" / METHOD / "run"
    assert last_step(resumed) == step + 7
    assert not list(resumed.glob(".unfinished*"))
    before, after = (
        torch.load(run / "nerfstudio_models" / f"step-{last_step(run):09d}.ckpt", weights_only=True)
        for run in (killed_run, resumed)
    )
    ages = [next(iter(saved["optimizers"]["fields"]["state"].values()))["step"] for saved in (before, after)]
    assert ages[1] == ages[0] + 7  # the optimiser's moments went on, too


def test_render_dataset(killed_run, done):
    _, output = done("dataset")
    rendered = cv2.imread(str(output / "test" / "rgb" / "0004.png"))
    assert rendered.shape == (20, 24, 3)
    assert cv2.imread(str(output / "test" / "distance_coloured" / "0004.png")).shape == (20, 24, 3)
    with gzip.open(output / "test" / "raw-depth" / "0012.npy.gz") as file:
        distance_m = np.load(file)
    assert distance_m.shape == (20, 24, 1)
    _, pipeline, _, _ = eval_setup(killed_run / "config.yml", test_mode="test")
    dataset = pipeline.datamanager.eval_dataset
    assert dataset is not None
    outputs = pipeline.model.get_outputs_for_camera(dataset.cameras[1:2])
    expected_m = outputs["depth"].numpy() * pipeline.model.metres_per_unit
    assert np.nanmax(np.abs(distance_m / expected_m - 1)) < 1e-3


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="ns-render interpolate writes videos with ffmpeg")
def test_render_interpolate(done):
    film = cv2.VideoCapture(str(done("interpolate")[1] / "film.mp4"))
    assert film.get(cv2.CAP_PROP_FRAME_COUNT) > 2


def test_export_pointcloud(done):
    try:
        import open3d  # noqa: F401
    except (ImportError, OSError):
        pytest.skip("open3d cannot be imported (Debian: apt-get install libusb-1.0-0)")
    header = (done("pointcloud")[1] / "point_cloud.ply").read_bytes()[:300].decode("latin1")
    assert int(header.split("element vertex ")[1].split()[0]) >= 500


def test_viewer(done):
    assert "the page begins: <!doctype html" in done("viewer")[0]


def test_the_hosts_method_with_depth_reads_our_scene(done):
    run = done("depth-nerfacto")[1].parent / "host" / "host" / "depth-nerfacto" / "run"
    assert last_step(run) == 2
