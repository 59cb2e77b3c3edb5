"""Definitions of ROS messages, as recordings embed them -> functions that read the wanted fields out of the bytes.

rosbags parses the definitions. Its own deserialiser makes an object of every header, pose and covariance of every
detection; a reader compiled here steps over what nobody asks for (`benchmarks/decoding.py` has the difference).

What is wanted is told by paths: "header.frame_id". "K|k" is the first of the two that the definition has, "id|" is None
where it has none. A pair of a path and a tuple of paths wants those of every message in a sequence.
"""

import re
import struct
from collections.abc import Callable, Mapping
from functools import cache
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

from replay.logged_message import LoggedSchema
from schemas.codec import CodecError

Wanted: TypeAlias = "tuple[str | tuple[str, Wanted], ...]"
Fields = list[tuple[str, Any]]  # name, rosbags' description of the type
Definitions = Mapping[str, Fields]  # type such as std_msgs/msg/Header -> its fields in order
Values = tuple[Any, ...]  # as wanted: numbers, strings, arrays (bytes of uint8), lists of Values of sequences, None

SHIPPED = Path(__file__).with_name("ros_definitions")
_SEPARATOR = "=" * 80 + "\n"
_NUMBERS = {
    "bool": "?", "byte": "B", "char": "B", "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i",
    "uint32": "I", "int64": "q", "uint64": "Q", "float32": "f", "float64": "d",
}  # fmt: skip
_BYTES = ("byte", "char", "uint8")
_CDR_HEADER = 4  # bytes: byte order and options; alignment counts from behind them
_LARGEST_SOURCE = 5000  # lines; the largest message read here takes 200


def full_name(name: str) -> str:
    """Returns a type's name as ROS 2 has it, sensor_msgs/msg/CameraInfo, whether or not "msg" is in it."""
    package, _, message = name.rpartition("/")
    return name if package.endswith("/msg") or not package else f"{package}/msg/{message}"


def parse(schema: LoggedSchema) -> Definitions:
    """Returns the fields of a message and of all messages in it; raises CodecError if the definition makes no sense."""
    try:
        text = schema.definition.decode().replace("\r\n", "\n")
        if schema.encoding in ("ros2idl", "omgidl"):
            text = re.sub(r"^(#|IDL: ).*$", "", text, flags=re.MULTILINE)  # rosbags does not know #include
            types: dict[str, Any] = {}
            for part in filter(str.strip, text.split(_SEPARATOR)):
                types |= get_types_from_idl(part)
        else:
            types = get_types_from_msg(text, schema.name)
    except Exception as error:  # what rosbags raises on nonsense has no common base
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise CodecError(f"the recording's definition of {schema.name} cannot be read: {reason}") from error
    times = get_typestore(Stores.EMPTY).fielddefs  # ROS 1 has them built in
    return {name: fields for name, (_, fields) in (times | types).items()}


@cache
def standard_definitions() -> Definitions:
    """Returns the definitions of the messages that ROS 2 comes with, and of those in `ros_definitions`."""
    types = dict(get_typestore(Stores.ROS2_JAZZY).fielddefs)
    for path in SHIPPED.glob("*/*.msg"):
        types |= get_types_from_msg(path.read_text(), f"{path.parent.name}/msg/{path.stem}")
    return {name: fields for name, (_, fields) in types.items()}


class Reader:
    """Reads the wanted fields of one type of message, checked to be as long as its definition says."""

    def __init__(self, definitions: Definitions, name: str, wanted: Wanted, encoding: str):
        """Compiles the reader.

        Args:
            definitions: the fields of the type and of all types in it.
            name: of the type, such as sensor_msgs/msg/CameraInfo.
            wanted: paths of fields.
            encoding: cdr or ros1.

        Raises CodecError if the definitions lack a type or a wanted field.
        """
        self._name = name
        self._cdr = encoding == "cdr"
        self._slack = 3 if self._cdr else 0  # writers fill CDR up to a multiple of four bytes
        compiled = [_Source(definitions, order, self._cdr).compile(name, wanted) for order in "<>"]
        self._little, self._big = compiled

    def __call__(self, data: bytes) -> Values:
        """Returns the wanted values in order; raises CodecError if the bytes are not such a message."""
        read = self._little
        if self._cdr:
            if len(data) < _CDR_HEADER or data[0] != 0 or data[1] > 1:
                raise CodecError(
                    f"{self._name} begins with {data[:4].hex() or 'nothing'}; wanted plain CDR, 0000 or 0001"
                )
            read = self._little if data[1] else self._big
        try:
            values, end = read(data)
        except (struct.error, ValueError) as error:
            raise CodecError(f"not a {self._name}: {error}") from error
        if not 0 <= len(data) - end <= self._slack:
            raise CodecError(f"not a {self._name}: {len(data)} bytes where its definition takes {end}")
        return values


