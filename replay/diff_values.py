"""Logged bytes of any known encoding -> named values, by the schema in the file: what `replay.diff` compares.

A message becomes a tree of `Level`s. Values that there is one of per row stand beside each other in a list, whichever
row of whichever parent they belong to, so that a frame of thirty tracks is a few lists and not thousands of objects.
Nothing is checked here as `schemas.codec` would: two logs may hold the same nonsense, and a thinned one lacks a lot.
"""

import json
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import accumulate, chain
from operator import attrgetter, methodcaller
from typing import Any, NamedTuple

import numpy as np
from google.protobuf.message import DecodeError, Message
from mcap.exceptions import McapError
from mcap.records import Schema
from mcap_protobuf.decoder import DecoderFactory
from rosbags.interfaces import Nodetype

from replay.logged_message import LoggedSchema
from replay.ros_reader import Definitions, Reader, full_name, parse, standard_definitions
from schemas import codec
from schemas.codec import CodecError


@dataclass(eq=False)
class Level:
    """A repeated or optional part of a message: its rows, under all rows of the level above, one behind the other."""

    name: str  # dotted, "predictions.paths"; empty: the message itself
    counts: list[int]  # rows under each row of the level above
    optional: bool = False  # at most one row each: a part that may be missing
    plain: bool = False  # rows are single values
    above: "Level | None" = None
    parts: dict[str, "list[Any] | Level"] = field(default_factory=dict)  # by dotted name, in the schema's order
    keys: list[Hashable] | None = None  # what tells the rows under one parent apart; None: their order
    labels: list[Hashable] | None = None  # what they are called; None: as their keys

    @property
    def rows(self) -> int:
        """How many rows there are in all."""
        return sum(self.counts)

    def below(self, name: str, counts: list[int], *, optional: bool = False, plain: bool = False) -> "Level":
        """Adds a level below this one and returns it."""
        level = Level(name, counts, optional, plain, above=self)
        self.parts[name] = level
        return level

    def empty(self, name: str, *, optional: bool, plain: bool) -> "Level":
        """Returns a level below this one that has no rows, and is not part of it."""
        return Level(name, [0] * self.rows, optional, plain, above=self)

    def place(self, row: int) -> tuple[int, int]:
        """Returns the row above that a row belongs to, and which of its rows it is."""
        ends = list(accumulate(self.counts))
        parent = int(np.searchsorted(ends, row, side="right"))
        return parent, row - (ends[parent] - self.counts[parent])


@dataclass(frozen=True)
class Ignore:
    """Names of fields that are left out, with everything in them."""

    names: tuple[str, ...] = ()

    def __contains__(self, name: str) -> bool:
        return any(name == ignored or name.startswith(f"{ignored}.") for ignored in self.names)


Flatten = Callable[[bytes], Level]  # raises CodecError


@lru_cache(maxsize=256)
def flattener(schema: LoggedSchema, encoding: str, ignore: tuple[str, ...] = ()) -> Flatten | None:
    """Returns the way to read a schema's messages; None if it cannot be read.

    The function raises CodecError for bytes that are no such message.
    """
    ignored = Ignore(ignore)
    try:
        match encoding:
            case "protobuf":
                return _Protobuf(_message_class(schema), ignored)
            case "json":
                return _Json(ignored)
            case "cdr" | "ros1":
                return _Ros(schema, encoding, ignored)
    except CodecError:
        return None
    return None


def has_field(schema: LoggedSchema, encoding: str, name: str) -> bool:
    """Tells whether messages of a schema may have a field of a dotted name; JSON ones may have any."""
    try:
        match encoding:
            case "protobuf":
                return _protobuf_has(_message_class(schema).DESCRIPTOR, name.split("."))
            case "json":
                return True
            case "cdr" | "ros1":
                return _ros_has(_definitions(schema, encoding), full_name(schema.name), name.split("."))
    except CodecError:
        return False
    return False


def use_keys(roots: Sequence[Level], name: str, key: str) -> bool:
    """Has the rows of a level told apart by one of their values, which is then no value to compare any more.

    If rows of one parent share that value, they are told apart by their order among those that do. Returns False, and
    leaves all messages as they are, if the value is missing anywhere.
    """
    levels = [level for root in roots if (level := level_of(root, name)) is not None and level.rows]
    found = [_values_of(level, key) for level in levels]
    if None in found:
        return False
    for level, values in zip(levels, found, strict=True):
        assert values is not None
        level.labels, level.keys = values, unique(values, level.counts)
        del level.parts[key]
    return True


def unique(names: Sequence[Hashable], counts: Sequence[int]) -> list[Hashable]:
    """Returns each row's name with how many of the same name come before it under the same parent."""
    keys: list[Hashable] = []
    for part in split(names, counts):
        seen: Counter[Hashable] = Counter()
        for name in part:
            keys.append((name, seen[name]))
            seen[name] += 1
    return keys


