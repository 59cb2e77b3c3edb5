"""The size of an encoded image from its header alone: logs often hold images smaller than the calibration's."""

import struct

_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # SOF0 to SOF15; the three are other segments
_JPEG_BARE = frozenset(range(0xD0, 0xD9)) | {0x01}  # markers without a length


def image_size_px(data: bytes) -> tuple[int, int] | None:
    """Returns width and height of a PNG or JPEG, None for anything else and for a header that is cut short."""
    try:
        if data.startswith(b"\x89PNG\r\n\x1a\n"):
            width, height = struct.unpack_from(">II", data, 16)
            return width, height
        if data.startswith(b"\xff\xd8"):
            return _jpeg_size_px(data)
    except (struct.error, IndexError):
        pass
    return None


def _jpeg_size_px(data: bytes) -> tuple[int, int] | None:
    """Walks from segment to segment up to the frame header. Raises IndexError or struct.error past the end."""
    place = 2
    while data[place] == 0xFF:
        marker = data[place + 1]
        if marker == 0xFF:  # a fill byte
            place += 1
        elif marker in _JPEG_BARE:
            place += 2
        elif marker in _JPEG_FRAMES:
            height, width = struct.unpack_from(">HH", data, place + 5)
            return width, height
        else:
            place += 2 + int(struct.unpack_from(">H", data, place + 2)[0])
    return None
