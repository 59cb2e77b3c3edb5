"""A frame drawn from above as a PNG, and the choice of the frame that is worth it. matplotlib is optional (`view`)."""

from pathlib import Path
from typing import Any

import numpy as np

from replay import colours
from replay.drawing import (
    PERSON_RADIUS_M,
    dashes,
    mixture_ellipses,
    modal_paths,
    split_by_fallback,
    vehicle_outline,
)
from replay.errors import ReplayError
from replay.frame_result import FrameResult
from schemas.messages import FloatArray

NEAR_M = 20.0  # what is this near to the vehicle counts for a busy moment, and is what the picture shows
SIZE_IN, DPI = (12.8, 8.0), 150
MAP_SHARE = 0.76  # of the width; the legend has the rest
LEAST_WEIGHT = 0.03
INK = "#e8ecef"
FAINT_INK = "#8b949e"


class PictureError(ReplayError):
    """A picture that cannot be drawn or written."""


class NoMatplotlib(PictureError):
    """A picture for which matplotlib would have to be installed."""


def busyness(result: FrameResult) -> float:
    """Returns how much there is to see near the vehicle: pedestrians predicted by the model, those on the move most.

    A pedestrian counts one, and half of one more for each further modal path, as they fork where it gets interesting.
    Standing people and fallbacks count a tenth.
    """
    vehicle_m = result.sensors.map_from_vehicle[:2, 3]
    tracks = {track.id: track for track in result.tracks.tracks}
    total = 0.0
    for prediction in result.predictions.predictions:
        track = tracks.get(prediction.track_id)
        if track is None or np.hypot(*(track.state[:2] - vehicle_m)) > NEAR_M:
            continue
        walks = np.hypot(*track.state[2:]) > 0.5 and not prediction.fallback
        total += 1 + 0.5 * min(len(prediction.paths) - 1, 2) if walks else 0.1
    return total


class BusiestMoment:
    """Keeps the busiest frame of those it is offered, and only that one; of equally busy ones the first."""

    def __init__(self) -> None:
        self.result: FrameResult | None = None
        self._most = -1.0

    def offer(self, result: FrameResult) -> None:
        """Looks at one more frame."""
        now = busyness(result)
        if now > self._most:
            self._most, self.result = now, result


def draw_top_down(result: FrameResult, path: Path) -> None:
    """Writes a PNG of one frame from above, north up, the vehicle in the middle, with a legend.

    Raises PictureError if matplotlib is missing or the file cannot be written; a half-written one never stays.
    """
    figure = new_figure(SIZE_IN, DPI)
    axes = figure.add_axes((0.0, 0.0, MAP_SHARE, 1.0))
    half_height = NEAR_M * SIZE_IN[1] / (SIZE_IN[0] * MAP_SHARE)
    draw_scene(axes, result, result.sensors.map_from_vehicle[:2, 3], (NEAR_M, half_height))
    _draw_legend(figure, result)
    write_png(figure, path)