def _values_of(level: Level, key: str) -> list[Hashable] | None:
    """Returns one value per row; None if a row has none, or one that cannot be a key."""
    values = level.parts.get(key)
    if isinstance(values, Level):  # a member that none of them lacks
        values = values.parts.get(key) if values.optional and 0 not in values.counts else None
    if not isinstance(values, list) or any(isinstance(value, dict | list) for value in values):
        return None
    return values


def split(values: Sequence[Any], counts: Sequence[int]) -> list[Sequence[Any]]:
    """Cuts a sequence into pieces of the given lengths."""
    return [values[end - count : end] for end, count in zip(accumulate(counts), counts, strict=True)]


def level_of(root: Level, name: str) -> Level | None:
    """Returns the rows of a dotted name; None if a message has none."""
    level, parts = root, name.split(".")
    for depth in range(1, len(parts) + 1):
        while isinstance(found := level.parts.get(".".join(parts[:depth])), Level):  # a list that may be missing is two
            level = found
    return level if level.name == name else None


# --- protobuf -------------------------------------------------------------------------------------------------------


@lru_cache(maxsize=256)
def _message_class(schema: LoggedSchema) -> type[Message]:
    """Returns the class of a schema, made of the definition in the file; of our own messages ours if there is none."""
    if not schema.definition and schema.name in codec.MESSAGE_TYPES:
        return codec.protobuf_type(codec.MESSAGE_TYPES[schema.name])
    try:
        read = DecoderFactory().decoder_for("protobuf", Schema(1, schema.definition, schema.encoding, schema.name))
        if read is None:
            raise CodecError(f"{schema.name} has a definition in {schema.encoding!r}; wanted protobuf")
        return type(read(b""))
    except (McapError, DecodeError, TypeError, ValueError, KeyError, RecursionError) as error:
        raise CodecError(f"the recording's definition of {schema.name} cannot be read: {error}") from error


class _Field(NamedTuple):
    name: str
    get: Callable[[Message], Any]
    has: Callable[[Message], bool] | None  # of fields that may be missing
    repeated: bool
    is_map: bool
    descriptor: Any  # of a message's type; None of a value's


class _Protobuf:
    """Flattens protobuf messages of one class."""

    def __init__(self, message_class: type[Message], ignore: Ignore):
        self._class, self._ignore = message_class, ignore
        self._plans: dict[str, list[_Field]] = {}  # by the dotted name of what the messages are

    def __call__(self, data: bytes) -> Level:
        try:
            message = self._class.FromString(data)
        except DecodeError as error:
            raise CodecError(f"not a {self._class.DESCRIPTOR.full_name}: {error}") from error
        root = Level("", [1])
        self._fill(root, "", [message], self._class.DESCRIPTOR)
        return root

    def _fill(self, level: Level, prefix: str, messages: Sequence[Any], descriptor: Any) -> None:
        """Puts the fields of a level's messages into it, one per row."""
        plan = self._plans.get(prefix)
        if plan is None:
            plan = self._plans[prefix] = self._plan(prefix, descriptor)
        for name, get, has, repeated, is_map, inner in plan:
            values: Iterable[Any]
            if repeated:
                found = [sorted(each.items()) if is_map else each for each in map(get, messages)]
                below = level.below(name, list(map(len, found)), plain=inner is None)
                children = list(chain.from_iterable(found))
                if is_map:
                    self._fill_map(below, children, inner)
                elif inner is None:
                    below.parts[name] = children
                elif children:
                    self._fill(below, name, children, inner)
            elif has is None:
                level.parts[name] = list(map(get, messages))
            else:
                there = [has(message) for message in messages]
                values = (get(message) for message, has_it in zip(messages, there, strict=True) if has_it)
                below = level.below(name, list(map(int, there)), optional=True, plain=inner is None)
                children = list(values)
                if inner is None:
                    below.parts[name] = children
                elif children:
                    self._fill(below, name, children, inner)

    def _fill_map(self, level: Level, items: Sequence[tuple[Any, Any]], inner: Any) -> None:
        """A map field's entries are told apart by their keys; those of messages hold the message's fields."""
        level.plain = False
        level.keys = [key for key, _ in items]
        values = [value for _, value in items]
        kind = inner.fields_by_name["value"].message_type
        if kind is None:
            level.parts[f"{level.name}.value"] = values
        elif values:
            self._fill(level, f"{level.name}.value", values, kind)

    def _plan(self, prefix: str, descriptor: Any) -> list[_Field]:
        """Returns how to read the fields that are not ignored."""
        plan = []
        for each in descriptor.fields:
            name = f"{prefix}.{each.name}" if prefix else each.name
            if name in self._ignore:
                continue
            inner = each.message_type
            has = methodcaller("HasField", each.name) if each.has_presence and not each.is_repeated else None
            is_map = inner is not None and inner.GetOptions().map_entry
            plan.append(_Field(name, attrgetter(each.name), has, each.is_repeated, is_map, inner))
        return plan


