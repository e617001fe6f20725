"""Maps of a source of depth put into a scene that exists: whole, or not at all.

The maps are first written beside the scene's own: a run that is killed, or fails on its last map, leaves the scene with
the maps it had. When all are there, transforms.json drops the old ones, the new ones are moved in, and it names them. A
run that is killed during this step leaves a scene without maps of that source.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from rich.progress import Progress

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import write_distance_png, write_json
from edge_depth_nerf.scene.format import CALIBRATION_FILE, LAYERS, later_layers, read_transforms
from edge_depth_nerf.scene.reader import SceneFolder, ScenePicture, read_scene

MOST_EMPTY = 0.1
"""A larger share of maps without any value is a mistake."""
FARTHEST_M = 200.0
"""What an estimate puts beyond is the sky, or as good as that: no value."""


def write_maps(
    scene: Path,
    layer: str,
    maps: Iterable[tuple[str, Float[np.ndarray, "h w"]]],
    source: Mapping[str, Any],
    progress: Progress | None = None,
    some_empty: bool = False,
) -> list[str]:
    """Write a map of a source of depth for every frame of a scene, and name them in its transforms.json.

    Values that are not finite, not positive, beyond 200 m, outside the lens or hidden by the camera's mask are written
    as 0 = none.

    Args:
        scene: the folder, or its transforms.json.
        layer: which source of depth, or what is known of its errors: one of `scene.format.later_layers()`.
        maps: `file_path` of a frame in transforms.json, and its H×W metres along the ray. One for every frame, in any
            order; taken one at a time.
        source: where they come from, as JSON; kept in transforms.json under the layer's name. Monocular maps need
            "trained_on", what their maker has seen: "scene" for a network that was trained on LiDAR and knows nothing
            beyond the scanner's field, "elsewhere" for others. They are not aligned to LiDAR.
        progress: where to show how far it is.
        some_empty: maps may have no value at all, as those from motion where nothing moved; else a tenth of them may.

    Returns:
        The names of frames whose maps have no value.

    Raises:
        FileNotFoundError: no scene there.
        InputError: no such source; a map has another size than its camera, or is of no frame; too many have no value;
            frames without a map; "trained_on" is missing.
    """
    if layer not in later_layers():
        raise InputError(f"{layer!r} is no source of depth; expected one of {', '.join(later_layers())}.")
    if layer == "mono" and source.get("trained_on") not in ("scene", "elsewhere"):
        raise InputError(
            f"source of the monocular maps: trained_on is {source.get('trained_on')!r}; expected scene or elsewhere."
        )
    words = "monocular map" if layer == "mono" else f"{layer.replace('_', ' ')} map"
    found = read_scene(scene)
    pictures = {picture.name: picture for picture in found.pictures}
    targets = {name: _target(layer, picture) for name, picture in pictures.items()}
    if len({*targets.values()}) < len(targets):
        raise InputError(
            f"{found.path}: two pictures of one camera have the same name except for their ending, so their maps "
            "would be one file. Rename one of them."
        )
    partial = found.folder / f".{layer}.partial"
    shutil.rmtree(partial, ignore_errors=True)
    task = progress.add_task(f"Writing {words}s of {found.folder.name}", total=len(pictures)) if progress else None
    written: set[str] = set()
    empty: list[str] = []
    try:
        for name, metres in maps:
            if name not in pictures or name in written:
                fault = "is of no frame of" if name not in pictures else "comes twice for"
                raise InputError(f"{name}: a {words} {fault} {found.path}. Give one for every file_path in it.")
            metres, is_empty = _usable(found, pictures[name], metres, words)
            write_distance_png(partial / targets[name], metres)
            written.add(name)
            empty += [name] * is_empty
            # the first three tell of another unit before hours of work
            no_unit = len(empty) == len(written) == 3
            if not some_empty and (no_unit or len(empty) > MOST_EMPTY * len(pictures)):
                raise InputError(
                    f"{empty[0]}: its {words} has no distance between 0 and {FARTHEST_M:g} m anywhere in the mask, as "
                    f"{len(empty)} of the first {len(written)}. Expected metres along the ray."
                )
            if progress and task is not None:
                progress.advance(task)
        if missing := sorted(pictures.keys() - written):
            raise InputError(
                f"{found.path}: {len(missing)} of {len(pictures)} frames have no {words}, such as {missing[0]}. "
                "Give one for every frame."
            )
        meta = read_transforms(found.path)
        for frame in meta["frames"]:
            frame.pop(LAYERS[layer].key, None)
        # `process` then knows that what lies there is not what it wrote
        write_json(found.path, {**meta, layer: {"unfinished": True}})
        # what was measured about the errors of the maps before
        (found.folder / CALIBRATION_FILE).unlink(missing_ok=True)
        for target in targets.values():
            (found.folder / target).parent.mkdir(parents=True, exist_ok=True)
            (partial / target).replace(found.folder / target)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    for frame in meta["frames"]:
        frame[LAYERS[layer].key] = targets[frame["file_path"]]
    meta[layer] = dict(source)
    write_json(found.path, meta)
    return empty


def _usable(
    scene: SceneFolder, picture: ScenePicture, metres: Float[np.ndarray, "h w"], words: str
) -> tuple[Float[np.ndarray, "h w"], bool]:
    """Leave out of a map what is no distance to anything, or outside the lens and the mask; errors call it `words`.

    Also whether nothing is left of it although something may be used.
    """
    size = (picture.lens.width, picture.lens.height)
    if metres.shape != size[::-1]:
        raise InputError(
            f"{picture.name}: its {words} is {metres.shape[1]}×{metres.shape[0]} pixels (width × height), its "
            f"camera {size[0]}×{size[1]}. Make the map from the scene's own picture, in its size."
        )
    usable = scene.usable(picture)
    # comparisons with NaN are false
    kept = usable & (metres > 0) & (metres <= FARTHEST_M)
    return np.where(kept, metres, 0.0), bool(usable.any() and not kept.any())


def _target(layer: str, picture: ScenePicture) -> str:
    """Path of its map in the scene."""
    camera = "/".join(part for part in Path(picture.camera).parts if part not in ("..", "/"))
    return f"{LAYERS[layer].folder.format(camera=camera)}/{Path(picture.name).stem}.png"
