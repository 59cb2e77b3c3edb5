"""The report's plots: error and likelihood against time, and calibration."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pcgan.report_style import FAINT_INK, GRID, as_image, line_style, method_colour, new_figure
from pcgan.scores import Curves
from pcgan.tables import METHOD_NAMES
from schemas.messages import FloatArray

_MOST_ACROSS = 5  # reliability plots side by side


def mean_curves(parts: Sequence[Curves]) -> Curves:
    """Returns the mean of the curves of several scenes or seeds; their steps must be the same."""
    return Curves(
        times_s=parts[0].times_s,
        error_m=np.mean([part.error_m for part in parts], axis=0),
        nll=np.mean([part.nll for part in parts], axis=0),
        shares=parts[0].shares,
        coverage=np.mean([part.coverage for part in parts], axis=0),
    )


def against_time(curves: Mapping[str, Curves]) -> str:
    """Returns error and likelihood at each predicted step, all methods together, as an image."""
    with new_figure(10.4, 3.9) as figure:
        left, right = figure.subplots(1, 2)
        _lines(left, {method: (c.times_s, c.error_m) for method, c in curves.items()})
        left.set(title="Error", ylabel="mean distance from the truth, m", ylim=(0, None))
        _lines(right, {method: (c.times_s, c.nll) for method, c in curves.items()})
        right.set(title="Negative log-likelihood", ylabel="nats, densities per m² (lower is better)")
        order = sorted(curves, key=lambda method: -float(curves[method].error_m[-1]))
        lines = dict(zip(curves, left.lines, strict=True))
        figure.legend(
            [lines[method] for method in order],
            [METHOD_NAMES.get(method, method) for method in order],
            loc="outside right center",
            title="by last error",
            title_fontproperties={"size": 8.5},
            handlelength=1.6,
        )
        return as_image(figure, "svg")


def reliability(curves: Mapping[str, Curves]) -> str:
    """Returns one calibration plot per method, as an image: how much highest-density regions hold, and should."""
    rows = math.ceil(len(curves) / _MOST_ACROSS)
    across = math.ceil(len(curves) / rows)
    with new_figure(2.15 * across + 0.5, 2.3 * rows + 0.3) as figure:
        grid = figure.subplots(rows, across, squeeze=False)
        for axes, (method, c) in zip(grid.flat, curves.items(), strict=False):
            colour = method_colour(method)
            axes.plot([0, 1], [0, 1], color=FAINT_INK, linewidth=0.9, linestyle=(0, (2, 2)))
            shares, held = np.r_[0, c.shares, 1], np.r_[0, c.coverage, 1]
            axes.fill_between(shares, shares, held, color=colour, alpha=0.22, linewidth=0)
            axes.plot(shares, held, color=colour, linewidth=2, linestyle=line_style(method))
            at_90 = float(np.interp(0.9, c.shares, c.coverage))
            axes.text(0.96, 0.06, f"90 % holds {100 * at_90:.1f} %", ha="right", fontsize=8.5, color=FAINT_INK)
            axes.set_title(METHOD_NAMES.get(method, method), fontsize=9.5).set_in_layout(False)
            axes.set(xlim=(0, 1), ylim=(0, 1), aspect="equal")
            axes.set_xticks((0, 0.5, 1), ("0", "50", "100"))
            axes.set_yticks((0, 0.5, 1), ("0", "50", "100"))
            axes.grid(True)
        for axes in list(grid.flat)[len(curves) :]:
            axes.remove()
        figure.supxlabel("the region should hold, % of the probability", fontsize=9.5)
        figure.supylabel("it holds, % of the truths", fontsize=9.5)
        return as_image(figure, "svg")


def _lines(axes: Any, values: Mapping[str, tuple[FloatArray, FloatArray]]) -> None:
    for method, (times, value) in values.items():
        first = method.startswith("pcgan")
        axes.plot(
            times,
            value,
            color=method_colour(method),
            linestyle=line_style(method),
            linewidth=2.6 if first else 1.7,
            zorder=3 if first else 2,
        )
    axes.grid(True, axis="y", color=GRID)
    axes.set_xlabel("time ahead, s")
    axes.set_xlim(left=0)
