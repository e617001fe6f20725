"""`edge-depth-nerf render-lidar`: the scans that a LiDAR would record in a trained scene, and how true they are."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from rich.console import Console

from edge_depth_nerf import __version__
from edge_depth_nerf.base.console import in_turn, say
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import open_folder, write_json, write_text
from edge_depth_nerf.cameras.transforms import rigid
from edge_depth_nerf.films.intensities import Intensities
from edge_depth_nerf.films.options import RenderLidarOptions
from edge_depth_nerf.films.paths import CameraPath, lane_shift
from edge_depth_nerf.films.placed import outside, placed
from edge_depth_nerf.films.scan_files import read_points, write_scan
from edge_depth_nerf.films.scan_film import write_film
from edge_depth_nerf.films.scanning import (
    CHECKPOINTS,
    LearnedScanner,
    RayDrop,
    check_checkpoint,
    evaluate,
    learn_ray_drop,
    load_model,
    recorded_pattern,
)
from edge_depth_nerf.jobs.runs import steps_done
from edge_depth_nerf.lidar.patterns import SENSORS, TEN_TURNS, ScanPattern, pattern_of_scan, rings_of
from edge_depth_nerf.lidar.scans import ScanFormat, read_scan
from edge_depth_nerf.lidar.trajectory import Trajectory
from edge_depth_nerf.plugin.compat import quiet_host
from edge_depth_nerf.plugin.scanning import Caster
from edge_depth_nerf.process.poses import read_tum, tum_text
from edge_depth_nerf.scene.reader import SceneFolder
from edge_depth_nerf.scene.sweeps import SceneScanner, scanners_of

RECORD, POSES, FIGURES, FILM = "scans.json", "poses.txt", "figures.json", "scans.webp"
UP = np.array([0.0, 0.0, 1.0])


def render_lidar(options: RenderLidarOptions, console: Console | None = None) -> Path:
    """Render scans, and hold the model against those of the drive that no training saw.

    Scans are in the scanner's frame, point by point at its own time, as a moving scanner records them. `poses.txt` has
    the scanner's pose in the recording's world at each scan's own time, in TUM's format. A run that was interrupted
    continues.

    Returns:
        The folder with the scans.

    Raises:
        FileNotFoundError: there is no scene, training or file at a given path.
        InputError: an option, the scene, the training or a file cannot be used, or the folder holds something else.
    """
    options.check()
    console = console or Console()
    output = options.output or options.load_config.parent / "scans"
    scene, to_model = placed(options, console)
    scanner = _scanner(scene, options)
    recorded = None if scanner is None else recorded_pattern(scanner)
    pattern = _pattern(options, scanner, recorded)
    times_s, poses = _path(options, scene, scanner)
    if warning := outside(poses, scene):
        say(console, warning, "yellow")
    cast = (pattern.directions, pattern.offset_s, times_s, poses, np.array(pattern.reach_m))
    record = {
        "made_by": f"edge-depth-nerf {__version__}",
        "scene": str(scene.path.resolve()),
        "load_config": str(options.load_config.resolve()),
        "steps": steps_done(options.load_config.parent / CHECKPOINTS),
        **{name: getattr(options, name) for name in ("sensor", "path", "shift_m", "every", "form")},
        "scanner": None if scanner is None else scanner.name,
        "rays": hashlib.sha256(b"".join(np.ascontiguousarray(each).tobytes() for each in cast)).hexdigest(),
    }
    check_checkpoint(options.load_config)
    for sweep in () if scanner is None else scanner.sweeps:
        if not sweep.path.is_file():
            raise FileNotFoundError(f"{sweep.path}: no such file, but {scene.path} names it. Process the drive again.")
    open_folder(output, output / RECORD, record, "scans")
    with console.status("Loading the model …"), quiet_host():
        caster = Caster(load_model(options.load_config, scene.path), to_model)
    ray_drop, intensities = RayDrop(), None
    if scanner is not None and recorded is not None:
        with console.status("Learning which rays come back"):
            ray_drop = learn_ray_drop(caster, scanner, recorded)
    if scanner is not None:
        with console.status("Learning how bright places are"):
            intensities = Intensities.learned(scanner)
    learned, path = LearnedScanner(caster, recorded, ray_drop, intensities), Trajectory(times_s, poses)
    files = {number: output / f"{number:010d}.{options.form}" for number in range(0, len(times_s), options.every)}
    missing = [number for number, file in files.items() if not file.is_file()]
    for number in in_turn(missing, "Rendering scans", console, done=len(files) - len(missing)):
        write_scan(files[number], learned.render(pattern, float(times_s[number]), path))
    times_s, poses = times_s[:: options.every], poses[:: options.every]
    to_world = rigid(poses[:, :3, :3], poses[:, :3, 3] + scene.world_offset_m)
    write_text(output / POSES, f"# time x y z qx qy qz qw: scanner to world\n{tum_text(times_s, to_world)}")
    say(console, f"{len(files)} scans of {len(pattern.elevation_rad)} × {pattern.firings} rays:\n  {output}")
    if options.film:
        scans_m = map(read_points, in_turn([*files.values()], "Drawing the film", console))
        write_film(output / FILM, scans_m, float(np.median(np.diff(times_s))) if len(times_s) > 1 else 0.1)
        say(console, f"  {output / FILM}")
    if scanner is not None:
        with console.status("Comparing with what no training saw"):
            figures = evaluate(learned, scene, scanner)
        write_json(output / FIGURES, figures)
        _show(figures, console)
    return output


def _scanner(scene: SceneFolder, options: RenderLidarOptions) -> SceneScanner | None:
    """Give the scanner of the drive that was asked for; None if the scene has none and none is needed."""
    scanners = scanners_of(scene.meta, scene.path)
    if options.scanner is not None and options.scanner not in scanners:
        there = f"it has {', '.join(scanners)}" if scanners else "it has none"
        raise InputError(f"--scanner {options.scanner}: {scene.path} has no such scanner; {there}.")
    found = scanners.get(options.scanner) if options.scanner else next(iter(scanners.values()), None)
    needed = [name for name in ("sensor", "path") if getattr(options, name) in ("recorded", "lane-shift")]
    if (found is None or len(found.sweeps) < 2) and needed:
        raise InputError(
            f"{scene.path}: keeps no sweeps of a scanner, so --{needed[0]} {getattr(options, needed[0])} is unknown. "
            "Process the drive again with this version; a drive of depth maps has none. Or name a scanner (--sensor "
            f"{', '.join(SENSORS)}) and a file of its poses (--path FILE)."
        )
    return found


def _pattern(options: RenderLidarOptions, scanner: SceneScanner | None, recorded: ScanPattern | None) -> ScanPattern:
    """Give the pattern of the sensor that was asked for; it turns as the drive's own scanner does, where that is known.

    Raises:
        FileNotFoundError, InputError: there is no such sensor or file, or the file has no rings.
    """
    timing = (scanner.timing if scanner is not None else None) or TEN_TURNS
    if options.sensor == "recorded":
        if recorded is None:
            assert scanner is not None
            raise InputError(
                f"the rings of {scanner.sweeps[0].path.parent} cannot be told apart, so --sensor recorded is unknown. "
                f"Name a scanner: {', '.join(SENSORS)}."
            )
        return recorded
    if options.sensor in SENSORS:
        return replace(SENSORS[options.sensor], timing=timing)
    path = Path(options.sensor)
    if not path.is_file():
        raise InputError(
            f"--sensor {options.sensor}: neither a scanner ({', '.join(('recorded', *SENSORS))}) nor a file of a scan."
        )
    points_m = read_scan(path, ScanFormat()).points_m.numpy()
    return pattern_of_scan(points_m, rings_of(points_m, str(path)), timing, str(path))


def _path(
    options: RenderLidarOptions, scene: SceneFolder, scanner: SceneScanner | None
) -> tuple[Float64[np.ndarray, "scans"], Float64[np.ndarray, "scans 4 4"]]:
    """Give times of scans, and poses, scanner to scene."""
    if options.path in ("recorded", "lane-shift"):
        assert scanner is not None
        path = scanner.trajectory
        times_s, poses = path.times_s, path.vehicle_to_world
        if options.path == "lane-shift":
            poses = lane_shift(CameraPath(times_s, poses, UP), times_s, False, options.shift_m)
        return times_s, poses
    if not Path(options.path).is_file():
        raise InputError(f"--path {options.path}: neither recorded nor lane-shift, nor a file of poses.")
    times_s, poses, _ = read_tum(Path(options.path))
    if len(times_s) < 2:
        raise InputError(f"{options.path}: {len(times_s)} poses, expected at least two: scans need the motion.")
    poses = poses.copy()
    poses[:, :3, 3] -= scene.world_offset_m
    return times_s, poses


def _show(figures: dict[str, dict[str, float]], console: Console) -> None:
    """Print how true scans are."""
    if not figures:
        say(console, "No sweep and no beam is held out, so nothing says how true the scans are.", "yellow")
        return
    for name, found in figures.items():
        what = f"Held-out {name}" if name in ("sweeps", "beams") else "Of these, inside a picture of their frame"
        text = (
            f"{what}, {found['rays']:,.0f} rays: the rendered distance is off by "
            f"{100 * found['median_m']:.1f} cm (median) and {found['p95_m']:.2f} m (95 %); {found['within_10_cm']:.1%} "
            f"are within 10 cm, {found['within_30_cm']:.1%} within 30 cm."
        )
        if "drop_f1" in found:
            text += f" Rays that are lost: F1 {found['drop_f1']:.2f}."
        if "chamfer_m" in found:
            text += f" Chamfer distance: {100 * found['chamfer_m']:.1f} cm."
        if "intensity_error" in found:
            text += f" Intensities are off by {found['intensity_error']:.0%} of their usual difference from the median."
        say(console, text)
