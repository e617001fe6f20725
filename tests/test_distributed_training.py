"""One training over several processes: nerfstudio's DDP around our DataManager and model."""

import subprocess
import sys
from itertools import chain
from pathlib import Path
from typing import Any

import pytest
import torch
from scenes import copy_sample_drive, fisheye, write_scene
from trainings import trainer_of

pytestmark = pytest.mark.slow

HERE = Path(__file__).parent
WORLD_SIZE = 2


@pytest.fixture(scope="module")
def ranks(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    """What each of two processes wrote down that trained together on a scene which nobody had trained on."""
    folder = tmp_path_factory.mktemp("together")
    scene = write_scene(folder / "scene", [fisheye(24, 20)])
    started = []
    for rank in range(WORLD_SIZE):
        command = [sys.executable, HERE / "distributed_rank.py", str(rank), str(WORLD_SIZE), scene, folder]
        with (folder / f"{rank}.log").open("w") as log:
            started.append(subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT))
    for rank, process in enumerate(started):
        assert process.wait(240) == 0, (folder / f"{rank}.log").read_text()[-3000:]
    return [torch.load(folder / f"{rank}.pt", weights_only=True) for rank in range(WORLD_SIZE)]


@pytest.mark.parametrize("which", ["drawn", "further"])
def test_no_ray_is_drawn_twice(ranks: list[dict[str, Any]], which: str) -> None:
    """Of two processes and two steps: 256 of 2880 pixels, and 1024 further ones for the surface."""
    batches = list(chain.from_iterable(found[which] for found in ranks))
    assert len(batches) == 2 * 2 and all(len(batch) > 0 for batch in batches)
    pixels = [tuple(pixel) for batch in batches for pixel in batch.tolist()]
    assert len(set(pixels)) == len(pixels)


def test_what_is_kept_on_disk_is_made_once(ranks: list[dict[str, Any]]) -> None:
    made = [found["made"] for found in ranks]
    # a table of pixels for training and one to evaluate on; their pictures share the one lens
    assert sum(found.get("write_table", 0) for found in made) == 2
    assert sum(found.get("_make", 0) for found in made) == 1


def test_gradients_are_averaged(ranks: list[dict[str, Any]]) -> None:
    assert {"rgb_loss", "edge_loss", "sky_loss", "surface_loss"} <= set(ranks[0]["losses"])
    one, two = ranks
    assert set(one["averaged"]) == set(one["mean"]) == set(one["before"])
    for name, mean in one["mean"].items():
        assert not torch.equal(one["own"][name], two["own"][name]) or not mean.any(), name
        for found in ranks:
            torch.testing.assert_close(found["averaged"][name], mean, rtol=1e-4, atol=1e-7, msg=name)
    assert one["averaged"]["exposure.log_gains"].any(dim=1).all()  # every picture is in some batch


def test_parameters_stay_equal(ranks: list[dict[str, Any]]) -> None:
    one, two = ranks
    assert one["after"]
    for name, value in one["after"].items():
        assert torch.equal(one["before"][name], two["before"][name]), name
        assert torch.equal(value, two["after"][name]), name
        assert not torch.equal(value, one["before"][name]), name


def test_the_first_process_saves_what_one_alone_reads(ranks: list[dict[str, Any]], tmp_path: Path) -> None:
    (checkpoint,) = ranks[0]["checkpoints"]
    scene = Path(checkpoint).parents[5] / "scene"
    trainer = trainer_of(scene, tmp_path, load_dir=Path(checkpoint).parent)
    alone = dict(trainer.pipeline.model.named_parameters())
    assert {name for name, value in alone.items() if len(value)} == set(ranks[0]["after"])
    for name, value in ranks[0]["after"].items():
        assert torch.equal(alone[name], value), name


@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="wants two GPUs")
def test_two_gpus_train_together(tmp_path: Path) -> None:
    command = ["ns-train", "edge-depth-nerf-lite", "--data", str(copy_sample_drive(tmp_path / "scene"))]
    command += ["--machine.num-devices", "2", "--max-num-iterations", "30", "--vis", "tensorboard"]
    command += ["--output-dir", str(tmp_path), "--timestamp", "run"]
    program = Path(sys.executable).with_name(command[0])
    done = subprocess.run([program, *command[1:]], capture_output=True, text=True, check=False, timeout=600)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    assert [path.name for path in tmp_path.rglob("*.ckpt")] == ["step-000000029.ckpt"]
