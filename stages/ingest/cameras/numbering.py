"""Which frame of the clip a camera's picture name means.

1. In footage that is a folder of pictures, a name that is a picture's own (without suffix) is that picture.
2. Otherwise the last run of digits in the name is a number. Where every number is a frame's, the numbers
   are the frames'. Where they are not, but all are one more than a frame's, they count from 1 (as FFmpeg
   numbers the pictures that it writes).
3. Anything else is refused: a camera of the wrong frame does more harm than none.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path, PurePath

from pipeline.errors import UserError
from stages.ingest.video import Clip

_NUMBER = re.compile(r"(?:.*\D)?(\d+)")


def frames_by_name(names: Iterable[str], clip: Clip, total: int, path: Path) -> tuple[dict[str, int], int]:
    """Picture name -> frame number, and whether the names counted from 0 or 1.

    Args:
        names: as the calibration has them, such as ``image12.jpg``, ``frames/00012.png`` or ``12``.
        clip: the footage.
        total: how many frames a video has; 0 if nobody knows, and then the numbers are believed.
        path: the calibration, for messages.

    Raises:
        UserError: a name without a number, two names of one frame, or numbers that are no frames'.
    """
    stems = {name: PurePath(name.replace("\\", "/")).stem for name in names}
    own = {file.stem: index for index, file in clip.pictures.items()}
    if own and all(stem in own for stem in stems.values()):
        return _distinct({name: own[stem] for name, stem in stems.items()}, path), 0
    numbers = {}
    for name, stem in stems.items():
        match = _NUMBER.fullmatch(stem)
        if match is None:
            raise UserError(f"{path}: the picture name '{name}' has no frame number: rename the pictures")
        numbers[name] = int(match.group(1))
    known = set(clip.pictures) or set(range(total))
    for first in (0, 1):
        if not known or all(number - first in known for number in numbers.values()):
            return _distinct({name: number - first for name, number in numbers.items()}, path), first
    stranger = next(name for name, number in numbers.items() if number not in known)
    raise UserError(
        f"{path}: the picture '{stranger}' is of no frame of {clip.path.name} ({len(known)} frames from "
        f"{min(known)} to {max(known)}): give the cameras of this clip, numbered as its frames from 0 or 1"
    )


def _distinct(frames: dict[str, int], path: Path) -> dict[str, int]:
    first: dict[int, str] = {}
    for name, frame in frames.items():
        if frame in first:
            raise UserError(f"{path}: '{first[frame]}' and '{name}' both name frame {frame}: keep one")
        first[frame] = name
    return frames
