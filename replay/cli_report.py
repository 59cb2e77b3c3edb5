"""The subcommand `pcgan report`: the page of a check, served so that its links open rerun."""

import os
import sys
import threading
import webbrowser
from pathlib import Path
from typing import Annotated

import typer

from replay.cli_common import REGRESSION, errors
from replay.interrupts import Interrupted, Interrupts

app = typer.Typer()


@app.command(rich_help_panel=REGRESSION)
def report(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="What pcgan check --page has written.")],
    port: Annotated[
        int | None,
        typer.Option(min=1, max=65535, metavar="N", help="Serve on this port, as for a tunnel. [default: a free one]"),
    ] = None,
    in_browser: Annotated[
        bool, typer.Option("--in-browser", metavar="", help="Open moments in the browser, not in rerun's own window.")
    ] = False,
    no_browser: Annotated[
        bool, typer.Option("--no-browser", metavar="", help="Say where the page is, and open no browser.")
    ] = False,
) -> None:
    """Show the page of a check; a click on one of its moments opens rerun there.

    The page is served on this machine alone, until Ctrl-C. Where there is no screen, rerun opens in the browser.

    **Examples**

    pcgan report page

    pcgan report page --in-browser --no-browser --port 8000

    **Exit codes**: 0 ended by Ctrl-C or SIGTERM, 2 an error.
    """
    from replay.report_server import ReportServer, Rerun

    rerun = Rerun(in_browser=in_browser)
    try:
        with Interrupts(), ReportServer(folder, rerun, port or 0) as server:
            serving = threading.Thread(target=server.serve_forever, daemon=True)
            serving.start()
            try:
                errors.print(f"{folder} is at {server.url}; Ctrl-C ends it", markup=False)
                if not no_browser and _has_screen():
                    webbrowser.open(server.url)
                serving.join()
            finally:
                server.shutdown()
    except Interrupted:
        pass
    finally:
        rerun.close()


def _has_screen() -> bool:
    """Returns whether a browser would have a window; without one a text browser would take over the terminal."""
    return sys.platform in ("darwin", "win32") or bool({"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys())
