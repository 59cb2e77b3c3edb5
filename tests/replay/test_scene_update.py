"""The scene that Foxglove and Lichtblick draw."""

from dataclasses import replace

import numpy as np
import pytest
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion

from replay import colours
from replay.scene_update import COASTING_OPACITY, scene_update, scene_update_bytes
from tests.replay.view_scenes import crowd


@pytest.fixture(scope="module")
def result():
    return next(crowd(people=30))


@pytest.fixture(scope="module")
def scene(result):
    return scene_update(result)


def entity(scene, name):
    (found,) = [entity for entity in scene.entities if entity.id == name]
    return found


def test_every_update_replaces_the_one_before(scene, result):
    (deletion,) = scene.deletions
    assert deletion.type == SceneEntityDeletion.ALL
    assert deletion.timestamp.ToNanoseconds() == result.tracks.stamp_ns
    for drawn in scene.entities:
        assert drawn.timestamp.ToNanoseconds() == result.tracks.stamp_ns
        assert drawn.lifetime.ToNanoseconds() == 1_000_000_000
        assert drawn.frame_id == "odom"
    assert [drawn.id for drawn in scene.entities] == ["vehicle", *(f"track/{i + 1}" for i in range(30))]


def test_track_is_a_cylinder_with_its_id_above(scene, result):
    for track in result.tracks.tracks:
        drawn = entity(scene, f"track/{track.id}")
        (cylinder,), (text,) = drawn.cylinders, drawn.texts
        assert [cylinder.pose.position.x, cylinder.pose.position.y] == track.state[:2].tolist()
        assert cylinder.pose.position.z == cylinder.size.z / 2
        assert cylinder.pose.orientation.w == 1
        assert (cylinder.bottom_scale, cylinder.top_scale) == (1, 1)
        assert cylinder.color.a == (COASTING_OPACITY if track.coasting else 1)
        assert text.text == str(track.id)
        assert text.billboard
        assert text.pose.position.z > cylinder.size.z
        colour = [cylinder.color.r, cylinder.color.g, cylinder.color.b]
        assert colour == (colours.track_colours([track.id])[0] / 255).tolist()


def test_lines_are_the_modal_paths_as_opaque_as_they_are_likely(scene, result):
    place = {track.id: track.state[:2] for track in result.tracks.tracks}
    for prediction in result.predictions.predictions:
        lines = entity(scene, f"track/{prediction.track_id}").lines
        assert len(lines) == len(prediction.paths)
        for line, path in zip(lines, prediction.paths, strict=True):
            points = np.array([(point.x, point.y) for point in line.points])
            np.testing.assert_array_equal(points, np.vstack([place[prediction.track_id], path.points_m]))
            assert line.type == (LinePrimitive.LINE_LIST if prediction.fallback else LinePrimitive.LINE_STRIP)
            assert line.color.a == pytest.approx(colours.path_opacity(path.probability))
            assert line.pose.orientation.w == 1
            assert line.thickness > 0


def test_vehicle_is_a_cube_where_the_vehicle_is(scene, result):
    (cube,) = entity(scene, "vehicle").cubes
    pose = result.sensors.map_from_vehicle
    centre = pose @ [0.9, 0, 0.95, 1]
    np.testing.assert_allclose([cube.pose.position.x, cube.pose.position.y, cube.pose.position.z], centre[:3])
    q = cube.pose.orientation
    assert 2 * np.arctan2(q.z, q.w) == pytest.approx(np.arctan2(pose[1, 0], pose[0, 0]))


def test_bytes_are_the_message_and_repeat(result, scene):
    wire = scene_update_bytes(result)
    assert wire == scene_update_bytes(next(crowd(people=30)))
    assert scene.SerializeToString(deterministic=True) == wire  # in canonical order, nothing left out


def test_a_frame_without_people_clears_the_scene(result):
    nobody = replace(
        result, tracks=replace(result.tracks, tracks=()), predictions=replace(result.predictions, predictions=())
    )
    assert [drawn.id for drawn in scene_update(nobody).entities] == ["vehicle"]


def test_a_track_without_prediction_has_no_lines(result):
    alone = replace(result, predictions=replace(result.predictions, predictions=()))
    assert all(not drawn.lines for drawn in scene_update(alone).entities[1:])


def test_long_paths_and_big_ids_are_encoded_whole(result):
    track = replace(result.tracks.tracks[0], id=2**40)
    path = replace(result.predictions.predictions[0].paths[0], points_m=np.arange(1400.0).reshape(700, 2))
    prediction = replace(result.predictions.predictions[0], track_id=2**40, paths=(path,))
    frame = replace(
        result,
        tracks=replace(result.tracks, tracks=(track,)),
        predictions=replace(result.predictions, predictions=(prediction,)),
    )
    drawn = entity(scene_update(frame), f"track/{2**40}")
    assert len(drawn.lines[0].points) == 701
    assert drawn.lines[0].points[700].y == 1399
