"""What the report's pictures share: matplotlib, which is optional, colours, and pictures as text to put into a page."""

import base64
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from typing import Any

INK = "#1f2328"
FAINT_INK = "#6e7781"
GRID = "#e6e8eb"
PANEL = "#fbfbfa"
TRUTH = "#1f6feb"
OBSERVED = "#111111"
VEHICLE = "#57606a"
VEHICLE_FILL = "#d0d7de"

# CVM yellow, SR-LSTM pink, PSGAN dark and PCGAN light green, as in the paper's figure.
METHOD_COLOURS = {
    "lin": "#8c959f",
    "cvm": "#e0a800",
    "weighted": "#d1570a",
    "sgan": "#8250df",
    "srlstm": "#e85aad",
    "psgan": "#116329",
    "pcgan": "#4ac26b",
}
PERSON_COLOURS = (
    "#d1570a", "#8250df", "#0b8a7d", "#cf222e", "#7d6b00", "#bf3989", "#5a7d1a", "#a0522d", "#4b3fa8", "#b8860b",
)  # fmt: skip

_SETTINGS: dict[Any, Any] = {
    "font.size": 9.5,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": "#c9ced4",
    "axes.facecolor": PANEL,
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": GRID,
    "grid.linewidth": 0.8,
    "xtick.color": FAINT_INK,
    "ytick.color": FAINT_INK,
    "xtick.major.size": 0,
    "ytick.major.size": 0,
    "legend.frameon": False,
    "figure.facecolor": "white",
    "svg.hashsalt": "pcgan",  # equal pictures have equal bytes
}


class ReportError(Exception):
    """A report that cannot be made or written."""


def method_colour(method: str) -> str:
    """Returns a method's colour; a variant such as "pcgan_paper" has its method's."""
    return METHOD_COLOURS.get(method) or METHOD_COLOURS.get(method.partition("_")[0], INK)


def line_style(method: str) -> Any:
    """Returns matplotlib's line style: dashed for variants."""
    return "-" if method in METHOD_COLOURS else (0, (4, 2))


@contextmanager
def new_figure(width_in: float, height_in: float) -> Iterator[Any]:
    """Gives a figure in the report's style; raises ReportError if matplotlib is missing."""
    try:
        import matplotlib as mpl
        from matplotlib.figure import Figure
        from matplotlib.layout_engine import ConstrainedLayoutEngine
    except ImportError as error:
        raise ReportError('a report needs matplotlib, which is not installed: pip install "pcgan[view]"') from error
    with mpl.rc_context(_SETTINGS):
        room = ConstrainedLayoutEngine(w_pad=0.08, h_pad=0.08, wspace=0.02)
        yield Figure(figsize=(width_in, height_in), layout=room)


def as_image(figure: Any, kind: str, dpi: int = 150) -> str:
    """Returns a figure, "svg" or "png", as a data address for an <img>."""
    stream = BytesIO()
    metadata = {"Date": None, "Creator": None} if kind == "svg" else {"Software": None}
    figure.savefig(stream, format=kind, dpi=dpi, metadata=metadata)
    media = "image/svg+xml" if kind == "svg" else "image/png"
    return f"data:{media};base64,{base64.b64encode(stream.getvalue()).decode('ascii')}"
