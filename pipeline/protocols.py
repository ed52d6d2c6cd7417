"""How an avatar's pictures are compared with the truth: every choice has a name, and sets of them have one.

Published numbers differ by what was done besides rendering: what the person stands on, whose mask cuts
the picture out, whether the pose was fitted to the very image that is scored. A protocol is a set of
those choices; ``summary.json`` and every table say which were used. This module loads nothing heavy, for
settings are read by the DAG.

What the paper says: NeuMan's test poses are refined on the image alone, and the background is masked as
ExAvatar does (Section 4.1). What its authors' release adds: NeuMan on white, TalkShow and ZJU-MoCap on
black, the ground-truth mask cutting both pictures, the whole image, AlexNet's LPIPS, means over frames.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

AUTO = "auto"
BACKGROUNDS = ("black", "white")
"""What a person can be composited on; their values are in :mod:`pipeline.composite`."""

OWN, TRUTH = RENDER_MASKS = ("own", "truth")
"""Whose alpha cuts the avatar's picture out: its own, or the truth's mask after it."""

PLAN, ON, OFF = REFINEMENTS = ("plan", "on", "off")
"""Whether held-out poses are refined on the held-out images: as the plan says, always, never."""


@dataclasses.dataclass(frozen=True)
class Protocol:
    """A set of choices.

    Attributes:
        background: one of ``BACKGROUNDS``.
        render_mask: one of ``RENDER_MASKS``.
        refine_test_poses: one of ``REFINEMENTS``.
    """

    background: str
    render_mask: str
    refine_test_poses: str


PROTOCOLS: Mapping[str, Protocol] = {
    "ours": Protocol("black", OWN, PLAN),
    "paper": Protocol("white", TRUTH, ON),  # its NeuMan table
    "paper_black": Protocol("black", TRUTH, OFF),  # its TalkShow and ZJU-MoCap tables
}
"""The protocols by name. ``ours`` lets a silhouette that is wrong cost something."""

DEFAULT = "ours"


def chosen(settings: Mapping[str, Any]) -> Protocol:
    """The choices of evaluate's settings: the named protocol's, but for those that are set one by one.

    Args:
        settings: of evaluate, as a table; what is missing is ``auto``.

    Raises:
        ValueError: a word that does not exist.
    """
    name = settings.get("protocol", DEFAULT)
    _check("protocol", name, tuple(PROTOCOLS))
    known = {"background": BACKGROUNDS, "render_mask": RENDER_MASKS, "refine_test_poses": REFINEMENTS}
    choices = {}
    for choice, words in known.items():
        word = settings.get(choice, AUTO)
        _check(choice, word, (AUTO, *words))
        if word != AUTO:
            choices[choice] = word
    return dataclasses.replace(PROTOCOLS[name], **choices)


def _check(setting: str, word: Any, words: tuple[str, ...]) -> None:
    if word not in words:
        raise ValueError(f"evaluate.{setting} must be one of {', '.join(words)}, not {word}")
