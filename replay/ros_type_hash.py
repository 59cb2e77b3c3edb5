"""Type hashes of ROS 2 messages (RIHS01, REP 2016) and, the other way round, the definition that has a given hash.

A key of rmw_zenoh names a type and its hash, never its definition: what arrives can be decoded only if we know a
definition with that hash. We know those of ROS 2's own packages, from rosbags, and those in `ros_definitions`.
"""

from functools import cache, lru_cache
from pathlib import Path

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from replay import ros_reader
from replay.errors import ReplayError
from replay.logged_message import LoggedSchema
from replay.rmw_zenoh import TYPE_HASH_NOT_SUPPORTED
from schemas.codec import CodecError

# Humble first: its keys carry no hash, so that the first definition found is taken
_RELEASES = (Stores.ROS2_HUMBLE, Stores.ROS2_LYRICAL, Stores.ROS2_KILTED, Stores.ROS2_JAZZY, Stores.ROS2_IRON)
_SHIPPED = Path(__file__).with_name("ros_definitions")  # a directory for each package
# vision_msgs 3 differs from 4 in this type alone; both put the same bytes on the wire
_VISION_MSGS_3 = {"vision_msgs/msg/BoundingBox2D": "geometry_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y\n"}


class TypeHashError(ReplayError):
    """A message type whose definition is unknown or cannot be hashed."""


@lru_cache(maxsize=256)
def type_hash(schema: LoggedSchema) -> str:
    """Returns the hash of a definition that holds everything it refers to, as recordings embed it."""
    if schema.encoding not in ("ros2msg", "ros2idl", "omgidl"):
        raise TypeHashError(
            f"{schema.name} is defined in {schema.encoding!r}; only ros2msg and ros2idl have ROS 2 hashes"
        )
    store = get_typestore(Stores.EMPTY)
    try:
        store.fielddefs = {name: ([], fields) for name, fields in ros_reader.parse(schema).items()}
        return store.hash_rihs01(schema.name)
    except CodecError as error:
        raise TypeHashError(str(error)) from error
    except KeyError as error:
        raise TypeHashError(f"the definition of {schema.name} lacks {error}") from error


@lru_cache(maxsize=256)
def definition_of(type_name: str, wanted_hash: str) -> LoggedSchema:
    """Returns the definition of a type that has the given hash; for Humble, which sends none, that of its release.

    Raises TypeHashError if we know none, naming the hashes that we know.
    """
    known = []
    for store in _stores():
        if type_name in store.fielddefs:
            known.append(store.hash_rihs01(type_name))
            if wanted_hash in (known[-1], TYPE_HASH_NOT_SUPPORTED):
                text, _ = store.generate_msgdef(type_name, ros_version=2)
                return LoggedSchema(type_name, "ros2msg", text.encode())
    have = f"only {', '.join(sorted(set(known)))}" if known else "nor any other of this type"
    raise TypeHashError(f"no definition of {type_name} with the hash {wanted_hash} is known, {have}")


@cache
def _stores() -> tuple[Typestore, ...]:
    """Returns the sets of definitions we know, in the order in which to search them."""
    ours = {
        f"{file.relative_to(_SHIPPED).parts[0]}/msg/{file.stem}": file.read_text()
        for file in sorted(_SHIPPED.rglob("*.msg"))
    }
    return (*map(get_typestore, _RELEASES), _extended(ours), _extended(ours | _VISION_MSGS_3))


def _extended(texts: dict[str, str]) -> Typestore:
    """Returns the newest release's definitions with more of them, by the type's name, added."""
    store = get_typestore(Stores.LATEST)
    store.fielddefs |= {
        name: fields for key, text in texts.items() for name, fields in get_types_from_msg(text, key).items()
    }
    return store