def _protobuf_has(descriptor: Any, parts: Sequence[str]) -> bool:
    for part in parts:
        found = descriptor.fields_by_name.get(part) if descriptor is not None else None
        if found is None:
            return False
        descriptor = found.message_type
    return True


# --- ROS ------------------------------------------------------------------------------------------------------------

_Wanted = tuple[Any, ...]  # as of `ros_reader`


class _Ros:
    """Flattens ROS 2 (CDR) and ROS 1 messages of one type."""

    def __init__(self, schema: LoggedSchema, encoding: str, ignore: Ignore):
        definitions, name = _definitions(schema, encoding), full_name(schema.name)
        self._wanted = _wanted(definitions, name, ignore, "", ())
        self._read = Reader(definitions, name, self._wanted, encoding)

    def __call__(self, data: bytes) -> Level:
        root = Level("", [1])
        self._fill(root, "", [self._read(data)], self._wanted)
        return root

    def _fill(self, level: Level, prefix: str, rows: Sequence[Sequence[Any]], wanted: _Wanted) -> None:
        for item, values in zip(wanted, zip(*rows, strict=True), strict=False):
            path, inner = (item, None) if isinstance(item, str) else item
            name = f"{prefix}.{path}" if prefix else path
            if inner is not None:
                below = level.below(name, list(map(len, values)))
                self._fill(below, name, list(chain.from_iterable(values)), inner)
            elif isinstance(values[0], np.ndarray | list):
                below = level.below(name, list(map(len, values)), plain=True)
                arrays = (value.tolist() if isinstance(value, np.ndarray) else value for value in values)
                below.parts[name] = list(chain.from_iterable(arrays))
            else:
                level.parts[name] = list(values)


def _definitions(schema: LoggedSchema, encoding: str) -> Definitions:
    if schema.definition.strip():
        return parse(schema)
    if encoding == "cdr":  # as on a live bus, where none is sent
        return standard_definitions()
    name = full_name(schema.name)
    raise CodecError(f"the recording has no definition of {name}, without which ROS 1 cannot be read")


def _ros_has(definitions: Definitions, name: str, parts: Sequence[str]) -> bool:
    for part in parts:
        kind, what = dict(definitions.get(name, ())).get(part, (None, None))
        if kind is None:
            return False
        if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            kind, what = what[0]
        name = what if kind == Nodetype.NAME else ""
    return True


def _wanted(
    definitions: Definitions, name: str, ignore: Ignore, prefix: str, inside: tuple[str, ...], start: str = ""
) -> _Wanted:
    """Returns all fields of a type as paths; `start` is the part of them that lies in the same message."""
    if name in inside or name not in definitions:
        raise CodecError(f"the recording's definition {'of' if name in inside else 'lacks'} {name}")
    wanted: list[Any] = []
    for each, (kind, what) in definitions[name]:
        path = f"{start}{each}"
        whole = f"{prefix}{path}"
        if whole in ignore:
            continue
        if kind == Nodetype.NAME:
            wanted += _wanted(definitions, what, ignore, prefix, (*inside, name), f"{path}.")
        elif kind in (Nodetype.ARRAY, Nodetype.SEQUENCE) and what[0][0] == Nodetype.NAME:
            wanted.append((path, _wanted(definitions, what[0][1], ignore, f"{whole}.", (*inside, name))))
        else:
            wanted.append(path)
    return tuple(wanted)


# --- JSON -----------------------------------------------------------------------------------------------------------


class _Json:
    """Flattens JSON messages; what a name means may change from row to row, so it is seen from the values."""

    def __init__(self, ignore: Ignore):
        self._ignore = ignore

    def __call__(self, data: bytes) -> Level:
        try:
            document = json.loads(data)
            root = Level("", [1])
            self._add(root, "", [document])
        except (ValueError, RecursionError) as error:
            raise CodecError(f"not JSON: {error}") from error
        return root

    def _add(self, level: Level, name: str, values: list[Any]) -> None:
        """Adds one value per row: members of objects, each of which may be missing, lists, anything else as it is."""
        if all(type(value) is dict for value in values):
            for key in dict.fromkeys(chain.from_iterable(values)):
                quoted = json.dumps(key) if "." in key or not key else key  # or two values might share a name
                inner = f"{name}.{quoted}" if name else quoted
                if inner in self._ignore:
                    continue
                there = [key in value for value in values]
                found = [value[key] for value in values if key in value]
                below = level.below(inner, list(map(int, there)), optional=True, plain=_plain(found))
                self._add(below, inner, found)
        elif all(type(value) is list for value in values):
            children = list(chain.from_iterable(values))
            below = level.below(name, list(map(len, values)), plain=_plain(children))
            if children:
                self._add(below, name, children)
        else:
            level.parts[name] = values


def _plain(values: Sequence[Any]) -> bool:
    return not any(isinstance(value, dict | list) for value in values)
