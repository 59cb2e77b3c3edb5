"""Which topic of a recording plays which role, and why; a clear word where one is missing, unfit, or in doubt.

A role is filled by what its messages are, told by the schema embedded in the file, never by the topic's name alone. The
name decides only between several that are fit: the defaults of `schemas.topics` go first.
"""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from pydantic import BaseModel, ConfigDict, Field

from replay.decoders import decoders_for, schemas_of
from replay.errors import LogError
from replay.logged_message import ChannelInfo, RawMessage
from schemas import topics
from schemas.codec import CodecError

WHAT = {
    "clusters": "LiDAR clusters",
    "points": "LiDAR points",
    "tracks": "tracks of another tracker",
    "pose": "vehicle pose",
    "camera": "camera detections",
    "calibration": "camera calibration",
    "image": "camera image",
    "transforms": "transforms",
    "truth": "ground truth",
}
MESSAGES: Mapping[str, tuple[str, ...]] = {
    "clusters": ("LidarClusters",),
    "points": ("PointCloud",),
    "tracks": ("ObjectTracks", "TrackFrame"),
    "pose": ("VehiclePose", "Transform"),
    "camera": ("CameraDetections",),
    "calibration": ("CameraCalibration",),
    "image": ("CompressedImage",),
    "transforms": ("Transform",),
    "truth": ("GroundTruthFrame",),
}  # role -> dataclasses that can fill it, the better one first
SCANS = ("clusters", "points", "tracks")  # one of these gives the frames
STAMPED = (*SCANS, "pose", "camera", "image")  # what is put together by its stamps

FrameOf = Callable[[str], str | None]


class CameraChoice(BaseModel):
    """The topics of one camera; what is left out is looked for."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    detections: str
    calibration: str | None = None
    image: str | None = None


class RoleChoices(BaseModel):
    """Topics chosen by the user, by role; what is left out is found by its messages."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    clusters: str | None = Field(default=None, description="segmented LiDAR scans")
    points: str | None = Field(default=None, description="LiDAR scans as points, to be segmented here")
    tracks: str | None = Field(
        default=None, description="another tracker's tracks, used instead of our fusion and tracking"
    )
    pose: str | None = Field(default=None, description="odometry, poses, or a topic of transforms")
    truth: str | None = Field(default=None, description="where people really were, to score against")
    transforms: tuple[str, ...] | None = Field(default=None, description="None: every topic of transforms")
    cameras: dict[str, CameraChoice] | None = Field(default=None, description="name -> topics. None: all cameras found")

    def with_role(self, role: str, topic: str) -> "RoleChoices":
        """Returns the choices with one more, as of `--role ROLE:=TOPIC`; raises LogError for a role nobody knows.

        `camera`, `calibration` and `image` may name the camera they are of: `camera.front`.
        """
        role, _, camera = role.partition(".")
        if role not in WHAT or (camera and role not in ("camera", "calibration", "image")):
            raise LogError(f"there is no role {role + ('.' + camera if camera else '')}; roles are {', '.join(WHAT)}")
        if role == "transforms":
            return self.model_copy(update={"transforms": (*(self.transforms or ()), topic)})
        cameras = dict(self.cameras or {})
        if role == "camera":
            name = camera or _camera_name(topic)
            if name in cameras:
                raise LogError(
                    f"{cameras[name].detections} and {topic} would both be of the camera {name}; "
                    "name them with --role camera.NAME:=TOPIC"
                )
            cameras[name] = CameraChoice(detections=topic)
        elif role in ("calibration", "image"):
            if camera not in cameras:
                known = ", ".join(cameras) or "none"
                raise LogError(
                    f"--role {role}.NAME:=TOPIC goes after the camera's own --role camera.NAME:=TOPIC; "
                    f"got {role}{'.' if camera else ''}{camera}, cameras chosen so far: {known}"
                )
            cameras[camera] = cameras[camera].model_copy(update={role: topic})
        else:
            return self.model_copy(update={role: topic})
        return self.model_copy(update={"cameras": cameras})


class Reading(NamedTuple):
    """How one topic is read, and why so."""

    topic: str
    role: str
    camera: str | None
    why: str


@dataclass(frozen=True)
class Roles:
    """The topics in use. Without cameras the LiDAR alone decides; without a ground truth the replay scores itself."""

    readings: Mapping[str, Reading]  # by topic
    cameras: tuple[str, ...]  # cameras with detections and a calibration
    missing: tuple[str, ...] = ()  # what would make the result better and is not there, in words

    def topics(self, *roles: str, camera: str | None = None) -> tuple[str, ...]:
        """Returns the topics that play one of the roles, of one camera if it is named."""
        return tuple(
            reading.topic
            for reading in self.readings.values()
            if reading.role in roles and (camera is None or reading.camera == camera)
        )

    @property
    def scans(self) -> str:
        """The topic whose messages give the frames."""
        return self.topics(*SCANS)[0]

    @property
    def scan_role(self) -> str:
        """What those messages are: one of SCANS."""
        return self.readings[self.scans].role

    @property
    def pose(self) -> str:
        """The topic that says where the vehicle is."""
        return self.topics("pose")[0]


