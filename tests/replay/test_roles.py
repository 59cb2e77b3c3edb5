"""Roles: which topic is what, and a clear word where one is missing or wrong."""

import pytest

from replay.errors import LogError
from replay.log_reader import ChannelInfo
from replay.roles import assign_roles, schemas_for
from schemas import topics

CLUSTERS, ODOMETRY = "/velodyne/front/clusters", "/vn100/odometry"
LIDAR = ChannelInfo(CLUSTERS, "pcgan.v1.LidarClusters", "protobuf", 10)
POSE = ChannelInfo(ODOMETRY, "pcgan.v1.VehiclePose", "protobuf", 100)
TF = ChannelInfo("/tf_static", "foxglove.FrameTransforms", "protobuf", 1)


def camera(name, kinds=("detections", "camera_info")):
    schemas = {"detections": "pcgan.v1.CameraDetections", "camera_info": "foxglove.CameraCalibration"}
    return [ChannelInfo(f"/gmsl/{name}/{kind}", schemas[kind], "protobuf", 30) for kind in kinds]


def test_default_names_need_no_remap():
    roles = assign_roles([LIDAR, POSE, TF, *camera("A0"), *camera("B1")])
    assert roles.cameras == ("A0", "B1")
    assert roles.topic_of[CLUSTERS] == CLUSTERS
    assert roles.default_of == {name: default for default, name in roles.topic_of.items()}


def test_the_lidar_alone_is_enough_and_what_is_missing_is_listed():
    roles = assign_roles([LIDAR, POSE])
    assert roles.cameras == ()
    assert set(roles.missing) == {*(f"/gmsl/{name}/detections" for name in topics.CAMERAS), "/tf", "/tf_static"}


def test_topics_of_no_role_are_left_alone():
    roles = assign_roles([LIDAR, POSE, ChannelInfo("/diagnostics", "x.Y", "cdr", 9)])
    assert "/diagnostics" not in roles.default_of


def test_a_remap_reads_another_name():
    odom = POSE._replace(topic="/odom")
    roles = assign_roles([LIDAR, odom], {ODOMETRY: "/odom"})
    assert roles.topic_of[ODOMETRY] == "/odom"
    assert roles.default_of["/odom"] == ODOMETRY


def test_a_remap_wins_over_the_default_name():
    roles = assign_roles([LIDAR, POSE, POSE._replace(topic="/odom")], {ODOMETRY: "/odom"})
    assert roles.topic_of[ODOMETRY] == "/odom"


def test_two_roles_cannot_share_a_topic():
    """One name cannot be two cameras: the decoded messages would all go to one of them."""
    A0 = camera("A0")
    with pytest.raises(LogError, match="/gmsl/A0/detections"):
        assign_roles([LIDAR, POSE, *A0, *camera("A1")], {"/gmsl/A1/detections": "/gmsl/A0/detections"})


@pytest.mark.parametrize(
    ("channels", "text"),
    [
        (
            [POSE],
            r"the log has no lidar clusters: looked for /velodyne/front/clusters \(pcgan\.v1\.LidarClusters\); "
            r"its topics are /vn100/odometry; use --topic /velodyne/front/clusters:=/your/topic",
        ),
        (
            [LIDAR],
            r"the log has no vehicle pose: looked for /vn100/odometry \(foxglove\.Odometry or foxglove\.PoseInFrame "
            r"or pcgan\.v1\.VehiclePose\); its topics are /velodyne/front/clusters; use --topic",
        ),
        ([], r"the log has no lidar clusters: .*; its topics are none"),
    ],
    ids=["no lidar", "no pose", "nothing"],
)
def test_a_missing_topic_names_what_was_looked_for_and_what_there_is(channels, text):
    with pytest.raises(LogError, match=text):
        assign_roles(channels)


def test_a_wrong_schema_is_named():
    wrong = LIDAR._replace(schema_name="foxglove.PointCloud")
    text = (
        r"/velodyne/front/clusters cannot serve as lidar clusters: wanted pcgan\.v1\.LidarClusters in protobuf, "
        r"found foxglove\.PointCloud in protobuf"
    )
    with pytest.raises(LogError, match=text):
        assign_roles([wrong, POSE])


def test_an_unknown_encoding_is_named():
    with pytest.raises(
        LogError, match=r"/vn100/odometry cannot serve as vehicle pose: .* found nav_msgs/Odometry in x"
    ):
        assign_roles([LIDAR, POSE._replace(schema_name="nav_msgs/Odometry", encoding="x")])
    with pytest.raises(LogError, match="found no schema in no encoding"):
        assign_roles([LIDAR, POSE._replace(schema_name="", encoding="")])


def test_a_camera_without_calibration_is_named():
    text = (
        r"camera A0 has detections \(/gmsl/A0/detections\) but no calibration: looked for /gmsl/A0/camera_info; "
        r"its topics are /gmsl/A0/detections, /velodyne/front/clusters, /vn100/odometry"
    )
    with pytest.raises(LogError, match=text):
        assign_roles([LIDAR, POSE, *camera("A0", ["detections"])])


def test_a_calibration_without_detections_makes_no_camera():
    assert assign_roles([LIDAR, POSE, *camera("A0", ["camera_info"])]).cameras == ()


def test_an_unknown_default_name_lists_the_known_ones():
    with pytest.raises(LogError, match=r"/odom is not a topic that can be remapped; those are .*/vn100/odometry"):
        assign_roles([LIDAR, POSE], {"/odom": ODOMETRY})


def test_a_remap_to_a_name_the_log_lacks_lists_what_it_has():
    with pytest.raises(LogError, match=r"the log has no topic /odom; its topics are /velodyne/front/clusters, /vn100"):
        assign_roles([LIDAR, POSE], {ODOMETRY: "/odom"})


def test_a_pose_may_come_in_any_of_its_schemas():
    for schema in ("foxglove.Odometry", "foxglove.PoseInFrame", "pcgan.v1.VehiclePose"):
        assert assign_roles([LIDAR, POSE._replace(schema_name=schema)]).topic_of[ODOMETRY] == ODOMETRY


def test_every_role_has_a_decoder():
    for topic in topics.INPUTS:
        assert schemas_for(topic), topic.name
