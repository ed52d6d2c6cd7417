"""Poses from and for other programs: what they mean, reading them, and handing them on.

SMPLest-X, Hand4Whole, ExAvatar and FlexiAvatar's own release write SMPL-X parameters as JSON, one file
a frame, under the same names: ``root_pose`` [3], ``body_pose`` [21][3], ``jaw_pose``, ``leye_pose``,
``reye_pose`` [3], ``lhand_pose``, ``rhand_pose`` [15][3], ``expr``, and ``shape`` (estimates) or ``trans``
[3] (fits); ``axes`` says what these are relative to. Datasets bring poses in many other forms; what the
ingest stage makes of them is an ``InitialPoses`` too, which ``record`` hands on to the fit stage.
"""

from pipeline.pose_files.axes import into_camera, into_world, moved_pivot
from pipeline.pose_files.export import tool_joints, write_peer_files
from pipeline.pose_files.hands import with_flat_hands
from pipeline.pose_files.read import (
    InitialPoses,
    on_frames,
    read_hand_mean,
    read_initial_poses,
    read_known_poses,
)
from pipeline.pose_files.record import RECORD, read_record, write_record

__all__ = [
    "RECORD", "InitialPoses", "into_camera", "into_world", "moved_pivot", "on_frames", "read_hand_mean",
    "read_initial_poses", "read_known_poses", "read_record", "tool_joints", "with_flat_hands",
    "write_peer_files", "write_record",
]  # fmt: skip
