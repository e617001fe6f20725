"""Pictures to look at: maps as colour, points over a picture, panels with titles and legends, side by side.

Pure. Pictures are H×W×3 uint8 RGB, distances H×W metres along the ray. Text is drawn by OpenCV, which knows ASCII
alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

NEAREST_M, FARTHEST_M = 1.0, 60.0
"""The colours of a distance run over these, logarithmically."""
NO_VALUE_RGB = (40, 40, 40)
"""Colour of pixels without a distance."""
INK_RGB = (30, 30, 30)
"""Colour of text and lines on white."""
_FONT = cv2.FONT_HERSHEY_SIMPLEX


@dataclass(frozen=True, eq=False)
class ColourScale:
    """Which colour stands for which value; values beyond the ends take the colours of the ends."""

    low: float
    """Value of the first colour."""
    high: float
    """Value of the last colour."""
    colours: NDArray[np.uint8]
    """256×3 RGB, from low to high."""
    ticks: tuple[float, ...]
    """Values that a legend names, rising."""
    unit: str
    """What a legend writes behind the last tick."""
    logarithmic: bool = True
    """Whether equal ratios, or else equal differences, are equally far apart."""

    def position(self, values: NDArray) -> NDArray:
        """Say where values lie on the scale: 0 at its low end, 1 at its high end, never beyond."""
        clipped = np.clip(values, self.low, self.high)
        if self.logarithmic:
            return np.log(clipped / self.low) / np.log(self.high / self.low)
        return (clipped - self.low) / (self.high - self.low)

    def values_at(self, positions: NDArray) -> NDArray:
        """Give the values at places on the scale, 0 to 1."""
        if self.logarithmic:
            return self.low * (self.high / self.low) ** positions
        return self.low + (self.high - self.low) * positions

    def coloured(self, values: NDArray, shown: NDArray[np.bool_]) -> NDArray[np.uint8]:
        """Colour H×W values where `shown` is True; the others have the colour of no value.

        Returns:
            H×W×3 uint8 RGB.

        """
        steps = np.rint(self.position(np.where(shown, values, self.low)) * 255).astype(np.uint8)
        return np.where(shown[..., None], self.colours[steps], np.array(NO_VALUE_RGB, np.uint8)).astype(np.uint8)


def _opencv_colours(colormap: int) -> NDArray[np.uint8]:
    return cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], colormap)[:, 0, ::-1].astype(np.uint8)


def _between(*stops: tuple[int, int, int]) -> NDArray[np.uint8]:
    """256 colours that pass through evenly spaced stops."""
    places = np.linspace(0, 255, len(stops))
    channels = [np.interp(np.arange(256), places, channel) for channel in np.transpose(stops)]
    return np.rint(np.stack(channels, -1)).astype(np.uint8)


DISTANCE = ColourScale(
    NEAREST_M, FARTHEST_M, _opencv_colours(cv2.COLORMAP_TURBO)[::-1], (1.0, 2.0, 5.0, 10.0, 20.0, 40.0, 60.0), "m"
)
"""Distances: near is red, far is blue."""
SIGMA = ColourScale(0.05, 20.0, _opencv_colours(cv2.COLORMAP_PLASMA), (0.05, 0.2, 0.5, 2.0, 5.0, 20.0), "m")
"""Standard deviations of a distance: sure is dark, unsure is bright."""
RELATIVE_ERROR = ColourScale(
    -50.0,
    50.0,
    _between((25, 70, 190), (240, 240, 240), (190, 30, 30)),
    (-50.0, -25.0, 0.0, 25.0, 50.0),
    "%",
    logarithmic=False,
)
"""Relative errors of a distance in percent: too near is blue, too far is red."""
COLOUR_ERROR = ColourScale(
    0.0, 25.0, _opencv_colours(cv2.COLORMAP_INFERNO), (0.0, 5.0, 10.0, 15.0, 20.0, 25.0), "%", logarithmic=False
)
"""Errors of a colour in percent of the whole range: right is dark, wrong is bright."""


def is_distance(distance_m: NDArray) -> NDArray[np.bool_]:
    """Say where a map has a value: where it is positive and finite."""
    return np.isfinite(distance_m) & (distance_m > 0)


def colour_distance(distance_m: NDArray, mask: NDArray[np.bool_] | None = None) -> NDArray[np.uint8]:
    """Colour a distance map: near is red, far is blue, the same distance always has the same colour.

    Args:
        distance_m: H×W metres; not positive or not finite = no value.
        mask: H×W, True = show; others are drawn as having no value.

    Returns:
        H×W×3 uint8 RGB.

    """
    shown = is_distance(distance_m)
    return DISTANCE.coloured(distance_m, shown if mask is None else shown & mask)


def distance_of_colours(coloured: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Read a distance map back from its colours, as exactly as these tell: to 1.6 %, and no farther than their ends.

    Args:
        coloured: H×W×3, by `colour_distance`, unharmed but for the last bit.

    Returns:
        H×W metres, 0 = no value.

    """
    palette = np.vstack((DISTANCE.colours, [NO_VALUE_RGB])).astype(int)
    metres = np.append(DISTANCE.values_at(np.arange(256) / 255), 0.0).astype(np.float32)
    places = np.array((1 << 16, 1 << 8, 1))
    codes, inverse = np.unique(coloured.reshape(-1, 3).astype(int) @ places, return_inverse=True)
    there = codes[:, None] // places % 256
    nearest = np.square(there[:, None] - palette).sum(-1).argmin(1)
    return metres[nearest][inverse].reshape(coloured.shape[:2])


