"""The report's pictured scenes, from above: what was seen, what is predicted, what people did."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from pcgan import distribution_metrics, mixture_density
from pcgan.forecast import Forecast
from pcgan.report_style import (
    FAINT_INK,
    INK,
    METHOD_COLOURS,
    OBSERVED,
    PERSON_COLOURS,
    TRUTH,
    VEHICLE,
    VEHICLE_FILL,
    as_image,
    method_colour,
    new_figure,
)
from pcgan.scene_choice import Scene
from pcgan.tables import METHOD_NAMES
from schemas.messages import FloatArray

COMPARED = ("cvm", "srlstm", "psgan", "pcgan")  # as in the paper's figure
_TREES = ("psgan", "pcgan")  # of these the whole tree is shown, of others the most probable path
_PANEL_IN = 5.1  # wide
_SHAPES = (1.0, 1.9)  # width to height, least and most
_VEHICLE_M = (4.5, 1.9)  # length and width drawn; the windows do not hold them
_SHOW_VEHICLE_M = 20.0  # a vehicle farther from the people is left out of the picture
_DRIVING_MPS = 0.2
_DENSE_S = 0.2  # steps shorter than this are drawn with smaller dots
_LEAST_M, _MARGIN_M = 3.0, 1.2
_PIXELS = 170  # of the longer side, for densities
_MANY = 3  # people in focus, beyond whom methods are compared by their most probable paths alone
_LEAST_PROBABILITY = 0.02


@dataclass(frozen=True, eq=False)
class SceneExample:
    """A scene and what several methods say of it."""

    title: str
    caption: str
    scene: Scene
    forecasts: Mapping[str, Forecast]  # by method, of the scene alone: no leading axis


@dataclass(frozen=True)
class _View:
    left: float
    right: float
    bottom: float
    top: float

    def holds(self, points: FloatArray) -> bool:
        """Whether any of the points (N, 2) is inside."""
        x, y = points[:, 0], points[:, 1]
        return bool(((x > self.left) & (x < self.right) & (y > self.bottom) & (y < self.top)).any())


def pictured(example: SceneExample, method: str = "pcgan") -> str:
    """Returns two views of a scene as an image: one method's mixtures and path trees, and methods compared."""
    forecast = example.forecasts[method]
    view = _view(example, forecast)
    shape = (view.right - view.left) / (view.top - view.bottom)
    with new_figure(2 * _PANEL_IN, _PANEL_IN / shape + 0.7) as figure:
        left, right = figure.subplots(1, 2)
        for axes in (left, right):
            _ground(axes, view)
            _people(axes, example.scene, view)
            _vehicles(axes, example.scene)
        colours = _person_colours(example.scene)
        _densities(left, example.scene, forecast, colours, view)
        for person, colour in enumerate(colours):
            _tree(left, example.scene, forecast, person, colour, 1.0 if person in example.scene.focus else 0.5)
        left.set_title(f"{METHOD_NAMES.get(method, method)}: mixtures and modal paths")
        compared = [name for name in COMPARED if name in example.forecasts] or list(example.forecasts)
        for name in compared:
            for person in example.scene.focus.tolist():
                _compared(right, example.scene, example.forecasts[name], person, name)
        right.set_title("Methods compared")
        _legend(figure, example, compared)
        return as_image(figure, "png")


def _view(example: SceneExample, forecast: Forecast) -> _View:
    """Returns the section shown: all of whom the picture is about, with room, in the shape of a panel."""
    scene = example.scene
    focus = scene.focus
    likeliest = forecast.likeliest.numpy()[focus]
    points = np.concatenate([part.reshape(-1, 2) for part in (scene.observed[focus], scene.future[focus], likeliest)])
    vehicle = scene.vehicle[focus, -1]
    vehicle = vehicle[np.isfinite(vehicle).all(axis=1)]  # (F or fewer, 4)
    near = np.linalg.norm(vehicle[:, :2] - np.nanmean(points, axis=0), axis=1) < _SHOW_VEHICLE_M
    rear = vehicle[near, :2] - _ahead(vehicle[near]) * _VEHICLE_M[0] / 2
    points = np.concatenate([points, vehicle[near, :2], rear])
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    width, height = (np.maximum(high - low, _LEAST_M) + 2 * _MARGIN_M).tolist()
    shape = min(max(width / height, _SHAPES[0]), _SHAPES[1])
    height = max(height, width / shape)
    width = height * shape
    x, y = ((low + high) / 2).tolist()
    return _View(x - width / 2, x + width / 2, y - height / 2, y + height / 2)


