"""Two futures side by side in rerun, seen from above with the vehicle driving up, in the vehicle's present frame.

driven_on/..., supposed/...  the same in both:
    grid, corridor  5 m cells; what the vehicle sweeps until the horizon, margin included
    vehicle         where it is now, where it is at the horizon, and the way of its nose between
    people, paths   coloured by the probability of entering the corridor, brighter if likelier
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pcgan.corridor import footprints
from replay import colours
from replay.drawing import PERSON_RADIUS_M, modal_paths, vehicle_outline
from replay.rerun_view import RerunView
from replay.what_if import Entry, Pedestrian, WhatIf
from schemas.messages import FloatArray, Prediction, VehiclePath

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

CORRIDOR = (40, 58, 72)
GRID_M = 5.0
LEAST_REACH_M = 10.0  # of the view, from its middle: a standing vehicle's corridor is small
DISC_M = 0.2  # height of a pedestrian: higher ones lean outwards, seen from so near
FLOOR_M = 0.05
LABELLED = 0.05  # who enters less probably has a label on hover only
MOST_ROWS = 8


class WhatIfView(RerunView):
    """Draws the two futures of one moment into a rerun recording."""

    def show_futures(self, found: WhatIf, people: Sequence[Pedestrian]) -> None:
        """Draws both; they are found under the frame's stamp."""
        import rerun as rr

        assert self._recording is not None, "a view is drawn into before it is closed"
        recording = self._recording
        shown = (
            ("driven_on", found.driven_on, {person.id: person.driven_on for person in people}),
            ("supposed", found.supposed, {person.id: person.supposed for person in people}),
        )
        corridors = [_in_vehicle(found, footprints(future.path, found.horizon_s)) for _, future, _ in shown]
        corners = np.concatenate(corridors).reshape(-1, 2)
        recording.send_blueprint(_layout(found, corners))
        recording.set_time("stamp", timestamp=np.datetime64(found.tracks.stamp_ns, "ns"))
        for (root, future, entries), corridor in zip(shown, corridors, strict=True):
            _draw_ground(recording, root, corridor, corners)
            _draw_vehicle(recording, root, found, future.path)
            _draw_people(recording, root, found, future.answer.predictions, entries)
        text = rr.TextDocument(_table(found, people), media_type="text/markdown")
        recording.log("figures", text)


@contextmanager
def what_if_view(rrd: Path | None, spawn: bool, name: str) -> Iterator[WhatIfView | None]:
    """Yields a view into a file, or in a viewer of its own, or None if neither is wanted; raises ViewError."""
    if rrd is None and not spawn:
        yield None
        return
    view = WhatIfView.spawn(name) if rrd is None else WhatIfView.to_file(rrd, name)
    with view:
        assert isinstance(view, WhatIfView)
        yield view


def _layout(found: WhatIf, corners_m: FloatArray) -> "rrb.Blueprint":
    """Returns both views, around the same place and from the same height, above a table."""
    import rerun.blueprint as rrb

    low, high = corners_m.min(axis=0), corners_m.max(axis=0)
    x, y = ((low + high) / 2).tolist()
    reach = max(*((high - low) / 2 + 3).tolist(), LEAST_REACH_M)
    eye = rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital,
        position=(x - 0.01, y, 2.1 * reach),  # not quite above: straight down leaves "up" open
        look_target=(x, y, 0.0),
        eye_up=(1.0, 0.0, 0.0),
    )
    views = [
        rrb.Spatial3DView(
            origin=f"/{root}", name=name, background=list(colours.BACKGROUND), line_grid=False, eye_controls=eye
        )
        for root, name in (("driven_on", found.driven_on.name), ("supposed", found.supposed.name))
    ]
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(*views), rrb.TextDocumentView(origin="/figures", name="Figures"), row_shares=[3, 1]
        ),
        rrb.TimePanel(timeline="stamp", state="hidden"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )


def _draw_ground(recording: "rr.RecordingStream", root: str, corridor: FloatArray, corners_m: FloatArray) -> None:
    import rerun as rr

    middle = np.round(corners_m.mean(axis=0) / GRID_M) * GRID_M
    reach = np.ceil(np.ptp(corners_m, axis=0).max() / GRID_M + 4) * GRID_M
    lines = np.arange(-reach, reach + GRID_M, GRID_M)
    ends = np.array([-reach, reach])
    across = np.stack(np.meshgrid(lines, ends, indexing="ij"), axis=-1)  # (N, 2, 2)
    strips = np.concatenate([across, across[..., ::-1]]) + middle
    recording.log(f"{root}/grid", rr.LineStrips3D(_lifted(strips, -FLOOR_M), colors=[colours.GRID], radii=[-0.5]))
    vertices = _lifted(corridor, 0.0).reshape(-1, 3)
    quads = 4 * np.arange(len(corridor))[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])  # (N, 2, 3)
    mesh = rr.Mesh3D(
        vertex_positions=vertices,
        triangle_indices=quads.reshape(-1, 3),
        vertex_colors=np.tile(np.array(CORRIDOR, np.uint8), (len(vertices), 1)),
    )
    recording.log(f"{root}/corridor", mesh)