def assign_roles(
    channels: Sequence[ChannelInfo], choices: RoleChoices | None = None, frame_of: FrameOf = lambda _: None
) -> Roles:
    """Matches a log's topics to roles: as chosen, by default name, or because only one is fit.

    Args:
        channels: what the log holds.
        choices: of the user.
        frame_of: returns the frame that a topic's first message names; asked only where names do not tell which
            calibration or image belongs to a camera.

    Raises LogError, saying what was looked for and what the log has, if a role that is needed has no topic, several
    could fill one, a chosen topic does not exist or has messages that its role cannot use, one topic would play two
    roles, or a camera has no calibration.
    """
    choices = choices or RoleChoices()
    found = _Found(channels)
    scan = _scan(found, choices)
    readings = [scan, _pose(found, choices)]
    if scan.role != "tracks":  # somebody else's tracks need no cameras
        readings += _cameras(found, choices, frame_of)
    pose = readings[1].topic
    readings += [r for r in _transforms(found, choices) if r.topic != pose]
    if (truth := found.only("truth", choices.truth)) is not None:
        readings.append(truth)
    counted = Counter(reading.topic for reading in readings)
    if shared := sorted(topic for topic, count in counted.items() if count > 1):
        parts = [" of ".join(filter(None, (r.role, r.camera))) for r in readings if r.topic == shared[0]]
        raise LogError(
            f"{shared[0]} cannot play two roles, {' and '.join(parts)}; choose other topics with --role ROLE:=TOPIC"
        )
    by_topic = {reading.topic: reading for reading in readings}
    cameras = tuple(sorted(r.camera for r in readings if r.role == "camera" and r.camera is not None))
    return Roles(by_topic, cameras, tuple(_missing(readings)))


def live_roles(choices: RoleChoices | None = None) -> Roles:
    """Returns the topics a live node listens to: as chosen, by default name otherwise; nothing can be checked yet."""
    choices = choices or RoleChoices()
    default = {topic.role: topic.name for topic in topics.INPUTS if topic.role in ("clusters", "pose")}
    chosen = {role: name for role in SCANS if (name := getattr(choices, role)) is not None}
    if len(chosen) > 1:
        raise LogError(f"only one of {' and '.join(chosen)} can give the frames; choose one")
    role, scans = next(iter(chosen.items()), ("clusters", default["clusters"]))
    readings = [Reading(scans, role, None, "chosen" if chosen else "the default name")]
    pose = choices.pose or default["pose"]
    readings.append(Reading(pose, "pose", None, "chosen" if choices.pose else "the default name"))
    if role != "tracks":
        cameras = choices.cameras
        if cameras is None:
            cameras = {name: CameraChoice(detections=f"/gmsl/{name}/detections") for name in topics.CAMERAS}
        for name, camera in sorted(cameras.items()):
            folder = camera.detections.rpartition("/")[0]
            calibration = camera.calibration or f"{folder}/camera_info"
            readings.append(Reading(camera.detections, "camera", name, "chosen" if choices.cameras else "default"))
            readings.append(Reading(calibration, "calibration", name, "chosen" if camera.calibration else "beside it"))
    for name in choices.transforms or ("/tf_static", "/tf"):
        if name != pose:
            readings.append(Reading(name, "transforms", None, "chosen" if choices.transforms else "the default name"))
    names = tuple(sorted(r.camera for r in readings if r.role == "camera" and r.camera is not None))
    return Roles({reading.topic: reading for reading in readings}, names)


def decoded(message: RawMessage, reading: Reading) -> tuple[object, ...]:
    """Returns a message's dataclasses, as its role wants them.

    Raises CodecError, naming what is wrong, if it does not decode, makes no sense, or cannot fill the role.
    """
    ways = decoders_for(message.schema, message.encoding)
    wanted = MESSAGES[reading.role]
    for name in wanted:
        for way in ways:
            if way.message == name:
                value = way.decode(message.data)
                return value if isinstance(value, tuple) else (value,)
    raise CodecError(
        f"schema {message.schema.name or 'none'} in {message.encoding or 'no encoding'} is no {reading.role}"
    )


