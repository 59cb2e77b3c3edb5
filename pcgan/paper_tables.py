"""Tables 1 and 2 of the paper (Eiffert et al., RA-L 2020): errors in m, as printed."""

from collections.abc import Iterator

METHODS = ("lin", "cvm", "sgan", "srlstm", "psgan", "pcgan")
SCENES = ("eth", "hotel", "univ", "zara1", "zara2")
METRICS = ("ade", "fde", "mhd")

# (metric, scene) -> per method, in the order of METHODS, after 8 and after 12 steps (3.2 and 4.8 s).
TABLE_1 = {
    ("ade", "eth"): ((0.50, 0.79), (0.48, 0.70), (0.51, 0.81), (0.43, 0.65), (0.45, 0.68), (0.43, 0.65)),
    ("ade", "hotel"): ((0.35, 0.39), (0.28, 0.33), (0.55, 0.67), (0.24, 0.42), (0.52, 0.64), (0.59, 0.64)),
    ("ade", "univ"): ((0.56, 0.82), (0.34, 0.56), (0.56, 0.78), (0.38, 0.53), (0.34, 0.55), (0.49, 0.57)),
    ("ade", "zara1"): ((0.41, 0.62), (0.28, 0.46), (0.46, 0.63), (0.28, 0.43), (0.25, 0.43), (0.25, 0.40)),
    ("ade", "zara2"): ((0.53, 0.77), (0.23, 0.35), (0.35, 0.56), (0.24, 0.32), (0.27, 0.37), (0.22, 0.34)),
    ("fde", "eth"): ((0.88, 1.57), (0.87, 1.34), (0.95, 1.72), (0.80, 1.26), (0.84, 1.34), (0.81, 1.25)),
    ("fde", "hotel"): ((0.60, 0.72), (0.40, 0.62), (0.49, 1.71), (0.45, 0.90), (1.13, 1.45), (1.10, 1.40)),
    ("fde", "univ"): ((1.01, 1.59), (0.71, 1.20), (1.20, 1.70), (0.81, 1.17), (0.71, 1.23), (0.89, 1.24)),
    ("fde", "zara1"): ((0.74, 1.21), (0.57, 0.99), (0.99, 1.38), (0.60, 0.93), (0.53, 0.87), (0.53, 0.89)),
    ("fde", "zara2"): ((0.95, 1.48), (0.47, 0.75), (0.75, 1.21), (0.51, 0.73), (0.56, 0.76), (0.45, 0.77)),
    ("mhd", "eth"): ((0.48, 0.66), (0.40, 0.57), (0.44, 0.66), (0.38, 0.54), (0.40, 0.59), (0.38, 0.55)),
    ("mhd", "hotel"): ((0.33, 0.33), (0.20, 0.27), (0.22, 0.69), (0.22, 0.37), (0.45, 0.56), (0.51, 0.55)),
    ("mhd", "univ"): ((0.52, 0.76), (0.31, 0.48), (0.48, 0.67), (0.34, 0.45), (0.30, 0.49), (0.41, 0.50)),
    ("mhd", "zara1"): ((0.39, 0.55), (0.24, 0.40), (0.40, 0.52), (0.26, 0.36), (0.23, 0.37), (0.23, 0.35)),
    ("mhd", "zara2"): ((0.47, 0.71), (0.23, 0.31), (0.31, 0.49), (0.22, 0.31), (0.25, 0.33), (0.20, 0.31)),
}

# (metric, scene) -> per method, after 12 steps: 1.0 s for VCI, 1.2 s for USyd.
TABLE_2 = {
    ("ade", "vci"): (0.11, 0.09, 0.12, 0.08, 0.12, 0.08),
    ("fde", "vci"): (0.23, 0.18, 0.22, 0.16, 0.20, 0.15),
    ("mhd", "vci"): (0.09, 0.07, 0.09, 0.07, 0.09, 0.07),
    ("ade", "usyd"): (0.16, 0.13, 0.16, 0.11, 0.11, 0.11),
    ("fde", "usyd"): (0.30, 0.24, 0.31, 0.22, 0.21, 0.21),
    ("mhd", "usyd"): (0.12, 0.09, 0.12, 0.09, 0.08, 0.09),
}

# Cells that are printed here but not to be chased.
SUSPECT = {
    "the mean error exceeds the last one, which then more than triples within 1.6 s": {
        ("sgan", "hotel", "8", "ade"),
        ("sgan", "hotel", "8", "fde"),
    },
    "the mean error hardly grows from 8 to 12 steps, while the last error grows": {
        ("psgan", "hotel", "8", "ade"),
        ("psgan", "hotel", "12", "ade"),
        ("pcgan", "hotel", "8", "ade"),
        ("pcgan", "hotel", "12", "ade"),
        ("pcgan", "univ", "8", "ade"),
        ("pcgan", "univ", "12", "ade"),
    },
    "taken over from older publications; a line fitted here is better": {
        ("lin", scene, "12", metric) for scene in SCENES for metric in METRICS
    },
}


def figure(method: str, scene: str, horizon: str, metric: str) -> float | None:
    """Returns a cell of either table, or the mean over the five scenes; None where the paper has nothing."""
    if method not in METHODS:
        return None
    column = METHODS.index(method)
    if scene == "mean":
        values = [figure(method, name, horizon, metric) for name in SCENES]
        found = [value for value in values if value is not None]
        return sum(found) / len(SCENES) if len(found) == len(SCENES) else None
    if (metric, scene) in TABLE_1 and horizon in ("8", "12"):
        return TABLE_1[metric, scene][column][0 if horizon == "8" else 1]
    if (metric, scene) in TABLE_2 and horizon == "12":
        return TABLE_2[metric, scene][column]
    return None


def best(scene: str, horizon: str, metric: str) -> tuple[float, str] | None:
    """Returns the best figure of the paper's methods in a cell, and whose it is; for "mean" the mean of the bests."""
    if scene == "mean":
        cells = [best(name, horizon, metric) for name in SCENES]
        figures = [cell[0] for cell in cells if cell is not None]
        return (sum(figures) / len(SCENES), "best of each") if len(figures) == len(SCENES) else None
    found = [(value, name) for name in METHODS if (value := figure(name, scene, horizon, metric)) is not None]
    return min(found, key=lambda cell: cell[0]) if found else None


def table_1_cells() -> Iterator[tuple[str, str, str]]:
    """Yields the 30 cells of Table 1: scene, horizon, metric."""
    for metric in METRICS:
        for horizon in ("8", "12"):
            for scene in SCENES:
                yield scene, horizon, metric


def suspect(method: str, scene: str, horizon: str, metric: str) -> str | None:
    """Returns what is wrong with a printed cell, if something is."""
    for reason, cells in SUSPECT.items():
        if (method, scene, horizon, metric) in cells:
            return reason
    return None
