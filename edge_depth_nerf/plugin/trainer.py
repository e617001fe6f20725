"""A trainer whose runs can be stopped and resumed at any time, and that stops at numbers that are not finite."""

from __future__ import annotations

import dataclasses
import os
import shlex
import shutil
import signal
import threading
import time
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
import yaml
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.engine.trainer import TRAIN_INTERATION_OUTPUT, Trainer, TrainerConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig
from nerfstudio.utils.decorators import check_main_thread
from nerfstudio.utils.rich_utils import CONSOLE
from nerfstudio.viewer.viewer import Viewer

from edge_depth_nerf.base.console import say
from edge_depth_nerf.base.errors import STOPPED_STATUS, InputError
from edge_depth_nerf.base.files import remove_leftovers, write_text
from edge_depth_nerf.base.interrupts import ctrl_c_put_off
from edge_depth_nerf.jobs.runs import checkpoints_in, commands_after, newest_checkpoint
from edge_depth_nerf.kernels.table_adam import TableAdam
from edge_depth_nerf.kernels.threads import torch_on_one_thread
from edge_depth_nerf.plugin.compat import ignore_deprecations_of_host, total_steps
from edge_depth_nerf.plugin.datamanager import FisheyeDepthDataManager
from edge_depth_nerf.plugin.dataparser import FisheyeDepthDataParserConfig, transforms_path
from edge_depth_nerf.plugin.grad_scaler import PatientGradScaler
from edge_depth_nerf.plugin.model import ModelOptions
from edge_depth_nerf.plugin.pipeline import EdgeDepthPipeline, NotFiniteError
from edge_depth_nerf.plugin.plain_errors import say_errors_plainly
from edge_depth_nerf.plugin.settings import as_typed, changed_settings, check_effect
from edge_depth_nerf.plugin.step_graphs import Capture, GpuCapture, StepGraphs, why_not

TOLD_EVERY_S, TOLD_EVERY_SHARE = 10.0, 0.05
"""Training prints a line after so many seconds, and after this share of the time since it began."""
PRESETS = {"edge-depth-nerf": "full", "edge-depth-nerf-paper": "paper"}
"""Methods with full-size models, meant for a GPU, and what `compare` calls their settings."""


@dataclass
class TrainingOptions:
    """Our options and the most used of nerfstudio's, before its others in the help."""

    data: Path | None = None
    max_num_iterations: int = 0
    cuda_graphs: bool = True
    """On a GPU, launch a step's kernels as one: several times faster, same results (docs/gpu.md)."""
    pipeline: VanillaPipelineConfig = field(default_factory=VanillaPipelineConfig)


@dataclass
class EdgeDepthTrainerConfig(TrainerConfig, TrainingOptions):
    """nerfstudio's trainer with atomic checkpoints and a check for finite numbers."""

    _target: type = field(default_factory=lambda: EdgeDepthTrainer)
    """Target class to instantiate."""

    def _changed(self) -> dict[str, Any]:
        """Give the settings that differ from the method's own."""
        from nerfstudio.configs.method_configs import all_methods  # imports this plugin's methods

        return changed_settings(self, all_methods.get(str(self.method_name), self))

    def print_to_terminal(self) -> None:
        """Print what is trained, and the settings that differ from the method's own; config.yml has all of them."""
        scene = self.pipeline.datamanager.data
        lines = [f"{self.method_name}: {self.max_num_iterations} steps on {self.machine.device_type}, scene {scene}"]
        for name, value in self._changed().items():
            lines.append(f"  {as_typed(name)} {value.__qualname__ if isinstance(value, type) else value}")
        say(CONSOLE, "\n".join(lines))

    def save_config(self) -> None:
        """Save config.yml as nerfstudio does, but atomically: half a file could not be loaded.

        Raises:
            FileNotFoundError: there is no scene at `--data`; then nothing is written.
            InputError: it is to train on a GPU where there is none, or a changed setting has no effect.
        """
        say_errors_plainly()
        ignore_deprecations_of_host()
        model = self.pipeline.model
        check_effect(self._changed(), isinstance(model, ModelOptions) and model.has_sky)
        if self.machine.device_type == "cuda" and not torch.cuda.is_available():
            raise InputError(
                "--machine.device-type cuda: torch finds no GPU here (`edge-depth-nerf doctor` says why). Add "
                "--machine.device-type cpu."
            )
        data: Any = self.pipeline.datamanager
        if isinstance(data.dataparser, FisheyeDepthDataParserConfig):
            transforms_path(Path(data.data or data.dataparser.data))
        path = self.get_base_dir() / "config.yml"
        CONSOLE.log(f"Saving config to: {path}")
        write_text(path, yaml.dump(self))
        remove_leftovers(path.parent)


