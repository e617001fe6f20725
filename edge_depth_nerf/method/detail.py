"""Detail: what pictures show beyond their own renderings, carried to new views by distance.

Not of the paper (issue 21). A field that is trained for minutes renders less detail than its training pictures have.
The pictures around a new view show most of what it lacks: a pixel of the view has a place in the scene, by its rendered
distance, and pictures that see this place show its detail. Pure torch.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from edge_depth_nerf.cameras import Camera

AGREEMENT = 0.03
"""Standard deviation of the ratio of two distances of one place."""
TURN = 0.2
"""Directions count exp((cos - 1) / TURN): 40° count a third."""
LEAST = 0.1
"""Added to the sum of the weights: where no picture counts, nothing is added."""
OVEREXPOSED = 254.5 / 255
"""From here on a colour is clipped."""
POINTS_AT_ONCE = 1 << 18
SOME_POINTS = 400
"""So many points of a view are enough to find the pictures that see most of it."""


@dataclass(frozen=True, eq=False)
class Detail:
    """What a picture shows beyond its own rendering."""

    lens: Camera
    pose: Float[Tensor, "3 4"]
    """Camera to scene: x right, y up, z backwards, as nerfstudio has it."""
    colours: Float[Tensor, "3 h w"]
    """The picture less its rendering, without its exposure; 0 where the picture may not be used."""
    distance: Float[Tensor, "1 h w"]
    """Rendered, in the scene's unit; 0 where the picture may not be used."""


def detail_of(
    lens: Camera,
    pose: Float[Tensor, "3 4"],
    image: Float[Tensor, "h w 3"],
    beyond: Float[Tensor, "h w 3"],
    distance: Float[Tensor, "h w"],
    usable: Bool[Tensor, "h w"],
) -> Detail:
    """Keep a picture's detail: `beyond` are its colours less its rendering's; more than 1 counts as 1.

    `distance` is rendered, in the scene's unit. Colours are 0 to 1, but an overexposed one may be any brighter: it does
    not say that a bright rendering is too bright.
    """
    beyond = torch.where(image >= OVEREXPOSED, beyond.clamp(min=0), beyond)
    # half the memory; rounding is 0.05 %, much less than AGREEMENT
    colours = torch.where(usable[..., None], beyond, 0).clamp(-1, 1).movedim(-1, 0).half()
    return Detail(lens, pose, colours.contiguous(), torch.where(usable, distance, 0)[None].half())


def seen_from(
    lens: Camera, pose: Float[Tensor, "3 4"], points: Float[Tensor, "points 3"]
) -> tuple[Float[Tensor, "points 2"], Float[Tensor, "points 3"], Float[Tensor, "points"]]:
    """Look at points in the scene from a picture.

    Returns:
        Where they are in the picture, -1 to 1 over its width and height, and beyond where it does not see them; the
        unit vectors to them; and their distances.
    """
    ahead = points - pose[:, 3]
    distance = ahead.norm(dim=-1)
    pixels, _ = lens.project(ahead @ pose[:, :3] * pose.new_tensor([1.0, -1.0, -1.0]))
    place = 2 * pixels / pixels.new_tensor([lens.width, lens.height]) - 1
    # not a number is what the lens cannot see
    return place.nan_to_num(nan=-2.0).clamp(-2, 2), ahead / distance.clamp(min=1e-9)[:, None], distance


def _counts(
    directions: Float[Tensor, "points 3"],
    distance: Float[Tensor, "points"],
    to_points: Float[Tensor, "points 3"],
    from_picture: Float[Tensor, "points"],
) -> Float[Tensor, "points"]:
    """Weigh pictures that see a place: more from a similar direction, and less from further away."""
    turned = torch.exp(((to_points * directions).sum(-1) - 1) / TURN)
    return turned * (distance / from_picture.clamp(min=1e-9)).clamp(max=1)


def pictures_that_see(
    origins: Float[Tensor, "rays 3"],
    directions: Float[Tensor, "rays 3"],
    distance: Float[Tensor, "rays"],
    pictures: Sequence[tuple[Camera, Float[Tensor, "3 4"]]],
    most: int,
) -> list[int]:
    """Choose the pictures that together see most of a view, as far as lenses and poses tell.

    One after the other, always the one that adds most to what the others show: two pictures of one place in one
    direction add less than two of different directions.

    Args:
        origins: of the view's rays.
        directions: of the view's rays, unit vectors.
        distance: at which the rays end, in the scene's unit.
        pictures: lens and pose of each.
        most: at most so many are chosen.

    Returns:
        Their numbers, in the order of choice; fewer if fewer see anything.
    """
    count = min(SOME_POINTS, len(distance))
    some = torch.arange(count, device=distance.device) * len(distance) // max(1, count)
    origins, directions, distance = origins[some], directions[some], distance[some]
    points = origins + directions * distance[:, None]
    rows = []
    for lens, pose in pictures:
        place, to_points, from_picture = seen_from(lens, pose, points)
        inside = (place.abs() < 1).all(-1)
        # a ray of nerfstudio's can be undefined, at the rim of a lens
        rows.append(torch.where(inside, _counts(directions, distance, to_points, from_picture), 0).nan_to_num(nan=0.0))
    chosen: list[int] = []
    if not rows:
        return chosen
    counts, total = torch.stack(rows), torch.zeros_like(distance)
    for _ in range(min(most, len(rows))):
        together = total + counts
        added = (together / (together + LEAST) - total / (total + LEAST)).sum(dim=-1)
        added[chosen] = 0
        best = int(added.argmax())
        if not added[best] > 0:
            break
        chosen.append(best)
        total = total + counts[best]
    return chosen


def carried(
    origins: Float[Tensor, "rays 3"],
    directions: Float[Tensor, "rays 3"],
    distance: Float[Tensor, "rays"],
    details: Iterable[Detail],
) -> Float[Tensor, "rays 3"]:
    """Look up the detail of a view in pictures around it; the view's rays are those of `pictures_that_see`.

    A picture counts where its own rendered distance agrees with the place that a ray ends at: it sees this place, and
    nothing in front of it.

    Returns:
        What is to be added to the colours of the rays: the weighted mean of the pictures' detail, less where few count.
    """
    details = list(details)
    parts = zip(*(each.split(POINTS_AT_ONCE) for each in (origins, directions, distance)), strict=True)
    return torch.cat([_carried(at, along, far, details) for at, along, far in parts])


def _carried(origins: Tensor, directions: Tensor, distance: Tensor, details: list[Detail]) -> Tensor:
    points = origins + directions * distance[:, None]
    total, weights = torch.zeros_like(points), torch.full_like(distance, LEAST)
    for detail in details:
        place, to_points, from_picture = seen_from(detail.lens, detail.pose, points)
        # between an edge's two sides nothing has the distance halfway
        rendered = _looked_up(detail.distance, place, "nearest")[:, 0]
        agrees = torch.exp(-0.5 * ((rendered / from_picture.clamp(min=1e-9) - 1) / AGREEMENT).square())
        weight = (agrees * _counts(directions, distance, to_points, from_picture)).nan_to_num(nan=0.0)
        total += weight[:, None] * _looked_up(detail.colours, place, "bilinear")
        weights += weight
    return total / weights[:, None]


def _looked_up(values: Float[Tensor, "channels h w"], place: Float[Tensor, "points 2"], mode: str) -> Tensor:
    """Look up values of a picture between its pixels, [points, channels]; 0 beyond its border."""
    found = F.grid_sample(values[None].float(), place[None, None], mode=mode, align_corners=False)
    return found[0, :, 0].t()
