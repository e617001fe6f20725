"""Pictures to look at: maps as colour, points over a picture, panels with titles and legends, side by side.

Pure. Pictures are H×W×3 uint8 RGB, distances H×W metres along the ray. Letters and legends are matplotlib's; pictures
stand beside them pixel by pixel.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.figure import Figure
    from matplotlib.legend import Legend

NEAREST_M, FARTHEST_M = 1.0, 60.0
"""The colours of a distance run over these, logarithmically."""
NO_VALUE_RGB = (40, 40, 40)
"""Colour of pixels without a distance."""
INK = "#1e1e1e"
"""Colour of text and lines on white."""


Colour = tuple[int, int, int]
"""Red, green, blue, 0 to 255."""


@dataclass(frozen=True, eq=False)
class ColourScale:
    """Which colour stands for which value; values beyond the ends take the colours of the ends."""

    low: float
    high: float
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
        """Colour H×W values as H×W×3 RGB where `shown` is True; the others have the colour of no value."""
        steps = np.rint(self.position(np.where(shown, values, self.low)) * 255).astype(np.uint8)
        return np.where(shown[..., None], self.colours[steps], np.array(NO_VALUE_RGB, np.uint8)).astype(np.uint8)


def _opencv_colours(colormap: int) -> NDArray[np.uint8]:
    return cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], colormap)[:, 0, ::-1].astype(np.uint8)


def _between(*stops: Colour) -> NDArray[np.uint8]:
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
HEIGHT = ColourScale(-2.0, 5.0, _opencv_colours(cv2.COLORMAP_TURBO), (-2.0, 0.0, 5.0), "m", logarithmic=False)
"""Heights above a scanner: low is blue, high is red."""
COLOUR_ERROR = ColourScale(
    0.0, 25.0, _opencv_colours(cv2.COLORMAP_INFERNO), (0.0, 5.0, 10.0, 15.0, 20.0, 25.0), "%", logarithmic=False
)
"""Errors of a colour in percent of the whole range: right is dark, wrong is bright."""


def is_distance(distance_m: NDArray) -> NDArray[np.bool_]:
    """Say where a map has a value: where it is positive and finite."""
    return np.isfinite(distance_m) & (distance_m > 0)


def colour_distance(distance_m: NDArray, mask: NDArray[np.bool_] | None = None) -> NDArray[np.uint8]:
    """Colour H×W metres as H×W×3 RGB: near is red, far is blue, the same distance always has the same colour.

    What is not positive or not finite, and what `mask` does not show (True = show), has the colour of no value.
    """
    shown = is_distance(distance_m)
    return DISTANCE.coloured(distance_m, shown if mask is None else shown & mask)


def distance_of_colours(coloured: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Read H×W metres back from their colours by `colour_distance`; 0 = no value.

    They are as exact as the colours: to 1.6 %, and no farther than their ends; the last bit may be harmed.
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
    picture: NDArray[np.uint8], where: NDArray[np.bool_], colour: Colour, hatched: bool = False
) -> NDArray[np.uint8]:
    """Tint a part of a picture; `hatched` adds diagonal lines in the full colour, for those who confuse two tints."""
    mixed = cv2.addWeighted(picture, 0.5, np.full_like(picture, colour), 0.5, 0)
    if hatched:
        row, column = np.indices(where.shape)
        mixed[(row + column) % 12 < 3] = colour
    return np.where(where[..., None], mixed, picture)


def _blank(width: int, height: int) -> Figure:
    """A white figure of so many pixels, to be written and drawn on."""
    # takes a third of a second; and no pyplot, which keeps one state for all threads
    from matplotlib.figure import Figure

    # with 64 pixels an inch, a power of two, none gets lost in rounding
    return Figure((width / 64, height / 64), dpi=64)


def drawn(figure: Figure) -> NDArray[np.uint8]:
    """Draw a figure of matplotlib's in its own size: H×W×3 RGB."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def text_bar(
    text: str, width: int, height: int = 30, size: float = 19.0, *, centred: bool = False
) -> NDArray[np.uint8]:
    """Write a line of text unchanged ($ starts no formula) on white, smaller where it would be wider.

    Width and height are pixels, the size of the letters is points. It stands in the middle, or else at the left.
    """
    figure = _blank(width, height)
    place, align = (0.5, "center") if centred else (2 / width, "left")
    line = figure.text(place, 0.5, text, size=size, ha=align, va="center_baseline", color=INK, parse_math=False)
    # step by step: hinted letters do not shrink evenly
    while size > 1 and line.get_window_extent().width > width - 4:
        size *= 0.95
        line.set_fontsize(size)
    return drawn(figure)


def with_colour_bar(sheet: NDArray[np.uint8], scale: ColourScale) -> NDArray[np.uint8]:
    """Put the legend of a scale below an H×W×3 sheet, at its left."""
    bar = colour_bar(scale, min(sheet.shape[1], 600))
    return np.vstack((sheet, _padded(bar, (0, 0), (0, sheet.shape[1] - bar.shape[1]))))


