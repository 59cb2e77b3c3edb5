"""The picture of a bad moment from above: the person concerned, what was predicted for it, and where it went."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from replay import colours
from replay.moment_ranking import Candidate
from replay.picture import draw_scene, new_figure, write_png
from schemas.messages import FloatArray

SIZE_IN, DPI = (5.6, 4.2), 100
MARGIN_M = 2.5  # around whatever matters
LEAST_HALF_HEIGHT_M = 6.0
CONCERNED, WENT = "#ff4f79", "#ffffff"  # the ring around the person, and its way
CAPTION_HEIGHT = 0.062  # of the picture


def draw_moment(candidate: Candidate, path: Path) -> None:
    """Writes a PNG that shows the person and the vehicle, and nobody's predictions but those concerned.

    Raises NoMatplotlib if that is missing, and PictureError if the file cannot be written.
    """
    figure = new_figure(SIZE_IN, DPI)
    axes = figure.add_axes((0.0, CAPTION_HEIGHT, 1.0, 1 - CAPTION_HEIGHT))
    result = candidate.result
    concerned = tuple(p for p in result.predictions.predictions if p.track_id in candidate.track_ids)
    centre, half = _section(candidate, [path.points_m for prediction in concerned for path in prediction.paths])
    seen = tuple(track for track in result.tracks.tracks if (abs(track.state[:2] - centre) < half).all())
    shown = replace(
        result,
        tracks=replace(result.tracks, tracks=seen),
        predictions=replace(result.predictions, predictions=concerned),
    )
    draw_scene(axes, shown, centre, half)
    _draw_way(axes, candidate)
    _draw_ring(axes, candidate.place_m, half[1])
    _draw_caption(figure, candidate, half[0])
    write_png(figure, path)


def _section(candidate: Candidate, paths_m: list[FloatArray]) -> tuple[FloatArray, tuple[float, float]]:
    """Returns the centre and half the size of a rectangle that holds vehicle, person, its way and predictions."""
    vehicle = candidate.result.sensors.map_from_vehicle[:2, 3]
    points = np.concatenate([vehicle[None], candidate.place_m[None], candidate.went_m, *paths_m])
    low, high = points.min(axis=0) - MARGIN_M, points.max(axis=0) + MARGIN_M
    aspect = SIZE_IN[0] / (SIZE_IN[1] * (1 - CAPTION_HEIGHT))
    width, height = ((high - low) / 2).tolist()
    half_height = max(height, width / aspect, LEAST_HALF_HEIGHT_M)
    return (low + high) / 2, (half_height * aspect, half_height)


def _draw_way(axes: Any, candidate: Candidate) -> None:
    way = np.concatenate([candidate.place_m[None], candidate.went_m])
    axes.plot(*way.T, color=WENT, linewidth=1.6, linestyle=(0, (1.2, 1.2)), zorder=9)
    if len(candidate.went_m):
        axes.scatter(*way[-1], s=42, marker="X", c=WENT, edgecolors=_BACKGROUND, linewidths=0.8, zorder=9)


def _draw_ring(axes: Any, place_m: FloatArray, half_height_m: float) -> None:
    from matplotlib.patches import Circle

    radius_m = max(0.75, 0.06 * half_height_m)  # to be found in a wide section, too
    axes.add_patch(Circle(place_m.tolist(), radius_m, facecolor="none", edgecolor=CONCERNED, linewidth=2.0, zorder=10))


def _draw_caption(figure: Any, candidate: Candidate, half_width_m: float) -> None:
    """Writes what the marks mean, in a line, beside a scale."""
    from matplotlib.lines import Line2D

    ink, middle = "#c9d1d9", CAPTION_HEIGHT / 2
    shows = "○ the person", "┅ where it went", "━ predicted" if candidate.track_ids else "no track"
    for x, text, colour in zip((0.02, 0.235, 0.515), shows, (CONCERNED, WENT, ink), strict=True):
        figure.text(x, middle, text, color=colour, fontsize=9, va="center")
    length_m = 5 if half_width_m > 15 else 2
    share = length_m / (2 * half_width_m)
    figure.add_artist(Line2D([0.98 - share, 0.98], [middle, middle], color=ink, linewidth=2, solid_capstyle="butt"))
    figure.text(0.97 - share, middle, f"{length_m} m", color=ink, fontsize=9, ha="right", va="center")


_BACKGROUND = "#{:02x}{:02x}{:02x}".format(*colours.BACKGROUND)
