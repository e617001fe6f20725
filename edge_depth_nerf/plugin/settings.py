"""Settings of a training as dotted names and values, and which of them its user changed."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from typing import Any

SAID_ANYWAY = ("data", "pipeline.datamanager.data", "timestamp", "experiment_name", "max_num_iterations")
"""Settings that each training has of its own, or that are printed beside the changed ones."""


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
