"""`edge-depth-nerf estimate-depth`: monocular maps for scenes, and how far they can be trusted.

They come from a network trained on the scenes' own LiDAR, from a ready-made one, or from files of another tool.

Held-out pictures, which scenes keep for the evaluation, are only predicted: they are neither trained on nor used to
stop. For stopping, one of eight training frames is kept aside, with all its cameras.
"""

from __future__ import annotations

import functools
import hashlib
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float32
from rich.console import Console
from rich.progress import Progress

from edge_depth_nerf import __version__
from edge_depth_nerf.base.console import progress_bars, say
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.one_writer import only_writer
from edge_depth_nerf.masks.sky import find_sky
from edge_depth_nerf.method.alignment import LEAST_POINTS
from edge_depth_nerf.mono.calibration import calibrate_scene
from edge_depth_nerf.mono.elsewhere import FittedMaps
from edge_depth_nerf.mono.examples import (
    LARGEST_SET_BYTES,
    Examples,
    camera_height_m,
    load_examples,
    network_view,
    room_radius_m,
    small_picture,
    working_size,
)
from edge_depth_nerf.mono.far_seen import field_deg, seen_above, static_cloud
from edge_depth_nerf.mono.files import find_maps
from edge_depth_nerf.mono.hf import ReadyNetwork, load_ready_network, view_layers
from edge_depth_nerf.mono.motion_seen import taught_by_motion
from edge_depth_nerf.mono.network import (
    ARCHITECTURE,
    DepthNetwork,
    NetworkSettings,
    distance_m,
    is_ours,
    load_network,
    log_room_distance,
    ray_geometry,
    save_network,
)
from edge_depth_nerf.mono.options import EstimateDepthOptions, Preset
from edge_depth_nerf.mono.pinhole_views import pinhole_views
from edge_depth_nerf.mono.relative import Layer
from edge_depth_nerf.mono.training import Trained, TrainingOptions, identity_of, torch_threads, train
from edge_depth_nerf.scene.put_maps import write_maps
from edge_depth_nerf.scene.reader import SceneFolder, ScenePicture, read_scene

Split = tuple[list[ScenePicture], list[ScenePicture]]
"""Pictures of a scene to train on, and those kept for stopping."""
WEIGHTS = "mono_network.safetensors"
"""The weights' file in a scene."""
KEEP_EVERY = 8
"""One training frame of so many is kept for stopping."""
_FEW_STEPS = 200
"""Less makes poor maps: on a rendered street the error is 27 % after 42 steps, 5 % after 500."""
_HEIGHT_PICTURES = 20
"""The camera's height is taken from so many pictures of each camera."""
_OUTLINE_SHARE = 3 / 350
"""How far off matching puts outlines, as a share of the picture's longer side."""
_EYE_LEVEL_M = 1.6
"""Height of a camera that nothing is known of."""


@dataclass(frozen=True)
class PresetValues:
    """What a preset stands for; see `NetworkSettings` and `TrainingOptions`."""

    channels: tuple[int, ...]
    working_px: int
    training: TrainingOptions


PRESETS: dict[Preset, PresetValues] = {
    "lite": PresetValues((16, 24, 48, 96, 128), 192, TrainingOptions(steps=500)),
    "full": PresetValues(
        (32, 64, 128, 256, 384, 512),
        512,
        # no GPU has trained it yet: Muon, measured with the small one, may want other rates here
        TrainingOptions(
            steps=20000, batch=8, learning_rate=1e-3, hidden_learning_rate=None, evaluate_every=250, patience=20
        ),
    ),
}


def estimate_depth(options: EstimateDepthOptions, console: Console | None = None) -> tuple[Path, Trained | None]:
    """Get maps for all pictures of scenes, write them there, and measure how far they can be trusted.

    Returns:
        The file whose weights made the maps, of other sources than our own network the folder or name given; and how
        it was trained, if it was now.

    Raises:
        FileNotFoundError: a scene, the weights or a map are not there.
        InputError: an option, a scene, the weights or a map cannot be used.
    """
    console = console or Console()
    assert options.cluster is None
    start, about, ready, scenes = opened(options)
    trained = None
    with ExitStack() as stack:
        # in one order, lest two wait for each other
        for folder in sorted(scene.folder.resolve() for scene in scenes):
            stack.enter_context(only_writer(folder, console))
        # another process may have written to them meanwhile
        scenes = [read_scene(path) for path in options.scenes]
        if ready is not None:
            weights = Path(ready.name)
            _write_predicted(ready, scenes, console)
        elif options.maps is not None:
            weights = options.maps
            _write_from_files(options, scenes[0], console)
        else:
            if options.trains:
                network, weights, about, trained = _train(scenes, options, start, console)
            else:
                assert start is not None and options.model is not None
                network, weights = start, options.model
            if not options.predict:
                console.print(f"Weights, for --model: {weights}", soft_wrap=True)
                return weights, trained
            _write_own(network, weights, about, scenes, console)
        count = sum(len(scene.pictures) for scene in scenes)
        console.print(f"{count} pictures got a monocular map, from {weights}", soft_wrap=True)
        for scene in scenes:
            if scene.has("lidar"):
                calibration = calibrate_scene(scene.path, console=console)
                console.print(f"{scene.folder}: {calibration.headline()}", soft_wrap=True)
    return weights, trained


