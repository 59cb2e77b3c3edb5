"""Messages compared with numpy against the same done one value after the other."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from replay.diff_compare import Comparison
from replay.diff_tally import TopicTally
from replay.diff_values import Level, flattener, use_keys
from replay.logged_message import LoggedSchema
from schemas import codec
from schemas.messages import Mixture, ModalPath, Prediction, PredictionFrame, VehicleHistory

ATOL, RTOL = 1e-2, 1e-3
few = settings(max_examples=60)
JSON = LoggedSchema("any", "jsonschema", b"")
NUMBERS = st.sampled_from(
    [0.0, 1.0, 1.005, 1.05, -3.0, 1e6, 1e6 + 500, 1e6 + 2000, math.nan, math.inf, -math.inf, 1.7e308, -1.7e308]
)


def compared(a: Level, b: Level, *, ours=False, defaults=False) -> TopicTally:
    tally = TopicTally("/x", (1, 1))
    tally.begin(1.5, 15)
    Comparison(tally, ATOL, RTOL, ours=ours, defaults=defaults).compare(a, b)
    return tally


def frame(predictions) -> PredictionFrame:
    return PredictionFrame(1, 10, "odom", "random", 0.4, tuple(predictions))


def prediction(number, paths, risk_time=None) -> Prediction:
    steps = max((len(points) for points in paths), default=1)
    one = np.ones((steps, 1), np.float32)
    mixture = Mixture(one, np.zeros((steps, 1, 2), np.float32), np.ones((steps, 1, 2), np.float32), 0 * one)
    return Prediction(number, False, tuple(ModalPath(0.5, np.array(p, float).reshape(-1, 2)) for p in paths), mixture,
                      corridor_time_s=risk_time)  # fmt: skip


def flat(message: PredictionFrame) -> Level:
    flatten = flattener(LoggedSchema("pcgan.v1.PredictionFrame", "protobuf", b""), "protobuf", ("predictions.mixture",))
    root = flatten(codec.encode(message))
    assert use_keys([root], "predictions", "predictions.track_id")
    return root


def alike(a, b) -> bool:
    """The tolerance of one value, as it is documented."""
    if isinstance(a, float) and math.isnan(a):
        return math.isnan(b)
    return a == b or (math.isfinite(a) and math.isfinite(b) and abs(a - b) <= ATOL + RTOL * abs(a))


def slowly(a: PredictionFrame, b: PredictionFrame) -> tuple[int, int, int]:
    """Coordinates and risk times compared, those that differ, and items of one message alone."""
    values = different = alone = 0
    in_a, in_b = ({each.track_id: each for each in message.predictions} for message in (a, b))
    alone += len(in_a.keys() ^ in_b.keys())
    for number in in_a.keys() & in_b.keys():
        one, other = in_a[number], in_b[number]
        times = [each.corridor_time_s for each in (one, other)]
        if times != [None, None]:
            values += 1
            different += None in times or not alike(*times)
        alone += abs(len(one.paths) - len(other.paths))
        for path, counterpart in zip(one.paths, other.paths, strict=False):
            alone += 2 * abs(len(path.points_m) - len(counterpart.points_m))
            for point, its in zip(path.points_m.tolist(), counterpart.points_m.tolist(), strict=False):
                values += 2
                different += sum(not alike(x, y) for x, y in zip(point, its, strict=True))
    return values, different, alone


paths = st.lists(st.lists(st.tuples(NUMBERS, NUMBERS), min_size=1, max_size=3), min_size=1, max_size=3)
frames = st.dictionaries(st.integers(1, 4), st.tuples(paths, st.sampled_from([None, 1.0, 1.005, 2.0])), max_size=4).map(
    lambda people: frame(prediction(number, *what) for number, what in people.items())
)


@few
@given(frames, frames)
def test_it_finds_what_a_plain_loop_finds(a, b):
    tally = compared(flat(a), flat(b), ours=True, defaults=True)
    counted = {"predictions.paths.x", "predictions.paths.y", "predictions.corridor_time_s"}
    fields = [each for name, each in tally.fields.items() if name in counted]
    values, different, alone = slowly(a, b)
    assert sum(each.values for each in fields) == values
    assert sum(each.different for each in fields) == different
    assert tally.items.total() == alone
    assert (tally.first is None) == (different == alone == 0)
    for name, each in tally.fields.items():
        if name not in counted:
            assert each.different == 0


@few
@given(frames, st.randoms())
def test_the_order_of_what_has_a_key_does_not_matter(a, random):
    shuffled = list(a.predictions)
    random.shuffle(shuffled)
    assert compared(flat(a), flat(replace(a, predictions=tuple(shuffled))), ours=True).first is None


@few
@given(st.lists(st.tuples(NUMBERS, NUMBERS), min_size=1))
def test_sizes_of_numbers_are_those_of_a_plain_loop(rows):
    a, b = ({"rows": [{"x": row[k]} for row in rows]} for k in (0, 1))
    tally = compared(json_flat(a), json_flat(b))
    apart = [abs(x - y) for x, y in rows if not alike(x, y)]
    found = tally.fields["rows.x"]
    assert (found.values, found.different) == (len(rows), len(apart))
    finite = [size for size in apart if math.isfinite(size)]
    if finite:
        assert found.sizes.largest == max(finite)
        assert found.sizes.smallest == min(finite)
    covered = [abs(x - y) for x, y in rows if alike(x, y) and math.isfinite(x)]
    assert tally.within == max(covered, default=0.0)


def json_flat(document) -> Level:
    return flattener(JSON, "json")(json.dumps(document).encode())


@pytest.mark.parametrize(
    ("a", "b", "text"),
    [
        ({"x": 1}, {"x": 2}, "x: 1 vs 2"),  # whole numbers have no tolerance
        ({"x": 1}, {"x": 1.005}, None),
        ({"x": 1}, {"x": 1.5}, "x: 1.000 vs 1.500 (atol 0.01)"),
        ({"x": True}, {"x": 1}, None),  # equal, as in Python
        ({"x": "left"}, {"x": "right"}, "x: left vs right"),
        ({"x": None}, {"x": 3}, "x: None vs 3"),
        ({"x": 1}, {"y": 1}, "x: 1 vs nothing"),
        ({}, {"y": {"z": "a"}}, "y: only in the second log"),
        ({"x": [1, 2, 3]}, {"x": [1, 2]}, "x: 3 values vs 2 values"),
        ({"x": [{"y": 1}, {"y": 2}]}, {"x": [{"y": 1}, {"y": 3}]}, "x[1].y: 2 vs 3"),
        ({"x": [{"y": 1}, {"y": 2}]}, {"x": [{"y": 1}]}, "x[1]: only in the first log"),
        ({"x": [{"y": 1}]}, {"x": [{"y": 1}, {"y": 2}]}, "x[1]: only in the second log"),
        ({"x": [[1, 2], [3, 4]]}, {"x": [[1, 2], [3, 5]]}, "x[1][1]: 4 vs 5"),
        ({"x": [{"y": 1}, {}]}, {"x": [{"y": 1}, {"y": 2}]}, "x[1].y: nothing vs 2"),
        ({"a.b": 1, "a": {"b": 2}}, {"a.b": 1, "a": {"b": 3}}, "a.b: 2 vs 3"),
        ({"a.b": 1, "a": {"b": 2}}, {"a.b": 7, "a": {"b": 2}}, '"a.b": 1 vs 7'),
        ({"x": 10**400}, {"x": 1.5}, f"x: {'1' + 58 * '0'}… vs 1.5"),
        ({"x": 10**400}, {"x": 1}, f"x: {'1' + 58 * '0'}… vs 1"),
        ({"x": []}, {}, "x: only in the first log"),
        ({"x": {}}, {}, "x: only in the first log"),
        ({"x": {}}, {"x": []}, "x: nothing vs 0 values"),
        ({"x": {"y": 1}}, {"x": 5}, "x.y: 1 vs nothing"),
    ],
)
def test_documents(a, b, text):
    first = compared(json_flat(a), json_flat(b)).first
    if text is None:
        assert first is None
    else:
        assert str(first) == f"/x at 1.500 s, {text}"


scalars = NUMBERS | st.integers() | st.text(max_size=2) | st.none() | st.booleans()
documents = st.recursive(
    scalars,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text("ab.", max_size=2), inner, max_size=3),
    max_leaves=10,
)


@few
@given(documents)
def test_any_document_is_the_same_as_itself(document):
    tally = compared(json_flat(document), json_flat(document))
    assert (tally.first, tally.items.total(), tally.within) == (None, 0, 0)


@few
@given(documents, documents)
def test_documents_that_differ_are_told_apart_without_a_tolerance(a, b):
    a, b = (json.loads(json.dumps(each).replace("NaN", "0.5")) for each in (a, b))  # else none would equal itself
    tally = TopicTally("/x", (1, 1))
    Comparison(tally, 0, 0, ours=False, defaults=False).compare(json_flat(a), json_flat(b))
    assert (tally.first is None) == (a == b)


def test_half_a_turn_is_one_angle(make):
    """A hair to either side of pi, as a vehicle's yaw may be, is no difference; a quarter turn is."""

    def history(yaw):
        states = np.array([[0, 0, yaw, 0, 0]])
        message = replace(make.result(0).tracks, vehicle_history=VehicleHistory(np.array([5]), states))
        return flattener(LoggedSchema("pcgan.v1.TrackFrame", "protobuf", b""), "protobuf")(codec.encode(message))

    assert compared(history(np.pi - 1e-3), history(1e-3 - np.pi), ours=True).first is None
    quarter = compared(history(np.pi), history(-np.pi / 2), ours=True)
    assert quarter.fields["vehicle_history.yaw"].sizes.largest == pytest.approx(np.pi / 2)


def test_rows_that_share_a_key_are_told_apart_by_their_order():
    a, b = (json_flat({"tracks": [{"id": number, "x": x} for number, x in rows]})
            for rows in ([(1, 1.0), (2, 5.0)], [(2, 5.0), (1, 1.0), (1, 2.0)]))  # fmt: skip
    assert use_keys((a, b), "tracks", "tracks.id")
    tally = compared(a, b, ours=True)
    assert str(tally.first) == "/x at 1.500 s, track 1: only in the second log"
    assert tally.items.total() == 1


@pytest.mark.parametrize("broken", [{"x": 1.0}, {"id": [1], "x": 1.0}, {"id": {"y": 1}, "x": 1.0}])
def test_rows_without_a_key_in_one_message_are_compared_in_order_in_both(broken):
    good = [{"id": 1, "x": 1.0}, {"id": 2, "x": 2.0}]
    a, b = json_flat({"tracks": good}), json_flat({"tracks": [broken, good[1]]})
    assert not use_keys((a, b), "tracks", "tracks.id")
    tally = compared(a, b, ours=True)
    assert str(tally.first).startswith("/x at 1.500 s, tracks[0].id")
    assert compared(a, json_flat({"tracks": good}), ours=True).first is None
