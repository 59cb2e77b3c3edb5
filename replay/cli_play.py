"""The subcommands `pcgan play` and `pcgan record`: recordings onto the zenoh bus, and the bus into recordings."""

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Annotated

import typer

from replay.cli_common import EXIT_REFUSED, LIVE, Log, ended_by_signals, errors, fail, refuse_unwritable
from replay.cli_live import Connect, Listen, Namespace, ZenohConfig, live_session, place, status_line
from replay.topic_choice import TopicChoice

app = typer.Typer()

Topics = Annotated[list[str] | None, typer.Option(metavar="NAMES", help="These topics; several with commas between.")]
Regex = Annotated[
    str | None, typer.Option("--regex", "-e", metavar="REGEX", help="Topics in whose name this is found.")
]
ExcludeRegex = Annotated[
    str | None,
    typer.Option("--exclude-regex", "-x", metavar="REGEX", help="Not the topics in whose name this is found."),
]


@app.command(rich_help_panel=LIVE)
def play(
    logs: Log,
    rate: Annotated[float, typer.Option("--rate", "-r", min=0.001, metavar="R", help="Times real time.")] = 1.0,
    start_offset: Annotated[float, typer.Option(min=0, metavar="S", help="Begin this many seconds into the log.")] = 0,
    playback_duration: Annotated[
        float | None,
        typer.Option(min=0.001, metavar="S", help="Stop after this many seconds of the log. [default: all]"),
    ] = None,
    loop: Annotated[bool, typer.Option("--loop", "-l", metavar="", help="Begin again at the end.")] = False,
    start_paused: Annotated[
        bool, typer.Option("--start-paused", "-p", metavar="", help="Begin paused; space goes on.")
    ] = False,
    topics: Topics = None,
    regex: Regex = None,
    exclude_regex: ExcludeRegex = None,
    remap: Annotated[
        list[str] | None, typer.Option(metavar="OLD:=NEW", help="Publish a topic under another name.")
    ] = None,
    delay: Annotated[float, typer.Option(min=0, metavar="S", help="Wait so long before the first message.")] = 0,
    wait_for_subscribers: Annotated[
        float, typer.Option(min=0, metavar="S", help="Wait for a subscriber before that, so long at most.")
    ] = 0,
    listen: Listen = None,
    connect: Connect = None,
    zenoh_config: ZenohConfig = None,
    namespace: Namespace = "",
) -> None:
    """Play a drive: publish its messages to zenoh as they arrived, bytes as they are.

    At a terminal, space pauses, the right arrow publishes the next message while paused, and the up and down arrows
    change the rate by a tenth.

    **Examples**

    pcgan play drive.mcap

    pcgan play drive.mcap --rate 0.5 --start-offset 60 --playback-duration 30

    pcgan play drive.mcap --loop --exclude-regex image

    pcgan play drive.mcap --topics /tf,/tf_static --remap /tf:=/other/tf

    **Exit codes**: 0 played to the end, 2 an error, 130 Ctrl-C, 143 SIGTERM.
    """
    from replay.keyboard import Keyboard
    from replay.log_reader import LogReader
    from replay.player import LogPublisher, Player, Schedule, Tally, play_log, played_topics

    logs, topics, remap = _as_rosbag2(logs, topics, remap)
    reader = LogReader(logs)
    played = played_topics(reader, _choice(topics, regex, exclude_regex), _remaps(remap), namespace)
    length_s = (reader.end_ns - reader.start_ns) / 1e9
    schedule = Schedule(rate, paused=start_paused)
    with ended_by_signals(), Keyboard() as keyboard, ExitStack() as ends:
        if start_paused and not keyboard.usable:
            fail("--start-paused wants a terminal: without one nobody could press space")
        session = ends.enter_context(live_session(listen, connect, zenoh_config))
        publisher = ends.enter_context(LogPublisher(session, played, namespace))
        errors.print(f"playing {len(played)} topics on {place(listen, connect, zenoh_config)}", markup=False)
        if wait_for_subscribers and not publisher.wait_for_subscriber(wait_for_subscribers):
            errors.print(f"note: nobody subscribed within {wait_for_subscribers:g} s", markup=False)

        def position(tally: Tally) -> str:
            state = "paused" if schedule.paused else "playing"
            into_s = (schedule.position_ns - reader.start_ns) / 1e9
            return f"{state} {into_s:.1f} of {length_s:.1f} s, rate {schedule.rate:.2f}, {tally.messages} messages"

        began_s = time.monotonic()
        tally = Tally()
        try:
            with status_line() as say:
                player = Player(schedule, keyboard, publisher.publish, lambda tally: say(position(tally)))
                tally = player.tally
                play_log(
                    reader,
                    played,
                    player,
                    schedule,
                    start_offset_s=start_offset,
                    duration_s=playback_duration,
                    delay_s=delay,
                    loop=loop,
                )
        finally:
            typer.echo(
                f"played {tally.messages} messages of {len(tally.topics)} topics, "
                f"{tally.payload_bytes / 1e6:.1f} MB, in {time.monotonic() - began_s:.1f} s; "
                f"at most {tally.most_late_s * 1e3:.1f} ms late"
            )


