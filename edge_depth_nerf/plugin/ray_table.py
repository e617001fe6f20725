"""Training rays read from a table of each lens, instead of nerfstudio's undistortion of every batch.

Host-facing. nerfstudio inverts a lens's polynomial by ten iterations for each pixel of each batch, and twice more for
its neighbours. The table holds the result, made once by nerfstudio's own `generate_rays` from a camera that is not
turned: the numbers are the same but for the rounding of one rotation. It lies in the scene's cache and is mapped into
memory (39 MB and five seconds for a lens of 1400×1400 px). Whole views keep the lenses rendered last in memory.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.model_components.ray_generators import RayGenerator
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from edge_depth_nerf.base.checked_cache import is_whole, keep_last, used, write_checked
from edge_depth_nerf.base.console import progress_bars
from edge_depth_nerf.plugin.fused.ray_samplers import rays_of

TABLE_VERSION = 2
"""Raised whenever the form of the file changes."""
KEPT_TABLES = 4
"""So many tables are kept of a scene, those used last: one for each set of lenses that was trained or shown."""
KEPT_VIEWS = 4
"""So many lenses' rays are kept in memory for whole views: of a drive's cameras, or of the viewer's resolutions."""
MOST_PIXELS = 1 << 24
"""Lenses with more pixels than this in all (a table of 335 MB) get no table."""
STRIP = 1 << 16
"""So many rays are made at once."""


def _lenses(cameras: Cameras) -> tuple[Float[Tensor, "lenses 13"], Int[Tensor, "cameras"]]:
    """List the different lenses, and the number of each camera's."""
    count = len(cameras)
    distortion = cameras.distortion_params
    values = [cameras.width, cameras.height, cameras.camera_type, cameras.fx, cameras.fy, cameras.cx, cameras.cy]
    values.append(torch.zeros(count, 6) if distortion is None else distortion)
    table = torch.cat([value.detach().cpu().double().view(count, -1) for value in values], dim=1)
    return torch.unique(table, dim=0, return_inverse=True)


