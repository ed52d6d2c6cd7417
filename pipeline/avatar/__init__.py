"""The avatar: a canonical representation that is decoded to Gaussians and posed with the body."""

from pipeline.avatar.architecture import Architecture
from pipeline.avatar.avatar import Avatar
from pipeline.avatar.canonical import Canonical, build_canonical
from pipeline.avatar.posed import Posed, pose_features
from pipeline.avatar.representation import ClipConditions, Decoded, Representation
from pipeline.avatar.storage import load_avatar, save_avatar
from pipeline.avatar.surface import Surface

__all__ = [
    "Architecture",
    "Avatar",
    "Canonical",
    "ClipConditions",
    "Decoded",
    "Posed",
    "Representation",
    "Surface",
    "build_canonical",
    "load_avatar",
    "pose_features",
    "save_avatar",
]