@app.command(rich_help_panel=LIVE)
def record(
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="OUT.mcap", help="The recording; it must not be there yet.")
    ],
    everything: Annotated[bool, typer.Option("--all", "-a", metavar="", help="Record all keys.")] = False,
    topics: Topics = None,
    regex: Regex = None,
    exclude_regex: ExcludeRegex = None,
    duration: Annotated[
        float | None, typer.Option(min=0.001, metavar="S", help="Stop after this many seconds. [default: Ctrl-C]")
    ] = None,
    listen: Listen = None,
    connect: Connect = None,
    zenoh_config: ZenohConfig = None,
    namespace: Namespace = "",
) -> None:
    """Record what is on the zenoh bus into an MCAP file, until Ctrl-C.

    **Examples**

    pcgan record -o out.mcap --all

    pcgan record -o out.mcap --topics /pcgan/tracks,/pcgan/predictions

    pcgan record -o out.mcap --all --exclude-regex image --duration 60

    **Exit codes**: 0 all well, also after Ctrl-C and SIGTERM, 2 an error, 3 messages were lost.
    """
    from replay.bus_channels import key_of
    from replay.recorder import Recorded, record_bus

    choice = _choice(topics, regex, exclude_regex)
    if everything and (choice.names or choice.regex):
        fail("--all records everything: leave --topics and --regex away, or it")
    if not (everything or choice.names or choice.regex):
        fail("nothing to record is chosen: --topics NAMES, --regex REGEX, or --all")
    for name in choice.names:
        try:
            key_of(name, namespace)
        except ValueError as error:
            fail(f"{error}; --regex takes expressions")
    refuse_unwritable(output)
    began_s = time.monotonic()

    def state(recorded: Recorded) -> str:
        lost = f", {recorded.dropped.total()} lost" if recorded.dropped else ""
        return (
            f"recording {time.monotonic() - began_s:.0f} s: {recorded.messages.total()} messages of "
            f"{len(recorded.messages)} topics, {recorded.payload_bytes / 1e6:.1f} MB{lost}"
        )

    where = place(listen, connect, zenoh_config)
    with live_session(listen, connect, zenoh_config) as session, _told_to_stop() as told, status_line() as say:
        began_s = time.monotonic()
        recorded = record_bus(
            session,
            output,
            choice,
            namespace=namespace,
            duration_s=duration,
            stop=told.is_set,
            on_ready=lambda: errors.print(f"recording {where} into {output}; Ctrl-C ends it", markup=False),
            on_tick=lambda recorded: say(state(recorded)),
        )
    for topic, count in sorted(recorded.messages.items()):
        typer.echo(f"{count:8} {topic}  {recorded.schemas[topic] or '(schema unknown)'}")
    lost = recorded.dropped.total()
    typer.echo(
        f"recorded {recorded.messages.total()} messages of {len(recorded.messages)} topics, "
        f"{recorded.payload_bytes / 1e6:.1f} MB, in {time.monotonic() - began_s:.1f} s; {lost} lost"
    )
    for key, count in sorted(recorded.dropped.items()):
        errors.print(f"{count} messages on {key} were lost: they came faster than the disk takes them", markup=False)
    typer.echo(f"wrote {output}")
    raise typer.Exit(EXIT_REFUSED if lost else 0)


@contextmanager
def _told_to_stop() -> Iterator[threading.Event]:
    """Yields an event that Ctrl-C and SIGTERM set."""
    told = threading.Event()
    before = {number: signal.signal(number, lambda *_: told.set()) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield told
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _as_rosbag2(
    logs: list[Path], topics: list[str] | None, remap: list[str] | None
) -> tuple[list[Path], list[str] | None, list[str] | None]:
    """Takes `--topics /a /b` and `--remap a:=b c:=d` as ros2 bag does: words that are no files belong to the option."""
    more = [str(log) for log in logs if not log.exists()]
    if topics and more and all(word.startswith("/") and ":=" not in word for word in more):
        return [log for log in logs if log.exists()], [*topics, *more], remap
    if remap and more and all(":=" in word for word in more):
        return [log for log in logs if log.exists()], topics, [*remap, *more]
    return logs, topics, remap


def _choice(names: list[str] | None, regex: str | None, exclude: str | None) -> TopicChoice:
    try:
        return TopicChoice.of(names or (), regex, exclude)
    except ValueError as error:
        fail(str(error))


def _remaps(options: list[str] | None) -> dict[str, str]:
    """Reads OLD:=NEW options."""
    names = {}
    for option in options or ():
        old, separator, new = option.partition(":=")
        if not separator or not old or not new:
            fail(f"--remap wants OLD:=NEW, for example /tf:=/other/tf; got {option!r}")
        names[old] = new
    return names
