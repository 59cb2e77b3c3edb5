"""Points out of packed records: any type and padding; what was not measured is left out, what is wrong is named."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from replay.point_fields import points_from_fields
from schemas.codec import CodecError

XYZ = {"x": (0, "<f4"), "y": (4, "<f4"), "z": (8, "<f4")}
POINTS = np.array([[4.0, -1.5, 0.25], [8.0, 2.5, -1.5]])


def packed(points, dtype="<f4"):
    return np.asarray(points, dtype).tobytes()


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("kind", ["f4", "f8", "i1", "i2", "i4", "u1", "u2", "u4"])
def test_every_type_and_order(order, kind):
    whole = np.array([[1, 2, 3], [4, 5, 6]])
    dtype = np.dtype(order + kind)
    fields = {axis: (i * dtype.itemsize, order + kind) for i, axis in enumerate("xyz")}
    found = points_from_fields(packed(whole, dtype), 2, 3 * dtype.itemsize, fields)
    np.testing.assert_array_equal(found, whole)
    assert found.dtype == np.float64


def test_other_fields_lie_between_and_are_ignored():
    record = np.dtype({
        "names": ["z", "intensity", "x", "ring", "y"],
        "formats": ["<f8", "<f4", "<f4", "<u2", ">i2"],
        "offsets": [0, 8, 13, 18, 20],  # x is not aligned
        "itemsize": 32,
    })  # fmt: skip
    cloud = np.zeros(2, record)
    cloud["x"], cloud["y"], cloud["z"], cloud["intensity"] = (0.5, -2.5), (7, -8), (0.1, 0.2), np.nan
    fields = {name: (record.fields[name][1], record.fields[name][0].str) for name in record.names}
    found = points_from_fields(cloud.tobytes(), 2, 32, fields)
    np.testing.assert_array_equal(found, [[0.5, 7, 0.1], [-2.5, -8, 0.2]])


def test_rows_with_padding():
    grid = np.arange(1, 19, dtype="<f4").reshape(2, 3, 3)
    rows = [row.tobytes() + b"\xff" * 5 for row in grid]
    found = points_from_fields(b"".join(rows), 6, 12, XYZ, rows=2, row_step=41)
    np.testing.assert_array_equal(found, grid.reshape(-1, 3))


def test_what_was_not_measured_is_left_out():
    points = [[1, 2, 3], [0, 0, 0], [np.nan, 1, 1], [1, np.inf, 1], [-0.0, 0, 0], [0, 0, 2]]
    np.testing.assert_array_equal(points_from_fields(packed(points), 6, 12, XYZ), [[1, 2, 3], [0, 0, 2]])


def test_an_empty_cloud_has_no_points():
    assert points_from_fields(b"", 0, 12, XYZ).shape == (0, 3)


def test_the_data_may_be_read_only_and_stay_as_they_are():
    data = packed(POINTS)
    found = points_from_fields(memoryview(data), 2, 12, XYZ)
    found[:] = 0
    assert data == packed(POINTS)


@pytest.mark.parametrize(
    ("changes", "wanted"),
    [
        ({"data": packed(POINTS)[:-1]}, "holds 23 bytes instead of 24 .2 points of 12 bytes"),
        ({"data": packed(POINTS) + b"\0"}, "holds 25 bytes instead of 24"),
        ({"count": 3}, "holds 24 bytes instead of 36"),
        ({"count": 2**63}, "holds 24 bytes instead of"),
        ({"count": -1}, "-1 points"),
        ({"rows": 0}, "2 points in 0 rows"),
        ({"count": 3, "rows": 2}, "3 points in 2 rows"),
        ({"rows": 2, "row_step": 11}, "rows of 11 bytes, too few for 1 points of 12 bytes"),
        ({"point_step": 8}, "z of 4 bytes at byte 8 does not fit into a point of 8 bytes"),
        ({"point_step": 0}, "x of 4 bytes at byte 0 does not fit into a point of 0 bytes"),
        ({"fields": {"x": (0, "<f4"), "y": (4, "<f4")}}, "no field z; its fields are x, y"),
        ({"fields": {}}, "no field x; its fields are none"),
        ({"fields": XYZ | {"y": (-4, "<f4")}}, "y of 4 bytes at byte -4"),
        ({"fields": XYZ | {"y": (4, "nonsense")}}, "y has an unknown type 'nonsense'"),
        ({"fields": XYZ | {"y": (4, "<S4")}}, "y is of type '<S4', which is not a number"),
        ({"data": packed([[1, 2, 3], [1e12, 0, 0]])}, "a point at 1e.12 m"),
    ],
)
def test_what_is_wrong_is_named(changes, wanted):
    given_ = {"data": packed(POINTS), "count": 2, "point_step": 12, "fields": XYZ, **changes}
    with pytest.raises(CodecError, match=f"^Scan.*{wanted}"):
        points_from_fields(**given_, name="Scan")


@given(
    st.binary(max_size=64),
    st.integers(-2, 2**40),
    st.integers(-20, 40),
    st.dictionaries(
        st.sampled_from("xyzi"), st.tuples(st.integers(-9, 40), st.sampled_from(["<f4", ">f8", "u1", "?"]))
    ),
    st.integers(-1, 4),
    st.none() | st.integers(-20, 40),
)
def test_nonsense_raises_nothing_but_codec_errors(data, count, step, fields, rows, row_step):
    try:
        points = points_from_fields(data, count, step, fields, rows=rows, row_step=row_step)
    except CodecError:
        return
    assert points.shape == (len(points), 3)
    assert np.isfinite(points).all()