def time_offsets(roles: Roles, offsets_ms: Mapping[str, float]) -> dict[str, int]:
    """Returns what is added to the stamps of each topic: topic -> ns.

    A ground truth belongs to its scan, whose stamp it bears: it is shifted with the scans, and never on its own.
    Raises LogError if a topic is not in use or has no stamp that counts.
    """
    may_have = roles.topics(*STAMPED)
    if unknown := sorted(set(offsets_ms) - set(may_have)):
        raise LogError(
            f"{unknown[0]} can have no time offset; topics with stamps that count are {listed(sorted(may_have))}"
        )
    offsets_ns = {topic: round(offset_ms * 1e6) for topic, offset_ms in offsets_ms.items()}
    if roles.scans in offsets_ns:
        offsets_ns |= dict.fromkeys(roles.topics("truth"), offsets_ns[roles.scans])
    return offsets_ns


# --- finding ---------------------------------------------------------------------------------------------------------


class _Found:
    """What a log holds, by topic and by what its messages can be."""

    def __init__(self, channels: Sequence[ChannelInfo]):
        self.channels: dict[str, ChannelInfo] = {}  # by topic; of several of a topic, one that can be read
        self._messages: dict[str, set[str]] = defaultdict(set)
        for channel in channels:
            messages = {way.message for way in decoders_for(channel.schema, channel.encoding)}
            if messages or channel.topic not in self.channels:
                self.channels[channel.topic] = channel
            self._messages[channel.topic] |= messages

    def fit(self, role: str) -> list[str]:
        """Returns the topics that can play a role, sorted; our own outputs only where there is nothing else."""
        names = sorted(name for name, messages in self._messages.items() if messages & set(MESSAGES[role]))
        return [name for name in names if not name.startswith("/pcgan/")] or names

    def carries(self, topic: str, message: str) -> bool:
        return message in self._messages[topic]

    def chosen(self, role: str, topic: str, camera: str | None = None) -> Reading:
        """Returns a topic in the role the user gave it; raises LogError if it cannot play it."""
        channel = self.channels.get(topic)
        if channel is None:
            raise LogError(f"the log has no topic {topic}; its topics are {listed(sorted(self.channels))}")
        self._check(role, channel)
        return Reading(topic, role, camera, "chosen")

    def _check(self, role: str, channel: ChannelInfo) -> None:
        if not self._messages[channel.topic] & set(MESSAGES[role]):
            raise LogError(
                f"{channel.topic} cannot serve as {WHAT[role]}: wanted {' or '.join(schemas_for(role))}, "
                f"found {channel.schema.name or 'no schema'} in {channel.encoding or 'no encoding'}"
            )

    def only(self, role: str, choice: str | None, among: Sequence[str] | None = None) -> Reading | None:
        """Returns the topic of a role that one topic plays; None without any. Raises LogError if that is in doubt."""
        if choice is not None:
            return self.chosen(role, choice)
        fit = self.fit(role) if among is None else among
        for topic in topics.INPUTS:
            if topic.role == role and topic.name in self.channels and topic.name not in fit and not fit:
                self._check(role, self.channels[topic.name])
            if topic.role == role and topic.name in fit:
                return Reading(topic.name, role, None, "the default name")
        if len(fit) > 1:
            raise LogError(
                f"{len(fit)} topics could be the {WHAT[role]}: {listed(fit)}; choose one with --role {role}:=TOPIC"
            )
        if not fit:
            return None
        return Reading(fit[0], role, None, f"the only topic with {self.channels[fit[0]].schema.name}")


def _scan(found: _Found, choices: RoleChoices) -> Reading:
    chosen = [role for role in SCANS if getattr(choices, role) is not None]
    if len(chosen) > 1:
        raise LogError(f"only one of {' and '.join(chosen)} can give the frames; choose one")
    if chosen:
        return found.chosen(chosen[0], getattr(choices, chosen[0]))
    for role in ("clusters", "points"):
        if (reading := found.only(role, None)) is not None:
            return reading
    default = next(topic.name for topic in topics.INPUTS if topic.role == "clusters")
    tracks = found.fit("tracks")
    hint = f"; it has tracks of a tracker: use --tracks {tracks[0]}" if tracks else ""
    raise LogError(
        f"the log has no {WHAT['clusters']} and no {WHAT['points']}: looked for {default} and for any topic of "
        f"{' or '.join(schemas_for('clusters') + schemas_for('points'))}; "
        f"its topics are {listed(sorted(found.channels))}{hint}"
    )


