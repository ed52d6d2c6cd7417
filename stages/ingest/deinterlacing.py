"""Interlaced footage as whole pictures: FFmpeg's ``idet`` to know it, ``bwdif`` to undo it.

Cameras mark what they film as interlaced, some mark whole pictures so, and programs lose the mark. So the
first pictures are looked at, too: where the lines of moving pictures show two moments, it is interlaced.
"""

from __future__ import annotations

import collections
from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

import av
from av.filter import Graph

LOOKED_AT = 48  # frames
_FEWEST = 8  # frames of two moments that unmarked footage must show
_SHARE = 0.8  # of the frames that could be told, with one field first: the noise of a codec has no parity
_AGAIN = (av.BlockingIOError, av.EOFError)

Tag = TypeVar("Tag")
Pair = tuple[Tag, av.VideoFrame]


def find_parity(frames: Iterable[av.VideoFrame]) -> tuple[str, str]:
    """Which field of interlaced footage comes first, and the line that says what was found.

    Args:
        frames: the first ones of the clip.

    Returns:
        ``tff`` (top), ``bff`` (bottom), ``auto`` (as each frame is marked), or nothing for whole pictures;
        and a note, which is empty where nothing is marked or found.
    """
    marked = looked = 0
    counts: dict[str, float] = {}
    for was_marked, frame in _filtered(((one.interlaced_frame, one) for one in frames), "idet", ""):
        looked += 1
        marked += was_marked
        counts = _counts(frame)
    first = max(("tff", "bff"), key=lambda parity: counts.get(parity, 0.0))
    twofold, whole = counts.get(first, 0.0), counts.get("progressive", 0.0)
    told = whole + counts.get("tff", 0.0) + counts.get("bff", 0.0)
    if marked * 2 > looked:
        if twofold < _SHARE / 2 * told:
            return "", "marked as interlaced, but its pictures are whole: left as they are"
        return "auto", "interlaced: each frame is made whole with FFmpeg's bwdif"
    if twofold >= _FEWEST and twofold > _SHARE * told:
        name = "top" if first == "tff" else "bottom"
        return (
            first,
            f"interlaced, though not marked so, {name} field first: made whole with FFmpeg's bwdif",
        )
    return "", ""


def deinterlaced(pairs: Iterable[Pair], parity: str) -> Iterator[Pair]:
    """The frames made whole, one for one and each with its tag.

    Args:
        pairs: (tag, frame), in order.
        parity: ``tff``, ``bff`` or ``auto``, see :func:`find_parity`.
    """
    which = "interlaced" if parity == "auto" else "all"
    return _filtered(pairs, "bwdif", f"mode=send_frame:parity={parity}:deint={which}")


def _filtered(pairs: Iterable[Pair], name: str, arguments: str) -> Iterator[Pair]:
    """The frames after one of FFmpeg's filters that gives one for each, each with its tag.

    Frames of another size or format than those before begin anew.
    """
    tags: collections.deque = collections.deque()  # of Tag
    graph, form = None, None
    for tag, frame in pairs:
        if graph is not None and form != (frame.width, frame.height, frame.format.name):
            yield from _last(graph, tags)
            graph = None
        if graph is None:
            graph, form = _graph(frame, name, arguments), (frame.width, frame.height, frame.format.name)
        tags.append(tag)
        graph.push(frame)
        for shown in _ready(graph):
            yield tags.popleft(), shown
    if graph is not None:
        yield from _last(graph, tags)


def _last(graph: Graph, tags: collections.deque[Tag]) -> Iterator[Pair]:
    graph.push(None)
    for shown in _ready(graph):
        yield tags.popleft(), shown


def _graph(frame: av.VideoFrame, name: str, arguments: str) -> Graph:
    """The filter between a source of frames like this one and a sink."""
    graph = Graph()
    source = graph.add_buffer(
        width=frame.width, height=frame.height, format=frame.format, time_base=frame.time_base
    )
    middle, sink = graph.add(name, arguments or None), graph.add("buffersink")
    source.link_to(middle)
    middle.link_to(sink)
    graph.configure()
    return graph


def _ready(graph: Graph) -> Iterator[av.VideoFrame]:
    pull: Callable[[], av.VideoFrame] = graph.vpull
    while True:
        try:
            yield pull()
        except _AGAIN:
            return


def _counts(frame: av.VideoFrame) -> dict[str, float]:
    """Idet's counts up to this frame, from several frames each."""
    prefix = "lavfi.idet.multiple."
    found = {}
    for key, text in frame.metadata.items():
        if key.startswith(prefix) and not key.endswith("current_frame"):
            found[key[len(prefix) :]] = float(text)
    return found
