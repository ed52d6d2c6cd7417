"""OpenEXR read without OpenEXR: multi-part scan lines, uncompressed or ZIP, as the file format is published.

Only what the tests need, and nothing of the library that wrote the files.
"""

import struct
import zlib

import av
import numpy as np

_KINDS = {0: np.dtype("<u4"), 1: np.dtype("<f2"), 2: np.dtype("<f4")}
_MULTI_PART = 0x1000
_LINES = {0: 1, 2: 1, 3: 16}  # compression -> scan lines in a block


def read_exr(path):
    """Part name -> {channel: [H, W] array}."""
    content = path.read_bytes()
    magic, version = struct.unpack_from("<II", content)
    assert magic == 20000630 and version == 2 | _MULTI_PART
    headers, at = [], 8
    while content[at]:
        header, at = _header(content, at)
        headers.append(header)
    at += 1
    read = {}
    for number, header in enumerate(headers):
        (chunks,) = struct.unpack("<i", header["chunkCount"])
        offsets = struct.unpack_from(f"<{chunks}Q", content, at)
        at += 8 * chunks
        read[header["name"].decode()] = _pixels(content, number, header, offsets)
    return read


def _header(content, at):
    header = {}
    while content[at]:
        name, at = _text(content, at)
        _, at = _text(content, at)
        (size,) = struct.unpack_from("<i", content, at)
        header[name] = content[at + 4 : at + 4 + size]
        at += 4 + size
    return header, at + 1


def _text(content, at):
    end = content.index(b"\0", at)
    return content[at:end].decode(), end + 1


def _channels(table):
    at, channels = 0, []
    while table[at]:
        name, at = _text(table, at)
        channels.append((name, _KINDS[struct.unpack_from("<i", table, at)[0]]))
        at += 16
    return channels


def _pixels(content, number, header, offsets):
    left, top, right, bottom = struct.unpack("<4i", header["dataWindow"])
    width, height, lines = right - left + 1, bottom - top + 1, _LINES[header["compression"][0]]
    channels = _channels(header["channels"])
    pictures = {name: np.zeros((height, width), kind) for name, kind in channels}
    for offset in offsets:
        part, y, size = struct.unpack_from("<3i", content, offset)
        assert part == number
        row, block = y - top, content[offset + 12 : offset + 12 + size]
        count = min(lines, height - row)
        full = count * width * sum(kind.itemsize for _, kind in channels)
        data, at = block if size == full else _unzipped(block), 0
        for line in range(row, row + count):
            for name, kind in channels:
                pictures[name][line] = np.frombuffer(data, kind, width, at)
                at += width * kind.itemsize
    return pictures


def _unzipped(block):
    """Undoes ZIP's deflate, differences and the parting of even and odd bytes."""
    steps = np.frombuffer(zlib.decompress(block), np.uint8).astype(np.int64)
    steps[1:] -= 128
    values = (np.cumsum(steps) % 256).astype(np.uint8)
    half, mixed = (len(values) + 1) // 2, np.empty_like(values)
    mixed[0::2], mixed[1::2] = values[:half], values[half:]
    return mixed.tobytes()


def ffmpeg_colors(path):
    """The first part's RGB as FFmpeg's own decoder reads it: [H, W, 3] float32."""
    frame = av.CodecContext.create("exr", "r").decode(av.Packet(path.read_bytes()))[0]
    assert frame.format.name == "gbrapf16le"
    green, blue, red = (
        np.frombuffer(plane, "<f2").reshape(frame.height, -1)[:, : frame.width] for plane in frame.planes[:3]
    )
    return np.stack([red, green, blue], -1).astype(np.float32)
