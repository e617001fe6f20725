"""The paper's protocol, as far as it states it, and where a scene departs from it."""

from __future__ import annotations

from typing import Any

TRAINING_FRAMES = 150
HELD_OUT_SHARE = 0.2


def departures(meta: dict[str, Any]) -> list[str]:
    """Say by a scene's transforms.json what of it is other than the paper has it: frames, split, sweeps, masks."""
    source = meta.get("source", {})
    frames = {split: _frames(meta, split) for split in ("train", "test")}
    found = []
    if frames["train"] != TRAINING_FRAMES:
        found.append(f"{frames['train']} training frames, not {TRAINING_FRAMES}")
    share = frames["test"] / (frames["train"] + frames["test"])
    if abs(share - HELD_OUT_SHARE) > 0.02:
        found.append(f"{share:.0%} held out, not {HELD_OUT_SHARE:.0%}")
    if source.get("sweeps", 0) != 0:
        found.append(f"{2 * source['sweeps'] + 1} sweeps, not one")
    if source.get("deskew", False):
        found.append("sweeps de-skewed")
    if source.get("occlusion", False):
        found.append("hidden returns removed")
    if source.get("ego_mask") or source.get("find_ego"):
        found.append("the vehicle itself masked out")
    if source.get("frame_masks") or source.get("find_moving"):
        found.append("moving things masked out")
    return found


def _frames(meta: dict[str, Any], split: str) -> int:
    names = set(meta[f"{split}_filenames"])
    return len({frame.get("frame", frame["file_path"]) for frame in meta["frames"] if frame["file_path"] in names})
