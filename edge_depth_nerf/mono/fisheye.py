"""`edge-depth-nerf fisheye-depth`: distance maps of a folder of fisheye pictures, by any network that knows pinholes.

No poses, no LiDAR, no training. Pictures are cut into overlapping pinhole views. The network's maps of these are made
to agree, each by a scale (and shift) of its own, and blended into one map for each picture.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32
from rich.console import Console

from edge_depth_nerf.base.console import progress_bars, run_jobs, say
from edge_depth_nerf.base.errors import InputError, require
from edge_depth_nerf.base.files import (
    IMAGE_SUFFIXES,
    as_people_count,
    is_newer,
    open_folder,
    read_image,
    read_mask,
    remove_leftovers,
    sha256_of,
    write_atomically,
    write_distance_png,
    write_png,
)
from edge_depth_nerf.base.one_writer import only_writer
from edge_depth_nerf.base.pictures import colour_distance
from edge_depth_nerf.cameras import KannalaBrandt, Pinhole, fit_kannala_brandt
from edge_depth_nerf.cameras.calibration_file import read_lens
from edge_depth_nerf.cameras.rays import rays
from edge_depth_nerf.masks.lens import dark_rim
from edge_depth_nerf.mono.elsewhere import agreed
from edge_depth_nerf.mono.files import count_m, find_map, read_maps
from edge_depth_nerf.mono.hf import load_ready_network, view_layers, weight_files
from edge_depth_nerf.mono.options import FisheyeDepthOptions
from edge_depth_nerf.mono.pinhole_views import PinholeView, pinhole_views
from edge_depth_nerf.mono.relative import Kind, Layer
from edge_depth_nerf.scene.checks import check_picture_size
from edge_depth_nerf.scene.put_maps import FARTHEST_M
from edge_depth_nerf.scene.writer import MAX_FIT_RMS_PX

RECORD, VIEWS, DISTANCE, COLOURED, MADE_OF = "views.json", "views", "distance", "coloured", "made_of.json"
FARTHEST = 100.0
"""Of maps without a unit: what lies so many medians away is the sky."""
_SHOWN_M = 8.0
"""Their median has this distance's colour, which is in the middle of the colours."""
_RIM_PICTURES = 12
"""The lens's dark rim is searched for in so many pictures."""
Layers = Callable[[Path], Sequence[Layer]]
"""What a picture's views say."""


