import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from replay.simulator.sensor_model import SensorModelV1
from replay.simulator.visibility import PERSON, VEHICLE, ObjectTable, look, stacked

COLUMNS = 720


def seen(offsets, radii, sweeps=None, phase=0.5):
    offsets, radii = np.array(offsets, float), np.array(radii, float)
    sweeps = np.zeros(len(radii), np.int64) if sweeps is None else np.array(sweeps)
    return look(offsets, radii, np.ones(len(radii), bool), sweeps, columns=COLUMNS, phase=phase)


def test_a_disc_fills_its_angle():
    view = seen([[10.0, 0.0]], [0.25])
    assert view.visible[0] == view.columns[0] == pytest.approx(2 * math.degrees(math.asin(0.025)) / 0.5, abs=1)
    assert view.mean_offset_rad[0] == pytest.approx(0.0, abs=math.radians(0.25))


def test_nearer_hides_farther_and_not_the_other_way_round():
    view = seen([[10.0, 0.0], [5.0, 0.0]], [0.25, 0.25])
    assert view.visible[0] == 0
    assert view.visible[1] == view.columns[1] > 0


def test_half_hidden_leaves_the_other_half():
    view = seen([[10.0, 0.0], [5.0, -0.25]], [0.25, 0.25])  # the nearer one covers what is right of the middle
    assert view.visible[0] == pytest.approx(view.columns[0] / 2, abs=1)
    assert view.first[0] >= view.columns[0] // 2 - 1
    assert view.last[0] == view.columns[0] - 1
    assert view.mean_offset_rad[0] > 0


def test_other_sweeps_hide_nothing():
    view = seen([[10.0, 0.0], [5.0, 0.0], [10.0, 0.0]], [0.25, 0.25, 0.25], sweeps=[0, 0, 1])
    assert view.visible.tolist() == [0, view.columns[1], view.columns[2]]


@settings(deadline=None, max_examples=25)
@given(
    st.lists(st.tuples(st.floats(-math.pi, math.pi), st.floats(2, 40), st.floats(0.1, 1.0)), max_size=12),
    st.floats(0, 0.99),
)
def test_painting_agrees_with_the_nearest_disc_of_each_column(discs, phase):
    """A plain loop over columns, looking for the nearest front, gives the same counts."""
    bearings, distances, radii = np.array(discs).reshape(-1, 3).T
    offsets = distances[:, None] * np.stack([np.cos(bearings), np.sin(bearings)], axis=-1)
    view = seen(offsets, radii, phase=phase)
    counts = np.zeros(len(discs), int)
    half, fronts = np.arcsin(radii / view.distances_m), view.distances_m - radii
    assume(len(set(fronts.round(9).tolist())) == len(fronts))  # of two at one distance either may win
    for column in range(COLUMNS):
        angle = (column + phase) * 2 * math.pi / COLUMNS
        apart = np.abs((angle - view.bearings_rad + math.pi) % (2 * math.pi) - math.pi)
        inside = np.flatnonzero(apart <= half + 1e-12)
        if len(inside):
            counts[inside[np.argmin(fronts[inside])]] += 1
    assert np.abs(counts - view.visible).max(initial=0) <= 1  # a column on an edge may go either way


def test_objects_of_a_scene(make_scene):
    objects = ObjectTable(SensorModelV1(), 0).objects(make_scene([[5, 0], [6, 1]], [[10, 0, 0]], [[3, 3, 0.1, 4]]))
    assert objects.kinds.tolist() == [PERSON, PERSON, VEHICLE, 2]
    assert len(set(objects.keys.tolist())) == 4
    assert (np.diff(objects.owners) >= 0).all()
    car = objects.centres_m[objects.owners == 2]
    assert car[:, 0].min() == pytest.approx(10 - 2.25 + 0.9)  # the outer discs touch the bumpers
    assert car[:, 0].max() == pytest.approx(10 + 2.25 - 0.9)
    assert np.diff(np.sort(car[:, 0])).max() < 0.91


def test_people_keep_their_height(make_scene):
    model = SensorModelV1()
    table = ObjectTable(model, 7)
    first, second = table.objects(make_scene([[5, 0], [6, 1]])), table.objects(make_scene([[8, 0], [6, 4]]))
    np.testing.assert_array_equal(first.heights_m, second.heights_m)
    heights = ObjectTable(model, 7).objects(make_scene(np.zeros((2000, 2)))).heights_m
    assert heights.mean() == pytest.approx(model.person_height_m, abs=0.01)
    assert heights.std() == pytest.approx(model.person_height_sd_m, abs=0.01)


def test_stacked_objects_count_on(make_scene):
    table = ObjectTable(SensorModelV1(), 0)
    one, two = table.objects(make_scene([[5, 0]], [[10, 0, 0]])), table.objects(make_scene([[1, 0], [2, 0]]))
    both = stacked([one, two])
    assert len(both.kinds) == 4
    assert both.owners[-2:].tolist() == [2, 3]
