"""How landmarks move when the unknowns do, in closed form.

A joint k that turns by omega (in the world) carries everything below it about its place P_k:
dp / d omega = omega x sum_j w_j (p_j - P_k) over the joints j at or below k, where p_j is where joint j
alone would put the landmark. Joint offsets move what hangs below them by R_parent - R, the part of
the chain that straightens; shape and expression turn with the blended rotation.
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from pipeline.body.skinning import forward_kinematics
from stages.fit.parameters import LandmarkModel, Parameters

_LEAST = 1e-6  # of skinning weight that makes a landmark depend on a joint


@dataclasses.dataclass(frozen=True)
class Layout:
    """Which unknowns are solved for, and their order.

    A frame's are K rotations of three, E expressions and the translation; what frames share are B betas
    and the 55 joint offsets.

    Attributes:
        joints: [K], the joints that turn.
        expressions: E, 0 if they are held.
        betas: B.
        offsets: whether joint offsets are solved for.
    """

    joints: Tensor
    expressions: int
    betas: int
    offsets: bool

    @property
    def turns(self) -> int:
        """How many unknowns of a frame are rotations."""
        return 3 * len(self.joints)

    @property
    def frame(self) -> int:
        """The number of unknowns of a frame."""
        return self.turns + self.expressions + 3

    @property
    def shared(self) -> int:
        """The number of unknowns that frames share."""
        return self.betas + (165 if self.offsets else 0)


@dataclasses.dataclass(frozen=True)
class Group:
    """N landmarks that depend on the same part of the body.

    Attributes:
        rows: [N], which landmarks of the model.
        weights: [N, 55], skinning.
        below: [N, 55], the weight that hangs at or below each joint.
        bones: the joints that carry any of them.
        chain: those and the joints above them.
        face: whether they are the face's, which alone have expressions here.
    """

    rows: Tensor
    weights: Tensor
    below: Tensor
    bones: Tensor
    chain: Tensor
    face: bool


@dataclasses.dataclass(frozen=True)
class Posed:
    """The model of T frames in its pose, without the clip's translation.

    Attributes:
        orientation: [T, 55, 3, 3], of the joints in the world.
        translation: [T, 55, 3], where a joint's transform puts the origin.
        joints: [T, 55, 3].
        rest: [T, N, 3], landmarks before posing, expression included.
        bend: [T, 55, 3, 3], a joint's parent's orientation less its own.
    """

    orientation: Tensor
    translation: Tensor
    joints: Tensor
    rest: Tensor
    bend: Tensor


def ancestry(parents: tuple[int, ...]) -> Tensor:
    """[55, 55], 1 where the second joint is the first or lies above it."""
    above = torch.eye(len(parents))
    for joint, parent in enumerate(parents):
        if parent >= 0:
            above[joint] += above[parent]
    return above


def group_of(model: LandmarkModel, rows: Tensor, face: bool) -> Group:
    """The group of some landmarks, [N] indices."""
    weights = model.weights[rows]
    below = weights @ ancestry(model.parents).to(weights)
    bones, chain = (torch.nonzero(w.abs().amax(0) > _LEAST)[:, 0] for w in (weights, below))
    return Group(rows, weights, below, bones, chain, face)


def pose(model: LandmarkModel, parameters: Parameters) -> Posed:
    """Pose the model."""
    joints = model.joints + model.joint_shape @ parameters.betas + parameters.joint_offset
    rest = model.rest + model.shape @ parameters.betas + model.joint @ parameters.joint_offset
    rest = rest + model.face @ parameters.face_control
    moved = parameters.expression @ model.expression.flatten(0, 1).mT
    transforms, places = forward_kinematics(parameters.matrices, joints, model.parents)
    orientation = transforms[..., :3]
    parents = torch.tensor(model.parents)
    above = orientation[:, parents.clamp_min(0)]
    root = (parents < 0)[:, None, None]
    above = torch.where(root, torch.eye(3).to(above), above)
    return Posed(
        orientation, transforms[..., 3], places, rest + moved.unflatten(1, rest.shape), above - orientation
    )


class Slopes:
    """The derivatives of a group's landmarks in a pose.

    Attributes:
        places: [T, N, 3], the landmarks, without translation.
        blended: [T, N, 3, 3], the blended rotation of each.
        frame: [F], columns among a frame's unknowns that the group depends on.
        shared: [S], columns among the shared unknowns.
    """

    def __init__(self, model: LandmarkModel, posed: Posed, group: Group, layout: Layout) -> None:
        """Prepare what every row needs."""
        self._model, self._posed, self._group, self._layout = model, posed, group, layout
        count = len(posed.joints)
        turn = posed.orientation[:, group.bones]
        carried = posed.rest[:, group.rows] @ turn.permute(0, 3, 1, 2).reshape(count, 3, -1)
        carried = carried.unflatten(-1, (-1, 3)) + posed.translation[:, None, group.bones]
        carried = carried * group.weights[:, group.bones, None]
        self.places = carried.sum(2)
        self.blended = (group.weights[:, group.bones] @ turn.flatten(2)).unflatten(-1, (3, 3))
        slots = torch.nonzero(torch.isin(layout.joints, group.chain))[:, 0]
        self._joints = layout.joints[slots]
        above = ancestry(model.parents).to(carried)[group.bones][:, self._joints]
        self._arms = above.mT @ carried
        self._arms -= group.below[:, self._joints, None] * posed.joints[:, None, self._joints]
        self._expressions = layout.expressions if group.face else 0
        three, start = torch.arange(3), layout.turns
        self.frame = torch.cat(
            [
                (3 * slots[:, None] + three).flatten(),
                start + torch.arange(self._expressions),
                start + layout.expressions + three,
            ]
        )
        offsets = layout.betas + (3 * group.chain[:, None] + three).flatten()
        self.shared = torch.cat([torch.arange(layout.betas), offsets if layout.offsets else offsets[:0]])

    def rows(self, along: Tensor, pick: Tensor | None = None) -> Tensor:
        """How far differences of landmarks move along some directions.

        Args:
            along: [T, M, R, 3], R directions in the world for each of M differences.
            pick: [M, N], each difference as a sum of landmarks; the N landmarks themselves if None.

        Returns:
            [T, M R, F + S], by the columns ``frame`` and then ``shared``.
        """
        model, group, layout = self._model, self._group, self._layout
        count, size = len(along), along.shape[1] * along.shape[2]
        arms = self._arms if pick is None else (pick @ self._arms.flatten(2)).unflatten(-1, (-1, 3))
        whole = torch.ones(len(group.rows)).to(along) if pick is None else pick.sum(1)
        below = group.below if pick is None else pick @ group.below
        linear = self._linear(along, pick)
        bend = self._posed.bend[:, group.chain].permute(0, 2, 1, 3).reshape(count, 3, -1)
        offsets = (along.flatten(1, 2) @ bend).view(*along.shape[:3], -1, 3)
        offsets = offsets * below[:, None, group.chain, None]
        shape = offsets.reshape(count, size, -1) @ model.joint_shape[group.chain].reshape(-1, layout.betas)
        columns = [
            self._turns(arms, along),
            linear[..., : self._expressions],
            (along * whole[:, None, None]).reshape(count, size, 3),
            linear[..., self._expressions :] + shape,
        ]
        if layout.offsets:
            offsets = offsets + self._on_joints(along, pick)
            columns.append(offsets.reshape(count, size, -1))
        return torch.cat(columns, dim=-1)

    def _turns(self, arms: Tensor, along: Tensor) -> Tensor:
        """Rotations: a . (omega x arm) = omega . (arm x a), with omega in each joint's own axes."""
        ax, ay, az = (along[..., None, k] for k in range(3))  # [T, M, R, 1]
        x, y, z = (arms[:, :, None, :, k] for k in range(3))  # [T, M, 1, K]
        turned = torch.stack([y * az - z * ay, z * ax - x * az, x * ay - y * ax])  # [3, T, M, R, K]
        turned = turned.permute(1, 4, 2, 3, 0).flatten(2, 3) @ self._posed.orientation[:, self._joints]
        return turned.transpose(1, 2).flatten(2)

    def _linear(self, along: Tensor, pick: Tensor | None) -> Tensor:
        """Expression and shape of the surface: [T, M R, E + B]."""
        model, rows = self._model, self._group.rows
        basis = torch.cat([model.expression[rows][..., : self._expressions], model.shape[rows]], dim=-1)
        if pick is None:
            turned = (along @ self.blended).transpose(0, 1).flatten(1, 2)  # [N, T R, 3]
            moved = (turned @ basis).unflatten(1, (len(along), -1)).transpose(0, 1)
            return moved.flatten(1, 2)
        moved = self.blended.transpose(0, 1).flatten(1, 2) @ basis  # [N, T 3, E + B]
        picked = (pick @ moved.flatten(1)).unflatten(1, (len(along), 3, -1)).transpose(0, 1)
        return (along @ picked).flatten(1, 2)

    def _on_joints(self, along: Tensor, pick: Tensor | None) -> Tensor:
        """Landmarks that are joints follow their offset: [T, M, R, chain, 3]."""
        joint = self._model.joint[self._group.rows][:, self._group.chain]
        if pick is None:
            return (along @ self.blended)[..., None, :] * joint[:, None, :, None]
        picked = torch.einsum("mn,tnij,nk->tmikj", pick, self.blended, joint)
        return torch.einsum("tmri,tmikj->tmrkj", along, picked)


def joint_slopes(model: LandmarkModel, posed: Posed, layout: Layout) -> Tensor:
    """How the joints' places move with a frame's rotations: [T, U, 3K], without rows that are zero."""
    above = ancestry(model.parents) - torch.eye(len(model.parents))
    above = above.to(posed.joints)[:, layout.joints]
    rows = torch.nonzero(above.sum(1))[:, 0]
    arm = (posed.joints[:, rows, None] - posed.joints[:, None, layout.joints]) * above[rows][..., None]
    zero = torch.zeros_like(arm[..., 0])
    x, y, z = arm.unbind(-1)
    cross = torch.stack([zero, z, -y, -z, zero, x, y, -x, zero], dim=-1).unflatten(-1, (3, 3))  # -[arm]x
    turned = cross.transpose(1, 2) @ posed.orientation[:, layout.joints, None]  # [T, K, U, 3, 3]
    return turned.permute(0, 2, 3, 1, 4).reshape(len(arm), 3 * len(rows), layout.turns)
