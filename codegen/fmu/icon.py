"""The icon that tools show for our FMUs: a race car from above."""

import struct
import zlib
from typing import Final

import numpy as np
import numpy.typing as npt

__all__ = ["car_icon", "png"]

_SIZE: Final = 128
_SAMPLES: Final = 4

Colour = tuple[int, int, int]

_ASPHALT: Final[Colour] = (52, 58, 70)
_LINE: Final[Colour] = (235, 235, 235)
_TYRE: Final[Colour] = (20, 20, 22)
_BODY: Final[Colour] = (225, 55, 45)
_GLASS: Final[Colour] = (150, 205, 235)

# centre x, centre y, half width, half height, corner radius (in hundredths of the icon), colour
_SHAPES: Final[tuple[tuple[float, float, float, float, float, Colour], ...]] = (
    (50, 50, 48, 48, 14, _ASPHALT),
    (12, 50, 1.2, 40, 1, _LINE),
    (88, 50, 1.2, 40, 1, _LINE),
    (34, 27, 5, 9, 2, _TYRE),
    (66, 27, 5, 9, 2, _TYRE),
    (33, 74, 6, 9, 2, _TYRE),
    (67, 74, 6, 9, 2, _TYRE),
    (50, 15, 17, 3, 1.5, _BODY),
    (50, 89, 18, 3.5, 1.5, _BODY),
    (50, 50, 8, 38, 7, _BODY),
    (50, 60, 13, 20, 8, _BODY),
    (50, 50, 6, 8, 5, _GLASS),
)


def png(pixels: npt.NDArray[np.uint8]) -> bytes:
    """PNG file of an image (height, width, 4): red, green, blue, opacity."""
    height, width, _ = pixels.shape

    def chunk(kind: bytes, data: bytes) -> bytes:
        body = kind + data
        return struct.pack(">I", len(data)) + body + struct.pack(">I", zlib.crc32(body))

    rows = b"".join(b"\0" + row.tobytes() for row in pixels)
    head = struct.pack(">IIBBBBB", width, height, 8, 6, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", head)
        + chunk(b"IDAT", zlib.compress(rows, 9))
        + chunk(b"IEND", b"")
    )


def car_icon() -> bytes:
    """PNG, 128 x 128 on a transparent ground."""
    fine = _SIZE * _SAMPLES
    x, y = np.meshgrid(*[(np.arange(fine) + 0.5) * 100 / fine] * 2)
    image = np.zeros((fine, fine, 4))
    for cx, cy, half_w, half_h, radius, colour in _SHAPES:
        dx = np.maximum(np.abs(x - cx) - (half_w - radius), 0)
        dy = np.maximum(np.abs(y - cy) - (half_h - radius), 0)
        image[dx**2 + dy**2 <= radius**2] = (*colour, 255)
    means = image.reshape(_SIZE, _SAMPLES, _SIZE, _SAMPLES, 4).mean(axis=(1, 3))
    opaque = np.maximum(means[..., 3:], 1) / 255  # the ground has no colour of its own
    means[..., :3] = means[..., :3] / opaque
    return png(np.clip(np.round(means), 0, 255).astype(np.uint8))
