"""Writing the folder that a pose-to-video model is given, see docs/auxiliary.md.

::

    guidance/reference.png             the person, whole, on a plain ground
    guidance/reference_pose.png        its skeleton
    guidance/poses/000000.png ...      the turn's skeletons
    guidance/poses.parquet, cameras.parquet, keypoints.parquet    our records of the turn
    guidance/guidance.json             sizes, frame rate, and why this reference frame
    guidance/peers/                    the same poses and cameras as the peers' tools read them
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipeline.body import write_poses
from pipeline.clip.fitted_clip import FittedClip
from pipeline.clip.frames import frame_path, write_png
from pipeline.clip.keypoints import empty_keypoints, write_keypoints
from pipeline.clip.records import write_cameras
from pipeline.files.json_files import write_json
from pipeline.pose_files import read_hand_mean, write_peer_files
from stages.auxiliary.reference import Reference
from stages.auxiliary.skeleton import draw_skeleton
from stages.auxiliary.turntable_motion import TurntableMotion

if TYPE_CHECKING:
    from pipeline.run.stage import Context

FOLDER = "guidance"


def write_guidance(
    context: Context, clip: FittedClip, turn: TurntableMotion, keypoints: np.ndarray, reference: Reference
) -> None:
    """Write everything that the module's docstring lists.

    Args:
        keypoints: [T, 133, 3], the turn's skeletons.
    """
    folder, settings = context.output / FOLDER, context.settings
    (folder / "poses").mkdir(parents=True)
    size = (turn.camera.width, turn.camera.height)
    write_png(folder / "reference.png", reference.image)
    write_png(folder / "reference_pose.png", draw_skeleton(reference.keypoints, *size))
    with context.progress(len(keypoints), "guidance") as progress:
        for row, points in enumerate(keypoints):
            write_png(frame_path(folder / "poses", row), draw_skeleton(points, *size))
            progress.advance()
    _write_records(folder, clip, turn, keypoints, context.body_file)
    write_json(
        folder / "guidance.json",
        {
            "frames": len(keypoints),
            "width": size[0],
            "height": size[1],
            "fps": settings.fps,
            "motion": settings.motion,
            "azimuth_degrees": [round(float(angle), 3) for angle in np.degrees(turn.azimuth)],
            "reference": dataclasses.asdict(reference.score) | {"padded": reference.padded},
        },
    )
    context.log(
        f"reference frame {reference.score.frame} (score {reference.score.total:.2f}"
        f"{', padded to the whole body' if reference.padded else ''})"
    )


def _write_records(
    folder: Path, clip: FittedClip, turn: TurntableMotion, keypoints: np.ndarray, body_file: Path
) -> None:
    cameras = dict.fromkeys(turn.poses.frames, turn.camera)
    write_poses(folder / "poses.parquet", turn.poses)
    write_cameras(folder / "cameras.parquet", cameras)
    table = empty_keypoints(np.array(turn.poses.frames))
    table.whole_body[:] = keypoints
    write_keypoints(folder / "keypoints.parquet", table)
    hand_mean = read_hand_mean(body_file)
    write_peer_files(folder / "peers", clip.body, clip.identity, turn.poses, turn.poses, cameras, hand_mean)
