"""Linear blend skinning of the SMPL-X schema, differentiable and batched over frames.

A joint's world transform is G_j = G_parent(j) [R_j | J_j - J_parent(j)]; what skinning needs is the
same with the rest pose removed, A_j = G_j [I | -J_j], so that rest points can be transformed as
they are: x' = sum_j w_j A_j x (SMPL, Loper et al. 2015, equations 2 to 7).
"""

from __future__ import annotations

import functools

import roma
import torch
from torch import Tensor

from pipeline.body.body_model import BodyModel
from pipeline.body.identity import Identity, expression_offsets, rest_joints, rest_vertices
from pipeline.body.poses import Pose


def joint_transforms(
    rotation: Tensor,  # [T, 55, 3]
    joints: Tensor,  # [55, 3]
    parents: tuple[int, ...],
) -> Tensor:
    """The transforms A_j that carry rest points with each joint.

    Args:
        rotation: rotation vectors, radians, each relative to its parent joint. Any number of
            leading dimensions in place of T.
        joints: rest joints, metres; a further [T, 55, 3] is allowed.
        parents: the kinematic tree, -1 for the root.

    Returns:
        [T, 55, 3, 4], ``[R | t]`` with the rest pose removed: the identity at zero rotation.
    """
    return forward_kinematics(roma.rotvec_to_rotmat(rotation), joints, parents)[0]


def forward_kinematics(
    matrices: Tensor,  # [T, 55, 3, 3]
    joints: Tensor,  # [55, 3]
    parents: tuple[int, ...],
) -> tuple[Tensor, Tensor]:
    """The joints' transforms and places in a pose that is given by local rotation matrices.

    Args:
        matrices: each relative to its parent joint.
        joints, parents: as for ``joint_transforms``.

    Returns:
        A_j as ``joint_transforms`` gives them, [T, 55, 3, 4], and the posed joints, [T, 55, 3], metres.
    """
    orientation, position = _world_joints(matrices, joints, parents)
    translation = position - (orientation @ joints[..., None])[..., 0]
    return torch.cat([orientation, translation[..., None]], dim=-1), position


def posed_joints(
    rotation: Tensor,  # [T, 55, 3]
    joints: Tensor,  # [55, 3]
    parents: tuple[int, ...],
) -> Tensor:
    """The joints' positions in a pose, without ``transl``: [T, 55, 3], metres."""
    return _world_joints(roma.rotvec_to_rotmat(rotation), joints, parents)[1]


def joint_orientations(rotation: Tensor, parents: tuple[int, ...]) -> Tensor:
    """Each joint's rotation in the world: [T, 55, 3] rotation vectors -> [T, 55, 3, 3]."""
    matrices = roma.rotvec_to_rotmat(rotation)
    return _world_joints(matrices, rotation.new_zeros(len(parents), 3), parents)[0]


def linear_blend_skinning(
    transforms: Tensor,  # [T, 55, 3, 4]
    weights: Tensor,  # [N, 55]
    points: Tensor,  # [N, 3] or [T, N, 3]
) -> Tensor:
    """Rest points carried to their pose by blended transforms, sum_j w_j A_j x.

    Returns:
        [T, N, 3], metres, without ``transl``.

    A point halfway between a joint that rests and one that moves by a metre moves by half a metre:

    >>> rest = torch.eye(3, 4)
    >>> moved = rest + torch.tensor([[0.0, 0, 0, 1], [0, 0, 0, 0], [0, 0, 0, 0]])
    >>> linear_blend_skinning(torch.stack([rest, moved])[None], torch.tensor([[0.5, 0.5]]), torch.zeros(1, 3))
    tensor([[[0.5000, 0.0000, 0.0000]]])
    """
    return transform_points(blend_transforms(transforms, weights), points)


def blend_transforms(
    transforms: Tensor,  # [T, 55, 3, 4]
    weights: Tensor,  # [N, 55]
) -> Tensor:
    """The weighted mean of the joints' transforms at each point: [T, N, 3, 4]."""
    return (weights @ transforms.flatten(-2)).unflatten(-1, (3, 4))


def transform_points(
    transforms: Tensor,  # [..., N, 3, 4]
    points: Tensor,  # [..., N, 3]
) -> Tensor:
    """Each point carried by a transform of its own: [..., N, 3].

    The product is written out: a batch of 3 x 3 products takes half as long again on a CPU.
    """
    along_x, along_y, along_z, translation = transforms.unbind(-1)
    x, y, z = points[..., None].unbind(-2)
    return along_x * x + along_y * y + along_z * z + translation


