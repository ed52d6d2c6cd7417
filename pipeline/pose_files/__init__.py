"""Poses from and for other programs: what they mean, reading them, and handing them on.

SMPLest-X, Hand4Whole, ExAvatar and FlexiAvatar's own release write SMPL-X parameters as JSON, one file
a frame, under the same names: ``root_pose`` [3], ``body_pose`` [21][3], ``jaw_pose``, ``leye_pose``,
``reye_pose`` [3], ``lhand_pose``, ``rhand_pose`` [15][3], ``expr``, and ``shape`` (estimates) or ``trans``
[3] (fits); ``axes`` says what these are relative to. Datasets bring poses in many other forms; what the
ingest stage makes of them is an ``InitialPoses`` too, which ``record`` hands on to the fit stage.
"""

from pipeline.pose_files.camera_frame import into_camera, into_world, moved_pivot
from pipeline.pose_files.export import tool_joints, write_peer_files
from pipeline.pose_files.hands import read_hand_mean, with_flat_hands
from pipeline.pose_files.initial_poses import (
    INITIAL_POSES,
    InitialPoses,
    is_official_smplx,
    knows_coefficients,
    on_frames,
    read_initial_poses,
    write_initial_poses,
)
from pipeline.pose_files.smplx_json import read_known_poses, read_smplx_json

__all__ = [
    "INITIAL_POSES", "InitialPoses", "into_camera", "into_world", "is_official_smplx", "knows_coefficients",
    "moved_pivot", "on_frames", "read_hand_mean", "read_initial_poses", "read_known_poses", "read_smplx_json",
    "tool_joints", "with_flat_hands", "write_initial_poses", "write_peer_files",
]  # fmt: skip
