"""The picture of one moment."""

import struct
from dataclasses import replace

import numpy as np
import pytest

from replay.picture import BusiestMoment, PictureError, busyness, draw_top_down
from tests.replay.view_scenes import crowd

pytest.importorskip("matplotlib", reason="matplotlib comes with pcgan[view]")


def test_picture_is_a_png_of_the_promised_size_and_repeats(tmp_path):
    result = next(crowd(people=30))
    draw_top_down(result, tmp_path / "a.png")
    draw_top_down(result, tmp_path / "b.png")
    data = (tmp_path / "a.png").read_bytes()
    assert data.startswith(b"\x89PNG")
    assert struct.unpack(">II", data[16:24]) == (1920, 1200)
    assert data == (tmp_path / "b.png").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.png", "b.png"]


def test_people_change_the_picture(tmp_path):
    """Pixels in a track's own colour are there with it and gone without it."""
    from matplotlib.image import imread

    from replay.colours import track_colours

    result = next(crowd(people=30))
    seen = next(t for t in result.tracks.tracks if not t.coasting and np.hypot(*t.state[:2]) < 10)
    alone = replace(
        result,
        tracks=replace(result.tracks, tracks=(seen,)),
        predictions=replace(result.predictions, predictions=()),
    )
    counts = []
    for frame in (alone, replace(alone, tracks=replace(alone.tracks, tracks=()))):
        draw_top_down(frame, tmp_path / "p.png")
        pixels = np.rint(imread(tmp_path / "p.png")[:, :1450, :3] * 255)  # the map, not the legend
        counts.append(int((np.abs(pixels - track_colours([seen.id])[0]).max(axis=-1) < 3).sum()))
    assert counts[0] > 300
    assert counts[1] == 0


def test_an_empty_frame_without_truth_can_be_drawn(tmp_path):
    result = next(crowd(people=4))
    empty = replace(
        result,
        tracks=replace(result.tracks, tracks=()),
        predictions=replace(result.predictions, predictions=()),
        ground_truth=None,
    )
    draw_top_down(empty, tmp_path / "empty.png")
    assert (tmp_path / "empty.png").stat().st_size > 1000


def test_a_place_that_cannot_be_written_is_named(tmp_path):
    with pytest.raises(PictureError, match=r"cannot write .*nowhere"):
        draw_top_down(next(crowd(people=2)), tmp_path / "nowhere" / "p.png")


def busiest_moment(results):
    moment = BusiestMoment()
    for result in results:
        moment.offer(result)
    return moment.result


def test_busiest_moment_is_the_one_with_most_to_see():
    frames = [*crowd(people=5, seed=1), *crowd(people=25, seed=2), *crowd(people=10, seed=3)]
    assert busiest_moment(frames) is frames[1]
    assert busyness(frames[1]) == max(map(busyness, frames))
    assert busiest_moment([]) is None


def test_of_equally_busy_moments_the_first_is_kept():
    first, second = next(crowd(people=5)), next(crowd(people=5))
    moment = BusiestMoment()
    moment.offer(first)
    moment.offer(second)
    assert moment.result is first


def test_people_far_away_standing_or_extrapolated_are_not_busy():
    result = next(crowd(people=30))
    far = result.sensors.map_from_vehicle.copy()
    far[0, 3] += 1000
    assert busyness(replace(result, sensors=replace(result.sensors, map_from_vehicle=far))) == 0
    fallback = tuple(replace(p, fallback=True) for p in result.predictions.predictions)
    extrapolated = replace(result, predictions=replace(result.predictions, predictions=fallback))
    assert 0 < busyness(extrapolated) < busyness(result) / 5