def _make(lenses: Tensor, advance: Callable[[int], object]) -> np.ndarray:
    """Make the table of some lenses, each row by row; `advance` gets the number of finished pixels.

    Its columns are the direction in the camera's frame (OpenGL, unit length), the area of the pixel at distance 1, and
    the length of the direction before it was normalised.
    """
    parts = []
    for lens in lenses.float():
        width, height = int(lens[0]), int(lens[1])
        fx, fy, cx, cy = lens[3:7].view(4, 1, 1)
        pose, kind = torch.eye(4)[None, :3], int(lens[2])
        camera = Cameras(pose, fx, fy, cx, cy, width, height, distortion_params=lens[None, 7:], camera_type=kind)
        for first in range(0, width * height, STRIP):
            pixels = torch.arange(first, min(first + STRIP, width * height))
            coords = torch.stack([pixels // width, pixels % width], dim=-1) + 0.5
            rays = camera.generate_rays(torch.zeros(len(pixels), 1, dtype=torch.long), coords)
            parts.append(torch.cat([rays.directions, rays.pixel_area, rays.metadata["directions_norm"]], dim=-1))
            advance(len(pixels))
    return torch.cat(parts).numpy()


def _read(path: Path) -> Tensor | None:
    # another process may remove it meanwhile
    with suppress(OSError):
        if is_whole(path, TABLE_VERSION):
            # copy on write: torch wants what it could write to, and nobody does
            table = np.load(path, mmap_mode="c", allow_pickle=False)
            used(path)
            return torch.from_numpy(table)
    return None


class TableRayGenerator(RayGenerator):
    """nerfstudio's `RayGenerator`, for cameras that share a few lenses; rays differ by float32's noise at most."""

    table: Tensor
    lenses: Tensor
    """Where the rays of each camera's lens begin, and its width."""
    poses: Tensor

    def __init__(self, cameras: Cameras, folder: Path) -> None:
        """Make the table, or find it in `folder`; where that cannot be written the table stays in memory."""
        super().__init__(cameras)
        lenses, lens = _lenses(cameras)
        pixels = (lenses[:, 0] * lenses[:, 1]).long()
        digest = hashlib.sha256(f"rays {TABLE_VERSION}".encode() + lenses.numpy().tobytes())
        path = folder / f"{digest.hexdigest()[:32]}.npy"
        table = _read(path)
        if table is None:
            with progress_bars(CONSOLE, transient=True) as progress:
                task = progress.add_task("Making the table of rays (once) …", total=int(pixels.sum()))
                made = _make(lenses, partial(progress.advance, task))
            with suppress(OSError):
                write_checked(path, TABLE_VERSION, lambda file: np.save(file, made))
                keep_last(folder, "*.npy", KEPT_TABLES)
            # from the file, so that processes share the memory
            table = _read(path)
            if table is None:
                table = torch.from_numpy(made)
        first = torch.cumsum(pixels, 0) - pixels
        for name, value in (
            ("table", table),
            ("lenses", torch.stack([first[lens], cameras.width[:, 0].cpu()], dim=1)),
            ("poses", cameras.camera_to_worlds.detach()),
        ):
            self.register_buffer(name, value.to(cameras.device), persistent=False)

    @staticmethod
    def suits(cameras: Cameras) -> bool:
        """Say whether a table can serve these cameras: few lenses, no times, no metadata of a camera's own."""
        kinds = (CameraType.PERSPECTIVE.value, CameraType.FISHEYE.value)
        if cameras.times is not None or cameras.metadata or cameras.camera_to_worlds.requires_grad:
            return False
        lenses, _ = _lenses(cameras)
        return bool(torch.isin(cameras.camera_type, torch.tensor(kinds, device=cameras.device)).all()) and (
            float((lenses[:, 0] * lenses[:, 1]).sum()) <= MOST_PIXELS
        )

    def forward(self, ray_indices: Int[Tensor, "num_rays 3"]) -> RayBundle:
        """Give the rays of pixels: picture, row and column."""
        picture, row, column = ray_indices.unbind(-1)
        # rows by `index_select` take a third of the time, and none is counted from the end
        first, width = self.lenses.index_select(0, picture).unbind(-1)
        place = torch.addcmul(first + column, row, width)
        ray, pose = self.table.index_select(0, place), self.poses.index_select(0, picture)
        x, y, z, area, length = ray.split(1, dim=1)
        if ray.device.type == "cuda":
            directions = torch.sum(ray[:, None, :3] * pose[:, :3, :3], dim=-1)
        else:  # where a sum over three numbers takes several times as long
            directions = x * pose[:, :3, 0] + y * pose[:, :3, 1] + z * pose[:, :3, 2]
        return rays_of(
            origins=pose[:, :3, 3],
            directions=directions,
            pixel_area=area,
            camera_indices=picture[:, None],
            metadata={"directions_norm": length},
        )


class ViewRays:
    """Rays of whole views on the CPU, as nerfstudio's `generate_rays` makes them, but for the rounding of one rotation.

    The rays of a lens are made once and then turned: making them takes a sixth of a view.
    """

    def __init__(self) -> None:
        self._of_lens = lru_cache(KEPT_VIEWS)(_make_in_memory)

    def of(self, camera: Cameras) -> RayBundle:
        """Give the rays of a camera of shape [1], as [height, width]."""
        if camera.shape != (1,) or not TableRayGenerator.suits(camera):
            return camera.generate_rays(camera_indices=0, keep_shape=True)
        lenses, _ = _lenses(camera)
        directions, areas, lengths = self._of_lens(tuple(lenses[0].tolist()))
        pose, shape = camera.camera_to_worlds[0], (int(camera.height), int(camera.width))
        return RayBundle(
            # nerfstudio flattens them for each part of the view, and would copy them each time
            origins=pose[:, 3].expand(*shape, 3).contiguous(),
            directions=(directions @ pose[:, :3].T).view(*shape, 3),
            pixel_area=areas.view(*shape, 1),
            camera_indices=torch.zeros(*shape, 1, dtype=torch.long),
            metadata={"directions_norm": lengths.view(*shape, 1)},
        )


def _make_in_memory(lens: tuple[float, ...]) -> tuple[Tensor, Tensor, Tensor]:
    """Make directions in the camera's frame, areas, and lengths of a lens's rays; [pixels, 3 or 1]."""
    table = torch.from_numpy(_make(torch.tensor([lens], dtype=torch.float64), lambda _: None))
    directions, areas, lengths = (part.contiguous() for part in table.split((3, 1, 1), dim=1))
    return directions, areas, lengths
