"""The values that ``motion=`` may have. Imports nothing heavy: the DAG asks, too."""

from __future__ import annotations

import dataclasses
import os
import re
import stat
from pathlib import Path

from pipeline.config.choices import VIDEOS
from pipeline.config.subjects import LONGEST, NAME
from pipeline.errors import UserError

TURNTABLE = "turntable"
SUBJECT = "subject:"
_SHOWN = 200  # characters of a word in a message
KINDS = {".bvh": "bvh", ".npz": "amass"}
REMEDY = (
    "a motion is a .bvh file, an AMASS or SMPL-X .npz, a folder of <frame>.json, a clip of somebody (.mp4, "
    ".mov, .mkv, .webm, .avi), subject:NAME (what another subject does in its clip), or turntable"
)


SUBJECT_FILES = {
    "ingest": ("footage.json", "cameras.parquet", "keypoints.parquet"),
    "fit": ("identity.safetensors", "poses.parquet"),
}
"""Stage -> files that are read of a subject whose clip is the motion."""


@dataclasses.dataclass(frozen=True)
class MotionSource:
    """The kind and the place of a motion.

    Attributes:
        kind: ``turntable``, ``subject``, ``clip``, ``bvh``, ``amass`` or ``peers``.
        path: the file or the folder, of the last four.
        subject: whose clip, of ``subject``, and the name that a ``clip`` has as a subject.
    """

    kind: str
    path: Path | None = None
    subject: str = ""


def motion_source(text: str) -> MotionSource:
    """The source that ``motion=`` names; a file's content is checked when it is read.

    Raises:
        UserError: it is none of the things that a motion may be.
    """
    if text == TURNTABLE:
        return MotionSource(TURNTABLE)
    if text.startswith(SUBJECT) and len(text) > len(SUBJECT):
        return MotionSource("subject", subject=text.removeprefix(SUBJECT))
    path = Path(text)
    try:
        mode = path.stat().st_mode if text else 0
    except (OSError, ValueError):  # a name may also be too long, or hold what no name does
        mode = 0
    shown = text if len(text) < _SHOWN else f"{text[:_SHOWN]}..."
    if not mode:
        raise UserError(f"motion={shown}: there is no such file; {REMEDY}")
    if stat.S_ISDIR(mode):
        return _folder(path)
    if not stat.S_ISREG(mode):
        raise UserError(f"motion={text}: it is neither a file nor a folder; {REMEDY}")
    if path.suffix.lower() in VIDEOS:
        return MotionSource("clip", path.absolute(), clip_name(path))
    kind = KINDS.get(path.suffix.lower())
    if kind is None:
        raise UserError(f"motion={text}: a {path.suffix or 'file without a suffix'} is no motion; {REMEDY}")
    return MotionSource(kind, path)


def _folder(path: Path) -> MotionSource:
    """A folder of poses; UserError where nothing in it can be one."""
    try:
        names = os.listdir(path)
    except OSError as error:
        raise UserError(f"motion={path}: cannot be listed ({error.strerror}); {REMEDY}") from None
    if not any(name.removesuffix(".json").isdigit() for name in names if name.endswith(".json")):
        raise UserError(f"motion={path}: has {len(names)} files, none usable as <frame>.json; {REMEDY}")
    return MotionSource("peers", path)


def clip_name(path: Path) -> str:
    """The name that a clip has as a subject: its file's, with _ for what no subject's name may hold.

    >>> clip_name(Path("my dance (2).mp4"))
    'my_dance__2_'
    """
    plain = re.sub(r"[^A-Za-z0-9_.-]", "_", path.stem)[:LONGEST]
    return plain if NAME.fullmatch(plain) else f"clip{plain}"[:LONGEST]
