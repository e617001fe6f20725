"""Settings of a training as dotted names and values, and which of them its user changed."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields, is_dataclass
from typing import Any

from edge_depth_nerf.base.errors import InputError

SAID_ANYWAY = ("data", "pipeline.datamanager.data", "timestamp", "experiment_name", "max_num_iterations")
"""Settings that each training has of its own, or that are printed beside the changed ones."""

WITHOUT_EFFECT = {
    "pipeline.model.near_plane": "use --pipeline.model.near-m",
    "pipeline.model.far_plane": "use --pipeline.model.far-m",
    "pipeline.model.use_appearance_embedding": "use --pipeline.model.exposure embedding",
    "pipeline.model.camera_optimizer.trans_l2_penalty": "use --pipeline.model.camera-optimizer.sigma-m",
    "pipeline.model.camera_optimizer.rot_l2_penalty": "use --pipeline.model.camera-optimizer.sigma-deg",
    "pipeline.datamanager.dataparser.scale_factor": "use fisheye-depth-data --metres-per-unit",
    **dict.fromkeys(
        (
            *(f"pipeline.model.{name}" for name in ("enable_collider", "collider_params", "loss_coefficients")),
            *(f"pipeline.datamanager.dataparser.{name}" for name in ("mask_color", "load_3D_points")),
            *(f"pipeline.datamanager.{name}_on_gpu" for name in ("images", "masks")),
            *(f"pipeline.datamanager.{split}_num_images_to_sample_from" for split in ("train", "eval")),
            *(f"pipeline.datamanager.{split}_num_times_to_repeat_images" for split in ("train", "eval")),
            *(f"pipeline.datamanager.{name}" for name in ("patch_size", "pixel_sampler", "eval_image_indices")),
        ),
        "leave it out",
    ),
}
"""nerfstudio's options that nothing here reads, and what to do instead."""
WITHOUT_EFFECT_BESIDE_SKY = {"pipeline.model.background_color": "leave it out, or add --pipeline.model.depth-loss none"}
"""As `WITHOUT_EFFECT`, where the sky is behind everything."""


def flattened(config: Any, prefix: str = "") -> dict[str, Any]:
    """Turn a configuration into dotted names and values."""
    if is_dataclass(config) and not isinstance(config, type):
        children = {entry.name: getattr(config, entry.name) for entry in fields(config)}
    elif isinstance(config, dict):
        children = config
    else:
        return {prefix: config}
    found: dict[str, Any] = {}
    for name, child in children.items():
        found |= flattened(child, f"{prefix}.{name}" if prefix else str(name))
    return found


def changed_settings(config: Any, usual: Any) -> dict[str, Any]:
    """Settings in which a configuration differs from its method's own, by dotted names."""
    before = flattened(usual)
    return {
        name: value
        for name, value in flattened(config).items()
        if name not in SAID_ANYWAY and (name not in before or before[name] != value)
    }


def as_typed(name: str) -> str:
    """Write a setting's dotted name as the option of `ns-train` that sets it."""
    _, of_scene, last = name.rpartition("pipeline.datamanager.dataparser.")
    return f"{'fisheye-depth-data ' if of_scene else ''}--{last.replace('_', '-')}"


def check_effect(changed: Iterable[str], has_sky: bool) -> None:
    """Raise an InputError if some of the changed settings have no effect."""
    without_effect = WITHOUT_EFFECT | (WITHOUT_EFFECT_BESIDE_SKY if has_sky else {})
    found = [
        f"{as_typed(name)} has no effect: {instead}"
        for name in changed
        for option, instead in without_effect.items()
        if name == option or name.startswith(f"{option}.")
    ]
    if found:
        raise InputError("; ".join(found) + ".")