def opened(
    options: EstimateDepthOptions,
) -> tuple[DepthNetwork | None, dict[str, Any], ReadyNetwork | None, list[SceneFolder]]:
    """Check the options, and open what they name: the network to start from, what is known of it, another, the scenes.

    Raises:
        FileNotFoundError: a scene or the weights are not there.
        InputError: an option, a scene or the weights cannot be used.
    """
    options.check()
    start, about = load_network(options.model) if options.model is not None else (None, {})
    ready = load_ready_network(options.hf, options.hf_output) if options.hf is not None else None
    scenes = [read_scene(path) for path in options.scenes]
    if len({scene.path.resolve() for scene in scenes}) < len(scenes):
        raise InputError("the scene is given twice. Name each scene once.")
    return start, about, ready, scenes


# ---- sources of maps ---------------------------------------------------------------------------------------------


def _write_own(
    network: DepthNetwork, weights: Path, about: dict[str, Any], scenes: Sequence[SceneFolder], console: Console
) -> None:
    source = {
        "kind": "network",
        # it has seen LiDAR alone, in whatever scene: beyond a scanner's field it knows nothing
        "trained_on": "scene",
        "weights": weights.name,
        "architecture": ARCHITECTURE,
        **{key: about[key] for key in ("preset", "steps", "abs_rel", "scenes", "field_deg") if key in about},
    }
    # single small pictures gain nothing from torch's threads, which wait for each other
    with progress_bars(console) as progress, torch_threads(1):
        for scene in scenes:
            # on these the maps are better than elsewhere
            frames = about.get("trained_frames", {})
            # weights of before have them by the scenes' names
            seen = frames.get(_key(scene), frames.get(_name(scene), []))
            source["trained_frames"] = seen
            empty = write_maps(scene.folder, "mono", predicted_maps(network, scene), source, progress)
            _say_empty(scene, empty, console)


def _write_predicted(network: ReadyNetwork, scenes: Sequence[SceneFolder], console: Console) -> None:
    fitted_to = "" if network.kind == "metric" else ", fitted to LiDAR"
    console.print(f"{network.name}: {network.model_type}, {network.kind} maps{fitted_to}", soft_wrap=True)
    source = {
        "kind": "ready-made network",
        "trained_on": "elsewhere",
        "network": Path(network.name).name,
        "architecture": network.model_type,
        "output": network.kind,
    }

    def layers(scene: SceneFolder, picture: ScenePicture) -> list[Layer]:
        return view_layers(network, pinhole_views(picture.lens, scene.theta_max_rad), scene.rgb(picture))

    # all scenes' faults are told before the first one's work
    fitted = [FittedMaps(scene, network.kind, functools.partial(layers, scene)) for scene in scenes]
    _write_fitted(fitted, source, console)


def _write_from_files(options: EstimateDepthOptions, scene: SceneFolder, console: Console) -> None:
    assert options.maps is not None and options.maps_kind is not None and options.maps_along is not None
    layers = find_maps(scene, options.maps, options.maps_kind, options.maps_along, options.metres_per_count)
    source = {
        "kind": "files",
        "trained_on": options.maps_trained_on or "elsewhere",
        "folder": options.maps.resolve().name,
        "output": options.maps_kind,
        "along": options.maps_along,
    }
    _write_fitted([FittedMaps(scene, options.maps_kind, layers)], source, console)


def _write_fitted(every: Sequence[FittedMaps], source: dict[str, Any], console: Console) -> None:
    with progress_bars(console) as progress:
        for fitted in every:
            maps = ((picture.name, without_sky(fitted.scene, picture, metres, metres)) for picture, metres in fitted)
            _say_empty(fitted.scene, write_maps(fitted.scene.folder, "mono", maps, source, progress), console)
    for fitted in every:
        if few := fitted.by_the_drive:
            console.print(
                f"{fitted.scene.folder}: {len(few)} of {len(fitted.scene.pictures)} pictures have fewer than "
                f"{LEAST_POINTS} LiDAR points to fit to, such as {few[0]}; they use the drive's fit",
                soft_wrap=True,
            )


