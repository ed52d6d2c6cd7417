"""The body: a SMPL-X-schema mesh that is loaded, shaped, posed, subdivided and named."""

from pipeline.body.body_model import BodyModel, load_body
from pipeline.body.identity import (
    Identity,
    expression_offsets,
    mean_identity,
    read_identity,
    rest_joints,
    rest_vertices,
    write_identity,
)
from pipeline.body.joints import JOINT_NAMES, joint_index
from pipeline.body.landmarks import Landmarks, PointSet, load_landmarks, locate
from pipeline.body.mesh import draw_mesh, edges, rasterize, uniform_laplacian, vertex_normals
from pipeline.body.parts import PARTS, is_face, is_part, part_labels
from pipeline.body.poses import Pose, Poses, read_poses, write_poses
from pipeline.body.skinning import (
    blend_transforms,
    joint_orientations,
    joint_transforms,
    matrix_transforms,
    pose_body,
    pose_frame,
    pose_offsets,
    posed_joints,
    posed_vertices,
    skin,
)
from pipeline.body.subdivision import subdivide

__all__ = [
    "JOINT_NAMES", "PARTS", "BodyModel", "Identity", "Landmarks", "PointSet", "Pose", "Poses",
    "blend_transforms", "draw_mesh", "edges", "expression_offsets", "is_face", "is_part", "joint_index",
    "joint_orientations", "joint_transforms", "load_body", "load_landmarks", "locate", "matrix_transforms",
    "mean_identity", "part_labels", "pose_body", "pose_frame", "pose_offsets", "posed_joints",
    "posed_vertices", "rasterize", "read_identity", "read_poses", "rest_joints", "rest_vertices", "skin",
    "subdivide", "uniform_laplacian", "vertex_normals", "write_identity", "write_poses",
]  # fmt: skip
