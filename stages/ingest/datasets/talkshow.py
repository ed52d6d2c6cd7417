"""TalkShow: a clip of somebody speaking, and what SHOW reconstructed of it.

::

    <seq>.mp4    the clip, cut from the broadcast, at most 10 s at 30 frames a second
    <seq>.pkl    SHOW's reconstruction; optional

The source is the folder that holds both, or the clip alone; a .pkl elsewhere is ``ingest.poses=FILE``.
Source: SHOW and TalkSHOW (github.com/yhw-yhw). The pickle has numbers of each frame t (numpy arrays or
torch tensors): global_orient [T, 1, 3], body_pose_axis [T, 63], jaw_pose, leye_pose, reye_pose [T, 3],
left_hand_pose and right_hand_pose [T, 12], expression [T, 100], transl [T, 3], betas [1, 300]; and width,
height, center, focal_length, camera_transl [3]. SHOW's program also writes a list that holds this one
table. There are as many frames as the clip has; a file of another number is another clip's and is refused.
Conversions: the camera does not turn, but it is PyTorch3D's, whose x and y point the other way than
OpenCV's, so with t = camera_transl a point x of the body is at x + (-t_x, -t_y, t_z) in OpenCV's axes, and
trans = transl + (-t_x, -t_y, t_z). The hands are 12 coefficients of SMPL-X's hand components, added to the
model's mean (flat_hand_mean is false): without the user's SMPL-X file (``body=``), whose components they
need, they begin relaxed, and the fit says so.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pipeline.config.choices import VIDEOS
from pipeline.errors import UserError
from pipeline.pose_files import InitialPoses
from pipeline.untrusted import read_pickle
from stages.ingest.cameras.calibration import EVERY_FRAME, CalibratedCamera, Calibration, pinhole_lens
from stages.ingest.datasets.recording import Recording, Shot, entry, numbers, read_array, stacked
from stages.ingest.datasets.smplx_poses import initial_poses
from stages.ingest.settings import IngestSettings
from stages.ingest.video import Clip, open_clip, read_clip

_REMEDY = "take SHOW's .pkl again, or leave it out"
_TO_OPENCV = np.array([-1.0, -1.0, 1.0])
_PARTS = (  # key -> numbers a frame, the joint it begins at
    ("global_orient", 3, 0), ("body_pose_axis", 63, 1), ("jaw_pose", 3, 22), ("leye_pose", 3, 23),
    ("reye_pose", 3, 24),
)  # fmt: skip


def recognises(folder: Path) -> bool:
    """One video and one pickle."""
    return len(_files(folder, VIDEOS)) == 1 and len(_files(folder, (".pkl",))) == 1


def read(source: Path, settings: IngestSettings) -> Recording:
    """Read a clip, and its pickle where there is one; UserError where a file is malformed."""
    video, pickled = source, Path(settings.poses) if settings.poses else None
    if source.is_dir():
        videos, found = _files(source, VIDEOS), _files(source, (".pkl",))
        if len(videos) != 1 or len(found) > 1:
            raise UserError(f"{source} holds {len(videos)} videos and {len(found)} .pkl: keep one clip's")
        video, pickled = videos[0], pickled or (found[0] if found else None)
    clip = open_clip(video)
    if pickled is None:
        note = f"no .pkl of SHOW's beside {video.name}: pose and camera are estimated"
        return Recording("talkshow", (Shot(clip),), notes=(note,))
    table = _table(read_pickle(pickled, _REMEDY), pickled)
    poses = _poses(table, pickled)
    _check_length(len(poses.frames), clip, pickled)
    calibration = Calibration(
        pickled, "SHOW", {EVERY_FRAME: _view(table, pickled)}, metric=True, upright=False
    )
    return Recording("talkshow", (Shot(clip, calibration, poses=poses),))


def _files(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    return sorted(file for file in folder.iterdir() if file.suffix.lower() in suffixes)


def _table(value: Any, path: Path) -> Any:
    """The one table of a pickle."""
    if not isinstance(value, list | tuple):
        return value
    if len(value) != 1:
        raise UserError(f"{path} is a list of {len(value)} results, not of one: {_REMEDY}")
    return value[0]


def _check_length(count: int, clip: Clip, path: Path) -> None:
    """Refuse the poses of another clip."""
    frames = clip.expected
    if frames != count:  # containers may be wrong about how many frames they have
        frames = sum(1 for _ in read_clip(clip, damaged="skip"))
    if frames != count:
        raise UserError(
            f"{path} is of {count} frames, {clip.path} has {frames}: take the .pkl of this very clip"
        )


def _view(table: Any, path: Path) -> CalibratedCamera:
    def number(key: str, shape: tuple[int, ...]) -> np.ndarray:
        return read_array(table, key, shape, path, _REMEDY)

    size = [int(number(key, (-1,))[0]) for key in ("width", "height")]
    focal = number("focal_length", (-1,))
    centre = number("center", (-1,))
    if min(size) < 1 or max(size) > 100_000 or focal[0] <= 0 or len(centre) < 2:
        raise UserError(f"{path}: its camera is empty: {_REMEDY}")
    lens = pinhole_lens(size[0], size[1], (focal[0], focal[-1]), (centre[0], centre[1]))
    return CalibratedCamera(lens, np.eye(3), np.zeros(3))


def _poses(table: Any, path: Path) -> InitialPoses:
    count = len(read_array(table, "body_pose_axis", (-1, 63), path, _REMEDY))

    def number(key: str, width: int) -> np.ndarray:
        value = entry(table, key, path, _REMEDY)
        return numbers(value, (count, width), f"{path}, '{key}' of {count} frames", _REMEDY)

    rotation = np.zeros((count, 55, 3))
    for key, width, joint in _PARTS:
        rotation[:, joint : joint + width // 3] = number(key, width).reshape(count, -1, 3)
    hands = stacked([number(f"{side}_hand_pose", -1) for side in ("left", "right")], path, _REMEDY, axis=1)
    camera = read_array(table, "camera_transl", (-1, 3), path, _REMEDY)
    if len(camera) not in (1, count):
        raise UserError(f"{path}, 'camera_transl' is neither of one frame nor of {count}: {_REMEDY}")
    transl = number("transl", 3) + camera * _TO_OPENCV
    expression, betas = number("expression", -1), read_array(table, "betas", (-1,), path, _REMEDY)
    return initial_poses(range(count), rotation, expression, betas, transl, hands=hands)