def pose_offsets(body: BodyModel, rotation: Tensor) -> Tensor | None:
    """Displacements by pose correctives, B_P(theta), or None if the body has none.

    Args:
        body: the body.
        rotation: [T, 55, 3], rotation vectors.

    Returns:
        [T, V, 3], metres, in T pose.
    """
    if body.pose_directions is None:
        return None
    matrices = roma.rotvec_to_rotmat(rotation[..., 1:, :])
    feature = (matrices - torch.eye(3, dtype=rotation.dtype, device=rotation.device)).flatten(-3)
    flat = body.pose_directions.reshape(-1, body.pose_directions.shape[2])
    return (feature @ flat.mT).unflatten(-1, body.v_template.shape)


def pose_body(
    body: BodyModel,
    identity: Identity,
    rotation: Tensor,  # [T, 55, 3]
    expression: Tensor,  # [T, E]
    transl: Tensor,  # [T, 3]
) -> tuple[Tensor, Tensor]:
    """The whole mesh and its joints in every frame.

    Returns:
        vertices [T, V, 3] and joints [T, 55, 3], metres, in the world.
    """
    joints = rest_joints(body, identity)
    rest = rest_vertices(body, identity) + expression_offsets(body, expression)
    correctives = pose_offsets(body, rotation)
    if correctives is not None:
        rest = rest + correctives
    transforms, posed = forward_kinematics(roma.rotvec_to_rotmat(rotation), joints, body.parents)
    vertices = linear_blend_skinning(transforms, body.skinning_weights, rest)
    return vertices + transl[..., None, :], posed + transl[..., None, :]


def pose_frame(body: BodyModel, identity: Identity, pose: Pose) -> tuple[Tensor, Tensor]:
    """The whole mesh and its joints in one frame.

    Returns:
        vertices [V, 3] and joints [55, 3], metres, in the world.
    """
    vertices, joints = pose_body(
        body, identity, pose.rotation[None], pose.expression[None], pose.transl[None]
    )
    return vertices[0], joints[0]


def posed_vertices(body: BodyModel, identity: Identity, pose: Pose) -> Tensor:
    """The mesh in one frame: [V, 3], metres, in the world.

    A metre up, in the rest pose:

    >>> from pathlib import Path
    >>> from pipeline.body import load_body, mean_identity
    >>> body = load_body(Path("data/body/open_body.npz"))
    >>> pose = Pose(rotation=torch.zeros(55, 3), expression=torch.zeros(10), transl=torch.tensor([0.0, 1, 0]))
    >>> vertices = posed_vertices(body, mean_identity(body), pose)
    >>> torch.allclose(vertices, body.v_template + pose.transl, atol=1e-5)
    True
    """
    return pose_frame(body, identity, pose)[0]


def _world_joints(local: Tensor, joints: Tensor, parents: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    """World orientation [T, 55, 3, 3] and position [T, 55, 3] of every joint, from local matrices.

    The tree is walked by depth, all joints of a depth at once: 11 steps instead of 55.
    """
    levels, places, order = _levels(parents)
    root = joints[..., list(levels[0]), :].expand(*local.shape[:-3], -1, -1)
    orientations, positions = [local[..., list(levels[0]), :, :]], [root]
    for level, place in zip(levels[1:], places, strict=True):
        above = orientations[-1][..., list(place), :, :]
        bone = joints[..., list(level), :] - joints[..., [parents[j] for j in level], :]
        orientations.append(above @ local[..., list(level), :, :])
        positions.append(positions[-1][..., list(place), :] + (above @ bone[..., None])[..., 0])
    back = list(order)
    return torch.cat(orientations, dim=-3)[..., back, :, :], torch.cat(positions, dim=-2)[..., back, :]


@functools.lru_cache(maxsize=8)
def _levels(
    parents: tuple[int, ...],
) -> tuple[tuple[tuple[int, ...], ...], tuple[tuple[int, ...], ...], tuple[int, ...]]:
    """A tree by depth.

    Returns:
        the joints of each depth; for each depth after the first, the parents' places in the depth
        above; and where each joint is found when the depths are written one after the other.
    """
    depth: list[int] = []
    for parent in parents:
        depth.append(0 if parent < 0 else depth[parent] + 1)
    levels = [tuple(j for j, d in enumerate(depth) if d == level) for level in range(max(depth) + 1)]
    places = [
        tuple(above.index(parents[j]) for j in level)
        for above, level in zip(levels[:-1], levels[1:], strict=True)
    ]
    written = [j for level in levels for j in level]
    return tuple(levels), tuple(places), tuple(written.index(j) for j in range(len(parents)))