def new_figure(size_in: tuple[float, float], dpi: int) -> Any:
    """Returns an empty figure; raises NoMatplotlib if that is missing."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise NoMatplotlib('a picture needs matplotlib, which is not installed: pip install "pcgan[view]"') from error
    figure = Figure(figsize=size_in, dpi=dpi, facecolor=_hex(colours.BACKGROUND))
    FigureCanvasAgg(figure)
    return figure


def draw_scene(axes: Any, result: FrameResult, centre_m: FloatArray, half_m: tuple[float, float]) -> None:
    """Draws all of a frame that lies within a rectangle: the ground, what was sensed, people, predictions, vehicle."""
    _draw_ground(axes, centre_m, half_m)
    _draw_mixtures(axes, result)
    _draw_sensing(axes, result)
    _draw_paths(axes, result)
    _draw_people(axes, result)
    _draw_vehicle(axes, result)


def write_png(figure: Any, path: Path) -> None:
    """Writes a figure; raises PictureError if the file cannot be written, and leaves no half of one."""
    part = path.with_name(path.name + ".part")
    try:
        # no software version inside: two runs write the same bytes
        figure.savefig(part, format="png", metadata={"Software": None}, facecolor=figure.get_facecolor())
        part.replace(path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise PictureError(f"cannot write {path}: {error}") from error


def _draw_ground(axes: Any, centre_m: FloatArray, half_m: tuple[float, float]) -> None:
    """Sets the section shown, and draws a grid of 5 m."""
    (x, y), (half_width, half_height) = centre_m.tolist(), half_m
    axes.set(xlim=(x - half_width, x + half_width), ylim=(y - half_height, y + half_height), aspect="equal")
    axes.set_axis_off()
    places = [np.arange(np.ceil((c - h) / 5) * 5, c + h, 5) for c, h in ((x, half_width), (y, half_height))]
    looks = {"colors": _hex(colours.GRID), "linewidth": 0.6, "zorder": 0}
    axes.vlines(places[0], y - half_height, y + half_height, **looks)
    axes.hlines(places[1], x - half_width, x + half_width, **looks)


def _draw_mixtures(axes: Any, result: FrameResult) -> None:
    """Draws every component of every step very faintly; where they add up, people are likely to be."""
    from matplotlib.collections import EllipseCollection

    predicted, _ = split_by_fallback(result.predictions.predictions)
    steps = max((len(p.mixture.weights) for p in predicted), default=0)
    ellipses = mixture_ellipses(predicted, range(steps), LEAST_WEIGHT)
    rgb = colours.track_colours(ellipses.track_ids) / 255
    for sigmas, strength in ((2.0, 0.07), (1.0, 0.20)):
        axis = 2 * sigmas * ellipses.half_axes_m
        rgba = np.column_stack([rgb, strength * ellipses.weights])
        axes.add_collection(
            EllipseCollection(
                axis[:, 0],
                axis[:, 1],
                np.degrees(ellipses.yaws_rad),
                units="xy",
                offsets=ellipses.centres_m,
                offset_transform=axes.transData,
                facecolors=rgba,
                edgecolors="none",
                zorder=1,
            )
        )


def _draw_sensing(axes: Any, result: FrameResult) -> None:
    """Draws LiDAR clusters as open squares, measurements as dots, and the truth as crosses."""
    sensors, measurements = result.sensors, result.measurements
    lidar = sensors.map_from_lidar
    clusters = sensors.clusters.centroids_m @ lidar[:3, :3].T + lidar[:3, 3]
    axes.scatter(
        *clusters[:, :2].T, s=34, marker="s", facecolors="none", edgecolors=_hex(colours.CLUSTER), lw=0.8, zorder=2
    )
    rgb = colours.probability_colours(measurements.pedestrian_probability) / 255
    axes.scatter(*measurements.positions_m.T, s=7, c=rgb, linewidths=0, zorder=6)
    if result.ground_truth is not None:
        axes.scatter(*result.ground_truth.positions_m.T, s=22, marker="x", c=_hex(colours.TRUTH), lw=0.9, zorder=5.5)


def _draw_paths(axes: Any, result: FrameResult) -> None:
    from matplotlib.collections import LineCollection

    predicted, fallback = split_by_fallback(result.predictions.predictions)
    paths = modal_paths(result.tracks, predicted)
    rgb = colours.track_colours(paths.track_ids) / 255
    rgba = np.column_stack([rgb, colours.path_opacity(paths.probabilities)])
    widths = 0.8 + 1.6 * paths.probabilities
    axes.add_collection(LineCollection(paths.strips_m(), colors=rgba, linewidths=widths, capstyle="round", zorder=4))
    if len(paths.lengths):
        ends = paths.points_m[np.cumsum(paths.lengths) - 1]
        axes.scatter(*ends.T, s=4 + 22 * paths.probabilities, c=rgba, linewidths=0, zorder=4)
    dashed = [dash for strip in modal_paths(result.tracks, fallback).strips_m() for dash in dashes(strip)]
    axes.add_collection(LineCollection(dashed, colors=_hex(colours.FALLBACK), linewidths=1.1, zorder=4))


def _draw_people(axes: Any, result: FrameResult) -> None:
    from matplotlib.collections import LineCollection
    from matplotlib.patches import Circle
    from matplotlib.patheffects import withStroke

    tracks = result.tracks.tracks
    rgb = colours.track_colours([track.id for track in tracks]) / 255
    tails = [track.history.states[:, :2] for track in tracks]
    faded = np.column_stack([rgb, np.full(len(rgb), 0.55)])
    axes.add_collection(LineCollection(tails, colors=faded, linewidths=0.9, zorder=3))
    outline = [withStroke(linewidth=2.2, foreground=_hex(colours.BACKGROUND))]
    for track, colour in zip(tracks, rgb, strict=True):
        x, y, vx, vy = track.state.tolist()
        face = "none" if track.coasting else colour
        axes.add_patch(Circle((x, y), PERSON_RADIUS_M, facecolor=face, edgecolor=colour, linewidth=1.2, zorder=5))
        away = _behind(vx, vy) * 0.75
        axes.text(
            x + away[0], y + away[1], str(track.id), color=colour, fontsize=8.5, fontweight="bold",
            ha="center", va="center", path_effects=outline, zorder=8, clip_on=True,
        )  # fmt: skip


def _behind(vx: float, vy: float) -> FloatArray:
    """Returns the unit vector behind a movement and to its left: out of the way of what is predicted."""
    speed = np.hypot(vx, vy)
    ahead = np.array([vx, vy]) / speed if speed > 0.1 else np.array([0.0, -1.0])
    away = -ahead + np.array([-ahead[1], ahead[0]])
    return np.asarray(away / np.hypot(*away))


def _draw_vehicle(axes: Any, result: FrameResult) -> None:
    from matplotlib.patches import Polygon

    pose = result.sensors.map_from_vehicle
    outline = vehicle_outline(pose)
    body = Polygon(
        outline, closed=True, facecolor=(*np.array(colours.VEHICLE) / 255, 0.16), edgecolor=_hex(colours.VEHICLE)
    )
    body.set(linewidth=1.6, zorder=7)
    axes.add_patch(body)
    bow, ahead = outline[2], pose[:2, 0]
    axes.annotate(
        "", bow + 2.2 * ahead, bow, zorder=7,
        arrowprops={"arrowstyle": "-|>", "color": _hex(colours.VEHICLE), "linewidth": 1.4, "shrinkA": 0, "shrinkB": 0},
    )  # fmt: skip


def _draw_legend(figure: Any, result: FrameResult) -> None:
    """Writes beside the picture what it shows, each mark drawn as it is."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    def line(colour: Any, **looks: Any) -> Any:
        return Line2D([], [], color=colour, **looks)

    def mark(colour: Any, marker: Any, size: float, **looks: Any) -> Any:
        return Line2D([], [], linestyle="none", marker=marker, markersize=size, color=colour, **looks)

    one, other = (colours.track_colours([number])[0] / 255 for number in (1, 3))
    rows = [
        (mark(_hex(colours.VEHICLE), (5, 0, -90), 11, markerfacecolor="none"), "vehicle and its heading"),
        (mark(one, "o", 9), "tracked pedestrian, with its id"),
        (mark(one, "o", 9, markerfacecolor="none", markeredgewidth=1.2), "coasting: not measured just now"),
        (line((*one, 0.55), linewidth=1), "where it was"),
        (line((*one, 1.0), linewidth=2.6), "modal path, likely"),
        (line((*one, 0.4), linewidth=1.3), "modal path, unlikely"),
        (Patch(facecolor=(*other, 0.35), edgecolor="none"), "predicted mixture"),
        (line(_hex(colours.FALLBACK), linewidth=1.1, linestyle=(0, (3, 2.5))), "fallback: too young, or coasting"),
        (mark(colours.probability_colours([0.95])[0] / 255, "o", 4), "fused measurement, a person"),
        (mark(colours.probability_colours([0.05])[0] / 255, "o", 4), "fused measurement, no person"),
        (mark(_hex(colours.CLUSTER), "s", 6, markerfacecolor="none"), "LiDAR cluster"),
    ]
    if result.ground_truth is not None:
        rows.append((mark(_hex(colours.TRUTH), "x", 5), "where people really were"))
    predictions = result.predictions
    steps = max((len(path.points_m) for p in predictions.predictions for path in p.paths), default=0)
    figure.text(0.775, 0.945, f"{len(result.tracks.tracks)} pedestrians", color=INK, fontsize=17, fontweight="bold")
    lines = (
        f"next {steps * predictions.dt_s:.1f} s in steps of {predictions.dt_s:.1f} s",
        f"model: {predictions.model}",
    )
    for place, text in zip((0.912, 0.886), lines, strict=True):
        figure.text(0.775, place, text, color=FAINT_INK, fontsize=10)
    legend = figure.legend(
        [handle for handle, _ in rows], [text for _, text in rows], loc="upper left", bbox_to_anchor=(0.768, 0.86),
        frameon=False, fontsize=10, labelcolor=INK, labelspacing=0.95, handlelength=2.2,
    )  # fmt: skip
    legend.set_zorder(10)
    scale = 5 * MAP_SHARE / (2 * NEAR_M)  # 5 m as a share of the picture's width
    figure.add_artist(line(FAINT_INK, linewidth=2, solid_capstyle="butt", transform=figure.transFigure))
    figure.artists[-1].set_data([0.775, 0.775 + scale], [0.035, 0.035])
    figure.text(0.775 + scale / 2, 0.045, "5 m", color=FAINT_INK, fontsize=9, ha="center", va="bottom")


def _hex(rgb: colours.RGB) -> str:
    return "#{:02x}{:02x}{:02x}".format(*rgb)