class _Slot(NamedTuple):
    """Where a wanted value goes, and what is wanted of it if it is a sequence of messages."""

    number: int
    inner: "Wanted | None"


class _Source:
    """Writes a reader as Python: runs of numbers of known places become one `struct`, what is not wanted its padding.

    The source holds names and constants of its own only, nothing that the recording says.
    """

    def __init__(self, definitions: Definitions, order: str, cdr: bool):
        self._definitions = definitions
        self._order = order
        self._cdr = cdr
        self._lines: list[str] = []
        self._constants: dict[str, Any] = {"frombuffer": np.frombuffer, "fits": _fits}
        self._depth = 1
        self._numbers = count()
        self._inside: list[str] = []  # the types that are being written
        self._format, self._variables = "", list[str]()  # a run of numbers, not yet written
        self._grain, self._past = 8, 0  # `at` is so many bytes past a multiple of the grain

    def compile(self, name: str, wanted: Wanted) -> Callable[[bytes], tuple[Values, int]]:
        """Returns the function from bytes to values and the place behind the message."""
        values = self._message(name, wanted)
        self._flush()
        source = [
            "def read(data):",
            f"    at, spent = {_CDR_HEADER if self._cdr else 0}, 0",
            *self._lines,
            f"    return {values}, at",
        ]
        exec("\n".join(source), self._constants)
        read: Callable[[bytes], tuple[Values, int]] = self._constants["read"]
        return read

    def _message(self, name: str, wanted: Wanted) -> str:
        """Writes a message; returns the source of the tuple of its wanted values."""
        found = ["None"] * len(wanted)
        self._fields(name, self._tree(name, wanted), found)
        return f"({', '.join(found)},)" if found else "()"

    def _tree(self, name: str, wanted: Wanted) -> dict[str, Any]:
        """Returns the wanted paths as nested dicts of field names, with a `_Slot` at each end."""
        tree: dict[str, Any] = {}
        for number, item in enumerate(wanted):
            paths, inner = (item, None) if isinstance(item, str) else item
            found = [path for path in paths.split("|") if path and self._has(name, path, inner is not None)]
            if found:
                *parents, last = found[0].split(".")
                node = tree
                for parent in parents:
                    node = node.setdefault(parent, {})
                node[last] = _Slot(number, inner)
            elif not paths.endswith("|"):
                raise CodecError(f"{name} has no field {' or '.join(paths.split('|'))} in the recording's definition")
        return tree

    def _has(self, name: str, path: str, messages: bool) -> bool:
        """Tells whether a type has a field: a sequence of messages, or numbers or a string."""
        field, _, rest = path.partition(".")
        kind, what = dict(self._of(name)).get(field, (None, None))
        if rest:
            return bool(kind == Nodetype.NAME and self._has(what, rest, messages))
        if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            return bool((what[0][0] == Nodetype.NAME) == messages)
        return bool(kind == Nodetype.BASE and not messages)

    def _of(self, name: str) -> Fields:
        if name not in self._definitions:
            raise CodecError(f"the recording's definition lacks {name}")
        return self._definitions[name]

    # --- writing ----------------------------------------------------------------------------------------------------

    def _fields(self, name: str, tree: dict[str, Any], found: list[str]) -> None:
        """Writes the fields of a message, and the names of wanted ones into their places in `found`."""
        if name in self._inside or len(self._lines) > _LARGEST_SOURCE:
            raise CodecError(f"the recording's definition of {name} has no end")
        self._inside.append(name)
        for field, (kind, what) in self._of(name):
            here = tree.get(field)
            if kind == Nodetype.NAME:
                self._fields(what, here or {}, found)
                continue
            slot = here if isinstance(here, _Slot) else None
            if kind == Nodetype.BASE:
                variable = self._scalar(what[0], slot is not None)
            else:
                (element_kind, element), length = what
                if element_kind == Nodetype.BASE and element[0] in _NUMBERS:
                    write = self._array if kind == Nodetype.ARRAY else self._sequence
                    variable = write(element[0], length, slot is not None)
                else:
                    times = str(length) if kind == Nodetype.ARRAY else self._number("I", True)
                    variable = self._loop(times, element_kind, element, slot)
            if slot is not None:
                found[slot.number] = variable
        if self._cdr and not self._of(name):
            self._number("B", False)  # ROS 2 gives a message without fields one that nobody sees
        self._inside.pop()

    def _scalar(self, base: str, wanted: bool) -> str:
        return self._string(wanted) if base == "string" else self._number(_code(base), wanted)

    def _number(self, code: str, wanted: bool) -> str:
        size = struct.calcsize("<" + code)
        self._align(size)
        self._format += code if wanted else f"{size}x"
        self._past += size
        return self._variable(wanted)

    def _string(self, wanted: bool) -> str:
        length = self._number("I", True)
        self._flush()
        variable = self._name() if wanted else ""
        if wanted:
            end = f"{length} - 1" if self._cdr else length  # CDR counts a zero at the end
            self._line(f"{variable} = data[at : at + {end}].decode()")
        self._line(f"at += {length}")
        self._grain, self._past = 1, 0
        return variable

    def _array(self, base: str, length: int, wanted: bool) -> str:
        """Writes an array of numbers of fixed length, which is part of a run."""
        size = struct.calcsize("<" + _code(base))
        self._align(size)
        self._format += f"{length * size}{'s' if wanted else 'x'}"
        self._past += length * size
        variable = self._variable(wanted)
        if wanted and base not in _BYTES:
            self._flush()
            self._line(f"{variable} = frombuffer({variable}, {self._dtype(base)!r})")
        return variable

    def _sequence(self, base: str, _: int, wanted: bool) -> str:
        """Writes a sequence of numbers."""
        length = self._number("I", True)
        self._flush()
        size = struct.calcsize("<" + _code(base))
        if self._cdr and size > 4:  # an empty sequence has no padding
            self._line(f"if {length}: at += ({_CDR_HEADER} - at) & {size - 1}")
        variable = self._name() if wanted else ""
        if wanted:
            part = f"data[at : at + {size} * {length}]"
            self._line(f"{variable} = {part if base in _BYTES else f'frombuffer({part}, {self._dtype(base)!r})'}")
        self._line(f"at += {size} * {length}")
        self._grain, self._past = min(size, 4), 0
        return variable

    def _loop(self, times: str, kind: int, element: Any, slot: _Slot | None) -> str:
        """Writes an array or sequence of messages or strings."""
        self._flush()
        variable = self._name() if slot is not None else ""
        if variable:
            self._line(f"{variable} = []")
        items = self._name()
        self._line(f"{items} = fits({times}, len(data) - at, spent, len(data))")
        self._line(f"spent += {items}")
        self._line(f"for _ in range({items}):")
        before = len(self._lines)
        self._depth += 1
        self._grain, self._past = 1, 0  # the second time round
        if kind == Nodetype.NAME:
            value = self._message(element, slot.inner or () if slot is not None else ())
        else:
            value = self._scalar(element[0], slot is not None)
        self._flush()
        if variable:
            self._line(f"{variable}.append({value})")
        elif len(self._lines) == before:  # items without fields, which nobody wants
            self._line("pass")
        self._depth -= 1
        self._grain, self._past = 1, 0
        return variable

    def _align(self, size: int) -> None:
        """Moves on to where CDR puts a number of a size; ROS 1 packs them."""
        if not self._cdr:
            return
        if size <= self._grain:
            padding = -self._past % size
            self._format += f"{padding}x" if padding else ""
            self._past += padding
        else:
            self._flush()
            self._line(f"at += ({_CDR_HEADER} - at) & {size - 1}")
            self._grain, self._past = size, 0

    def _flush(self) -> None:
        """Writes the run of numbers that has gathered."""
        if not self._format:
            return
        run = struct.Struct(self._order + self._format)
        if self._variables:
            unpack = self._name()
            self._constants[unpack] = run.unpack_from
            self._line(f"{', '.join(self._variables)}, = {unpack}(data, at)")
        self._line(f"at += {run.size}")
        self._format, self._variables = "", []

    def _variable(self, wanted: bool) -> str:
        if not wanted:
            return ""
        self._variables.append(self._name())
        return self._variables[-1]

    def _name(self) -> str:
        return f"v{next(self._numbers)}"

    def _line(self, text: str) -> None:
        self._lines.append("    " * self._depth + text)

    def _dtype(self, base: str) -> str:
        return np.dtype(self._order + _code(base)).str


def _code(base: str) -> str:
    if base not in _NUMBERS:
        raise CodecError(f"the recording's definition has a {base}, which is not supported")
    return _NUMBERS[base]


def _fits(length: int, room: int, spent: int, whole: int) -> int:
    """Returns the length of a sequence whose items take at least a byte each; raises ValueError if it cannot be.

    Items may be empty in ROS 1. So that sequences of sequences of these end, a message holds no more items (`spent` so
    far) than it has bytes.
    """
    if length > room or spent + length > whole:
        raise ValueError(f"a sequence of {length} in {max(room, 0)} bytes")
    return length
