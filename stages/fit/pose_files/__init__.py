"""Poses of other programs as the start of the fit, or as its result; and the fit written for them."""

from stages.fit.pose_files.export import write_peer_files
from stages.fit.pose_files.given import given_poses, keep_given
from stages.fit.pose_files.start import initial_facing, initial_from_files, is_official_smplx

__all__ = [
    "given_poses", "initial_facing", "initial_from_files", "is_official_smplx", "keep_given",
    "write_peer_files",
]  # fmt: skip
