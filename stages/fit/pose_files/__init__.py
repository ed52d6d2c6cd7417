"""Poses from and for other programs: SMPL-X parameters as JSON, one file a frame.

SMPLest-X, Hand4Whole, ExAvatar and FlexiAvatar's own release write the same names:
``root_pose`` [3], ``body_pose`` [21][3], ``jaw_pose``, ``leye_pose``, ``reye_pose`` [3], ``lhand_pose``,
``rhand_pose`` [15][3], ``expr``, and ``shape`` (estimates) or ``trans`` [3] (fits); ``axes`` says what
these are relative to.
"""

from stages.fit.pose_files.export import write_peer_files
from stages.fit.pose_files.read import InitialPoses, read_hand_mean, read_initial_poses
from stages.fit.pose_files.start import initial_facing, initial_from_files, is_official_smplx

__all__ = [
    "InitialPoses", "initial_facing", "initial_from_files", "is_official_smplx", "read_hand_mean",
    "read_initial_poses", "write_peer_files",
]  # fmt: skip