class EdgeDepthTrainer(Trainer):
    """nerfstudio's trainer with atomic checkpoints and a check for finite numbers.

    Ctrl-C ends it after the current step, with a checkpoint of that step and a line on how to resume.
    """

    config: EdgeDepthTrainerConfig  # pyrefly: ignore

    def __init__(self, config: EdgeDepthTrainerConfig, local_rank: int = 0, world_size: int = 1) -> None:
        """Initialise it as nerfstudio's Trainer."""
        super().__init__(config, local_rank, world_size)
        self.grad_scaler = PatientGradScaler(enabled=self.use_grad_scaler and self.device != "cpu")  # pyrefly: ignore
        self._last_step: int | None = None  # of this process
        self.graphs: StepGraphs | None = None
        self._progress = _Progress()

    def setup(self, test_mode: Literal["test", "val", "inference"] = "val") -> None:
        """Set up as nerfstudio does; Ctrl-C ends it with one line."""
        if self.device == "cpu" and self.config.method_name in PRESETS and test_mode == "val":
            CONSOLE.print(
                f"[yellow]{self.config.method_name} is meant for a GPU, but this training uses the CPU: expect hours. "
                "edge-depth-nerf-lite takes minutes."
            )
        try:
            super().setup(test_mode)
            if self.config.cuda_graphs and test_mode != "inference" and torch.device(self.device).type == "cuda":
                self._use_graphs(GpuCapture(self.device))
        except KeyboardInterrupt:
            CONSOLE.print("\nStopped before the first step.")
            raise SystemExit(STOPPED_STATUS) from None

    def _use_graphs(self, capture: Capture) -> None:
        reason = why_not(self)
        if reason is None:
            self.graphs = StepGraphs(self, capture)
        else:
            CONSOLE.print(f"[yellow]Training goes without CUDA graphs: {reason}.")

    def setup_optimizers(self) -> Optimizers:
        """Set up as nerfstudio does; where it logs gradients, hash tables have whole ones."""
        optimizers = super().setup_optimizers()
        if self.config.log_gradients:
            for optimizer in optimizers.optimizers.values():
                if isinstance(optimizer, TableAdam):
                    optimizer.want_whole_gradients()
        return optimizers

    def train(self) -> None:
        """Train as nerfstudio does.

        Raises:
            SystemExit: after Ctrl-C, with status 130 and a checkpoint of the last step. After a completed training
                Ctrl-C only closes the viewer, and is no error.
        """
        if self.world_size > 1 or threading.current_thread() is not threading.main_thread():
            super().train()  # nerfstudio ends the processes of its ranks; only the main thread receives signals
            return
        before = signal.signal(signal.SIGINT, signal.default_int_handler)
        try:
            super().train()
        except KeyboardInterrupt:
            if self.training_state != "completed":
                self._stop()
        finally:
            signal.signal(signal.SIGINT, before)

    def _stop(self) -> None:
        if self._last_step is None:
            CONSOLE.print("\nStopped before the first step.")
        else:
            self.save_checkpoint(self._last_step)
            remaining = total_steps(self) - self._last_step - 1
            said = f"\nStopped after step {self._last_step}; its checkpoint is saved."
            if remaining:
                folder = shlex.quote(str(self.checkpoint_dir))
                said += (
                    f" To resume, add this to the same command: --load-dir {folder} --max-num-iterations {remaining}"
                )
            say(CONSOLE, said)
        raise SystemExit(STOPPED_STATUS) from None

    def _train_complete_viewer(self) -> None:
        """End the viewer's training, show detail if its switch asks for it, and wait for Ctrl-C as nerfstudio does."""
        viewer, pipeline = self.viewer_state, self.pipeline
        if isinstance(pipeline, EdgeDepthPipeline) and isinstance(viewer, Viewer):
            pipeline.layers.end_training()
            if pipeline.layers.detail.value:
                self.training_state = "completed"
                viewer._trigger_rerender()
        super()._train_complete_viewer()

    def train_iteration(self, step: int) -> TRAIN_INTERATION_OUTPUT:
        """Do a step as nerfstudio does.

        Raises:
            InputError: a loss was not finite. The message names the pictures and the last checkpoint.
        """
        # the fused kernels on the CPU get the threads
        fused = self.device == "cpu" and getattr(self.pipeline.model, "fused", False)
        try:
            with ctrl_c_put_off(), torch_on_one_thread() if fused else nullcontext():
                result = None if self.graphs is None else self.graphs.step(step)
                if result is None:
                    result = super().train_iteration(step)
                self._last_step = step
            self.tell(step, result[0])
            return result
        except NotFiniteError as error:
            raise InputError(f"{error} {self._kept()}") from error

    def tell(self, step: int, loss: torch.Tensor) -> None:
        """Print a line on the training, if it is time."""
        if self.local_rank == 0:
            self._progress.note(step, loss, self)

    def _check_viewer_warnings(self) -> None:
        """Leave out nerfstudio's note that nothing is evaluated."""

    def _after_train(self) -> None:
        """Do as nerfstudio does, and say what comes next before the viewer waits."""
        if self.local_rank == 0:
            at_end = TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN], lambda step: self._say_next())
            self.callbacks.append(at_end)
        super()._after_train()

    def _say_next(self) -> None:
        config, preset = self.base_dir / "config.yml", PRESETS.get(str(self.config.method_name), "lite")
        manager = self.pipeline.datamanager
        assert isinstance(manager, FisheyeDepthDataManager)
        # without held-out pictures of its own, or without depth, there is nothing to compare
        compares = manager.train_dataset.scene.split_known and manager.config.depth_source != "none"
        commands = commands_after(config, Path(manager.get_datapath()), preset, compares)
        lines = [f"{what}: {command}" for what, command in commands.items()]
        say(CONSOLE, "\n".join(lines))

    @check_main_thread
    @ctrl_c_put_off()
    def save_checkpoint(self, step: int) -> None:
        """Save into a folder beside the checkpoints, then move the complete file into theirs.

        nerfstudio writes directly into the checkpoint folder, so a kill while writing leaves half a file as the newest
        checkpoint. Ours is outside, because resuming parses every name in the checkpoint folder.

        Raises:
            InputError: a parameter is not finite, or the file cannot be written. The checkpoint before is kept.
        """
        pipeline: Any = self.pipeline
        if (name := pipeline.broken_parameter()) is not None:
            raise InputError(
                f"The parameter {name} is not finite after step {step}, because a gradient was not. {self._kept()}"
            )
        folder = self.checkpoint_dir
        # on the same disk, wherever --relative-model-dir leads
        partial = folder.parent / ".unfinished_checkpoint"
        shutil.rmtree(partial, ignore_errors=True)
        self.checkpoint_dir = partial
        try:
            try:
                super().save_checkpoint(step)
            finally:
                self.checkpoint_dir = folder
            folder.mkdir(parents=True, exist_ok=True)
            (written,) = partial.iterdir()
            os.replace(written, folder / written.name)
        except (OSError, RuntimeError) as error:
            # torch does not name the reason
            raise InputError(
                f"{folder}: the checkpoint of step {step} cannot be written ({error}). Is the disk full? {self._kept()}"
            ) from error
        finally:
            shutil.rmtree(partial, ignore_errors=True)
        if self.config.save_only_latest_checkpoint:
            for checkpoint in folder.glob("*.ckpt"):
                if checkpoint.name != written.name:
                    checkpoint.unlink()

    def _load_checkpoint(self) -> None:
        """Load a checkpoint as nerfstudio does: the newest complete one of `load_dir`.

        Raises:
            InputError: there is none, or it is of other options.
        """
        folder = self.config.load_dir
        if folder is None or self.config.load_step is not None:
            self._load_fitting()
            return
        newest = newest_checkpoint(folder)
        every = checkpoints_in(folder)
        if newest is None:
            found = f"{len(every)} checkpoints, none of them complete" if every else "no checkpoint"
            raise InputError(
                f"{folder}: found {found}; --load-dir takes the folder nerfstudio_models of a training. To start a "
                "new training, leave it out."
            )
        if newest != every[-1]:
            CONSOLE.print(f"[bold yellow]{every[-1]} is incomplete; resuming from {newest.name}.")
        given = self.config
        self.config = dataclasses.replace(given, load_step=int(newest.stem.removeprefix("step-")))
        try:
            self._load_fitting()
        finally:
            self.config = given

    def _load_fitting(self) -> None:
        try:
            super()._load_checkpoint()
        except InputError:
            raise
        except (KeyError, ValueError) as error:  # of its optimisers, whose parameters torch does not name
            raise InputError(
                f"The checkpoint's optimisers do not fit ({error}). exposure, camera-optimizer.mode, predict-normals "
                "and optimizers must be those of the training that is resumed: repeat its options. config.yml has them."
            ) from error

    def _kept(self) -> str:
        """Return a sentence on how to resume."""
        newest = newest_checkpoint(self.checkpoint_dir)
        if newest is None and self.config.load_dir is not None:
            newest = newest_checkpoint(self.config.load_dir)
        if newest is None:
            return "No checkpoint was saved so far."
        return f"The last checkpoint, {newest}, is kept; resume with --load-dir {newest.parent}."


