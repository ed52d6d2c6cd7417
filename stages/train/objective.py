"""The training objective (paper, Equation 9; supplement D): a few drawn frames to weighted terms."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import torch
from torch import Tensor

from pipeline.avatar import Avatar, Decoded, Posed
from pipeline.body import Pose
from pipeline.clip.composite import over
from pipeline.clip.views import View
from pipeline.device import moved
from pipeline.metrics import Lpips, ssim_loss
from pipeline.splat import Rendering, render
from stages.train import losses, schedule
from stages.train.data import TrainingData
from stages.train.face import face_loss, face_triangles, paste
from stages.train.frame_visibility_cache import FrameVisibilityCache
from stages.train.perceptual import crop, due, perceptual
from stages.train.poses import PoseRefinement
from stages.train.regularisers import Regularisers
from stages.train.settings import TrainSettings

Terms = dict[str, Tensor]
FrameHook = Callable[[Pose, View], None]
"""Called with the pose in which a frame was rendered, and the frame."""


@dataclasses.dataclass(frozen=True)
class Draw:
    """The random values of one draw of a frame. Equal positions in a run draw equally.

    Attributes:
        position: which draw of the run this is.
        frame: its number.
        background: [3], the colour behind the person.
        noise: [54 * 6], added to what the heads are told of the pose.
        time: seconds that the residual heads are told; None where they are told none.
        place: in [0, 1), where on the person LPIPS looks.
    """

    position: int
    frame: int
    background: Tensor
    noise: Tensor
    time: float | None
    place: float


class Objective:
    """The terms of one optimiser step.

    Attributes:
        avatar, poses: what is trained.
        data: what it is compared with.
        texture: [N, 3], the data's, where the avatar is; None where no term asks for it.
        settings: the weights.
        on_frame: called after each rendering, if there is one.
        visibility_cache: which Gaussians each frame showed when it was last drawn.
    """

    def __init__(
        self,
        avatar: Avatar,
        poses: PoseRefinement,
        data: TrainingData,
        settings: TrainSettings,
        network: Lpips | None = None,
    ):
        """The objective on the avatar's device; renders nothing yet.

        Args:
            avatar: what is trained; everything else goes where it is.
            poses: fitted; they move if they are refined.
            data: the training frames, with a texture if the face loss has a weight.
            settings: the weights.
            network: LPIPS; must be given if it has a weight.

        Raises:
            ValueError: a term has a weight and not what it needs.
        """
        if settings.lpips and network is None:
            raise ValueError("the LPIPS term needs its network")
        if settings.face and data.texture is None:
            raise ValueError("the face term needs a texture")
        self.avatar, self.poses, self.settings = avatar, poses, settings
        self.data, self.regularisers = data, Regularisers(settings)
        self.texture = moved(data.texture, avatar.device)
        self.network = None if network is None else network.to(avatar.device)
        self.on_frame: FrameHook | None = None
        count = len(avatar.surfaces[-1].canonical)
        self.visibility_cache = FrameVisibilityCache(data.frames, count).to(avatar.device)

    def __call__(self, iteration: int, level: int, poses_move: bool) -> Terms:
        """The weighted terms, averaged over the frames of the step.

        Args:
            iteration: which step of the run.
            level: of subdivision.
            poses_move: whether the refined poses are used, so that gradients reach them.
        """
        decoded, batch = self.avatar.decode(level), self.settings.batch
        draws = [self.draw(iteration * batch + place) for place in range(batch)]
        total: Terms = {}
        for draw in draws:
            for name, value in self._frame_terms(decoded, draw, level, poses_move).items():
                total[name] = total.get(name, torch.zeros_like(value)) + value / batch
        return {**total, **self.regularisers.static(decoded)}

    def draw(self, position: int) -> Draw:
        """Everything random about the ``position``-th drawn frame of the run."""
        settings, seed = self.settings, self.settings.seed
        frame = schedule.drawn_of_two(seed, *self.data.sources, settings.generated_every, position)
        timeless = schedule.drawn_share(seed, schedule.TIME, position) < settings.time_dropout
        length = 6 * (self.poses.poses.rotation.shape[1] - 1)
        device = self.avatar.device
        return Draw(
            position=position,
            frame=frame,
            background=schedule.drawn_background(seed, position).to(device),
            noise=settings.pose_noise * schedule.drawn_noise(seed, position, length).to(device),
            time=None if timeless else self.data.clip.seconds.get(frame),
            place=schedule.drawn_share(seed, schedule.CROP, position),
        )

    def _frame_terms(self, decoded: Decoded, draw: Draw, level: int, poses_move: bool) -> Terms:
        settings, view = self.settings, moved(self.data.view(draw.frame), self.avatar.device)
        pose = self.poses(draw.frame) if poses_move else self.poses.fitted(draw.frame)
        posed = self._pose(decoded, pose, draw, level)
        rendering = render(posed.gaussians, view.camera)
        self.visibility_cache.record(draw.frame, level, rendering.weights, decoded.surface.rows)
        if self.on_frame is not None:
            self.on_frame(pose, view)
        terms = {**self._photometric(rendering, view, draw), **self.regularisers.posed(decoded, posed)}
        if settings.face and not view.generated:
            terms["face"] = settings.face * self._face_term(decoded, posed, view)
        if settings.pose_change and poses_move and not view.generated:
            terms["pose_change"] = settings.pose_change * self.poses.change(draw.frame)
        return terms

    def _pose(self, decoded: Decoded, pose: Pose, draw: Draw, level: int) -> Posed:
        surface, rows = decoded.surface, None
        if self.settings.pose_seen_only:
            count = len(surface.canonical)
            rows = self.visibility_cache.visible_rows(draw.frame, level, count, surface.rows)
        return self.avatar.pose(decoded, pose, draw.noise, draw.time, rows)

    def _photometric(self, rendering: Rendering, view: View, draw: Draw) -> Terms:
        """L1, SSIM and LPIPS between rendering and frame, both over the drawn background."""
        settings = self.settings
        image = over(rendering.color, rendering.alpha, draw.background)
        target = view.composite(draw.background)
        if view.trust is not None:
            image = losses.blend_to_target(image, target, view.trust)
        weights = (settings.l1, settings.ssim, settings.lpips)
        l1, ssim, lpips = (settings.generated if view.generated and one else one for one in weights)
        terms = {"l1": l1 * losses.l1(image, target), "ssim": ssim * ssim_loss(image, target)}
        if self.network is not None and lpips and self._lpips_due(draw):
            place = crop(view.alpha, settings.lpips_crop, draw.place)
            # As many times the weight, so that its mean over the run is that of a term of every frame.
            distance = perceptual(self.network, image, target, place)
            terms["lpips"] = lpips * settings.lpips_every * distance
        return terms

    def _lpips_due(self, draw: Draw) -> bool:
        settings = self.settings
        begun = schedule.begun(settings, settings.lpips_from, draw.position // settings.batch)
        return begun and due(draw.position, settings.lpips_every)

    def _face_term(self, decoded: Decoded, posed: Posed, view: View) -> Tensor:
        if self.texture is None:
            raise ValueError("the face term needs a texture")
        canonical, means = decoded.surface.canonical, posed.gaussians.means
        chosen, texture = face_triangles(canonical), decoded.surface.pick(self.texture)
        return face_loss(paste(view.camera, means, canonical.faces, chosen, texture), view.color, view.alpha)