def _ground(axes: Any, view: _View) -> None:
    axes.set(xlim=(view.left, view.right), ylim=(view.bottom, view.top), aspect="equal")
    axes.set_xticks(np.arange(np.ceil(view.left), view.right))
    axes.set_yticks(np.arange(np.ceil(view.bottom), view.top))
    axes.tick_params(labelbottom=False, labelleft=False)
    axes.grid(True)
    for spine in axes.spines.values():
        spine.set_visible(False)
    length = 1.0 if view.right - view.left < 12 else 2.0 if view.right - view.left < 25 else 5.0
    x, y = view.left + 0.4, view.bottom + 0.035 * (view.top - view.bottom)
    axes.plot([x, x + length], [y, y], color=FAINT_INK, linewidth=2, solid_capstyle="butt", zorder=9)
    axes.text(x + length / 2, y, f"{length:.0f} m\n", ha="center", va="baseline", fontsize=8, color=FAINT_INK, zorder=9)


def _people(axes: Any, scene: Scene, view: _View) -> None:
    """Draws what was observed, and what people then did."""
    dot = 2.8 if scene.dt_s > _DENSE_S else 1.4
    for person in range(len(scene.observed)):
        track = scene.observed[person][scene.seen[person]]
        truth = np.concatenate([scene.observed[person, -1:], scene.future[person]])
        if not view.holds(np.concatenate([track, truth])):
            continue
        alpha = 1.0 if person in scene.focus else 0.45
        axes.plot(*truth.T, color=TRUTH, linewidth=1.4, marker="o", markersize=dot, alpha=alpha, zorder=7.5)
        axes.plot(*track.T, color=OBSERVED, linewidth=1.6, marker="o", markersize=0.8 * dot, alpha=alpha, zorder=6)
        axes.plot(*track[-1], marker="o", markersize=7, color=OBSERVED, markeredgecolor="white", alpha=alpha, zorder=8)


def _vehicles(axes: Any, scene: Scene) -> None:
    """Draws each vehicle once: its way, a box where it is, an arrow, and its speed."""
    from matplotlib.patches import FancyArrowPatch, FancyBboxPatch
    from matplotlib.transforms import Affine2D

    found = scene.vehicle[np.isfinite(scene.vehicle).all(axis=(1, 2))]
    drawn: list[FloatArray] = []
    for track in found:
        if any(np.linalg.norm(track[-1, :2] - other) < 0.5 for other in drawn):
            continue
        drawn.append(track[-1, :2])
        x, y, vx, vy = track[-1].tolist()
        axes.plot(*track[:, :2].T, color=VEHICLE, linewidth=1.6, linestyle=(0, (1, 1)), zorder=3)
        length, width = _VEHICLE_M
        speed = float(np.hypot(vx, vy))
        yaw = float(np.arctan2(vy, vx))
        ahead = _ahead(track[-1])
        box = FancyBboxPatch((-length / 2, -width / 2), length, width, boxstyle="round,pad=0,rounding_size=0.4")
        box.set(facecolor=VEHICLE_FILL, edgecolor=VEHICLE, linewidth=1.4, zorder=4)
        box.set_transform(Affine2D().rotate(yaw).translate(x, y) + axes.transData)
        axes.add_patch(box)
        if speed > _DRIVING_MPS:
            arrow = FancyArrowPatch(track[-1, :2], track[-1, :2] + ahead * (length / 2 + 1.3), arrowstyle="-|>")
            arrow.set(mutation_scale=16, color=VEHICLE, linewidth=2.2, zorder=5)
            axes.add_patch(arrow)
        at = track[-1, :2] - 1.1 * ahead
        axes.text(*at, f"{speed:.1f} m/s", ha="center", va="center", fontsize=8, color=INK, zorder=9, clip_on=True)


def _ahead(states: FloatArray) -> FloatArray:
    """(..., 4) x, y, vx, vy -> (..., 2): the direction of driving."""
    yaw = np.arctan2(states[..., 3], states[..., 2])
    return np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)