def resize(pixels: NDArray, size: tuple[int, int]) -> NDArray:
    """Bring a picture or a map to a size (width, height), for looking at.

    Pictures are averaged when they shrink. Maps (bool, float) keep the values they have: an average over an edge would
    be a distance that is nowhere.
    """
    if pixels.dtype == np.uint8:
        smaller = size[0] < pixels.shape[1]
        return cv2.resize(pixels, size, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_CUBIC)
    if pixels.dtype == np.bool_:
        return cv2.resize(pixels.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST_EXACT) > 0
    return cv2.resize(pixels, size, interpolation=cv2.INTER_NEAREST_EXACT)


def draw_points(
    picture: NDArray[np.uint8], distance_m: NDArray[np.float32], size: tuple[int, int]
) -> NDArray[np.uint8]:
    """Draw values of a distance map as discs over its picture.

    Where they are dense, one of each small cell is drawn, so that the picture can be seen between them; the one nearest
    to the cell's centre, whatever its distance: a far one that shines through a near thing is to be seen as well.

    Args:
        picture: H×W×3; shown paler, so that the colours of the discs stand out.
        distance_m: H×W metres; not positive or not finite = no value.
        size: width and height of what is made, px.

    """
    height, width = distance_m.shape
    canvas = resize(picture, size)
    canvas = cv2.addWeighted(canvas, 0.7, np.full_like(canvas, 90), 0.3, 0)
    rows, columns = np.nonzero(is_distance(distance_m))
    # pixel centres are at +0.5 in both
    x, y = (columns + 0.5) * size[0] / width, (rows + 0.5) * size[1] / height
    # a whole number of the map's pixels, lest the two grids interfere
    pixel = size[0] / width
    cell_px = math.ceil(max(size[0] / 90, 4.0) / pixel) * pixel
    column, row = np.floor(x / cell_px), np.floor(y / cell_px)
    off_centre = np.hypot(x / cell_px - column - 0.5, y / cell_px - row - 0.5)
    nearest_first = np.lexsort((off_centre, column, row))
    cells = np.stack((row, column), -1)[nearest_first]
    first = np.ones(len(cells), bool)
    first[1:] = (cells[1:] != cells[:-1]).any(1)
    chosen = nearest_first[first]

    nothing_m = 1e9
    discs_m = np.full((size[1], size[0]), nothing_m, np.float32)
    discs_m[y[chosen].astype(int), x[chosen].astype(int)] = distance_m[rows[chosen], columns[chosen]]
    radius = max(round(0.28 * cell_px), 1)
    # eroding takes the least value under the disc
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    discs_m = cv2.erode(discs_m, disc)
    return np.where((discs_m < nothing_m)[..., None], colour_distance(discs_m), canvas)


def tinted(
    picture: NDArray[np.uint8], where: NDArray[np.bool_], colour: tuple[int, int, int], hatched: bool = False
) -> NDArray[np.uint8]:
    """Tint a part of a picture; `hatched` adds diagonal lines in the full colour, for those who confuse two tints."""
    mixed = cv2.addWeighted(picture, 0.5, np.full_like(picture, colour), 0.5, 0)
    if hatched:
        row, column = np.indices(where.shape)
        mixed[(row + column) % 12 < 3] = colour
    return np.where(where[..., None], mixed, picture)


def text_width(text: str, scale: float) -> int:
    """Say how wide `write_text` makes a text, px."""
    return cv2.getTextSize(text, _FONT, scale, 1)[0][0]


def write_text(
    sheet: NDArray[np.uint8],
    text: str,
    at: tuple[int, int],
    scale: float = 0.6,
    *,
    align: float = 0.0,
    max_width: int | None = None,
    colour: tuple[int, int, int] = INK_RGB,
    halo: bool = False,
) -> int:
    """Write ASCII text into a picture, in place.

    Args:
        sheet: the picture.
        text: one line; what is not ASCII becomes a question mark.
        at: x and baseline y, px.
        scale: 1 is about 22 px high.
        align: 0 = the text begins at x, 0.5 = it is centred there, 1 = it ends there.
        max_width: the text is made smaller where it would be wider, px.
        colour: RGB.
        halo: whether it gets a white rim, to be read over lines.

    Returns:
        Its width, px.

    """
    text = text.encode("ascii", "replace").decode()
    width = text_width(text, scale)
    if max_width is not None and width > max_width:
        scale *= max_width / width
        width = text_width(text, scale)
    x = at[0] - round(align * width)
    if halo:
        cv2.putText(sheet, text, (x, at[1]), _FONT, scale, (255, 255, 255), 4, cv2.LINE_AA)
    cv2.putText(sheet, text, (x, at[1]), _FONT, scale, colour, 1, cv2.LINE_AA)
    return width


