"""The subcommand `pcgan track`: tracks of the sensors that are on the bus, until Ctrl-C."""

from contextlib import ExitStack

import typer

from pcgan.node_health import DEFAULT_DEADLINE_MS
from replay.cli_common import (
    LIVE,
    PedestrianLabels,
    ProfileFile,
    RoleOptions,
    TimeOffsets,
    Tracks,
    errors,
    fail,
    settings_of,
)
from replay.cli_live import (
    Connect,
    Deadline,
    Listen,
    Namespace,
    Ros2Domain,
    ZenohConfig,
    health_line,
    live_session,
    place,
    status_line,
    warn_of_others,
)
from replay.roles import WHAT, Roles, live_roles, time_offsets

app = typer.Typer()


@app.command(rich_help_panel=LIVE)
def track(
    tracks: Tracks = None,
    role: RoleOptions = None,
    pedestrian_label: PedestrianLabels = None,
    time_offset: TimeOffsets = None,
    profile: ProfileFile = None,
    listen: Listen = None,
    connect: Connect = None,
    zenoh_config: ZenohConfig = None,
    namespace: Namespace = "",
    ros2_domain: Ros2Domain = None,
    deadline_ms: Deadline = DEFAULT_DEADLINE_MS,
) -> None:
    """Track live over zenoh until Ctrl-C: sensor topics in, pcgan/tracks and pcgan/vehicle_pose out.

    **Examples**

    pcgan track

    pcgan track --profile my_vehicle.toml --connect tcp/192.168.1.5:7447

    pcgan track --role clusters:=/clusters --role pose:=/odom --deadline-ms 50

    pcgan track --ros2-domain 0
    """
    from replay.bus_channels import key_of
    from replay.track_node import alive_key, run

    settings = settings_of(
        profile, roles=role, tracks=tracks, time_offsets=time_offset, pedestrian_labels=pedestrian_label
    )
    with ExitStack() as ends:
        session = ends.enter_context(live_session(listen, connect, zenoh_config, ros2_domain))
        where = place(listen, connect, zenoh_config, ros2_domain)
        sensors, on_tracked = None, None
        if ros2_domain is None:
            roles = live_roles(settings.roles)
        else:
            from replay.ros2_bus import Ros2Node
            from replay.ros2_nodes import Ros2Sensors, Ros2Tracks, graph_roles

            errors.print(f"looking for sensors on {where}", markup=False)
            roles = graph_roles(session, ros2_domain, settings.roles)
            node = ends.enter_context(Ros2Node(session, ros2_domain, "pcgan_track"))
            sensors, on_tracked = Ros2Sensors(node, roles), Ros2Tracks(node).put
        time_offsets(roles, settings.sync.time_offset_ms)  # what cannot work is said before anything begins
        try:
            for topic in roles.readings:
                key_of(topic, namespace)
        except ValueError as error:
            fail(str(error))
        warn_of_others(session, alive_key("*", namespace), "a tracker", "its tracks and ours mix")
        errors.print(f"tracking on {where}: {_listing(roles)}; Ctrl-C ends it", markup=False)
        with status_line() as say:
            refused = run(
                session,
                settings,
                namespace=namespace,
                deadline_ms=deadline_ms,
                roles=roles,
                sensors=sensors,
                on_tracked=on_tracked,
                on_health=lambda health: say(health_line(health)),
            )
    if refused:
        errors.print(f"{refused} messages or scans were refused", markup=False)


def _listing(roles: Roles) -> str:
    """Returns what is listened to, by role; cameras by their names."""
    parts = []
    for role, what in WHAT.items():
        if role == "calibration":
            continue  # goes with the cameras
        names = roles.cameras if role == "camera" else roles.topics(role)
        if names:
            parts.append(f"{what} {' '.join(names)}")
    return ", ".join(parts)
