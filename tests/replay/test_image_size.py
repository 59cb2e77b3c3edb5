"""Image sizes from headers."""

import struct

import pytest

from replay.image_size import image_size_px


def make_jpeg(width: int, height: int, marker: int = 0xC0) -> bytes:
    app0 = b"\xff\xe0" + struct.pack(">H", 16) + b"JFIF\0" + bytes(9)
    tables = b"\xff\xff\xc4" + struct.pack(">H", 5) + b"\xff\xc0\x00"  # a fill byte; its content looks like a frame
    frame = b"\xff" + bytes([marker]) + struct.pack(">HBHHB", 17, 8, height, width, 3) + bytes(9)
    return b"\xff\xd8" + app0 + tables + frame


def make_png(width: int, height: int) -> bytes:
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sII", 13, b"IHDR", width, height) + bytes(5)


@pytest.mark.parametrize("marker", [0xC0, 0xC1, 0xC2])
def test_jpeg(marker):
    assert image_size_px(make_jpeg(1920, 1208, marker)) == (1920, 1208)


def test_png():
    assert image_size_px(make_png(640, 480)) == (640, 480)


@pytest.mark.parametrize("make", [make_jpeg, make_png])
def test_every_cut_header_is_unknown_not_an_error(make):
    whole = make(640, 480)
    end = whole.index(
        struct.pack(">HH" if make is make_jpeg else ">II", *((480, 640) if make is make_jpeg else (640, 480)))
    )
    for length in range(end):
        assert image_size_px(whole[:length]) is None


def test_other_formats_are_unknown():
    assert image_size_px(b"RIFF\0\0\0\0WEBPVP8 ") is None
    assert image_size_px(b"") is None
