"""The registration objective, Eq. 1: its terms' weights, and their sum.

Every term is summed over points and averaged over frames, so that weights do not depend on a clip's
length. Errors are measured in pixels of a picture whose long side is 512, so that they do not depend on
its size either.
"""

from __future__ import annotations

import dataclasses

import roma
import torch
from torch import Tensor

from pipeline.body import BodyModel, mean_identity, rest_joints
from pipeline.body.joints import BODY_POSE, JAW
from stages.fit import terms
from stages.fit.camera_batch import CameraBatch
from stages.fit.face import FaceTarget, sface
from stages.fit.face_offset import mirror_matrix
from stages.fit.joint_limits import joint_limits
from stages.fit.observations import Directions, Observations
from stages.fit.parameters import EYES, HANDS, LandmarkModel, Parameters
from stages.fit.settings import FitSettings
from stages.fit.windows import Window, windows

LONG_SIDE = 512.0
CHEST_DISTANCE = 0.22  # metres; a hand seen before the torso is nearer than the shoulders by this
INITIAL_BETAS = 0.5
EXPRESSION = 25.0
SHAPE = 0.05
JOINT_OFFSET = 2000.0
FACE_LENGTH = 2000.0
SFACE = {"vertex": 1e4, "laplacian": 1e7, "edge": 1e4}
_SATURATION = (40.0, 20.0, 20.0, 20.0)  # pixels, by group: body, hands, face

