"""One colour table for the view, the picture and the scene: a pedestrian has the same colour in all three.

Colours are sRGB, 0 to 255, chosen for a dark ground. The track palette alternates hues that stay apart for people with
red-green blindness (Okabe and Ito's set, brightened, and six tints between them); ids are drawn beside the marks, since
no palette of thirty can be told apart.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Bytes = NDArray[np.uint8]
RGB = tuple[int, int, int]

BACKGROUND: RGB = (14, 18, 23)
GRID: RGB = (38, 45, 54)
VEHICLE: RGB = (236, 239, 241)
CLUSTER: RGB = (108, 124, 143)
FALLBACK: RGB = (158, 164, 171)
TRUTH: RGB = (142, 147, 153)
DETECTION: RGB = (255, 255, 255)

_TRACKS: Bytes = np.array(
    [
        (86, 180, 233),  # sky blue
        (240, 163, 30),  # orange
        (52, 200, 150),  # green
        (229, 130, 185),  # pink
        (242, 229, 92),  # yellow
        (150, 150, 255),  # periwinkle
        (245, 112, 66),  # vermilion
        (120, 222, 232),  # pale cyan
        (178, 120, 220),  # violet
        (175, 222, 105),  # lime
        (255, 185, 150),  # apricot
        (64, 140, 255),  # blue
    ],
    np.uint8,
)
# Unlikely to likely: slate, teal, cream. Falls and rises in lightness alone, so that it needs no colour vision.
_PROBABILITY: Bytes = np.array([(74, 84, 98), (84, 150, 160), (255, 244, 206)], np.uint8)


def track_colours(track_ids: ArrayLike) -> Bytes:
    """Returns the colours (A, 3) of track ids (A,); an id has one colour in every frame and every run."""
    chosen: Bytes = _TRACKS[np.asarray(track_ids, np.int64) % len(_TRACKS)]
    return chosen


def with_opacity(colours: Bytes, opacity: ArrayLike) -> Bytes:
    """Returns colours (..., 4) from colours (..., 3) and an opacity from 0 to 1 that broadcasts to (...)."""
    alpha = np.broadcast_to(np.clip(np.asarray(opacity, float), 0, 1), colours.shape[:-1])
    return np.concatenate([colours, np.rint(alpha * 255).astype(np.uint8)[..., None]], axis=-1)


def path_opacity(probability: ArrayLike) -> NDArray[np.float64]:
    """Returns how opaque paths (N,) are drawn: by probability, with a floor under which nothing could be seen."""
    return np.asarray(0.22 + 0.78 * np.clip(np.asarray(probability, float), 0, 1))


def probability_colours(probability: ArrayLike) -> Bytes:
    """Returns colours (M, 3) of pedestrian probabilities (M,), 0 to 1: dark slate to bright cream."""
    place = np.clip(np.asarray(probability, float), 0, 1) * (len(_PROBABILITY) - 1)
    columns = [np.interp(place, range(len(_PROBABILITY)), _PROBABILITY[:, channel]) for channel in range(3)]
    return np.asarray(np.rint(np.stack(columns, axis=-1)), np.uint8)
