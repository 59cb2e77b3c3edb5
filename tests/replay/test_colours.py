"""The colour table."""

import numpy as np

from replay import colours


def luminance(rgb):
    linear = np.where(rgb / 255 <= 0.04045, rgb / 255 / 12.92, ((rgb / 255 + 0.055) / 1.055) ** 2.4)
    return linear @ [0.2126, 0.7152, 0.0722]


def test_an_id_keeps_its_colour():
    ids = np.array([3, 1_000_003, 3, 0])
    first = colours.track_colours(ids)
    np.testing.assert_array_equal(first, colours.track_colours(ids))
    np.testing.assert_array_equal(first[0], first[2])
    assert colours.track_colours([]).shape == (0, 3)


def test_track_colours_stand_out_from_the_ground_and_from_each_other():
    palette = colours.track_colours(range(12)).astype(float)
    ground = luminance(np.array(colours.BACKGROUND, float))
    assert ((luminance(palette) + 0.05) / (ground + 0.05) > 4.5).all()  # the contrast that WCAG asks of text
    apart = np.linalg.norm(palette[:, None] - palette, axis=-1) + 1e3 * np.eye(12)
    assert apart.min() > 45


def test_likelier_means_brighter_and_more_opaque():
    assert (np.diff(luminance(colours.probability_colours(np.linspace(0, 1, 21)).astype(float))) > 0).all()
    opacity = colours.path_opacity([0.0, 0.3, 1.0])
    assert opacity.tolist() == sorted(opacity)
    assert opacity[0] > 0.1
    assert opacity[-1] == 1


def test_opacity_becomes_a_fourth_channel():
    rgba = colours.with_opacity(colours.track_colours([1, 2]), [0.0, 2.0])
    assert rgba.dtype == np.uint8
    assert rgba[:, 3].tolist() == [0, 255]