def _pose(found: _Found, choices: RoleChoices) -> Reading:
    fit = found.fit("pose")
    poses = [name for name in fit if found.carries(name, "VehiclePose")]
    moving = [name for name in fit if name not in poses and not _is_static(name)]
    if choices.pose is not None and choices.pose in fit and choices.pose not in poses + moving:
        raise LogError(f"{choices.pose} holds mounts, which do not move: it cannot say where the vehicle is")
    reading = found.only("pose", choices.pose, poses or moving)
    if reading is None:
        default = next(topic.name for topic in topics.INPUTS if topic.role == "pose")
        raise LogError(
            f"the log has no {WHAT['pose']}: looked for {default} and for any topic of "
            f"{' or '.join(schemas_for('pose'))}; its topics are {listed(sorted(found.channels))}; "
            "use --role pose:=TOPIC"
        )
    if reading.why != "chosen" and not poses:
        return reading._replace(why="no topic of poses: from the transforms")
    return reading


def _transforms(found: _Found, choices: RoleChoices) -> list[Reading]:
    if choices.transforms is not None:
        return [found.chosen("transforms", topic) for topic in choices.transforms]
    return [Reading(topic, "transforms", None, "its messages") for topic in found.fit("transforms")]


def _is_static(topic: str) -> bool:
    return topic.endswith("tf_static")


def static_only(names: Iterable[str]) -> list[str]:
    """Returns those topics of transforms that hold mounts alone, by their name; all of them if none says so."""
    names = list(names)
    return [name for name in names if _is_static(name)] or names


# --- cameras ---------------------------------------------------------------------------------------------------------


def _cameras(found: _Found, choices: RoleChoices, frame_of: FrameOf) -> list[Reading]:
    cameras = choices.cameras
    why = "chosen"
    if cameras is None:
        fit = found.fit("camera")
        named = _camera_names(fit)
        cameras = {named[topic]: CameraChoice(detections=topic) for topic in fit}
        why = "its messages"
    readings = []
    for name, camera in sorted(cameras.items()):
        readings.append(found.chosen("camera", camera.detections, name)._replace(why=why))
        calibration = _partner("calibration", name, camera.detections, camera.calibration, found, frame_of)
        if calibration is None:
            raise LogError(
                f"camera {name} has detections ({camera.detections}) but no calibration: looked for one beside it or "
                f"of its frame; its topics are {listed(sorted(found.channels))}; "
                f"use --role camera.{name}:={camera.detections} --role calibration.{name}:=TOPIC, choose other cameras "
                "likewise, or none with an empty [roles.cameras] in a profile"
            )
        readings.append(calibration)
        if (image := _partner("image", name, camera.detections, camera.image, found, frame_of)) is not None:
            readings.append(image)
    return readings


def _partner(
    role: str, camera: str, detections: str, choice: str | None, found: _Found, frame_of: FrameOf
) -> Reading | None:
    """Returns a camera's calibration or image: as chosen, in the same folder of names, or of the same frame."""
    if choice is not None:
        return found.chosen(role, choice, camera)
    fit = found.fit(role)
    folder = detections.rpartition("/")[0]
    beside = [topic for topic in fit if folder and topic.startswith(folder + "/")]
    if len(beside) == 1:
        return Reading(beside[0], role, camera, f"beside {detections}")
    if not fit:
        return None
    frame = frame_of(detections)
    same = [topic for topic in (beside or fit) if frame and frame_of(topic) == frame]
    if len(same) == 1:
        return Reading(same[0], role, camera, f"of the frame of {detections}, {frame}")
    return None


def _camera_names(detections: Sequence[str]) -> dict[str, str]:
    """Returns a short name for each camera, by its topic: the part that tells them apart, else the whole."""
    short = {topic: _camera_name(topic) for topic in detections}
    if len(set(short.values())) < len(short):
        return {topic: topic.strip("/").replace("/", "_") for topic in detections}
    return short


def _camera_name(detections: str) -> str:
    """Returns "A0" for /gmsl/A0/detections, "front" for /front."""
    parts = detections.strip("/").split("/")
    return parts[-2] if len(parts) > 1 else parts[-1]


def _missing(readings: Sequence[Reading]) -> Iterable[str]:
    roles = {reading.role for reading in readings}
    if "tracks" in roles:
        return
    names = {reading.topic for reading in readings}
    if "camera" not in roles:
        yield f"{WHAT['camera']}: the LiDAR alone decides who is a pedestrian"
    elif names & {topic.name for topic in topics.INPUTS if topic.role == "camera"}:
        yield from (topic.name for topic in topics.INPUTS if topic.role == "camera" and topic.name not in names)
    if "transforms" not in roles and not any(_is_static(name) for name in names):
        yield WHAT["transforms"]


def schemas_for(role: str) -> list[str]:
    """Returns the names of the schemas that can fill a role."""
    return sorted({name for message in MESSAGES[role] for name in schemas_of(message)})


def listed(names: Sequence[str]) -> str:
    """Returns names in a row, for people; "none" without any."""
    return ", ".join(names) or "none"
