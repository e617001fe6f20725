"""`edge-depth-nerf birds-eye`: the road of a trained scene from straight above, with its heights.

Each pixel has a ray of its own, straight down. It begins a little above the vehicle's highest camera, where the road is
free: trees, bridges and roofs are above it. Pixels are transparent where the field shows nothing, where the ray begins
inside something, and where no training picture saw what the field shows.
"""

from __future__ import annotations

import shutil
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8
from rich.console import Console

from edge_depth_nerf import __version__
from edge_depth_nerf.base.console import in_turn, say
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import (
    encoded,
    open_folder,
    read_npz,
    remove_leftovers,
    write_atomically,
    write_bytes,
    write_text,
)
from edge_depth_nerf.films.ground_plan import TILE_PX, GroundPlan, Tile, driven_path
from edge_depth_nerf.films.options import RANGES, BirdsEyeOptions
from edge_depth_nerf.films.paths import up_of
from edge_depth_nerf.films.placed import placed, poses_of
from edge_depth_nerf.films.scanning import CHECKPOINTS, HIT, check_checkpoint, load_model
from edge_depth_nerf.films.seen import TrainingViews
from edge_depth_nerf.jobs.runs import steps_done
from edge_depth_nerf.plugin.compat import quiet_host
from edge_depth_nerf.plugin.scanning import Caster

PICTURE, HEIGHT, RECORD, TILES = "road.png", "height.tif", "birds_eye.json", "tiles"
BELOW_M = 8.0
"""Rays end so far below the vehicle's highest camera."""
LEAST_M = 0.1
"""A ray that hits something at once begins inside it: a house, a tree, a bank."""
DOWN = np.array([0.0, 0.0, -1.0])

Colours = UInt8[np.ndarray, "h w 4"]
Heights = Float32[np.ndarray, "h w"]


def render_birds_eye(options: BirdsEyeOptions, console: Console | None = None) -> Path:
    """Render the road from above. A run that was interrupted continues.

    Returns:
        The folder with road.png, height.tif and their world files, road.pgw and height.tfw, which give the places of
        pixels in the recording's world. Heights are z there, metres; NaN where the picture is transparent.

    Raises:
        FileNotFoundError: there is no scene or training at a given path.
        InputError: an option, the scene or the training cannot be used, or the folder holds something else.
    """
    options.check()
    console = console or Console()
    output = options.output or options.load_config.parent / "birds_eye"
    scene, to_model = placed(options, console)
    poses = poses_of(scene.pictures)
    if up_of(poses[:, :3, :3])[2] < 1:
        raise InputError(
            f"{scene.path}: z is not up in this scene, so no picture can be taken from above. Turn the scene, or "
            "process the drive with `edge-depth-nerf process`."
        )
    path_m = driven_path([picture.frame for picture in scene.pictures], poses[:, :3, 3])
    plan = GroundPlan(path_m, options.metres_per_pixel, options.margin_m)
    record = {
        "made_by": f"edge-depth-nerf {__version__}",
        "scene": str(scene.path),
        "load_config": str(options.load_config),
        "steps": steps_done(options.load_config.parent / CHECKPOINTS),
        **{name: getattr(options, name) for name in RANGES},
        "width": plan.width,
        "height": plan.height,
    }
    check_checkpoint(options.load_config)
    open_folder(output, output / RECORD, record, "pictures")
    remove_leftovers(output)
    if not all((output / name).is_file() for name in (PICTURE, HEIGHT)):
        tiles = list(plan.tiles())
        missing = [tile for tile in tiles if not _tile_path(output, tile).is_file()]
        if missing:
            with console.status("Loading the model …"), quiet_host():
                caster = Caster(load_model(options.load_config, scene.path), to_model)
            views = TrainingViews(scene, caster)
            for tile in in_turn(missing, "Rendering the road", console, done=len(tiles) - len(missing)):
                colours, height_m = render_tile(plan, tile, caster, views, options.above_m)
                arrays = {"colours": colours, "height_m": height_m}
                write_atomically(_tile_path(output, tile), partial(np.savez_compressed, **arrays))
        _put_together(output, tiles, plan, scene.world_offset_m)
    shutil.rmtree(output / TILES, ignore_errors=True)
    side = f"{100 * options.metres_per_pixel:g} cm"
    say(console, f"The road from above, {plan.width}×{plan.height} px of {side}, and its heights:")
    say(console, f"  {output / PICTURE}\n  {output / HEIGHT}")
    return output


def _tile_path(output: Path, tile: Tile) -> Path:
    return output / TILES / f"{tile.row:06d}_{tile.column:06d}.npz"


def render_tile(
    plan: GroundPlan, tile: Tile, caster: Caster, views: TrainingViews, above_m: float
) -> tuple[Colours, Heights]:
    """Render a tile's colours, transparent where nothing is known, and its heights in the scene, metres."""
    place, path_m, near = plan.of_tile(tile)
    colours = np.zeros((*near.shape, 4), np.uint8)
    height_m = np.full(near.shape, np.nan, np.float32)
    # nerfstudio renders nothing of no rays
    if not near.any():
        return colours, height_m
    start_m = path_m[near] + above_m
    origin_m = np.concatenate([place[near], start_m[:, None]], axis=1)
    down = np.broadcast_to(DOWN, origin_m.shape)
    cast = caster.cast(origin_m, down, reach_m=above_m + BELOW_M, colours=True)
    assert cast.rgb is not None
    found = np.flatnonzero((cast.hit >= HIT) & (cast.distance_m >= LEAST_M))
    surface_m = origin_m[found] + DOWN * cast.distance_m[found, None]
    found = found[views.see(surface_m)]
    row, column = (axis[found] for axis in np.nonzero(near))
    colours[row, column, :3] = np.rint(cast.rgb[found].clip(0, 1) * 255)
    colours[row, column, 3] = 255
    height_m[row, column] = start_m[found] - cast.distance_m[found]
    return colours, height_m


def _put_together(output: Path, tiles: list[Tile], plan: GroundPlan, offset_m: np.ndarray) -> None:
    """Write the picture, the heights and their world files."""
    colours = np.zeros((plan.height, plan.width, 4), np.uint8)
    height_m = np.full((plan.height, plan.width), np.nan, np.float32)
    for tile in tiles:
        arrays = read_npz(_tile_path(output, tile), ("colours", "height_m"), 4 * TILE_PX**2)
        colours[tile.slices], height_m[tile.slices] = arrays["colours"], arrays["height_m"]
    height_m += np.float32(offset_m[2])
    for name, pixels in ((HEIGHT, height_m), (PICTURE, colours)):
        suffix = Path(name).suffix
        write_text(output / name.replace(suffix, f"{suffix[:2]}{suffix[-1]}w"), plan.world_file(offset_m))
        write_bytes(output / name, encoded(suffix, pixels))
