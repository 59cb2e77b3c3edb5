"""Which topic of a recording plays which role, and a clear word where one is missing or of the wrong kind."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from replay.decoders import DECODERS
from replay.errors import LogError
from replay.log_reader import ChannelInfo
from schemas import topics
from schemas.topics import CAMERAS, Topic


@dataclass(frozen=True)
class Roles:
    """The topics in use. Without cameras the LiDAR alone decides; without a ground truth the replay scores itself."""

    topic_of: Mapping[str, str]  # default topic name -> name in this log, of the topics it holds
    cameras: tuple[str, ...]  # cameras with detections and a calibration
    missing: tuple[str, ...]  # default names that are wanted, not required, and not there

    @property
    def default_of(self) -> dict[str, str]:
        """Name in this log -> default topic name."""
        return {name: default for default, name in self.topic_of.items()}


REQUIRED = ("lidar clusters", "vehicle pose")
STAMPED = (*REQUIRED, "camera detections", "camera image")  # what is put together by its stamps


def assign_roles(channels: Sequence[ChannelInfo], remaps: Mapping[str, str] | None = None) -> Roles:
    """Matches a log's topics to roles: by default name, or as remapped (default name -> name in this log).

    Raises LogError, saying what was looked for and what the log has, if a required topic is missing, a remapped one
    does not exist, a topic has a schema or encoding that its role cannot use, or a camera has no calibration.
    """
    remaps = dict(remaps or {})
    defaults = {topic.name for topic in topics.INPUTS}
    if unknown := sorted(set(remaps) - defaults):
        raise LogError(f"{unknown[0]} is not a topic that can be remapped; those are {_listed(sorted(defaults))}")
    by_name = {channel.topic: channel for channel in channels}
    if absent := sorted(set(remaps.values()) - set(by_name)):
        raise LogError(f"the log has no topic {absent[0]}; its topics are {_listed(sorted(by_name))}")

    taken = Counter(name for default, name in remaps.items() if default != name)
    taken.update(topic.name for topic in topics.INPUTS if topic.name in by_name and topic.name not in remaps)
    if shared := sorted(name for name, roles in taken.items() if roles > 1):
        raise LogError(f"{shared[0]} cannot play two roles; remap what it is read as by default, too")
    topic_of = {}
    for topic in topics.INPUTS:
        channel = by_name.get(remaps.get(topic.name, topic.name))
        if channel is not None:
            _check_schema(topic, channel)
            topic_of[topic.name] = channel.topic
    for topic in topics.INPUTS:
        if topic.role in REQUIRED and topic.name not in topic_of:
            wanted = " or ".join(schemas_for(topic))
            raise LogError(
                f"the log has no {topic.role}: looked for {topic.name} ({wanted}); "
                f"its topics are {_listed(sorted(by_name))}; use --topic {topic.name}:=/your/topic"
            )
    cameras = tuple(camera for camera in CAMERAS if f"/gmsl/{camera}/detections" in topic_of)
    for camera in cameras:
        if f"/gmsl/{camera}/camera_info" not in topic_of:
            raise LogError(
                f"camera {camera} has detections ({topic_of[f'/gmsl/{camera}/detections']}) but no calibration: "
                f"looked for /gmsl/{camera}/camera_info; its topics are {_listed(sorted(by_name))}"
            )
    optional = ("camera detections", "transforms", "static transforms")
    missing = tuple(topic.name for topic in topics.INPUTS if topic.role in optional and topic.name not in topic_of)
    return Roles(topic_of, cameras, missing)


def time_offsets(roles: Roles, offsets_ms: Mapping[str, float]) -> dict[str, int]:
    """Returns what is added to the stamps of each topic: name in this log -> ns.

    A ground truth belongs to its scan, whose stamp it bears: it is shifted with the clusters, and never on its own.

    Args:
        roles: the topics in use.
        offsets_ms: topic, by its name in the log or by its default name -> ms.

    Raises LogError if a topic is not in use, has no stamp that counts, or is named twice.
    """
    may_have = {t.name: roles.topic_of[t.name] for t in topics.INPUTS if t.role in STAMPED and t.name in roles.topic_of}
    offsets_ns: dict[str, int] = {}
    for name, offset_ms in offsets_ms.items():
        topic = name if name in may_have.values() else may_have.get(name)
        if topic is None:
            listed = _listed(sorted(may_have.values()))
            raise LogError(f"{name} can have no time offset; topics with stamps that count are {listed}")
        if topic in offsets_ns:
            raise LogError(
                f"{topic} has two time offsets, one under its name in the log and one under its default name"
            )
        offsets_ns[topic] = round(offset_ms * 1e6)
    truth = roles.topic_of.get("/simulation/ground_truth")
    scans = roles.topic_of["/velodyne/front/clusters"]
    return offsets_ns | ({truth: offsets_ns[scans]} if truth is not None and scans in offsets_ns else {})


def schemas_for(topic: Topic) -> list[str]:
    """Returns the names of the schemas that can fill a topic's role."""
    return sorted(name for name, (message, _) in DECODERS.items() if message == topic.message)


def _check_schema(topic: Topic, channel: ChannelInfo) -> None:
    wanted = schemas_for(topic)
    if channel.encoding != "protobuf" or channel.schema_name not in wanted:
        raise LogError(
            f"{channel.topic} cannot serve as {topic.role}: wanted {' or '.join(wanted)} in protobuf, "
            f"found {channel.schema_name or 'no schema'} in {channel.encoding or 'no encoding'}"
        )


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names) if names else "none"