def colour_bar(scale: ColourScale, width: int) -> NDArray[np.uint8]:
    """Draw the legend of a scale: its colours with their values below, and the colour of no value."""
    return legend([("none", NO_VALUE_RGB)], width, scale)


def legend(names: Sequence[tuple[str, Colour]], width: int, scale: ColourScale | None = None) -> NDArray[np.uint8]:
    """Draw a legend of named colours, at the right of a scale's if there is one: 40 px high, on white."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, LogNorm, Normalize
    from matplotlib.patches import Patch

    # in a font's size, a letter is about 0.8 px wide, and a patch with its gaps 6
    letters = sum(len(name) for name, _ in names)
    figure, size = _blank(width, 40), min(14.0, width / 30, width / (0.8 * letters + 6 * len(names) + 1))
    patches = [Patch(color="#{:02x}{:02x}{:02x}".format(*colour), label=name) for name, colour in names]
    place = "center left" if scale is None else "center right"
    figure.legend(
        handles=patches, loc=place, ncols=len(names), fontsize=size, frameon=False, borderpad=0, handlelength=1.4
    )
    if scale is not None:
        norm = (LogNorm if scale.logarithmic else Normalize)(scale.low, scale.high)
        ticks = list(scale.ticks if width >= 300 else (scale.low, scale.high))
        axes = figure.add_axes((0.04, 0.55, 0.76, 0.3))
        bar = figure.colorbar(ScalarMappable(norm, ListedColormap(scale.colours / 255)), axes, orientation="horizontal")
        bar.set_ticks(ticks, labels=[f"{tick:g}{f' {scale.unit}' * (tick == ticks[-1])}" for tick in ticks], size=size)
        bar.minorticks_off()
        bar.outline.set_visible(False)
    return drawn(figure)


def add_legend_below(
    figure: Figure,
    handles: Sequence[Artist],
    names: Sequence[str],
    place: Literal["outside lower left", "outside lower center"],
) -> None:
    """Put a legend below a figure's axes, in as many columns as fit, and enlarge the figure by it."""
    if not names:
        return

    def legend_in(columns: int) -> Legend:
        return figure.legend(handles, names, loc=place, ncols=columns, frameon=False, borderaxespad=0)

    def is_too_wide(columns: int) -> bool:
        legend = legend_in(columns)
        width = legend.get_window_extent().width
        legend.remove()
        return bool(width > figure.bbox.width)

    # each try lays out the whole legend; more columns are wider
    fitting = bisect_left(range(1, len(names) + 1), True, key=is_too_wide)
    box = legend_in(max(fitting, 1)).get_window_extent()
    # a single name can be wider than the axes
    figure.set_size_inches(
        max(figure.bbox.width, box.width) / figure.dpi, (figure.bbox.height + box.height) / figure.dpi
    )


def panel(picture: NDArray[np.uint8], title: str, legend: NDArray[np.uint8] | None = None) -> NDArray[np.uint8]:
    """Put a title above a picture and a legend of its width below it; without one that place stays white."""
    below = np.full((40, picture.shape[1], 3), 255, np.uint8) if legend is None else legend
    return np.vstack((text_bar(title, picture.shape[1]), picture, below))


def _padded(picture: NDArray[np.uint8], rows: tuple[int, int], columns: tuple[int, int]) -> NDArray[np.uint8]:
    """Put white above and below, left and right of a picture."""
    return np.pad(picture, (rows, columns, (0, 0)), constant_values=255)


def lay_out(panels: Sequence[NDArray[np.uint8]], columns: int, heading: Sequence[str]) -> NDArray[np.uint8]:
    """Lay out panels of one size row by row, under lines of text, the first of them large."""
    cells = [_padded(one, (7, 7), (7, 7)) for one in panels]
    cells += [np.full_like(cells[0], 255)] * (-len(cells) % columns)
    rows = [np.hstack(cells[first : first + columns]) for first in range(0, len(cells), columns)]
    width = rows[0].shape[1] - 14
    lines = [text_bar(text, width, 28, 17.0 if number else 24.0) for number, text in enumerate(heading)]
    return np.vstack([*(_padded(line, (0, 0), (7, 7)) for line in lines), *rows])


def side_by_side(rows: Sequence[Sequence[NDArray[np.uint8]]], titles: Sequence[str]) -> NDArray[np.uint8]:
    """Lay out pictures in rows, with a title above each column and a thin gap between them.

    The pictures of a row have one size; those of narrower rows stand in the middle.
    """
    gap, width = 6, max(row[0].shape[1] for row in rows)
    lines = [[text_bar(title, width, 34 - gap, centred=True) for title in titles], *rows]
    sheet = [
        np.hstack([_padded(one, (0, gap), (spare // 2, gap + spare - spare // 2)) for one in line])
        for line in lines
        for spare in [width - line[0].shape[1]]
    ]
    return np.vstack(sheet)[:-gap, :-gap]
