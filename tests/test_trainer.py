"""Ctrl-C during a training: the step is finished, saved, and can be gone on from."""

from __future__ import annotations

import contextlib
import io
import os
import re
import shlex
import shutil
import signal
from copy import deepcopy
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from nerfstudio.configs.method_configs import all_methods
from nerfstudio.engine.trainer import Trainer
from nerfstudio.pipelines.base_pipeline import Pipeline
from nerfstudio.viewer.viewer import Viewer
from scenes import fisheye, transforms, write_scene
from trainings import trainer_of

from edge_depth_nerf import cli
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.compare.options import CompareOptions
from edge_depth_nerf.films.options import CameraPathOptions
from edge_depth_nerf.jobs.runs import newest_checkpoint
from edge_depth_nerf.kernels.threads import kernel_threads
from edge_depth_nerf.plugin.config import apply_overrides
from edge_depth_nerf.plugin.grad_scaler import PatientGradScaler
from edge_depth_nerf.plugin.model import EdgeDepthNerfModel
from edge_depth_nerf.plugin.pipeline import EdgeDepthPipeline
from edge_depth_nerf.plugin.settings import WITHOUT_EFFECT, check_effect, flattened
from edge_depth_nerf.plugin.trainer import EdgeDepthTrainer

STEPS = 4


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("scene"), [fisheye(24, 20)])


@pytest.fixture(autouse=True)
def wide_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "300")


@pytest.fixture
def trainer(scene: Path, tmp_path: Path) -> EdgeDepthTrainer:
    return trainer_of(scene, tmp_path / "runs", max_num_iterations=STEPS)