class _Progress:
    """Says now and then where a training is: loss, PSNR of held-out pixels, milliseconds a step, time to go."""

    def __init__(self) -> None:
        self._began_s = 0.0
        self._said: tuple[int, float] | None = None
        """Step and time of the last line."""

    def note(self, step: int, loss: torch.Tensor, trainer: EdgeDepthTrainer) -> None:
        """Take note that a step was taken; print a line if it is time, and after the last one."""
        if self._said is None:
            # the first step compiles
            self._began_s = time.perf_counter()
            self._said = step, self._began_s
            return
        last, last_s = self._said
        now_s, left = time.perf_counter(), total_steps(trainer) - step - 1
        if left and now_s - last_s < max(TOLD_EVERY_S, TOLD_EVERY_SHARE * (now_s - self._began_s)):
            return
        # waits for a GPU
        said = f"Step {step + 1:,} of {total_steps(trainer):,}: loss {float(loss.detach()):.4f}"
        step_s = (time.perf_counter() - last_s) / (step - last)
        if isinstance(trainer.pipeline, EdgeDepthPipeline) and len(trainer.pipeline.datamanager.eval_dataset):
            said += f", held-out PSNR {trainer.pipeline.held_out_psnr():.1f} dB"
        rays = trainer.pipeline.datamanager.get_train_rays_per_batch() * trainer.world_size
        said += f"; {1e3 * step_s:.3g} ms a step, {rays / step_s:,.0f} rays/s"
        if torch.device(trainer.device).type == "cuda":
            graphs = trainer.graphs is not None and trainer.graphs.recorded > 0
            said += f", {torch.cuda.max_memory_reserved(trainer.device) / 1e9:.1f} GB of GPU memory"
            said += f", {'by' if graphs else 'without'} CUDA graphs"
        say(CONSOLE, said + (f"; {_duration(step_s * left)} to go" if left else ""))
        self._said = step, time.perf_counter()


def _duration(seconds: float) -> str:
    """Write a duration as a person would say it."""
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
