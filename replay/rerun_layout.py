"""How the rerun view is arranged: the map at the left, six cameras as they look out of the vehicle, counts below."""

from collections.abc import Mapping

import rerun.blueprint as rrb

from replay import colours
from schemas.topics import CAMERAS

ROWS = (("A1", "A0", "A2"), ("B0", "A3", "B1"))  # left, front, right; left side, back, right side
TITLES = {
    "A0": "A0 front",
    "A1": "A1 front left",
    "A2": "A2 front right",
    "A3": "A3 back",
    "B0": "B0 left side",
    "B1": "B1 right side",
}
EYE_HEIGHT_M = 46.0


def layout(cameras: Mapping[str, tuple[int, int]]) -> rrb.Blueprint:
    """Returns the blueprint for a drive with these cameras (name -> width and height in pixels); none is fine too."""
    legend = rrb.TextDocumentView(origin="/legend", name="Legend")
    series = rrb.TimeSeriesView(
        origin="/counts",
        name="People",
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.LeftTop),
    )
    below = rrb.Horizontal(series, legend, column_shares=[1, 1])
    if not cameras:
        body: rrb.Container = rrb.Horizontal(map_view("/map/**"), rrb.Vertical(series, legend), column_shares=[3, 1])
    else:
        wanted = [name for row in ROWS for name in row if name in cameras]
        panes = wanted + sorted(cameras.keys() - set(CAMERAS))
        grid = rrb.Grid(*(_camera(name, *cameras[name]) for name in panes), grid_columns=min(3, len(panes)))
        body = rrb.Horizontal(map_view("/map/**"), rrb.Vertical(grid, below, row_shares=[5, 4]), column_shares=[10, 11])
    return rrb.Blueprint(
        body,
        rrb.TimePanel(timeline="stamp", state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )


def map_view(contents: str | list[str], name: str = "Map") -> rrb.Spatial3DView:
    """Returns a view from above that moves with the vehicle but keeps north up: its origin is `map/centre`.

    The eye's own `tracking_entity` does not follow in a view whose eye position is given (rerun 0.41).
    """
    return rrb.Spatial3DView(
        origin="/map/centre",
        contents=contents,
        name=name,
        background=list(colours.BACKGROUND),
        line_grid=False,
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital,
            position=(0.0, -0.01, EYE_HEIGHT_M),  # not quite above: straight down leaves "up" open
            look_target=(0.0, 0.0, 0.0),
            eye_up=(0.0, 1.0, 0.0),
        ),
    )


def _camera(name: str, width_px: int, height_px: int) -> rrb.Spatial2DView:
    return rrb.Spatial2DView(
        origin=f"/cameras/{name}",
        name=TITLES.get(name, name),
        background=list(colours.BACKGROUND),
        visual_bounds=rrb.VisualBounds2D(x_range=(0, width_px), y_range=(0, height_px)),
    )