def _say_empty(scene: SceneFolder, names: Sequence[str], console: Console) -> None:
    if names:
        what = f"{len(names)} pictures get no monocular map, such as {names[0]}: nothing in it can be used."
        say(console, f"{scene.folder}: {what}", "yellow")


# ---- training --------------------------------------------------------------------------------------------------


def _train(
    scenes: Sequence[SceneFolder], options: EstimateDepthOptions, start: DepthNetwork | None, console: Console
) -> tuple[DepthNetwork, Path, dict[str, Any], Trained | None]:
    """Train, or find that it was done; give the network, its file, what is known about it, and the training.

    Raises:
        InputError: the weights' file is not to be overwritten; a scene cannot be trained on.
    """
    preset = PRESETS[options.preset]
    training = replace(preset.training, steps=options.train_steps or preset.training.steps, seconds=options.seconds)
    weights = options.output or scenes[0].folder / WEIGHTS
    checkpoint = weights.with_suffix(".checkpoint")
    found, about = _weights_of_before(weights, options, scenes[0].folder / WEIGHTS, console)
    settings = start.settings if start else NetworkSettings(preset.channels, preset.working_px, _EYE_LEVEL_M, 1.0)
    with progress_bars(console) as progress:
        used, examples, kept, mean_height_m, reached_deg = _gather(scenes, settings, console, progress)
        if start is None:
            settings = replace(settings, camera_height_m=mean_height_m, room_radius_m=room_radius_m(examples))
        identity = identity_of(examples, settings, training, start)
        if found is not None and about.get("identity") == identity:
            console.print(f"{weights} is trained already", soft_wrap=True)
            checkpoint.unlink(missing_ok=True)
            return found, weights, about, None
        task = progress.add_task("Training", total=1.0)

        def report(share: float, error: float) -> None:
            said = "" if np.isinf(error) else f", error {error:.1%} of the distance"
            progress.update(task, completed=share, description=f"Training{said}")

        trained = train(examples, kept, settings, training, start=start, checkpoint=checkpoint, report=report)
    about = {
        "made_by": f"edge-depth-nerf {__version__}",
        "preset": options.preset,
        "steps": trained.best_step,
        "abs_rel": None if kept is None else round(trained.abs_rel, 5),
        "scenes": [_name(scene) for scene in scenes],
        "trained_frames": {
            _key(scene): [picture.name for picture in pictures] for scene, pictures in zip(scenes, used, strict=True)
        },
        "field_deg": reached_deg,
        "identity": identity,
    }
    save_network(weights, trained.network, about)
    checkpoint.unlink(missing_ok=True)
    _say_trained(trained, training, examples, kept, console)
    return trained.network, weights, about, trained


def _gather(
    scenes: Sequence[SceneFolder], settings: NetworkSettings, console: Console, progress: Progress
) -> tuple[list[list[ScenePicture]], Examples, Examples | None, float, list[float]]:
    """Read the pictures and LiDAR of scenes.

    Returns:
        The pictures of each scene to train on; these read; those kept for stopping read, None if they measured nothing;
        the mean height of the cameras above the ground; the least and the largest elevation that LiDAR reached.

    Raises:
        InputError: no LiDAR point lies in any training picture.
    """
    weighted = any(scene.has("motion") for scene in scenes)
    split = _thinned([training_split(scene) for scene in scenes], settings.working_px, weighted, console)
    training = [pictures for pictures, _ in split]
    heights = [camera_heights_m(scene, settings) for scene in scenes]
    task = progress.add_task("Gathering LiDAR", total=4 * sum(map(len, training)))
    fields, far_seen = [], []
    for scene, pictures in zip(scenes, training, strict=True):
        fields.append(field_deg(scene, pictures, lambda: progress.advance(task)))
        cloud = static_cloud(scene, pictures, lambda: progress.advance(task))
        far_seen.append(functools.partial(seen_above, cloud, scene))
    reading = progress.add_task("Reading pictures", total=sum(len(pictures) for both in split for pictures in both))
    size = settings.working_px, settings.multiple_px, lambda: progress.advance(reading)
    of_motion = [functools.partial(taught_by_motion, scene) if scene.has("motion") else None for scene in scenes]
    examples = load_examples(scenes, training, heights, *size, far_seen, of_motion)
    # what stops the training is what these pictures measured themselves
    stopping = [pictures for _, pictures in split]
    kept = load_examples(scenes, stopping, heights, *size) if any(stopping) else None
    if not examples.lidar_m.any():
        raise InputError(
            f"{scenes[0].path}: no LiDAR point lies inside the masks of the training pictures, so there is nothing "
            "to train on. Check the LiDAR maps with `edge-depth-nerf inspect`."
        )
    if kept is not None and not kept.lidar_m.any():
        console.print(
            f"No LiDAR point lies inside the masks of the {len(kept)} pictures set aside for early stopping: "
            "training takes all its steps, and its error is unknown",
            soft_wrap=True,
        )
        kept = None
    # some picture has returns
    known = [field for field in fields if field is not None]
    mean_height_m = float(np.mean([height for by_camera in heights for height in by_camera.values()]))
    limits_deg = [min(low for low, _ in known), max(high for _, high in known)]
    return training, examples, kept, mean_height_m, limits_deg


