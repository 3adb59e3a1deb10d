"""Kernels of frames: from the inflated bytes of OpenEXR and PNG to values."""

from __future__ import annotations

import numpy as np

from skindb.jit import kernel
from skindb.types import ByteMatrix, ByteVector, IntVector

Halves = np.ndarray[tuple[int, int, int], np.dtype[np.uint16]]  # bits of half floats


@kernel
def unpack_lines(content: ByteVector, order: IntVector, out: Halves) -> None:
    """Undo the byte predictor of OpenEXR for a block of lines of half floats.

    Each byte is the difference to the one before, plus 128. The first half of them are
    the lower bytes of all values, the second half the upper ones; both are summed in one
    loop, because each sum has to wait for the one before.

    Parameters
    ----------
    content
        (2 n,) inflated bytes of n values, channel by channel in each line.
    order
        (3,) index of R, G, B among the channels of a line.
    out
        (lines, w, 3) uint16 output.
    """
    lines, width, _ = out.shape
    channels = content.shape[0] // (2 * lines * width)
    count = content.shape[0] // 2
    lower = np.int64(128)
    upper = np.int64(128)
    for i in range(count):
        upper += np.int64(content[i]) - 128
    start = 0
    for y in range(lines):
        for channel in range(channels):
            place = -1
            for c in range(3):
                if order[c] == channel:
                    place = c
            for x in range(width):
                lower += np.int64(content[start + x]) - 128
                upper += np.int64(content[count + start + x]) - 128
                if place >= 0:
                    out[y, x, place] = (lower & 255) | ((upper & 255) << 8)
            start += width


@kernel
def undo_filters(content: ByteMatrix, step: int, swap: int, out: ByteMatrix) -> bool:
    """Undo the filters of PNG (ISO/IEC 15948, section 9); False if one is unknown.

    Parameters
    ----------
    content
        (h, 1 + n) inflated bytes: the filter of each row, and its bytes.
    step
        Number of bytes of a pixel.
    swap
        1 if the bytes of a value are exchanged, 0 otherwise.
    out
        (h, n) output.
    """
    height, size = out.shape
    zeros = np.zeros(size, np.uint8)
    for y in range(height):
        kind = content[y, 0]
        row = content[y, 1:]
        line = out[y]
        above = out[y - 1] if y else zeros
        if kind == 0:
            for i in range(size):
                line[i ^ swap] = row[i]
        elif kind == 1:
            for start in range(step):  # the sum stays in a register
                total = np.int64(0)
                for i in range(start, size, step):
                    total += row[i]
                    line[i ^ swap] = total
        elif kind == 2:
            for i in range(size):
                line[i ^ swap] = row[i] + above[i ^ swap]
        elif kind == 3:
            for i in range(size):
                left = np.int64(line[(i - step) ^ swap]) if i >= step else np.int64(0)
                mean = (left + np.int64(above[i ^ swap])) // 2
                line[i ^ swap] = np.int64(row[i]) + mean
        elif kind == 4:
            for i in range(size):
                up = np.int64(above[i ^ swap])
                left = np.int64(line[(i - step) ^ swap]) if i >= step else np.int64(0)
                corner = (
                    np.int64(above[(i - step) ^ swap]) if i >= step else np.int64(0)
                )
                from_left = abs(up - corner)
                from_up = abs(left - corner)
                from_corner = abs(left + up - 2 * corner)
                nearest = corner
                if from_left <= from_up and from_left <= from_corner:
                    nearest = left
                elif from_up <= from_corner:
                    nearest = up
                line[i ^ swap] = np.int64(row[i]) + nearest
        else:
            return False
    return True
