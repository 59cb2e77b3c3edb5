"""What live commands share: options, the session they open, the line that says how a node is doing."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from replay.cli_common import errors, fail
from schemas.messages import NodeHealth

if TYPE_CHECKING:
    import zenoh

Listen = Annotated[str | None, typer.Option(metavar="ENDPOINT", help="Listen here, and route between all who connect.")]
Connect = Annotated[
    str | None,
    typer.Option(metavar="ENDPOINT", help="Connect here. [default: tcp/127.0.0.1:7447; the first of us listens there]"),
]
ZenohConfig = Annotated[
    Path | None, typer.Option(metavar="FILE", help="zenoh configuration: TLS, access control, other networks.")
]
Namespace = Annotated[str, typer.Option(metavar="TEXT", help="Prefix of the zenoh keys.")]
Ros2Domain = Annotated[
    int | None,
    typer.Option(
        "--ros2-domain", min=0, max=232, metavar="N", help="Be a node of this ROS 2 domain, on rmw_zenoh's router."
    ),
]
Deadline = Annotated[
    float, typer.Option(min=1, metavar="MS", help="How old a frame's result may be before it is counted as late.")
]

SETTLE_S = 2.0  # so long what a command has published may take to leave when it ends


@contextmanager
def live_session(
    listen: str | None, connect: str | None, zenoh_config: Path | None, ros2_domain: int | None = None
) -> Iterator["zenoh.Session"]:
    """Opens a live command's session, or ends the command; peers that a configuration turns away are told of."""
    from pcgan import bus
    from pcgan.bus_log import refusals_told

    with ExitStack() as ends:
        if zenoh_config is not None:
            ends.enter_context(refusals_told(lambda said: errors.print(said, markup=False)))
        try:
            if ros2_domain is not None and zenoh_config is None:
                from replay import ros2_bus

                if listen is not None:
                    fail("--listen: with --ros2-domain we are a client of ROS 2's router; say where with --connect")
                session = ros2_bus.open_session(connect or ros2_bus.ROUTER)
            else:
                session = bus.open_shared_session(
                    listen=[listen] if listen else [], connect=[connect] if connect else [], config_file=zenoh_config
                )
        except bus.BusError as error:
            fail(str(error))
        ends.callback(session.close)
        ends.callback(bus.settle, session, SETTLE_S)
        yield session


def place(listen: str | None, connect: str | None, zenoh_config: Path | None, ros2_domain: int | None = None) -> str:
    """Returns where a live command is, for people."""
    from pcgan.bus import DEFAULT_ENDPOINT

    where = listen or connect or str(zenoh_config or DEFAULT_ENDPOINT)
    return where if ros2_domain is None else f"{where}, ROS 2 domain {ros2_domain}"


@contextmanager
def status_line() -> Iterator[Callable[[str], None]]:
    """Yields what shows a line of text at a terminal, in the place of the one before; in a pipe it shows nothing."""
    if not errors.is_terminal:
        yield lambda _: None
        return
    from rich.live import Live
    from rich.text import Text

    with Live(console=errors, auto_refresh=False, transient=True) as live:
        yield lambda text: live.update(Text(text, no_wrap=True, overflow="ellipsis"), refresh=True)


def warn_of_others(session: "zenoh.Session", key: str, what: str, consequence: str) -> None:
    """Says so if somebody does already what we are about to do."""
    if any(reply.ok is not None for reply in session.liveliness().get(key, timeout=1.0)):
        errors.print(f"note: {what} is there already: {consequence}; end one, or use --namespace", markup=False)


def health_line(health: NodeHealth) -> str:
    """Returns a report in one line."""
    return (
        f"in {health.input_hz:.0f}/s, out {health.rate_hz:.1f}/s, "
        f"{health.latency_p50_ms:.0f} ms (p99 {health.latency_p99_ms:.0f}), "
        f"{health.dropped} dropped, {health.late} late, {health.refused} refused"
        f"{f'; {health.problem}' if health.problem else ''}"
    )