def _say_trained(
    trained: Trained, training: TrainingOptions, examples: Examples, kept: Examples | None, console: Console
) -> None:
    short = not trained.stopped_early and trained.steps < training.steps
    early = ", where it stopped early" if trained.stopped_early else ""
    if short:
        early = f" of {training.steps:,}, where the time limit was reached,"
    error = ""
    if kept is not None:
        error = f"; error on the {len(kept)} pictures set aside for early stopping: {trained.abs_rel:.1%}"
    console.print(
        f"Trained {trained.steps} steps{early} in {trained.seconds:.0f} s on {len(examples)} pictures{error}",
        soft_wrap=True,
    )
    if short and trained.steps < _FEW_STEPS:
        console.print(
            f"Fewer than {_FEW_STEPS} steps make poor maps: increase --seconds, or use a machine without other work.",
            style="yellow",
            soft_wrap=True,
        )


def _weights_of_before(
    weights: Path, options: EstimateDepthOptions, scenes_own: Path, console: Console
) -> tuple[DepthNetwork | None, dict[str, Any]]:
    """Load what lies where the weights are to go, after a look whether it may be overwritten.

    At the place of the first scene's own weights a file is this project's, whatever is in it.

    Raises:
        InputError: the file is what training starts from, or is not this project's.
    """
    if options.model is not None and weights.resolve() == options.model.resolve():
        raise InputError(
            f"{weights}: training would start from these weights and overwrite them, and so continue from its own "
            "result each time. Name another file with --output."
        )
    if not weights.exists():
        return None, {}
    if weights.resolve() != scenes_own.resolve() and not is_ours(weights):
        raise InputError(
            f"--output {weights}: exists already, and was not written by `estimate-depth`. Name another file, or "
            "remove this one."
        )
    try:
        return load_network(weights)
    except InputError:
        console.print(f"{weights} is broken or of another version: training starts again", soft_wrap=True, markup=False)
        return None, {}


def _name(scene: SceneFolder) -> str:
    return scene.folder.resolve().name


def _key(scene: SceneFolder) -> str:
    """What tells a scene's pictures from another's, wherever its folder lies: their names, and their files' sizes."""
    listed = [(picture.name, picture.files["image"].stat().st_size) for picture in scene.pictures]
    return hashlib.sha256(repr(sorted(listed)).encode()).hexdigest()[:32]