@dataclass(frozen=True, eq=False)
class Fisheyes:
    """Pictures of one camera, and how they are cut."""

    pictures: Sequence[Path]
    lens: KannalaBrandt | Pinhole
    theta_max_rad: float
    mask: Bool[np.ndarray, "h w"] | None
    """What may be used."""
    mask_file: Path | None = None
    """Where that is from."""

    @property
    def views(self) -> tuple[PinholeView, ...]:
        """All of a picture."""
        return pinhole_views(self.lens, self.theta_max_rad)

    def usable(self) -> Bool[np.ndarray, "h w"]:
        """Pixels that see anything: inside the lens by its calibration, its dark rim, and the mask."""
        spread = self.pictures[:: max(len(self.pictures) // _RIM_PICTURES, 1)]
        found = rays(self.lens, self.theta_max_rad).within
        for more in (dark_rim(map(read_image, spread)), self.mask):
            found = found if more is None else found & more
        return found


def fisheye_depth(options: FisheyeDepthOptions, console: Console | None = None) -> Path:
    """Cut the views, or make the distance maps. A run that was interrupted continues.

    Returns:
        The folder that was written to.

    Raises:
        FileNotFoundError: the pictures, the calibration or a map are not there.
        InputError: an option or a file cannot be used, or the folder holds something else.
    """
    options.check()
    console, output = console or Console(), options.output
    fisheyes = open_fisheyes(options)
    network = load_ready_network(options.hf, options.hf_output) if options.hf is not None else None
    with only_writer(output, console):
        open_folder(output, output / RECORD, _record(options, fisheyes), "views")
        remove_leftovers(output)
        if network is not None:
            weights = {path.name: sha256_of(path) for path in weight_files(Path(str(options.hf)))}
            about = {"network": network.name, "kind": network.kind, "weights": weights}

            def predicted(picture: Path) -> list[Layer]:
                return view_layers(network, fisheyes.views, read_image(picture))

            _make(output, fisheyes, {path: [] for path in fisheyes.pictures}, predicted, network.kind, about, console)
        elif options.maps is not None:
            assert options.maps_kind is not None
            found = {path: _maps_of(options.maps, path, fisheyes.views) for path in fisheyes.pictures}
            every = [path for paths in found.values() for path in paths]
            metres = count_m(options.maps, every, options.maps_kind, options.metres_per_count)
            about = {"maps": str(options.maps.absolute()), "kind": options.maps_kind, "along": options.maps_along}

            def read(picture: Path) -> list[Layer]:
                maps = read_maps(found[picture], metres)
                layers = [view.layer(each) for view, each in zip(fisheyes.views, maps, strict=True)]
                along_ray = options.maps_along == "ray"
                return [replace(each, cosine=np.ones_like(each.cosine)) if along_ray else each for each in layers]

            _make(output, fisheyes, found, read, options.maps_kind, {**about, "metres_per_count": metres}, console)
        else:
            jobs = [partial(_cut, path, output, fisheyes) for path in fisheyes.pictures]
            run_jobs(jobs, "Cutting views", console)
            say(
                console,
                f"{len(jobs) * len(fisheyes.views)} views: {output / VIEWS}\nLet a network write a map of each view, "
                "as .npy or 16-bit .png of its name and size, into a folder. Then run this command again with "
                "--maps FOLDER --maps-kind metric, relative or inverse.",
            )
    return output


def open_fisheyes(options: FisheyeDepthOptions) -> Fisheyes:
    """Read the calibration, and check the sizes of all pictures.

    Raises:
        FileNotFoundError: a file or folder is not there.
        InputError: there is no picture, one is of another size than the lens, or a file cannot be used.
    """
    if not options.calibration.is_file():
        raise FileNotFoundError(f"{options.calibration}: no such file. --calibration names the file with the lens.")
    lens, theta_max_rad = read_lens(options.calibration, options.camera or ""), math.radians(options.theta_max_deg)
    if not options.pictures.is_dir():
        raise FileNotFoundError(f"{options.pictures}: no such folder. Give the folder of one camera's pictures.")
    listed = [path for path in options.pictures.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES]
    pictures = sorted((path for path in listed if not path.name.startswith(".")), key=as_people_count)
    if not pictures:
        raise InputError(f"{options.pictures}: has no picture; expected files that end in {', '.join(IMAGE_SUFFIXES)}.")
    names = [path.stem for path in pictures]
    if twice := {name for name in names if names.count(name) > 1}:
        raise InputError(f"{options.pictures}: has several pictures {min(twice)}. Keep one of each name.")
    for path in [*pictures, *([options.mask] if options.mask else [])]:
        check_picture_size(path, lens)
    if not isinstance(lens, KannalaBrandt | Pinhole):
        fit = fit_kannala_brandt(lens, theta_max_rad)
        off = (
            f"{options.calibration}: a Kannala-Brandt camera differs from this {lens.model} lens by {fit.rms_px:.2f} px"
        )
        require(fit.rms_px <= MAX_FIT_RMS_PX, off, f"at most {MAX_FIT_RMS_PX} px rms. Use a smaller --theta-max-deg")
        lens = fit.camera
    return Fisheyes(pictures, lens, theta_max_rad, read_mask(options.mask) if options.mask else None, options.mask)


def _record(options: FisheyeDepthOptions, fisheyes: Fisheyes) -> dict[str, Any]:
    """Say how pictures are cut; a view's axes are columns in the camera's frame (x right, y down, z forward)."""
    return {
        "pictures": str(options.pictures.absolute()),
        "lens": fisheyes.lens.to_dict(),
        "theta_max_deg": options.theta_max_deg,
        "mask": options.mask and str(options.mask.absolute()),
        "views": [
            {
                "name": f"PICTURE_{number}",
                **{key: getattr(view, key) for key in ("width", "height", "focal_px")},
                "view_to_camera": view.view_to_camera.tolist(),
            }
            for number, view in enumerate(fisheyes.views)
        ],
    }


def _cut(picture: Path, output: Path, fisheyes: Fisheyes) -> None:
    paths = [output / VIEWS / f"{picture.stem}_{number}.png" for number in range(len(fisheyes.views))]
    if all(is_newer(path, [picture]) for path in paths):
        return
    rgb = read_image(picture)
    for path, view in zip(paths, fisheyes.views, strict=True):
        write_png(path, view.cut(rgb))


def _maps_of(folder: Path, picture: Path, views: Sequence[PinholeView]) -> list[Path]:
    stems = [folder / f"{picture.stem}_{number}" for number in range(len(views))]
    return [find_map(stem, stem.name, (view.width, view.height)) for stem, view in zip(stems, views, strict=True)]


def _make(
    output: Path,
    fisheyes: Fisheyes,
    sources: dict[Path, list[Path]],
    layers: Layers,
    kind: Kind,
    about: dict[str, Any],
    console: Console,
) -> None:
    """Write the distance maps that are missing, or older than what they are made of, and pictures of them."""
    open_folder(output / DISTANCE, output / DISTANCE / MADE_OF, about, "maps")
    suffix = ".png" if kind == "metric" else ".npy"
    targets = {path: output / DISTANCE / f"{path.stem}{suffix}" for path in sources}
    masks = [] if fisheyes.mask_file is None else [fisheyes.mask_file]
    missing = [path for path, target in targets.items() if not is_newer(target, [path, *sources[path], *masks])]
    usable = fisheyes.usable() if missing else np.empty((0, 0), bool)
    with progress_bars(console, counted=True) as progress:
        for path in progress.track(missing, description="Distance maps"):
            distance = joined(layers(path), usable, kind)
            shown_m = distance * (1 if kind == "metric" else _SHOWN_M)
            write_png(output / COLOURED / f"{path.stem}.png", np.hstack((read_image(path), colour_distance(shown_m))))
            if kind == "metric":
                write_distance_png(targets[path], distance)
            else:
                write_atomically(targets[path], partial(np.save, arr=distance))
    unit = "metres, 16-bit PNGs of 1/256 m" if kind == "metric" else "without a unit: each map's median is 1"
    say(console, f"{len(targets)} distance maps ({unit}): {output / DISTANCE}; to look at: {output / COLOURED}")


def joined(layers: Sequence[Layer], usable: Bool[np.ndarray, "h w"], kind: Kind) -> Float32[np.ndarray, "h w"]:
    """Join what the views of a picture say: distance along the ray, 0 = none.

    It is metres if the maps are. Others are divided by their median.
    """
    distance = np.where(usable, agreed(layers, usable, kind), 0)
    farthest = FARTHEST_M
    if kind != "metric" and (distance > 0).any():
        distance /= np.median(distance[distance > 0])
        farthest = FARTHEST
    return np.where(distance <= farthest, distance, 0).astype(np.float32)
