"""The training objective: the table of its terms, and their sum over the frames of a step.

The paper's Equation 9, with the weights of its supplement D::

    L = lambda_L1 L_1 + lambda_ssim L_ssim + lambda_lpips L_lpips + lambda_face L_face + lambda_reg L_reg

``FRAME_TERMS`` are taken of every drawn frame, ``STATIC_TERMS`` once a step; L_reg is everything below the
pictures. A row says which loss (``losses.py``) is taken of what (``rendered_frame.py``), which settings weigh
it, and which setting says from when. A term without a weight is not computed.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor

from pipeline.avatar import Avatar, Decoded, Surface
from pipeline.body import Pose
from pipeline.clip.views import View
from pipeline.device import moved
from pipeline.metrics import Lpips, ssim_loss
from pipeline.splat import render
from stages.train import losses, schedule
from stages.train.body_regions import PartWeights, Regions, find_regions, weighted_by
from stages.train.data import TrainingData
from stages.train.frame_visibility_cache import FrameVisibilityCache
from stages.train.poses import PoseRefinement
from stages.train.rendered_frame import RenderedFrame, StaticAvatar
from stages.train.schedule import Draw
from stages.train.settings import TrainSettings

TRUST = {"color": 0, "shape": 1}  # columns of ``Avatar.trust``

Source = TypeVar("Source", StaticAvatar, RenderedFrame)
Terms = dict[str, Tensor]


@dataclasses.dataclass(frozen=True)
class Term(Generic[Source]):
    """One row of the objective.

    Attributes:
        name: in messages and in curve.parquet.
        loss: what is computed; its values are unreduced.
        of: its arguments; the term is left out where one of them is None.
        weight: the setting that weighs it.
        hands, face, scalp: the settings that weigh it on these parts instead, a vertex at a time.
        smooths: it counts more, a vertex at a time, where evidence of what it smooths is weak: "color" or
            "shape"; not at all differently if empty.
        generated: the setting that weighs it on generated frames instead.
        captured_only: it is not taken of generated frames.
        since: the setting with the fraction of the run from which it takes part; from the start if empty.
        needs: the setting without which it is not taken.
        share: which part of the weight it has in a frame; all of it if None.
        times: the setting with how many renderings of a frame it stands for; of generated frames always the
            pictures'.
        every: the setting with the draws for one that it is taken of, with as many times the weight, so
            that its mean over the run is that of a term of every draw.
        mask: weights of single values.
        count: what the values' sum is divided by; their number if None.
    """

    name: str
    loss: Callable[..., Tensor]
    of: Callable[[Source], tuple[Any, ...]]
    weight: str
    hands: str = ""
    face: str = ""
    scalp: str = ""
    smooths: str = ""
    generated: str = ""
    captured_only: bool = False
    since: str = ""
    times: str = ""
    every: str = ""
    mask: Callable[[Source], Tensor | None] | None = None
    count: Callable[[Source], int] | None = None
    needs: str = ""
    share: Callable[[Source], float] | None = None

    @property
    def by_part(self) -> bool:
        """True where each vertex has the weight of its body part."""
        return bool(self.hands or self.face or self.scalp)

    @property
    def weights(self) -> tuple[str, ...]:
        """The settings that weigh it on captured frames."""
        return tuple(name for name in (self.weight, self.hands, self.face, self.scalp) if name)

    def part_weights(self, settings: TrainSettings) -> PartWeights:
        """The weights on hands, face, scalp and elsewhere."""
        names = (self.hands, self.face, self.scalp, self.weight)
        hands, face, scalp, elsewhere = (getattr(settings, name or self.weight) for name in names)
        return hands, face, scalp, elsewhere

    def scalar_weight(self, settings: TrainSettings, generated: bool) -> float:
        """The factor of its weighted mean; 1 where vertices have weights of their own."""
        if self.by_part:
            return 1.0
        made = bool(generated and self.generated and not settings.generated_as_captured)
        weight: float = getattr(settings, self.generated if made else self.weight)
        if self.times:
            weight *= settings.renderings if made else getattr(settings, self.times)
        return weight * getattr(settings, self.every) if self.every else weight

    def first_iteration(self, settings: TrainSettings) -> int | None:
        """The first iteration that it takes part in; None where it has no weight or never begins."""
        if not any(getattr(settings, name) for name in self.weights):
            return None
        if self.needs and not getattr(settings, self.needs):
            return None
        return schedule.first_iteration(settings, getattr(settings, self.since)) if self.since else 0

    def takes_part(self, settings: TrainSettings, iteration: int, position: int, generated: bool) -> bool:
        """True where it is computed.

        Args:
            settings: the weights.
            iteration: of the run.
            position: which draw of the run the frame is.
            generated: the frame is no captured one.
        """
        first = self.first_iteration(settings)
        if first is None or iteration < first or (self.captured_only and generated):
            return False
        return not self.every or position % int(getattr(settings, self.every)) == 0


# fmt: off
FRAME_TERMS: tuple[Term[RenderedFrame], ...] = (
    # Pictures over the drawn background: L_1, L_ssim and L_lpips
    Term("l1", losses.l1, lambda f: (f.image, f.target), "l1", generated="generated",
         times="l1_renderings", share=lambda f: f.color_share),
    Term("l1_scene", losses.l1, lambda f: f.over_scene or (None,), "l1", times="l1_renderings",
         captured_only=True, needs="scene_share", share=lambda f: f.scene_share),
    Term("ssim", ssim_loss, lambda f: f.pictures, "ssim", generated="generated",
         times="renderings"),
    Term("lpips", losses.lpips, lambda f: (f.network, *f.crops), "lpips", generated="generated",
         since="lpips_from", times="renderings", every="lpips_every"),
    # L_reg of what is rendered, by body part (Section 3.6; ExAvatar)
    Term("laplacian_scale", losses.laplacian, lambda f: (f.compared_scale, f.neighbours),
         "laplacian_scale", face="laplacian_scale_face", smooths="shape", mask=lambda f: f.unmixed),
    Term("laplacian_color", losses.laplacian, lambda f: (f.colors, f.neighbours),
         "laplacian_color", hands="laplacian_color_hands", smooths="color", mask=lambda f: f.unmixed),
    Term("scale_size", losses.l2, lambda f: (f.posed.gaussians.scales,),
         "scale_size", hands="scale_size_hands", face="scale_size_face"),
    Term("scale_shrink", losses.scale_shrink, lambda f: (f.posed.log_scale,), "scale_shrink"),
    Term("scale_growth", losses.scale_growth, lambda f: (f.posed.log_scale,), "scale_growth"),
    Term("pose_scale", losses.l2, lambda f: (f.scale_change,),
         "pose_scale", hands="pose_scale_hands", face="pose_scale_face", since="pose_heads_from"),
    Term("hand_color", losses.color_variance, lambda f: (f.regions.on_hands(f.colors),), "hand_color"),
    Term("arm_color", losses.l2, lambda f: (f.underside_contrast,), "arm_color"),
    Term("laplacian_pose_offset", losses.laplacian, lambda f: (f.offset, f.neighbours),
         "laplacian_offset", face="laplacian_offset_face", smooths="shape", since="pose_heads_from",
         mask=lambda f: f.unmixed),
    Term("pose_offset", losses.l2, lambda f: (f.posed.pose_offset,), "pose_offset", since="pose_heads_from"),
    Term("residual_size", losses.l2, lambda f: (f.posed.color_residual,), "residual_size",
         since="residual_from"),
    # L_face: the face in its mean texture, where it covers the person; a mean over the whole crop
    Term("face", losses.l1, lambda f: (f.face.color, f.face.pixels_of(f.view.color)), "face",
         times="renderings", captured_only=True, mask=lambda f: f.face.pixels_of(f.view.alpha)[:, None],
         count=lambda f: f.view.color.numel()),
    Term("pose_change", losses.l2, lambda f: (f.pose_change,), "pose_change", captured_only=True,
         since="refine_from"),
)
STATIC_TERMS: tuple[Term[StaticAvatar], ...] = (
    Term("laplacian_offset", losses.laplacian, lambda s: (s.decoded.offset, s.neighbours),
         "laplacian_offset", face="laplacian_offset_face", smooths="shape"),
    Term("offset", losses.l2, lambda s: (s.decoded.offset,), "offset", hands="offset_hands",
         face="offset_face", scalp="offset_scalp"),
    Term("joint_change", losses.l2, lambda s: (s.joint_change,), "joint_change"),
    Term("joint_symmetry", losses.size, lambda s: (s.joint_asymmetry,), "joint_symmetry"),
    Term("hand_normal", losses.outward_offset,
         lambda s: (s.regions.on_hands(s.decoded.offset), s.regions.on_hands(s.normals)), "hand_normal"),
)
# fmt: on
TERMS: tuple[Term[Any], ...] = (*FRAME_TERMS, *STATIC_TERMS)


def describe_objective(settings: TrainSettings) -> str:
    """The terms that take part, each with its weights and first iteration: a line for the log."""
    found = []
    for term in TERMS:
        first = term.first_iteration(settings)
        if first is not None:
            weights = "/".join(f"{getattr(settings, name):g}" for name in term.weights)
            found.append(f"{term.name} {weights}" + (f" from iteration {first}" if first else ""))
    return "objective: " + ", ".join(found)


class TrainingObjective:
    """The weighted terms of one optimiser step.

    Attributes:
        avatar, poses: what is trained.
        data: what it is compared with.
        settings: the weights.
        texture: [N, 3], the data's, where the avatar is; None where no term asks for it.
        scene: behind the person, the data's, where the avatar is; None where it is not compared.
        network: LPIPS; None where it has no weight.
        on_frame: called with each rendered frame's pose and view.
        visibility_cache: which Gaussians each frame showed when it was last drawn.
    """

    def __init__(
        self,
        avatar: Avatar,
        poses: PoseRefinement,
        data: TrainingData,
        settings: TrainSettings,
        network: Lpips | None = None,
        on_frame: Callable[[Pose, View], None] = lambda pose, view: None,
    ):
        """The objective on the avatar's device; renders nothing yet.

        Args:
            avatar: what is trained; everything else goes where it is.
            poses: fitted; they move if they are refined.
            data: the training frames, with a texture if the face loss has a weight.
            settings: the weights.
            network: LPIPS; must be given if it has a weight.
            on_frame: called with the pose in which a frame was rendered, and the frame.

        Raises:
            ValueError: a term has a weight and not what it needs.
        """
        if settings.lpips and network is None:
            raise ValueError("the LPIPS term needs its network")
        if settings.face and data.texture is None:
            raise ValueError("the face term needs a texture")
        self.avatar, self.poses, self.data, self.settings = avatar, poses, data, settings
        self.texture = moved(data.texture, avatar.device)
        self.scene = None if data.scene is None else data.scene.to(avatar.device)
        self.network = None if network is None else network.to(avatar.device)
        self.on_frame = on_frame
        count = len(avatar.surfaces[-1].canonical)
        self.visibility_cache = FrameVisibilityCache(data.frames, count).to(avatar.device)
        self._last_regions: tuple[Surface, Regions] | None = None

    def __call__(self, iteration: int, level: int, poses_move: bool) -> Terms:
        """The weighted terms by name, averaged over the frames of the step; scalars.

        Args:
            iteration: which step of the run.
            level: of subdivision.
            poses_move: the refined poses are used, so that gradients reach them.
        """
        decoded, batch = self._decode(level), self.settings.batch
        total: Terms = {}
        for position in range(iteration * batch, (iteration + 1) * batch):
            frame = self._render(decoded, self.draw(position), level, poses_move)
            terms = self._evaluate(FRAME_TERMS, frame, iteration, position, frame.view.generated)
            for name, value in terms.items():
                total[name] = total.get(name, torch.zeros_like(value)) + value / batch
        identity = self.avatar.identity_change
        static = StaticAvatar(decoded=decoded, regions=self._regions(decoded.surface), identity=identity)
        return {**total, **self._evaluate(STATIC_TERMS, static, iteration)}

    def draw(self, position: int) -> Draw:
        """Everything random about the ``position``-th drawn frame of the run."""
        noise = 6 * (self.poses.poses.rotation.shape[1] - 1)
        seconds = self.data.clip.seconds
        drawn = schedule.make_draw(self.settings, self.data.sources, seconds, noise, position)
        return moved(drawn, self.avatar.device)

    def _decode(self, level: int) -> Decoded:
        """The static avatar; pictures do not teach the colours of Gaussians that no frame shows.

        A little light passes between Gaussians, and what lies behind them, the back of a head, would learn
        the face in front.
        """
        decoded = self.avatar.decode(level)
        if self.settings.unseen == "generated":  # as training leaves it
            return decoded
        shown = decoded.surface.pick(self.avatar.trust)[:, :1] > 0
        logits = decoded.color_logit
        return dataclasses.replace(decoded, color_logit=torch.where(shown, logits, logits.detach()))

    def _render(self, decoded: Decoded, draw: Draw, level: int, poses_move: bool) -> RenderedFrame:
        """A drawn frame beside its rendering."""
        view = moved(self.data.view(draw.frame), self.avatar.device)
        pose = self.poses(draw.frame) if poses_move else self.poses.fitted(draw.frame)
        surface, rows = decoded.surface, None
        if self.settings.pose_seen_only:
            count = len(surface.canonical)
            rows = self.visibility_cache.visible_rows(draw.frame, level, count, surface.rows)
        posed = self.avatar.pose(decoded, pose, draw.noise, draw.time, rows)
        rendering = render(posed.gaussians, view.camera)
        if self.settings.pose_seen_only:
            self.visibility_cache.record(draw.frame, level, rendering.weights, surface.rows)
        self.on_frame(pose, view)
        return RenderedFrame(
            decoded=decoded,
            regions=self._regions(surface),
            draw=draw,
            view=view,
            posed=posed,
            rendering=rendering,
            refinement=self.poses if poses_move else None,
            texture=self.texture,
            network=self.network,
            crop_side=self.settings.lpips_crop,
            metres=self.settings.scale_smoothness == "metres",
            scene=self.scene,
            scene_share=self.settings.scene_share,
        )

    def _evaluate(
        self,
        terms: Sequence[Term[Source]],
        source: Source,
        iteration: int,
        position: int = 0,
        generated: bool = False,
    ) -> Terms:
        """The weighted scalars of the terms that take part; the arguments are those of ``takes_part``."""
        found: Terms = {}
        for term in terms:
            if not term.takes_part(self.settings, iteration, position, generated):
                continue
            mean = _reduced(term, source)
            if mean is not None:
                weight = term.scalar_weight(self.settings, generated)
                found[term.name] = (weight if term.share is None else weight * term.share(source)) * mean
        return found

    def _regions(self, surface: Surface) -> Regions:
        """The regions of a surface, computed once until another takes its place."""
        if self._last_regions is None or self._last_regions[0] is not surface:
            by_part = {term.name: term.part_weights(self.settings) for term in TERMS if term.by_part}
            arms = bool(self.settings.arm_color)
            regions = find_regions(surface.canonical, by_part, arms)
            doubt = 1 + self.settings.weak_smoothness * (1 - surface.pick(self.avatar.trust))
            factors = {term.name: doubt[:, TRUST[term.smooths], None] for term in TERMS if term.smooths}
            self._last_regions = surface, weighted_by(regions, factors)
        return self._last_regions[1]


def _reduced(term: Term[Source], source: Source) -> Tensor | None:
    """The mean of a term's loss, weighted by its mask and by body part; None where an operand is missing."""
    operands = term.of(source)
    if any(operand is None for operand in operands):
        return None
    weight, mask = source.regions.weights.get(term.name), term.mask(source) if term.mask else None
    if mask is not None:
        weight = mask if weight is None else mask * weight
    count = term.count(source) if term.count else None
    return losses.weighted_mean(term.loss(*operands), weight, count)