def training_split(scene: SceneFolder) -> Split:
    """Divide a scene's training pictures by whole frames: to train on, and to stop by.

    Raises:
        InputError: it has no LiDAR, or does not say what is held out.
    """
    if not all("lidar" in picture.files for picture in scene.pictures):
        raise InputError(
            f"{scene.path}: has no LiDAR maps, which the network is trained on. Name a ready-made network by --hf, "
            "maps of any network by --maps, or weights that a scene with LiDAR has given by --model (docs/mono.md)."
        )
    if not scene.split_known:
        raise InputError(
            f"{scene.path}: does not say which pictures are held out (train_filenames, val_filenames, "
            "test_filenames). Add them, so that the network never sees pictures that are used for "
            "evaluation."
        )
    allowed = [picture for picture in scene.pictures if not picture.held_out]
    frames = sorted({picture.frame for picture in allowed})
    kept = frames[KEEP_EVERY // 2 :: KEEP_EVERY]
    return (
        [picture for picture in allowed if picture.frame not in kept],
        [picture for picture in allowed if picture.frame in kept],
    )


def _thinned(split: list[Split], working_px: int, weighted: bool, console: Console) -> list[Split]:
    """Take every k-th picture where all would not fit in memory."""
    pictures = [picture for both in split for pictures in both for picture in pictures]
    pixels = max(math.prod(working_size(p.lens.width, p.lens.height, working_px)) for p in pictures)
    # colours, distance and mask, and perhaps the distance's weight
    most = LARGEST_SET_BYTES // (pixels * (3 + 4 + 1 + 4 * weighted))
    step = -(-len(pictures) // most)
    if step > 1:
        console.print(f"{len(pictures)} pictures would not fit in memory: every {step}th is used", soft_wrap=True)
    return [(used[::step], kept[::step]) for used, kept in split]


def camera_heights_m(scene: SceneFolder, settings: NetworkSettings) -> Mapping[str, float]:
    """Height of each camera above the ground: from LiDAR of training pictures, else as the network knows it."""
    heights = {}
    for camera, pictures in scene.cameras().items():
        usable = [picture for picture in pictures if not picture.held_out and "lidar" in picture.files]
        spread = usable[:: -(-len(usable) // _HEIGHT_PICTURES) or 1]
        heights[camera] = camera_height_m(scene, spread, settings.working_px) or settings.camera_height_m
    return heights


# ---- prediction ------------------------------------------------------------------------------------------------


def predicted_maps(network: DepthNetwork, scene: SceneFolder) -> Iterator[tuple[str, Float32[np.ndarray, "h w"]]]:
    """Predict all pictures of a scene, one after another: file_path and H×W metres along the ray, 0 in the sky.

    The network never learns about the sky, where LiDAR has no points; so the sky is found in the picture.
    """
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    # as it was trained: weights in another order in memory round otherwise
    network = network.to(device).to(memory_format=torch.channels_last)
    heights = camera_heights_m(scene, network.settings)
    for picture in scene.pictures:
        metres = predict(network, scene, picture, heights[picture.camera], device)
        yield picture.name, without_sky(scene, picture, metres)


def without_sky(
    scene: SceneFolder,
    picture: ScenePicture,
    metres: Float32[np.ndarray, "h w"],
    known_m: Float32[np.ndarray, "h w"] | None = None,
) -> Float32[np.ndarray, "h w"]:
    """Look for the sky in a picture, and leave it out of its map.

    A pixel with a LiDAR point is no sky, nor is one that motion matched. Matching puts outlines some pixels off, so a
    distance beside an outline does not prove that there is no sky around. Another map (`known_m`) can tell a ceiling
    from the sky.
    """
    lidar_m = scene.lidar_m(picture)
    matched_m = scene.distance_m(picture, "motion")
    if matched_m is not None:
        radius_px = max(1, round(_OUTLINE_SHARE * max(metres.shape)))
        inside = cv2.erode((matched_m > 0).astype(np.uint8), np.ones((2 * radius_px + 1,) * 2, np.uint8)) > 0
        lidar_m = np.where((lidar_m == 0) & inside, matched_m, lidar_m)
    usable = scene.usable(picture)
    sky = find_sky(scene.rgb(picture), usable, picture.up_in_camera, picture.lens, lidar_m, known_m)
    if matched_m is not None:
        sky &= matched_m == 0
    return np.where(sky, 0, metres)


@torch.no_grad()
def predict(
    network: DepthNetwork, scene: SceneFolder, picture: ScenePicture, height_m: float, device: torch.device
) -> Float32[np.ndarray, "h w"]:
    """Predict one picture at its own size, metres along the ray."""
    settings = network.settings
    rays, usable = network_view(scene, picture, settings.working_px)
    rows, columns = usable.shape
    rgb = small_picture(scene, picture, (columns, rows))

    def padded(values: np.ndarray) -> torch.Tensor:
        margins = [(0, -side % settings.multiple_px) for side in (rows, columns)]
        values = np.pad(values, [*margins, *[(0, 0)] * (values.ndim - 2)])
        return torch.from_numpy(values)[None].to(device)

    up_in_camera = picture.up_in_camera.astype(np.float32)
    up, height = (torch.from_numpy(np.asarray(v, np.float32))[None].to(device) for v in (up_in_camera, height_m))
    geometry, _ = ray_geometry(padded(rays), up, height, settings)
    seen = padded(rgb).permute(0, 3, 1, 2).float() / 255.0
    log_ratio = network(seen, geometry, padded(usable))[0, :rows, :columns].cpu().numpy()
    # the ratio is smooth, the room is known exactly at any size
    log_ratio = cv2.resize(log_ratio, (picture.lens.width, picture.lens.height), interpolation=cv2.INTER_LINEAR)
    height_sine = torch.from_numpy(scene.rays(picture).directions @ up_in_camera).clamp(-1.0, 1.0)
    log_room = log_room_distance(height_sine, height_m, settings.room_radius_m)
    return distance_m(torch.from_numpy(log_ratio), log_room).numpy()