def _draw_vehicle(recording: "rr.RecordingStream", root: str, found: WhatIf, path: VehiclePath) -> None:
    import rerun as rr

    outlines = _in_vehicle(found, footprints(path, found.horizon_s, margin_m=0))  # (N, 4, 2)
    then = outlines[-1][[0, 1, 2, 3, 0]]
    strips = [vehicle_outline(np.eye(4)), then, outlines[:, 1:3].mean(axis=1)]  # the last: the way of its nose
    recording.log(
        f"{root}/vehicle",
        rr.LineStrips3D(
            [_lifted(strip, FLOOR_M) for strip in strips],
            colors=[(*colours.VEHICLE, 255), (*colours.VEHICLE, 110), (*colours.VEHICLE, 110)],
            radii=[-1.2, -0.8, -0.8],
        ),
    )


def _draw_people(
    recording: "rr.RecordingStream",
    root: str,
    found: WhatIf,
    predictions: Sequence[Prediction],
    entries: dict[int, Entry],
) -> None:
    import rerun as rr

    tracks = found.tracks.tracks
    places = _in_vehicle(found, np.array([track.state[:2] for track in tracks], float).reshape(-1, 2))
    colour = colours.probability_colours([entries[track.id].probability for track in tracks])
    concerned = np.array([entries[track.id].probability >= LABELLED for track in tracks], bool)
    for entity, chosen in (("concerned", concerned), ("others", ~concerned)):
        count = int(chosen.sum())
        discs = rr.Cylinders3D(
            centers=_lifted(places[chosen], DISC_M / 2),
            lengths=[DISC_M] * count,
            radii=[PERSON_RADIUS_M] * count,
            colors=colour[chosen],
            fill_mode="solid",
            labels=[_label(tracks[row].id, entries[tracks[row].id]) for row in np.flatnonzero(chosen)],
            show_labels=entity == "concerned",  # the others' on hover, or a crowd's hide all
        )
        recording.log(f"{root}/people/{entity}", discs)
    paths = modal_paths(found.tracks, predictions)
    likely = colours.probability_colours([entries[int(number)].probability for number in paths.track_ids])
    recording.log(
        f"{root}/paths",
        rr.LineStrips3D(
            [_lifted(_in_vehicle(found, strip), FLOOR_M) for strip in paths.strips_m()],
            colors=colours.with_opacity(likely, colours.path_opacity(paths.probabilities)),
            radii=-(0.8 + 1.0 * paths.probabilities),
        ),
    )


def _label(number: int, entry: Entry) -> str:
    return str(number) if entry.time_s is None else f"{number}: {entry.probability:.0%} {entry.time_s:.1f} s"


def _table(found: WhatIf, people: Sequence[Pedestrian]) -> str:
    concerned = [person for person in people if person.concerned]
    lines = [
        f"Vehicle at {found.motion.speed_mps:.1f} m/s. Shaded: its corridor within the horizon. Brighter: likelier to "
        "enter it. The model sees the vehicle up to now only: predicted paths are the same on both sides.",
        "",
        f"| pedestrian | drives on | {found.supposed.name} |",
        "|---|---|---|",
        *(f"| {p.id} | {_words(p.driven_on)} | {_words(p.supposed)} |" for p in concerned[:MOST_ROWS]),
    ]
    return "\n".join(lines if concerned else [lines[0], "", "Nobody enters either corridor."])


def _words(entry: Entry) -> str:
    return "0 %" if entry.time_s is None else f"{100 * entry.probability:.0f} %, after {entry.time_s:.1f} s"


def _in_vehicle(found: WhatIf, points_m: FloatArray) -> FloatArray:
    """(..., 2) in the odometry frame -> (..., 2) in the vehicle's present frame."""
    c, s = np.cos(found.motion.yaw_rad), np.sin(found.motion.yaw_rad)
    return np.asarray((points_m - [found.motion.x_m, found.motion.y_m]) @ np.array([[c, -s], [s, c]]))


def _lifted(points_m: FloatArray, height_m: float) -> FloatArray:
    """(..., 2) -> (..., 3) at a height, single precision."""
    return np.concatenate([points_m, np.full((*points_m.shape[:-1], 1), height_m)], axis=-1).astype(np.float32)
