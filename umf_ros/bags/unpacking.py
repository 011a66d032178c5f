"""Chunks of recordings unpacked to a limit: a few kilobytes may stand for as many gigabytes as somebody likes."""

from __future__ import annotations

import bz2

from lz4.frame import LZ4FrameDecompressor

from umf_ros.bags.records import LARGEST_CHUNK


def unpack_bz2(data: bytes) -> bytes:
    """Contents of a chunk.

    Raises:
        ValueError: there are more than any recorder writes.
    """
    return _limited(bz2.BZ2Decompressor().decompress(data, LARGEST_CHUNK + 1))


def unpack_lz4(data: bytes) -> bytes:
    """Likewise.

    Raises:
        ValueError: there are more than any recorder writes.
        RuntimeError: they are damaged.
    """
    return _limited(LZ4FrameDecompressor().decompress(data, LARGEST_CHUNK + 1))


def _limited(unpacked: bytes) -> bytes:
    if len(unpacked) > LARGEST_CHUNK:
        raise ValueError(f"a chunk holds more than {LARGEST_CHUNK} bytes")
    return unpacked
