"""Reference outputs: what a case gave when somebody said that it was right, small enough for a repository.

A reference is an MCAP file of the output's tracks, poses and predictions, thinned (replay/thin_output.py). Its metadata
record "pcgan.reference" holds digests of the whole messages, so that "byte for byte" is still known; where they came
from; and why it was written. There is no clock and no path in it: the same output and reason give the same file.
"""

import hashlib
import io
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import IO, Any

import numpy as np
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from replay.check_result import Reference, Status, repeatable
from replay.diff_result import Difference, LogDiff, Tolerances
from replay.errors import OutputError, ReplayError
from replay.expectations import figures
from replay.log_reader import LogReader
from replay.logged_message import LoggedSchema
from replay.part_file import write_whole
from replay.thin_output import GRID, TOPICS, thinned
from schemas import codec
from schemas.messages import FloatArray, Prediction, PredictionFrame
from schemas.topics import PREDICTIONS

FORMAT = "1"
RECORD, LINEAGE = "pcgan.reference", "pcgan"  # names of metadata records: ours, the output's
SETTINGS, SUMMARY = "settings.json", "summary.json"  # names of attachments
ENDING = ".reference.mcap"
THINNED = ("tracks.history", "vehicle_history", "vehicle_path", "predictions.mixture")  # fields not to be compared
NAMED = ("model",)  # another one is said beside the differences that it makes
MIXTURE_FIGURES = ("nll", "ground_truth.nll")  # the figures that see more of a mixture than its paths
MIXTURE_TOLERANCE = 1e-3  # of these figures and of the mixtures' spread; relative, and absolute below 1
MOST_FORMER = 20  # writes that a reference remembers


class BadReference(ReplayError):
    """A reference that cannot be read."""


@dataclass(frozen=True)
class Origin:
    """Where an output came from."""

    version: str  # of pcgan
    model: str
    model_sha256: str
    inputs: tuple[tuple[str, str], ...]  # base name, SHA-256
    settings: dict[str, Any]


@dataclass(frozen=True)
class Content:
    """What an output held, to the byte and in figures."""

    topics: dict[str, str]  # topic -> SHA-256 of its messages and their log times
    mixtures: str  # SHA-256 of the mixtures alone
    spread_m: float | None  # root mean square distance of mixtures from the likeliest path, all steps; None without


@dataclass(frozen=True)
class StoredReference:
    """A reference as it was read."""

    path: Path
    reason: str
    former: tuple[dict[str, str], ...]  # version, model and reason of earlier writes, newest first
    origin: Origin
    content: Content
    summary: dict[str, object]  # the figures that repeat


@dataclass(frozen=True)
class Comparison:
    """An output beside its reference."""

    status: Status  # IDENTICAL, CLOSE, CHANGED or UNREFERENCED
    problem: str = ""  # one line, of CHANGED
    reference: Reference | None = None
    reference_summary: dict[str, object] = field(default_factory=dict)
    diff: LogDiff | None = None


def reference_path(folder: Path, name: str) -> Path:
    """Returns where the reference of a case lies."""
    return folder / f"{name}{ENDING}"


# --- comparing -------------------------------------------------------------------------------------------------------


def compare(path: Path, output: Path, summary: Mapping[str, object], tolerances: Tolerances) -> Comparison:
    """Compares an output of a replay with its reference.

    IDENTICAL says that every byte of tracks, poses and predictions is as it was, CLOSE that all numbers lie within the
    tolerances, with tracks that may be numbered otherwise. Mixtures are not kept: where they differ, their spread and
    the likelihood of what happened must not differ by more than MIXTURE_TOLERANCE.

    Args:
        path: the reference; if it is not there the status is UNREFERENCED.
        output: a whole output, as of `pcgan replay`.
        summary: the replay's `Summary.as_json()`.
        tolerances: see `pcgan diff`; atol counts as half of GRID at least.

    Raises:
        BadReference: the reference cannot be read.
    """
    if not path.exists():
        return Comparison(
            Status.UNREFERENCED, "there is nothing to compare with; --update --reason TEXT writes a reference"
        )
    stored = read_reference(path)
    origin, content = read_origin(output), read_content(output)
    found = Comparison(
        Status.IDENTICAL,
        reference=Reference(
            path,
            stored.origin.version,
            stored.origin.model,
            stored.origin.model_sha256,
            stored.reason,
            stored.origin.inputs,
            changes(stored.origin, origin),
        ),
        reference_summary=stored.summary,
    )
    if content.topics == stored.content.topics:
        return found
    from replay.diff import diff_logs

    topics = TOPICS if tolerances.topics is None else tolerances.topics
    atol, ignore = max(tolerances.atol, GRID / 2), (*tolerances.ignore, *THINNED, *NAMED)
    allowed = tolerances.model_copy(update={"topics": topics, "atol": atol, "ignore": ignore})
    diff = diff_logs([path], [output], allowed)
    if not diff.same:
        return replace(found, status=Status.CHANGED, problem=words(diff.first), diff=diff)
    lines = _mixture_changes(stored, content, summary)
    wanted = any(fnmatchcase(PREDICTIONS.name, pattern) for pattern in topics)
    if lines and wanted and not {"predictions", "predictions.mixture"} & set(tolerances.ignore):
        problem = f"the paths are the same, their mixtures are not: {', '.join(lines)}"
        return replace(found, status=Status.CHANGED, problem=problem, diff=diff)
    return replace(found, status=Status.CLOSE, diff=diff)


