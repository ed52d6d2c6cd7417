"""Poses from and for other programs: SMPL-X parameters as JSON, one file a frame.

SMPLest-X, Hand4Whole, ExAvatar and FlexiAvatar's own release write the same names:
``root_pose`` [3], ``body_pose`` [21][3], ``jaw_pose``, ``leye_pose``, ``reye_pose`` [3], ``lhand_pose``,
``rhand_pose`` [15][3], ``expr``, and ``shape`` (estimates) or ``trans`` [3] (fits); ``axes`` says what
these are relative to.
"""

from pipeline.pose_files.axes import into_camera, into_world, moved_pivot
from pipeline.pose_files.export import tool_joints, write_peer_files
from pipeline.pose_files.read import InitialPoses, read_hand_mean, read_initial_poses

__all__ = [
    "InitialPoses", "into_camera", "into_world", "moved_pivot", "read_hand_mean", "read_initial_poses",
    "tool_joints", "write_peer_files",
]  # fmt: skip
