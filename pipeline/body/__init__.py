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
from pipeline.body.mesh import edges, subdivide, uniform_laplacian, vertex_normals
from pipeline.body.parts import PARTS, is_face, is_part, part_labels
from pipeline.body.poses import Pose, Poses, read_poses, write_poses
from pipeline.body.rasterize import draw_mesh, rasterize
from pipeline.body.skinning import (
    blend_transforms,
    forward_kinematics,
    joint_orientations,
    joint_transforms,
    linear_blend_skinning,
    pose_body,
    pose_frame,
    pose_offsets,
    posed_joints,
    posed_vertices,
    transform_points,
)

__all__ = [
    "JOINT_NAMES", "PARTS", "BodyModel", "Identity", "Landmarks", "PointSet", "Pose", "Poses",
    "blend_transforms", "draw_mesh", "edges", "expression_offsets", "forward_kinematics", "is_face",
    "is_part", "joint_index", "joint_orientations", "joint_transforms", "linear_blend_skinning",
    "load_body", "load_landmarks", "locate", "mean_identity", "part_labels", "pose_body", "pose_frame",
    "pose_offsets", "posed_joints", "posed_vertices", "rasterize", "read_identity", "read_poses",
    "rest_joints", "rest_vertices", "subdivide", "transform_points", "uniform_laplacian", "vertex_normals",
    "write_identity", "write_poses",
]  # fmt: skip