@pytest.fixture(scope="module")
def trained(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[EdgeDepthTrainer, str]:
    """A training to its end, and what it said, of every step it can."""
    said = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(said):
        patch.setenv("COLUMNS", "300")
        patch.setattr("edge_depth_nerf.plugin.trainer.TOLD_EVERY_S", 0.0)
        patch.setattr("edge_depth_nerf.plugin.trainer.TOLD_EVERY_SHARE", 0.0)
        whole = trainer_of(scene, tmp_path_factory.mktemp("trained"), max_num_iterations=STEPS)
        whole.train()
    return whole, said.getvalue()


def ctrl_c_within(trainer: EdgeDepthTrainer, at: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Send it in the middle of a step, between the losses and their gradients."""
    pipeline = trainer.pipeline
    given = pipeline.get_train_loss_dict

    def interrupted(*, step: int):
        result = given(step=step)
        if step == at:
            signal.raise_signal(signal.SIGINT)
        return result

    monkeypatch.setattr(pipeline, "get_train_loss_dict", interrupted)


def parameters(pipeline: Pipeline) -> dict[str, torch.Tensor]:
    return {name: value.detach().clone() for name, value in pipeline.model.named_parameters()}


def test_ctrl_c_finishes_the_step_saves_it_and_says_how_to_go_on(trainer, tmp_path, monkeypatch, capsys):
    before = signal.getsignal(signal.SIGINT)
    ctrl_c_within(trainer, 2, monkeypatch)
    with pytest.raises(SystemExit) as ended:
        trainer.train()
    assert ended.value.code == 130
    assert signal.getsignal(signal.SIGINT) is before
    assert os.listdir(trainer.checkpoint_dir) == ["step-000000002.ckpt"]
    said = capsys.readouterr().out
    assert "Stopped after step 2; its checkpoint is saved." in said and "Traceback" not in said
    folder, left = trainer.checkpoint_dir, STEPS - 3
    assert f"--load-dir {folder} --max-num-iterations {left}" in said
    again = trainer_of(trainer.config.data, tmp_path / "again", load_dir=folder, max_num_iterations=left)
    expected = parameters(trainer.pipeline)
    assert all(torch.equal(value, expected[name]) for name, value in parameters(again.pipeline).items())
    again.train()
    assert os.listdir(again.checkpoint_dir) == [f"step-{STEPS - 1:09}.ckpt"]


def test_lambda_falls_over_the_whole_training_also_of_one_taken_up_again(trained, tmp_path):
    trainer = trained[0]
    whole = trainer.pipeline.model
    assert isinstance(whole, EdgeDepthNerfModel)
    assert whole.config.depth_loss_final == 0.01
    assert whole.weights_now()[0] == pytest.approx(whole.config.depth_loss_mult * 0.01 ** ((STEPS - 1) / STEPS))
    folder = trainer.checkpoint_dir
    longer = trainer_of(trainer.config.data, tmp_path / "longer", load_dir=folder, max_num_iterations=STEPS)
    longer.train()
    model = longer.pipeline.model
    assert isinstance(model, EdgeDepthNerfModel)
    share = 0.01 ** ((2 * STEPS - 1) / (2 * STEPS))
    assert model.weights_now()[0] == pytest.approx(whole.config.depth_loss_mult * share)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"model__exposure": "none"}, r"optimisers do not fit .* exposure, camera-optimizer\.mode"),
        ({"model__exposure": "embedding"}, r"field\.mlp_head.* have other sizes than here\. Load it with the options"),
        ({"model__max_res": 1024}, r"was made with .* grids of 16, 2048, .* cells; here are .* grids of 16, 1024, "),
        ({"parser__metres_per_unit": 20.0}, r"made with 10 m a unit, .*; here are 20 m a unit"),
        ({"parser__metres_per_unit": 10.04}, r"made with 10 m a unit, .*; here are 10\.04 m a unit"),
        ({"parser__center_method": "none"}, r"the origin at .*; here are .*, the origin at -?0, -?0, -?0 m"),
    ],
)
def test_a_training_is_resumed_with_its_own_options(trained, tmp_path, changes, said):
    with pytest.raises(InputError, match=f"^The checkpoint(?:'s)? .*{said}"):
        trainer_of(trained[0].config.data, tmp_path, load_dir=trained[0].checkpoint_dir, **changes)


def test_a_training_is_not_taken_to_fewer_pictures(trained, tmp_path):
    scene = shutil.copytree(trained[0].config.data, tmp_path / "scene")
    with transforms(scene) as meta:
        meta["train_filenames"].pop()
    with pytest.raises(InputError, match=r"exposure\.log_gains have other sizes than here"):
        trainer_of(scene, tmp_path, load_dir=trained[0].checkpoint_dir)


def test_a_checkpoint_without_scale_is_loaded(trained, tmp_path):
    """Those of earlier versions have none."""
    newest = newest_checkpoint(trained[0].checkpoint_dir)
    assert newest is not None
    saved = torch.load(newest)
    assert saved["pipeline"].pop("made_with")[3] == pytest.approx(10)
    torch.save(saved, tmp_path / newest.name)
    trainer_of(trained[0].config.data, tmp_path / "runs", load_dir=tmp_path, model__max_res=1024)


def test_in_a_step_torch_has_one_thread_and_the_kernels_have_all(trainer, monkeypatch):
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    seen = []
    given = trainer.pipeline.get_train_loss_dict

    def watched(*, step: int):
        seen.append((torch.get_num_threads(), kernel_threads()))
        return given(step=step)

    monkeypatch.setattr(trainer.pipeline, "get_train_loss_dict", watched)
    try:
        trainer.train_iteration(0)
        # nerfstudio's own code in torch is left as it is
        trainer.pipeline.model.fused = False
        trainer.train_iteration(1)
        assert seen == [(1, 3), (3, 3)]
        assert torch.get_num_threads() == kernel_threads() == 3
    finally:
        torch.set_num_threads(before)


def test_ctrl_c_in_the_last_step_leaves_nothing_to_go_on_with(trainer, monkeypatch, capsys):
    ctrl_c_within(trainer, STEPS - 1, monkeypatch)
    with pytest.raises(SystemExit):
        trainer.train()
    said = capsys.readouterr().out
    assert f"Stopped after step {STEPS - 1}; its checkpoint is saved.\n" in said and "--load-dir" not in said


def test_ctrl_c_while_a_checkpoint_is_written_leaves_it_whole(trainer, monkeypatch):
    save = torch.save

    def interrupted(*arguments, **options):
        monkeypatch.setattr(torch, "save", save)  # once
        signal.raise_signal(signal.SIGINT)
        save(*arguments, **options)

    monkeypatch.setattr(torch, "save", interrupted)
    trainer.train()  # the last checkpoint: training is complete
    assert os.listdir(trainer.checkpoint_dir) == [f"step-{STEPS - 1:09}.ckpt"]


def test_ctrl_c_ends_the_viewer_of_a_complete_training_without_error(trainer, monkeypatch, capsys):
    after = trainer._after_train

    def waits() -> None:
        after()
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(trainer, "_after_train", waits)
    trainer.train()
    assert "Stopped" not in capsys.readouterr().out


def test_detail_appears_when_training_ends(trainer, monkeypatch):
    """The picture that the viewer shows is of before; nothing else asks for another one."""
    asked = []
    viewer = object.__new__(Viewer)
    monkeypatch.setattr(Viewer, "_trigger_rerender", lambda _: asked.append(trainer.pipeline.layers.shows_detail()))
    monkeypatch.setattr(Trainer, "_train_complete_viewer", lambda _: asked.append("waits"))
    monkeypatch.setattr(trainer, "viewer_state", viewer)
    layers = trainer.pipeline.layers
    button = SimpleNamespace(visible=True)
    viewer_of_layers = SimpleNamespace(trainer=trainer, pause_train=button, resume_train=button)
    monkeypatch.setattr(layers, "viewer", viewer_of_layers, raising=False)
    for switched_on, expected in ((False, ["waits"]), (True, [True, "waits"])):
        asked.clear()
        trainer.training_state, button.visible = "training", True
        layers.detail.value = switched_on
        assert not layers.shows_detail()
        trainer._train_complete_viewer()
        assert asked == expected
        assert not button.visible, "nothing can be paused any more"


def test_a_relative_scene_is_said_to_be_relative(trainer, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    trainer.config.pipeline.datamanager.data = Path("elsewhere")
    with pytest.raises(FileNotFoundError, match=f"searched in {tmp_path}: relative paths start at the current folder"):
        trainer.config.save_config()


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("pipeline.model.near_plane", 1.0, "--pipeline.model.near-plane has no effect: use --pipeline.model.near-m"),
        ("pipeline.datamanager.pixel_sampler.ignore_mask", True, "pixel-sampler.ignore-mask has no effect: leave it"),
        ("pipeline.datamanager.patch_size", 4, "--pipeline.datamanager.patch-size has no effect: leave it out"),
        ("pipeline.datamanager.dataparser.mask_color", (0, 0, 0), "fisheye-depth-data --mask-color has no effect"),
        ("pipeline.model.background_color", "white", "leave it out, or add --pipeline.model.depth-loss none"),
    ],
)
def test_settings_without_effect_are_refused(trainer, name, value, said):
    config = deepcopy(all_methods["edge-depth-nerf-lite"])
    config.pipeline.datamanager.data = trainer.config.pipeline.datamanager.data
    check_effect(config._changed(), has_sky=True)
    apply_overrides(config, {name: value}, "test")
    with pytest.raises(InputError, match=said):
        config.save_config()
    # without a sky, nerfstudio's backgrounds have their effect
    config.pipeline.model.depth_loss = "none"
    if "background" in name:
        config.save_config()


def test_settings_without_effect_are_there():
    names = {*flattened(all_methods["edge-depth-nerf-lite"])}
    assert [option for option in WITHOUT_EFFECT if not any(f"{name}.".startswith(f"{option}.") for name in names)] == []


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_configuration_of_a_gpu_is_not_trained_without_one(trainer):
    trainer.config.machine.device_type = "cuda"
    with pytest.raises(InputError, match=r"finds no GPU here .* Add --machine.device-type cpu"):
        trainer.config.save_config()
    assert not (trainer.config.get_base_dir() / "config.yml").exists()


def test_the_full_model_without_a_gpu_is_advised_against(scene, tmp_path, capsys):
    for method, said in (("edge-depth-nerf-lite", False), ("edge-depth-nerf", True)):
        trainer_of(scene, tmp_path / method, method_name=method)
        assert ("edge-depth-nerf-lite takes minutes" in " ".join(capsys.readouterr().out.split())) is said


def test_a_prior_of_lidar_alone_is_said(capsys, trainer, tmp_path):
    """Not so of a drive without LiDAR, whose distances from motion are the prior."""
    of_both = capsys.readouterr().out
    trainer_of(write_scene(tmp_path / "no mono", mono=False, frames=3), tmp_path / "runs")
    assert "LiDAR alone" in capsys.readouterr().out
    scene = write_scene(tmp_path / "motion", lidar=False, frames=3)
    with transforms(scene) as meta:
        for frame in meta["frames"]:
            frame["motion_file_path"] = frame.pop("mono_file_path")
    trainer_of(scene, tmp_path / "runs")
    for said in (of_both, capsys.readouterr().out):
        assert " Prior: " in said and "LiDAR alone" not in said


@pytest.mark.parametrize("logged", [True, False])
def test_logged_gradients_are_those_of_tables_too(scene, tmp_path, logged):
    """Without the log a table has none: its optimiser sums it up level by level."""
    trainer = trainer_of(scene, tmp_path / "runs", max_num_iterations=1, log_gradients=logged)
    trainer.train_iteration(0)
    tables = {name: each for name, each in trainer.pipeline.model.named_parameters() if "hash_table" in name}
    assert tables and {each.grad is not None for each in tables.values()} == {logged}


def test_checkpoints_may_go_to_another_place(scene, tmp_path):
    folder = tmp_path / "elsewhere" / "checkpoints"
    trainer = trainer_of(scene, tmp_path / "runs", max_num_iterations=1, relative_model_dir=folder)
    trainer.save_checkpoint(0)
    assert [path.name for path in folder.parent.iterdir()] == ["checkpoints"]
    assert [path.name for path in folder.iterdir()] == ["step-000000000.ckpt"]


@pytest.mark.parametrize(("work", "within"), [("train", "_init_viewer_state"), ("setup", "setup_optimizers")])
def test_ctrl_c_before_the_first_step(trainer, monkeypatch, capsys, work, within):
    monkeypatch.setattr(trainer, within, lambda: signal.raise_signal(signal.SIGINT))
    with pytest.raises(SystemExit) as ended:
        getattr(trainer, work)()
    assert newest_checkpoint(trainer.checkpoint_dir) is None
    assert ended.value.code == 130 and "Stopped before the first step." in capsys.readouterr().out


def test_a_checkpoint_of_the_full_preset_on_a_cpu_is_taken_up_on_a_gpu_and_back(trained, trainer, monkeypatch):
    """What mixed precision keeps is nothing on a CPU; a scaler of a GPU begins anew, and its state harms no CPU."""
    monkeypatch.setattr("torch.cuda.amp.common.amp_definitely_not_available", lambda: False)
    scalers, folder = [], trained[0].checkpoint_dir
    for enabled in (True, False):
        newest = newest_checkpoint(folder)
        assert newest is not None
        scalers.append(torch.load(newest)["scalers"])
        # as a trainer with this scaler takes it up, and saves it again
        trainer.grad_scaler, trainer.config.load_dir = PatientGradScaler(enabled=enabled), folder
        trainer._load_checkpoint()
        folder = trainer.checkpoint_dir
        trainer.save_checkpoint(STEPS + len(scalers))
    assert scalers[0] == {} and scalers[1]["scale"] == 2.0**16


def test_a_training_says_where_it_is_and_ends_with_the_next_commands(trained):
    trainer, said = trained
    lines = re.findall(r"^Step (\d) of 4: loss (\d\.\d+), held-out PSNR (\d+\.\d) dB; .* rays/s(.*)$", said, re.M)
    assert [line[0] for line in lines] == ["2", "3", "4"]
    assert all(line[3].endswith("to go") for line in lines[:-1]) and lines[-1][3] == ""
    assert float(lines[-1][2]) == pytest.approx(trainer.pipeline.held_out_psnr(), abs=3)
    config = trainer.base_dir / "config.yml"
    found = dict(re.findall(r"^([A-Z][a-z ]+): ((?:ns-|edge-depth-nerf ).*)$", said, re.M))
    assert list(found) == ["View it", "Evaluate it", "Make a film", "Compare"]
    assert all(f"--load-config {config}" in found[what] for what in ("View it", "Evaluate it", "Make a film"))
    film, compared = (cli.parse(shlex.split(found[what])[1:]) for what in ("Make a film", "Compare"))
    assert isinstance(film, CameraPathOptions) and film.load_config == config
    assert isinstance(compared, CompareOptions) and compared.scenes == (trainer.config.data,)
    assert compared.preset == "lite"


def test_asking_for_held_out_psnr_changes_no_training(trainer, tmp_path):
    other = trainer_of(trainer.config.data, tmp_path / "other", max_num_iterations=STEPS)
    for step in range(3):
        for each in (trainer, other):
            torch.manual_seed(step)
            each.train_iteration(step)
        assert isinstance(other.pipeline, EdgeDepthPipeline) and 5 < other.pipeline.held_out_psnr() < 40
    expected = parameters(trainer.pipeline)
    assert all(torch.equal(value, expected[name]) for name, value in parameters(other.pipeline).items())
