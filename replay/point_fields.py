"""Points out of packed records, fields by offset and type: sensor_msgs/PointCloud2 and foxglove.PointCloud."""

from collections.abc import Mapping

import numpy as np

from schemas.codec import LARGEST, CodecError
from schemas.messages import FloatArray


def points_from_fields(
    data: bytes | memoryview,
    count: int,
    point_step: int,
    fields: Mapping[str, tuple[int, str]],
    *,
    rows: int = 1,
    row_step: int | None = None,
    name: str = "PointCloud",
) -> FloatArray:
    """Returns the points (N, 3), float64, of a cloud in its own order, without those that were not measured.

    Left out are points that are not finite, and those at exactly the origin, which is how many drivers mark that a beam
    met nothing.

    Args:
        data: the packed records.
        count: points in all rows together.
        point_step: bytes from one point to the next.
        fields: name -> (offset in the record, numpy type with byte order, such as "<f4"); all but x, y, z are ignored.
        rows: of an organised cloud; each holds `count / rows` points.
        row_step: bytes from one row to the next; default: no padding.
        name: of the message, for errors.

    Raises CodecError naming what is wrong if x, y or z is missing, not a number or does not fit into its record, if the
    data are not as long as the sizes say, or if a coordinate is absurdly large.
    """
    if rows < 1 or count % rows:
        raise CodecError(f"{name} has {count} points in {rows} rows")
    width = count // rows
    row_step = width * point_step if row_step is None else row_step
    columns = [_column(fields, axis, point_step, name) for axis in "xyz"]
    if count == 0:
        return np.zeros((0, 3))
    if row_step < width * point_step:
        raise CodecError(f"{name} has rows of {row_step} bytes, too few for {width} points of {point_step} bytes")
    if len(data) != rows * row_step:
        raise CodecError(
            f"{name} holds {len(data)} bytes instead of {rows * row_step} ({count} points of {point_step} bytes)"
        )
    cloud = np.empty((rows, width, 3))
    for axis, (offset, dtype) in enumerate(columns):
        cloud[..., axis] = np.ndarray((rows, width), dtype, data, offset, (row_step, point_step))
    points = cloud.reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1) & points.any(axis=1)]
    if len(points) and (largest := np.abs(points).max()) > LARGEST:
        raise CodecError(f"{name} has a point at {largest:.3g} m, more than {LARGEST:g}")
    return points


def _column(
    fields: Mapping[str, tuple[int, str]], axis: str, point_step: int, name: str
) -> tuple[int, np.dtype[np.generic]]:
    """Returns the offset and type of a coordinate, checked."""
    if axis not in fields:
        raise CodecError(f"{name} has no field {axis}; its fields are {', '.join(fields) or 'none'}")
    offset, format = fields[axis]
    try:
        dtype = np.dtype(format)
    except TypeError:
        raise CodecError(f"{name}.{axis} has an unknown type {format!r}") from None
    if dtype.kind not in "fiu":
        raise CodecError(f"{name}.{axis} is of type {format!r}, which is not a number")
    if offset < 0 or offset + dtype.itemsize > point_step:
        raise CodecError(
            f"{name}.{axis} of {dtype.itemsize} bytes at byte {offset} does not fit into a point of {point_step} bytes"
        )
    return offset, dtype
