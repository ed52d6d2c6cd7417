"""Words that a setting may have and that shared code knows, too: declared here, once.

Settings are read where torch is not imported, so this module imports nothing heavy.
"""

from typing import Literal

Device = Literal["auto", "cpu", "cuda"]
"""Where a stage computes; see ``pipeline.device``."""

LpipsNetwork = Literal["alex", "vgg"]
"""Backbones of LPIPS; on a CPU VGG costs twenty times what AlexNet does."""

ResidualPlace = Literal["canonical", "posed"]
"""The place of a Gaussian that its residual head is told; see ``pipeline.avatar.residual``."""

UpAxis = Literal["x", "y", "z", "-x", "-y", "-z"]
"""The axis of a motion's world that points up."""

Up = Literal["auto", UpAxis]
"""An axis, or the one that ``pipeline.motion.up_axis`` finds."""

BodyPart = Literal[
    "torso", "head", "face", "left_arm", "right_arm", "left_hand", "right_hand", "left_leg", "right_leg"
]  # fmt: skip
"""Parts of the body; a label is the index of its name. The head's label does not include the face."""

ResidualPart = Literal[BodyPart, "rest"]
"""Parts that may have a residual head; ``rest`` is what the others leave."""

Background = Literal["black", "white"]
"""What avatar and truth are composited on."""

RenderMask = Literal["own", "truth"]
"""Whose alpha cuts the avatar's picture out: its own, or the truth's mask after it."""

Refinement = Literal["plan", "on", "off"]
"""Whether held-out poses are refined on the held-out images: as the plan says, always, never."""

EdgeColors = Literal["own", "photograph"]
"""The truth's colours where its mask is soft: the person's own, or the photograph's, the wall among them."""

ProtocolName = Literal["ours", "paper", "paper_black"]
"""Named sets of the four choices before; see ``pipeline.config.evaluation_protocol``."""

PlyUp = Literal["-y", "y", "z"]
"""The axis that points up in the world of a .ply for other programs; ours is y."""

VIDEOS = (".mp4", ".mov", ".mkv", ".webm", ".avi")
"""Suffixes of files that are looked for as clips."""

SplatFormat = Literal["ply", "spz", "glb"]
"""Formats of splats; see ``pipeline.splat.splat_files``."""