# What holds each joint of body_pose to its initial rotation; the other joints have 0.3.
_STIFFNESS = {
    "pelvis": 1.0, "spine1": 6.0, "spine2": 6.0, "spine3": 6.0, "neck": 1.5, "head": 1.5, "left_collar": 10.0,
    "right_collar": 10.0, "left_ankle": 1.0, "right_ankle": 1.0, "left_foot": 1.0, "right_foot": 1.0,
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Prediction:
    """A clip as parameters predict it.

    Attributes:
        matrices: [T, 55, 3, 3], with the joints that nothing was seen of at their initial rotation.
        joints: [T, 55, 3], in the world.
        in_camera: [T, N, 3], landmarks in the camera's axes.
        pixels: [T, N, 2].
    """

    matrices: Tensor
    joints: Tensor
    in_camera: Tensor
    pixels: Tensor


@dataclasses.dataclass(frozen=True)
class FaceTerm:
    """The two sides of L_sface: the face that was fitted first, and its points on the body."""

    target: FaceTarget
    model: LandmarkModel

    def loss(self, parameters: Parameters) -> Tensor:
        """L_sface, Eq. 4, in millimetres and square millimetres, each term a mean over the face."""
        model = self.model
        points = model.rest + model.shape @ parameters.betas + model.face @ parameters.face_control
        found = sface(points, self.target)
        return sum((SFACE[name] * value.mean() for name, value in found.items()), points.new_zeros(()))


class RegistrationObjective:
    """The loss of a clip as a function of its parameters."""

    def __init__(
        self,
        body: BodyModel,
        observations: Observations,
        model: LandmarkModel,
        views: CameraBatch,
        initial: Parameters,
        movable: Tensor,  # [55]
        settings: FitSettings,
        target: FaceTerm | None = None,
        times: Tensor | None = None,  # [T] float64, of the frames; by default their numbers
    ) -> None:
        """Prepare what does not change during the optimisation."""
        self.target = target
        self.observations, self.model, self.views = observations, model, views
        self.settings, self.initial = settings, initial
        self.start = initial.matrices
        self.movable = movable[:, None, None]
        self.weight = observations.mask * observations.weight
        self.saturation = torch.tensor(_SATURATION)[observations.group]
        self.scale = (LONG_SIDE / views.size.amax(1))[:, None, None]
        numbers = (observations.frames - observations.frames[0]).double()
        self.times = numbers if times is None else times
        names = body.joint_names[:JAW]
        self.joint_limits = joint_limits()
        self.looked_at = torch.unique(torch.cat([self.joint_limits.joint, torch.arange(JAW, HANDS.start)]))
        self.stiffness = torch.tensor([_STIFFNESS.get(name, 0.3) for name in names])
        kinds = (observations.limbs, observations.hand_bones)
        self.bones = [(bones, *_picks(bones, len(observations.group))) for bones in kinds]
        self.shoulders = list(observations.shoulders)
        self.face = observations.of("face") & (model.face.sum(1) > 0)
        self.mirror_face = mirror_matrix(model.rest[self.face])
        self.mirror_joints = mirror_matrix(rest_joints(body, mean_identity(body)))

    @property
    def whole(self) -> Window:
        """The window of all frames."""
        return windows(len(self.times), len(self.times))[0]

    def predict(self, parameters: Parameters, window: Window) -> Prediction:
        """Pose and project the landmarks of a window's frames."""
        matrices = torch.where(self.movable, parameters.matrices, self.start[window.posed])
        points, joints = self.model.posed(parameters, matrices)
        views = self.views.rows(window.posed)
        in_camera = views.to_camera(points)
        return Prediction(matrices, joints, in_camera, views.to_pixels(in_camera))

    def __call__(
        self, parameters: Parameters, robust: bool, window: Window | None = None
    ) -> dict[str, Tensor]:
        """The weighted terms of Eq. 1, each a number; their sum is the loss.

        Args:
            parameters: the unknowns, of the window's posed frames.
            robust: let the error of a point saturate; at the start every point pulls in proportion.
            window: the frames that count; all by default. The losses of windows that cover the clip
                add up to the clip's.
        """
        window = self.whole if window is None else window
        predicted = self.predict(parameters, window)
        share = (window.end - window.begin) / len(self.times)
        settings = self.settings
        return {
            "keypoints": self._mean(self._keypoints(predicted, robust, window), window),
            "directions": self._mean(self._directions(predicted, window), window),
            "in_front": self._mean(self._in_front(predicted, window), window),
            "init": settings.lambda_init
            * (
                self._mean(self._init(parameters, predicted, window), window)
                + share * self._betas(parameters)
            ),
            "sface": share * settings.lambda_sface * self._sface(parameters),
            "sreg": share * settings.lambda_sreg * self._sreg(parameters),
            "smooth": settings.smoothness * self._smooth(parameters, predicted, window),
        }

    def values(self, parameters: Parameters) -> dict[str, float]:
        """The weighted terms of the whole clip as they are at the end of a fit, window by window."""
        total: dict[str, float] = {}
        with torch.no_grad():
            for window in windows(len(self.times), self.settings.minibatch):
                terms_of = self(parameters.rows(window.low, window.high), True, window)
                for name, value in terms_of.items():
                    total[name] = total.get(name, 0.0) + float(value)
        return total

    def residuals(self, parameters: Parameters) -> Tensor:
        """Reprojection errors, [T, N], pixels of the stored frames; NaN where masked."""
        parts = []
        with torch.no_grad():
            for window in windows(len(self.times), self.settings.minibatch):
                predicted = self.predict(parameters.rows(window.low, window.high), window)
                error = (predicted.pixels - self.observations.pixels[window.posed]).norm(dim=-1)
                parts.append(error[window.own])
        error = torch.cat(parts)
        return torch.where(self.observations.mask, error, torch.full_like(error, torch.nan))

    def _mean(self, of_frames: Tensor, window: Window) -> Tensor:
        """The part of a window's own frames in the mean over the clip: [W] -> a number."""
        return of_frames[window.own].sum() / len(self.times)

    def _keypoints(self, predicted: Prediction, robust: bool, window: Window) -> Tensor:
        seen, scale = self.observations, self.scale[window.posed]
        pixels, target = predicted.pixels * scale, seen.pixels[window.posed] * scale
        error = terms.keypoint_loss(
            pixels, target, seen.mask[window.posed], self.saturation if robust else None
        )
        return (error * self.weight[window.posed]).sum(1) / 8

    def _directions(self, predicted: Prediction, window: Window) -> Tensor:
        total = predicted.pixels.new_zeros(len(predicted.pixels))
        for bones, start, end in self.bones:
            unit, weight = bones.unit[window.posed], bones.weight[window.posed]
            loss = terms.direction_loss(start @ predicted.in_camera, end @ predicted.in_camera, unit)
            total = total + (loss * weight).sum(1)
        return total

    def _in_front(self, predicted: Prediction, window: Window) -> Tensor:
        """Hands seen before a chest that faces the camera are in front of it."""
        shoulders = predicted.pixels[:, self.shoulders].detach()
        left, right = shoulders[:, :1, 0], shoulders[:, 1:, 0]
        pixels, margin = predicted.pixels.detach(), 5 / self.scale[window.posed][..., 0]
        over = (pixels[..., 0] > right - margin) & (pixels[..., 0] < left + margin)
        over = over & (pixels[..., 1] > shoulders[..., 1].mean(1, keepdim=True))
        over = over & self.observations.mask[window.posed] & self.observations.hands
        depth = predicted.in_camera[..., 2]
        chest = (depth[:, self.shoulders[0]] + depth[:, self.shoulders[1]]) / 2
        return 20 * (terms.in_front_loss(depth, chest, CHEST_DISTANCE) * over).sum(1)

    def _init(self, parameters: Parameters, predicted: Prediction, window: Window) -> Tensor:
        """L_init, Eq. 3, and the priors on single joints."""
        matrices, start = predicted.matrices, self.start[window.posed]
        pose = terms.rotation_loss(matrices[:, :JAW], start[:, :JAW]) * self.stiffness
        hands = terms.rotation_loss(matrices[:, HANDS], start[:, HANDS])
        expression = terms.initial_loss(parameters.expression, self.initial.expression[window.posed])
        vectors = self._vectors(matrices)
        eyes, jaw = vectors[:, EYES].square(), vectors[:, JAW].square()
        limits = self.joint_limits
        outside = terms.joint_limit_loss(limits.of(vectors), limits.low, limits.high)
        return (
            4 * pose.sum(1)
            + 0.45 * hands.sum(1)
            + EXPRESSION * expression.sum(1)
            + 200 * jaw[:, 1:].sum(1)
            + 5 * eyes.sum((1, 2))
            + 200 * eyes[..., 2].sum(1)
            + 50 * outside.sum(1)
        )

    def _betas(self, parameters: Parameters) -> Tensor:
        """L_init, Eq. 3, of the shape."""
        return INITIAL_BETAS * terms.initial_loss(parameters.betas, self.initial.betas).sum()

    def _vectors(self, matrices: Tensor) -> Tensor:
        """Rotation vectors of the joints that a prior looks at, zero for the others: [W, 55, 3]."""
        vectors = roma.rotmat_to_rotvec(matrices[:, self.looked_at])
        return vectors.new_zeros(len(matrices), 55, 3).index_copy(1, self.looked_at, vectors)

    def _sface(self, parameters: Parameters) -> Tensor:
        """L_sface, Eq. 4; zero where no face was fitted."""
        return parameters.betas.new_zeros(()) if self.target is None else self.target.loss(parameters)

    def _sreg(self, parameters: Parameters) -> Tensor:
        """L_sreg, Eq. 5, and the length of the face offsets."""
        face_offset = self.model.face[self.face] @ parameters.face_control
        return (
            SHAPE * terms.shape_loss(parameters.betas).sum()
            + JOINT_OFFSET * terms.joint_offset_loss(parameters.joint_offset).sum()
            + JOINT_OFFSET * terms.symmetry_loss(parameters.joint_offset, self.mirror_joints).sum()
            + FACE_LENGTH * terms.face_offset_loss(face_offset).sum()
            + 500 * terms.symmetry_loss(face_offset, self.mirror_face).sum()
        )

    def _smooth(self, parameters: Parameters, predicted: Prediction, window: Window) -> Tensor:
        """Accelerations of joints and place, and a little velocity of everything."""
        times, own, transl = self.times[window.posed], window.differences, parameters.transl
        placed = terms.acceleration(predicted.joints - transl[:, None], times)[own].square()
        moved = terms.acceleration(transl, times)[own].square()
        turned = (
            terms.velocity(predicted.matrices, times)[own].square().sum((2, 3)) / 2
        )  # squared angle, nearly
        joints = turned.new_full((55,), 1.0)
        joints[0], joints[BODY_POSE], joints[JAW], joints[EYES] = 10.0, 3.0, 2.0, 0.5
        changed = terms.velocity(parameters.expression, times)[own].square()
        total = 200 * (placed.sum() + moved.sum()) + (turned * joints).sum() + 0.05 * changed.sum()
        return total / len(self.times)


def _picks(bones: Directions, count: int) -> tuple[Tensor, Tensor]:
    """Matrices [L, N] that pick the bones' starts and ends."""
    one_hot = torch.nn.functional.one_hot
    return one_hot(bones.start, count).float(), one_hot(bones.end, count).float()
