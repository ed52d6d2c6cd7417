"""The sizes of an avatar."""

from __future__ import annotations

import dataclasses

ON_REQUEST = ("residual_moves", "plane_pose", "learn_identity", "learn_opacity", "correctives")
"""Sizes that a file holds only where they are not the default."""


@dataclasses.dataclass(frozen=True)
class Architecture:
    """Everything that must be known to rebuild an avatar's networks; stored in its file.

    Attributes:
        plane_resolution: texels along a side of each plane.
        plane_channels: features a texel; three planes give ``f_i`` three times as many.
        plane_deviation: standard deviation of the first features; a file does not hold it.
        width: hidden channels of the heads.
        groups: of GroupNorm in the heads.
        subdivisions: levels of midpoint subdivision of the body mesh.
        offset_unit, pose_offset_unit: metres that a head's output of 1 stands for.
        scale: initial standard deviation along the surface, in distances to the neighbours.
        thickness: initial standard deviation along the normal, in those along the surface.
        inset: how far inside the body's surface Gaussians lie, in initial standard deviations along it: many
            together, whose tails add up, then end where the surface does.
        opacity: of every Gaussian.
        residual_parts: parts that have a residual colour head, if any of their vertices is kept.
        residual_width: hidden channels of those heads.
        residual_place: which place they are told, ``"canonical"`` or ``"posed"`` (see ``residual.py``).
        residual_moves: whether they move Gaussians, too: the ablation of the paper's supplement E.3.
        place_frequencies, time_frequencies: of the encodings of that place and of the time.
        pose_heads: whether there are any; one who never moves needs none.
        representation: ``"triplane"`` or ``"bases"``; the sizes of planes and heads are the triplane's.
        bases: K, of the bases.
        bends: how many of them are bends, see ``driving_signal.py``.
        plane_pose: whose rest mesh tells the triplane's coordinates: ``"own"``, the identity's in T pose, or
            ``"open"``, the mean identity's with legs apart and the mouth open (see ``open_positions``).
        learn_identity: betas and joint offsets change in training (see ``identity_change.py``).
        learn_opacity: each Gaussian has an opacity of its own, which starts at ``opacity``.
        correctives: where the body's pose correctives act: ``"all"``, or ``"face_and_hands"``.
    """

    plane_resolution: int = 128
    plane_channels: int = 32
    width: int = 128
    groups: int = 8
    subdivisions: int = 1
    offset_unit: float = 0.02
    pose_offset_unit: float = 0.01
    scale: float = 0.55
    thickness: float = 0.5
    inset: float = 0.0
    opacity: float = 0.999
    residual_parts: tuple[str, ...] = ()
    residual_width: int = 64
    residual_place: str = "canonical"
    place_frequencies: int = 6
    time_frequencies: int = 6
    pose_heads: bool = True
    residual_moves: bool = False
    representation: str = "triplane"
    bases: int = 0
    bends: int = 0
    plane_deviation: float = 0.01
    plane_pose: str = "own"
    learn_identity: bool = False
    learn_opacity: bool = False
    correctives: str = "all"
