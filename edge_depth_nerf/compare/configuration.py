"""The configuration of a run: one preset for all methods, and the named fields of the method."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from nerfstudio.engine.trainer import TrainerConfig

from edge_depth_nerf.compare.methods import LAMBDA, METHODS, SIGMA_MODE, MethodName, Preset, Setting
from edge_depth_nerf.compare.specification import RunSpecification
from edge_depth_nerf.plugin.config import apply_overrides, make_specifications, read_method_file
from edge_depth_nerf.plugin.settings import flattened

REGISTERED: dict[Preset, str] = {
    "lite": "edge-depth-nerf-lite",
    "full": "edge-depth-nerf",
    "paper": "edge-depth-nerf-paper",
}
"""The registered method that each preset begins with."""
COMMON = {
    # a training that is evaluated now and then, by the trainer's own measure, would not be timed alone
    "steps_per_eval_batch": 0,
    "steps_per_eval_image": 0,
    "steps_per_eval_all_images": 0,
    "vis": "tensorboard",
    # each step in the log
    "logging.local_writer.enable": True,
    "logging.local_writer.max_log_size": 0,
    "logging.profiler": "basic",
    "timestamp": "run",
}
"""What a compared training sets beyond its preset."""


def literal_form() -> dict[str, Any]:
    """The published method to the letter: what the preset paper sets otherwise than full, which is its size."""
    presets = read_method_file()["presets"]
    return {name: value for name, value in presets["paper"].items() if presets["full"].get(name) != value}


def configuration(run: RunSpecification, folder: Path | None = None) -> tuple[TrainerConfig, set[str]]:
    """Resolve the configuration of a run; nerfstudio's files go to a folder in the run's.

    Returns:
        The configuration, and the dotted names in which its method may differ from others.
    """
    config = make_specifications(read_method_file())[REGISTERED[run.preset]].config
    method = METHODS[run.method]
    shared: dict[str, Any] = {
        **COMMON,
        "machine.seed": run.seed,
        "pipeline.datamanager.data": Path(run.scene),
        **({} if run.steps is None else {"max_num_iterations": run.steps}),
        **({} if folder is None else {"output_dir": folder.parent, "experiment_name": folder.name}),
    }
    named = {
        **(literal_form() if method.variant == "paper" else {}),
        **method.overrides,
        **Setting(run.weight, run.sigma_m).overrides(method),
    }
    apply_overrides(config, {**shared, **named}, f"method {run.method}")
    return config, set(named)


def setting_of(config: TrainerConfig, name: MethodName) -> tuple[float | None, float | str | None]:
    """λ and σ (metres, or the prior's own as its sigma_mode) that a configuration ends up with; None without a loss."""
    method, values = METHODS[name], flattened(config)
    if method.sigma_field is None:
        return None, None
    takes_own = method.loss == "edge" and values[SIGMA_MODE] != "constant"
    return values[LAMBDA], values[SIGMA_MODE if takes_own else method.sigma_field]


def described(config: TrainerConfig) -> dict[str, str]:
    """A configuration as dotted names and words, the same in every process."""
    return {
        name: value.__qualname__ if callable(value) and hasattr(value, "__qualname__") else repr(value)
        for name, value in flattened(config).items()
    }