def with_colour_bar(sheet: NDArray[np.uint8], scale: ColourScale) -> NDArray[np.uint8]:
    """Put the legend of a scale below an H×W×3 sheet, at its left."""
    legend = colour_bar(scale, min(sheet.shape[1], 600))
    below = np.full((legend.shape[0], sheet.shape[1], 3), 255, np.uint8)
    below[:, : legend.shape[1]] = legend
    return np.vstack((sheet, below))


def colour_bar(scale: ColourScale, width: int) -> NDArray[np.uint8]:
    """Draw the legend of a scale: its colours with their values below, and the colour of no value.

    Returns:
        40 px high, `width` px wide, on white.

    """
    bar = np.full((40, width, 3), 255, np.uint8)
    none_width, margin = 70, 16
    length = max(width - none_width - 2 * margin, 2)
    steps = np.rint(np.linspace(0, 255, length)).astype(int)
    bar[6:18, margin : margin + length] = scale.colours[steps]
    places = scale.position(np.array(scale.ticks, float))
    labels = [*(f"{tick:g}" for tick in scale.ticks[:-1]), f"{scale.ticks[-1]:g} {scale.unit}"]
    room = width
    for where, label in zip(places[::-1], labels[::-1], strict=True):
        x = margin + round(float(where) * (length - 1))
        bar[18:22, x] = INK_RGB
        half = text_width(label, 0.42) // 2
        if x + half < room:  # where ticks are too near to each other, the lower one goes without
            write_text(bar, label, (x, 36), 0.42, align=0.5)
            room = x - half - 4
    left = margin + length + margin
    bar[6:18, left + 22 : left + 52] = NO_VALUE_RGB
    write_text(bar, "none", (left + 37, 36), 0.42, align=0.5)
    return bar


def swatches(names: Sequence[tuple[str, tuple[int, int, int]]], width: int) -> NDArray[np.uint8]:
    """Draw a legend of named colours, as high as a colour bar."""
    bar = np.full((40, width, 3), 255, np.uint8)
    x = 8
    for name, colour in names:
        bar[10:26, x : x + 24] = colour
        x += 32
        x += write_text(bar, name, (x, 24), 0.5, max_width=max(width - x, 1)) + 18
    return bar


def panel(picture: NDArray[np.uint8], title: str, legend: NDArray[np.uint8] | None = None) -> NDArray[np.uint8]:
    """Put a title above a picture and a legend of its width below it; without one that place stays white."""
    width = picture.shape[1]
    bar = np.full((30, width, 3), 255, np.uint8)
    write_text(bar, title, (2, 21), max_width=width - 4)
    return np.vstack((bar, picture, np.full((40, width, 3), 255, np.uint8) if legend is None else legend))


def lay_out(panels: Sequence[NDArray[np.uint8]], columns: int, heading: Sequence[str]) -> NDArray[np.uint8]:
    """Lay out panels of one size row by row, under lines of text.

    Args:
        panels: H×W×3 each.
        columns: how many stand side by side.
        heading: the lines, the first one large.

    """
    gap, line = 14, 28
    height, width = panels[0].shape[:2]
    rows = -(-len(panels) // columns)
    top = gap + line * len(heading) + 6
    made = np.full((top + rows * (height + gap), gap + columns * (width + gap), 3), 255, np.uint8)
    for number, text in enumerate(heading):
        at = (gap, gap + line * number + 18)
        write_text(made, text, at, 0.55 if number else 0.75, max_width=made.shape[1] - 2 * gap)
    for number, one in enumerate(panels):
        y, x = top + number // columns * (height + gap), gap + number % columns * (width + gap)
        made[y : y + height, x : x + width] = one
    return made


def side_by_side(rows: Sequence[Sequence[NDArray[np.uint8]]], titles: Sequence[str]) -> NDArray[np.uint8]:
    """Lay out pictures in rows, with a title above each column and a thin gap between them.

    Args:
        rows: each with one H×W×3 picture a column, of one size in a row; narrower ones stand in the middle.
        titles: one a column.

    """
    gap, bar = 6, 34
    heights, width = [row[0].shape[0] for row in rows], max(row[0].shape[1] for row in rows)
    sheet = np.full((bar + sum(heights) + gap * (len(rows) - 1), len(titles) * (width + gap) - gap, 3), 255, np.uint8)
    for column, title in enumerate(titles):
        left, top = column * (width + gap), bar
        write_text(sheet, title, (left + width // 2, 23), align=0.5, max_width=width)
        for row, height in zip(rows, heights, strict=True):
            own = row[column].shape[1]
            begin = left + (width - own) // 2
            sheet[top : top + height, begin : begin + own] = row[column]
            top += height + gap
    return sheet