def words(difference: Difference | None) -> str:
    """Returns a difference between a reference and what came out now, in a line."""
    line = "" if difference is None else str(difference)
    return line.replace("in the first log", "in the reference").replace("in the second log", "in this run")


def changes(former: Origin, now: Origin) -> tuple[str, ...]:
    """Returns what may have caused a difference, in words: "tracking.tracker.confirm_hits 2 -> 3"."""
    found = []
    if former.version != now.version:
        found.append(f"version {former.version} -> {now.version}")
    if former.model_sha256 != now.model_sha256:
        named = former.model != now.model
        before, after = (
            f"{origin.model} ({origin.model_sha256[:8]})" if named else origin.model_sha256[:8]
            for origin in (former, now)
        )
        found.append(f"model {before} -> {after}")
    if former.inputs != now.inputs:
        before, after = (
            ", ".join(f"{name} {digest[:8]}" for name, digest in origin.inputs) for origin in (former, now)
        )
        found.append(f"input {before} -> {after}")
    before_of, after_of = _leaves(former.settings), _leaves(now.settings)
    for name in sorted(before_of.keys() | after_of.keys()):
        before, after = (json.dumps(leaves[name]) if name in leaves else "nothing" for leaves in (before_of, after_of))
        if before != after:
            found.append(f"{name} {before} -> {after}")
    return tuple(found)


def _mixture_changes(stored: StoredReference, content: Content, summary: Mapping[str, object]) -> list[str]:
    """Returns the figures of mixtures that differ by more than MIXTURE_TOLERANCE, before and now."""
    if content.mixtures == stored.content.mixtures:
        return []
    before, after = figures(stored.summary), figures(summary)
    pairs: list[tuple[str, float | None, float | None]] = [
        ("spread_m", stored.content.spread_m, content.spread_m),
        *((name, before.get(name), after.get(name)) for name in MIXTURE_FIGURES),
    ]
    return [f"{name} {_short(a)} -> {_short(b)}" for name, a, b in pairs if not _near(a, b)]


def _near(a: float | None, b: float | None) -> bool:
    if a is None or b is None:
        return a is b
    return abs(a - b) <= MIXTURE_TOLERANCE * max(1.0, abs(a))


def _short(number: float | None) -> str:
    return "nothing" if number is None else f"{number:.4g}"


def _leaves(nested: Mapping[str, Any], above: str = "") -> dict[str, Any]:
    """Returns nested values by their dotted names."""
    leaves: dict[str, Any] = {}
    for name, value in nested.items():
        if isinstance(value, Mapping) and value:
            leaves |= _leaves(value, f"{above}{name}.")
        else:
            leaves[f"{above}{name}"] = value
    return leaves


# --- reading ---------------------------------------------------------------------------------------------------------


def read_reference(path: Path) -> StoredReference:
    """Reads what a reference says about itself; its messages are for `diff_logs`.

    Raises:
        BadReference: it is damaged, no reference at all, or of a format that this version does not know.
    """
    try:
        for _ in LogReader([path]).messages():  # every chunk's checksum, before anything is believed
            pass
        records, attachments = _said(path)
        if RECORD not in records:
            raise BadReference(f"{path} is no reference: it has no record {RECORD!r}{_ANEW}")
        said = records[RECORD]
        if said.get("format") != FORMAT:
            raise BadReference(
                f"{path} is a reference of format {said.get('format')!r}, and this version reads {FORMAT!r}{_ANEW}"
            )
        return StoredReference(
            path,
            said["reason"],
            tuple(json.loads(said["former"])),
            _origin(said, attachments[SETTINGS]),
            Content(**json.loads(said["content"])),
            json.loads(attachments[SUMMARY]),
        )
    except BadReference:
        raise
    except OSError as error:
        raise BadReference(f"{path} cannot be read: {error.strerror or error}") from error
    except ReplayError as error:
        raise BadReference(f"{error}".removesuffix("; try --salvage") + _ANEW) from error
    except (McapError, KeyError, ValueError, TypeError, AttributeError, RecursionError) as error:
        raise BadReference(f"{path} is a damaged reference ({type(error).__name__}: {error}){_ANEW}") from error


_ANEW = "; write it anew with --update --reason TEXT"


def read_origin(output: Path) -> Origin:
    """Returns what an output of a replay says about where it came from."""
    records, attachments = _said(output)
    return _origin(records[LINEAGE], attachments[SETTINGS])


