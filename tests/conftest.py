"""Builders that several packages' tests share: a random-initialised model, small drives, hand-made recordings."""

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import pytest
import torch
from hypothesis import settings
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import build_file_descriptor_set

from pcgan import checkpoint
from pcgan.model import Generator, ModelConfig
from replay.simulator import simulate
from schemas import codec

settings.register_profile("no deadline", deadline=None)  # a shared machine stalls now and then
settings.load_profile("no deadline")


class Logged(NamedTuple):
    """A message to be logged: a dataclass with a pcgan.v1 protobuf, or the bytes of a schema's name."""

    topic: str
    log_time_ns: int
    message: object  # dataclass, or bytes
    schema: str = ""  # of bytes
    encoding: str = "protobuf"


@pytest.fixture(scope="session")
def model(tmp_path_factory) -> Path:
    """A checkpoint of random weights: tests of the replay do not depend on what ships."""
    path = tmp_path_factory.mktemp("model") / "random.safetensors"
    config = ModelConfig()
    with torch.random.fork_rng(devices=()):
        torch.manual_seed(7)
        weights = Generator(config).state_dict()
    checkpoint.save(path, config, weights, {"data": "none"})
    return path


@pytest.fixture(scope="session")
def drive(tmp_path_factory) -> Path:
    """A 6 s drive through a crowd of 8."""
    path = tmp_path_factory.mktemp("drives") / "drive.mcap"
    simulate(path, clip=None, vehicle=None, pedestrians=8, duration_s=6.0, seed=3)
    return path


@pytest.fixture(scope="session")
def short_drive(tmp_path_factory) -> Path:
    """A 3 s drive through a crowd of 5."""
    path = tmp_path_factory.mktemp("drives") / "short.mcap"
    simulate(path, clip=None, vehicle=None, pedestrians=5, duration_s=3.0, seed=4)
    return path


@pytest.fixture(scope="session")
def logged() -> type[Logged]:
    """The record `make_log` takes."""
    return Logged


@pytest.fixture
def make_log(tmp_path):
    """Writes a recording from `Logged` records, in their order; writer options as of mcap.writer.Writer."""

    def make(messages: Iterable[Logged], name: str = "log.mcap", *, finish: bool = True, **options) -> Path:
        path = tmp_path / name
        schemas: dict[str, int] = {}
        channels: dict[tuple[str, str], int] = {}
        with path.open("wb") as stream:
            writer = Writer(stream, **{"compression": CompressionType.NONE, **options})
            writer.start(profile="", library="pcgan tests")
            for topic, log_time_ns, message, schema, encoding in messages:
                data, name, definition = _payload(message, schema)
                if name not in schemas:
                    schemas[name] = writer.register_schema(name, "protobuf", definition) if name else 0
                if (topic, name) not in channels:
                    channels[topic, name] = writer.register_channel(topic, encoding, schemas[name])
                writer.add_message(channels[topic, name], log_time_ns, data, log_time_ns)
            if finish:
                writer.finish()
        return path

    return make


def _payload(message: object, schema: str) -> tuple[bytes, str, bytes]:
    if isinstance(message, bytes):
        return message, schema, b""
    definition = build_file_descriptor_set(codec.protobuf_type(type(message))).SerializeToString()
    return codec.encode(message), codec.schema_name(type(message)), definition


@pytest.fixture
def edit_log(tmp_path):
    """Copies a recording with its messages changed: `change` takes and returns (topic, log time, bytes) in order."""

    def edit(
        source: Path,
        change: Callable[[list[tuple[str, int, bytes]]], Iterable[tuple[str, int, bytes]]],
        name: str = "edited.mcap",
        topics: Mapping[str, str] = MappingProxyType({}),  # old name -> new name
        schemas: Mapping[str, str] = MappingProxyType({}),  # a topic that `change` adds -> one with its schema
        **options,  # of mcap.writer.Writer
    ) -> Path:
        found, schema_of, declared = [], {}, {}
        with source.open("rb") as stream:
            for schema, channel, message in make_reader(stream).iter_messages():
                found.append((channel.topic, message.log_time, message.data))
                schema_of[channel.topic] = schema
        path = tmp_path / name
        numbers: dict[str, int] = defaultdict(int)
        with path.open("wb") as stream:
            writer = Writer(stream, **options)
            writer.start(profile="", library="pcgan tests")
            for topic, log_time_ns, data in change(found):
                if topic not in declared:
                    schema = schema_of[schemas.get(topic, topic)]
                    identifier = writer.register_schema(schema.name, schema.encoding, schema.data)
                    declared[topic] = writer.register_channel(topics.get(topic, topic), "protobuf", identifier)
                writer.add_message(declared[topic], log_time_ns, data, log_time_ns, numbers[topic])
                numbers[topic] += 1
            writer.finish()
        return path

    return edit


# --- public data sets ----------------------------------------------------------------------------------------------


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    """Fails a test that skipped for want of data that is there: such a skip would hide that nothing was tested."""
    report = yield
    shared = Path(str(item.config.rootpath)).parent / "shared" / "data" / "dut"
    if report.skipped and call.excinfo is not None and "PCGAN_DATA" in str(call.excinfo.value) and shared.is_dir():
        report.outcome = "failed"
        report.longrepr = f"skipped for want of data ({call.excinfo.value}), but {shared.name} is there"
    return report
