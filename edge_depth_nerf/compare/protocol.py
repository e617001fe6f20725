"""The paper's protocol, as far as it states it, and where a scene departs from it."""

from __future__ import annotations

from typing import Any

TRAINING_FRAMES = 150
HELD_OUT_SHARE = 0.2


def departures(meta: dict[str, Any]) -> list[str]:
    """Say by a scene's transforms.json what of it is other than the paper has it: frames, split, sweeps, masks."""
    source = meta.get("source", {})
    frames = {split: _frames(meta, split) for split in ("train", "test")}
    share = frames["test"] / (frames["train"] + frames["test"])
    sweeps = 2 * source.get("sweeps", 0) + 1
    said = {
        f"{frames['train']} training frames, not {TRAINING_FRAMES}": frames["train"] != TRAINING_FRAMES,
        f"{share:.0%} held out, not {HELD_OUT_SHARE:.0%}": abs(share - HELD_OUT_SHARE) > 0.02,
        f"{sweeps} sweeps, not one": sweeps > 1,
        "sweeps de-skewed": source.get("deskew"),
        "hidden returns removed": source.get("occlusion"),
        "the vehicle itself masked out": source.get("ego_mask") or source.get("find_ego"),
        "moving things masked out": source.get("frame_masks") or source.get("find_moving"),
    }
    return [text for text, departs in said.items() if departs]


def _frames(meta: dict[str, Any], split: str) -> int:
    names = set(meta[f"{split}_filenames"])
    return len({frame.get("frame", frame["file_path"]) for frame in meta["frames"] if frame["file_path"] in names})