def read_content(output: Path) -> Content:
    """Returns the digests of an output of a replay."""
    topics: dict[str, Any] = {}
    mixtures, squares, steps = hashlib.sha256(), 0.0, 0
    for message in LogReader([output]).messages(set(TOPICS)):
        digest = topics.setdefault(message.topic, hashlib.sha256())
        digest.update(message.log_time_ns.to_bytes(8, "little") + len(message.data).to_bytes(8, "little"))
        digest.update(message.data)
        if message.topic == PREDICTIONS.name:
            for prediction in codec.decode(PredictionFrame, message.data).predictions:
                mixture = prediction.mixture
                for part in (mixture.weights, mixture.means_m, mixture.sigmas_m, mixture.rhos):
                    mixtures.update(np.ascontiguousarray(part).tobytes())
                distances = _distances_m2(prediction)
                squares, steps = squares + float(distances.sum()), steps + len(distances)
    return Content(
        {topic: digest.hexdigest() for topic, digest in sorted(topics.items())},
        mixtures.hexdigest(),
        float(np.sqrt(squares / steps)) if steps else None,
    )


def _distances_m2(prediction: Prediction) -> FloatArray:
    """Returns the mixture's mean squared distance from the likeliest path at each step (P,).

    From the path, not from the mixture's own mean: a mixture that is not where its paths are is noticed, too.
    """
    mixture, path = prediction.mixture, prediction.paths[0]
    weights = np.asarray(mixture.weights, float)[..., None]  # (P, K, 1)
    means, sigmas = np.asarray(mixture.means_m, float), np.asarray(mixture.sigmas_m, float)  # (P, K, 2)
    away = means - np.asarray(path.points_m, float)[:, None]
    distances: FloatArray = (weights * (away**2 + sigmas**2)).sum(axis=(1, 2))
    return distances


def _origin(said: Mapping[str, str], settings: bytes) -> Origin:
    inputs = tuple((str(each["name"]), str(each["sha256"])) for each in json.loads(said["inputs"]))
    return Origin(said["version"], said["model"], said["model_sha256"], inputs, json.loads(settings))


def _said(path: Path) -> tuple[dict[str, dict[str, str]], dict[str, bytes]]:
    """Returns a file's metadata records and attachments by name."""
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        records = {record.name: record.metadata for record in reader.iter_metadata()}
        return records, {attachment.name: attachment.data for attachment in reader.iter_attachments()}


# --- writing ---------------------------------------------------------------------------------------------------------


def write_reference(path: Path, output: Path, summary: Mapping[str, object], reason: str) -> None:
    """Writes, or replaces, a reference; the reasons of the one before are kept in it.

    Args:
        path: where it goes; folders are made.
        output: a whole output of a replay.
        summary: the replay's `Summary.as_json()`.
        reason: why this is right from now on.

    Raises:
        OutputError: it cannot be written; the one before is then still there.
    """
    content = io.BytesIO()
    _write(content, output, summary, " ".join(reason.split()), _former(path))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror or error}") from error
    write_whole(path, content.getvalue())


def _former(path: Path) -> tuple[dict[str, str], ...]:
    """Returns the writes that a reference at `path` remembers, itself the first; none of a damaged one."""
    try:
        stored = read_reference(path) if path.exists() else None
    except BadReference:
        stored = None
    if stored is None:
        return ()
    latest = {"version": stored.origin.version, "model_sha256": stored.origin.model_sha256, "reason": stored.reason}
    return (latest, *stored.former)[:MOST_FORMER]


def _write(
    stream: IO[bytes], output: Path, summary: Mapping[str, object], reason: str, former: tuple[dict[str, str], ...]
) -> None:
    origin, content = read_origin(output), read_content(output)
    writer = Writer(stream, compression=CompressionType.ZSTD)
    writer.start(profile="", library="pcgan")
    schemas: dict[LoggedSchema, int] = {}
    channels: dict[str, int] = {}
    at_ns = 0
    for sequence, message in enumerate(LogReader([output]).messages(set(TOPICS))):
        if message.schema not in schemas:
            schemas[message.schema] = writer.register_schema(*message.schema)
        if message.topic not in channels:
            channels[message.topic] = writer.register_channel(message.topic, message.encoding, schemas[message.schema])
        at_ns = message.log_time_ns
        writer.add_message(channels[message.topic], at_ns, thinned(message), at_ns, sequence)
    for name, value in ((SETTINGS, origin.settings), (SUMMARY, repeatable(summary))):
        writer.add_attachment(
            create_time=at_ns,
            log_time=at_ns,
            name=name,
            media_type="application/json",
            data=json.dumps(value, indent=2, sort_keys=True).encode(),
        )
    said = {
        "content": json.dumps(vars(content), sort_keys=True),
        "format": FORMAT,
        "former": json.dumps(former),
        "inputs": json.dumps([{"name": name, "sha256": digest} for name, digest in origin.inputs]),
        "model": origin.model,
        "model_sha256": origin.model_sha256,
        "reason": reason,
        "version": origin.version,
    }
    writer.add_metadata(RECORD, said)
    writer.finish()  # type: ignore[no-untyped-call]
