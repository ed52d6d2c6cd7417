"""How an avatar's pictures are compared with the truth: every choice has a name, and sets of them have one.

Published numbers differ by what was done besides rendering: what the person stands on, whose mask cuts
the picture out, whether the pose was fitted to the very image that is scored, and whether the truth's soft
edge has the person's own colours or the photograph's. A protocol is a set of
those choices; ``summary.json`` and every table say which were used. This module loads nothing heavy, for
settings are read by the DAG.

What the paper says: NeuMan's test poses are refined on the image alone, and the background is masked as
ExAvatar does (Section 4.1). What its authors' release adds: NeuMan on white, TalkShow and ZJU-MoCap on
black, the ground-truth mask cutting both pictures, the whole image, AlexNet's LPIPS, means over frames.
The masking is said of all tables and the refinement of NeuMan alone; the colour under INSTA and WildAvatar is
said nowhere, and black is taken, as for all else but NeuMan.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, get_args

from pipeline.config.choices import Background, EdgeColors, ProtocolName, Refinement, RenderMask

AUTO = "auto"
OWN, TRUTH = get_args(RenderMask)
PLAN, ON, OFF = get_args(Refinement)
OWN_COLORS, PHOTOGRAPH = get_args(EdgeColors)


@dataclasses.dataclass(frozen=True)
class Protocol:
    """A set of choices."""

    background: Background
    render_mask: RenderMask
    refine_test_poses: Refinement
    edge_colors: EdgeColors = "own"


PROTOCOLS: Mapping[ProtocolName, Protocol] = {
    "ours": Protocol("black", OWN, PLAN),
    "paper": Protocol("white", TRUTH, ON, PHOTOGRAPH),  # its NeuMan table
    "paper_black": Protocol("black", TRUTH, OFF, PHOTOGRAPH),  # its other tables
}
"""The protocols by name. ``ours`` lets a silhouette that is wrong cost something."""

DEFAULT: ProtocolName = "ours"


def chosen(settings: Mapping[str, Any]) -> Protocol:
    """The choices of evaluate's settings: the named protocol's, but for those that are set one by one.

    Args:
        settings: of evaluate, as a table; what is missing is ``auto``.
    """
    words = {field.name: settings.get(field.name, AUTO) for field in dataclasses.fields(Protocol)}
    choices = {choice: word for choice, word in words.items() if word != AUTO}
    return dataclasses.replace(PROTOCOLS[settings.get("protocol", DEFAULT)], **choices)