def _person_colours(scene: Scene) -> list[str]:
    """Returns a colour per pedestrian; those the picture is about come first."""
    others = [person for person in range(len(scene.observed)) if person not in scene.focus]
    order = [*scene.focus.tolist(), *others]
    return [PERSON_COLOURS[order.index(person) % len(PERSON_COLOURS)] for person in range(len(scene.observed))]


def _densities(axes: Any, scene: Scene, forecast: Forecast, colours: list[str], view: _View) -> None:
    """Shades where each pedestrian is likely to be at any of the steps, each step relative to its own peak."""
    from matplotlib.colors import to_rgb

    width, height = view.right - view.left, view.top - view.bottom
    scale = _PIXELS / max(width, height)
    x = torch.linspace(view.left, view.right, round(width * scale))
    y = torch.linspace(view.bottom, view.top, round(height * scale))
    grid = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)  # (Y, X, 2)
    for person, colour in enumerate(colours):
        if not view.holds(scene.observed[person]):
            continue
        mixture = distribution_metrics.take(forecast.mixture, person)
        at_means = mixture_density.log_likelihood(
            distribution_metrics.take(mixture, (slice(None), None)), mixture.means
        )
        peak = at_means.amax(dim=-1)  # (P,)
        relative = (mixture_density.log_likelihood(mixture, grid.unsqueeze(-2)) - peak).amax(dim=-1).exp()  # (Y, X)
        image = np.empty((*relative.shape, 4))
        image[..., :3] = to_rgb(colour)
        image[..., 3] = (0.42 if person in scene.focus else 0.16) * relative.clamp(max=1).numpy()
        axes.imshow(
            image,
            extent=(view.left, view.right, view.bottom, view.top),
            origin="lower",
            interpolation="bilinear",
            zorder=1,
        )


def _tree(axes: Any, scene: Scene, forecast: Forecast, person: int, colour: str, strength: float) -> None:
    """Draws all modal paths of a pedestrian, the more probable the wider."""
    from matplotlib.patheffects import Normal, Stroke

    start = scene.observed[person, -1]
    probabilities = forecast.paths.probabilities[person].tolist()
    for probability, points in reversed(list(zip(probabilities, forecast.paths.points[person].numpy(), strict=True))):
        if probability < _LEAST_PROBABILITY:
            continue
        width = 1.0 + 2.4 * probability
        axes.plot(
            *np.concatenate([start[None], points]).T,
            color=colour,
            linewidth=width,
            alpha=strength * (0.45 + 0.55 * probability),
            solid_capstyle="round",
            path_effects=[Stroke(linewidth=width + 1.4, foreground="white", alpha=0.6 * strength), Normal()],
            zorder=7,
        )
        axes.plot(*points[-1], marker="o", markersize=1.6 + 3 * probability, color=colour, alpha=strength, zorder=7)


def _compared(axes: Any, scene: Scene, forecast: Forecast, person: int, method: str) -> None:
    if method in _TREES and len(scene.focus) <= _MANY:
        _tree(axes, scene, forecast, person, method_colour(method), 1.0)
        return
    path = np.concatenate([scene.observed[person, -1:], forecast.likeliest[person].numpy()])
    axes.plot(*path.T, color=method_colour(method), linewidth=2.4, solid_capstyle="round", zorder=6.5)


def _legend(figure: Any, example: SceneExample, compared: list[str]) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles = [
        Line2D([], [], color=OBSERVED, marker="o", markersize=4, label="observed"),
        Line2D([], [], color=TRUTH, marker="o", markersize=4, label="what people did"),
        Line2D([], [], color=PERSON_COLOURS[0], linewidth=3, label="modal paths (wider: likelier)"),
        Patch(color=PERSON_COLOURS[0], alpha=0.35, label="mixture"),
    ]
    if np.isfinite(example.scene.vehicle).any():
        handles.append(Patch(facecolor=VEHICLE_FILL, edgecolor=VEHICLE, label="vehicle"))
    for name in compared:
        colour = METHOD_COLOURS.get(name, INK)
        handles.append(Line2D([], [], color=colour, linewidth=3, label=METHOD_NAMES.get(name, name)))
    figure.legend(
        handles=handles, loc="outside lower center", ncols=9, columnspacing=1.4, fontsize=8.2, handlelength=1.6
    )
