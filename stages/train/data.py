"""The data that an avatar is learnt from: the fitted clip, and generated frames beside the captured ones."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from torch import Tensor

from pipeline.body import BodyModel, Poses
from pipeline.clip.fitted_clip import FittedClip, read_fitted_clip
from pipeline.clip.views import View, ViewCache
from stages.train.generated import GeneratedFrames, joined, read_generated
from stages.train.scene import BackgroundPlate


@dataclasses.dataclass(frozen=True)
class TrainingData:
    """The fitted clip as training reads it.

    Attributes:
        clip: the captured frames and the fitted person.
        crops: captured frames around the person.
        whole: captured frames, uncropped.
        generated: frames that a model made of sides the camera never saw, if there are any.
        drawn: the captured frames that are drawn; all of the split's if None.
        texture: [N, 3], the mean colour that the training frames show at each Gaussian; None where
            no term asks for it.
        scene: what is behind the person in the crops; None where it moves or no term asks for it.
    """

    clip: FittedClip
    crops: ViewCache
    whole: ViewCache
    generated: GeneratedFrames | None = None
    drawn: tuple[int, ...] | None = None
    texture: Tensor | None = None  # [N, 3]
    scene: BackgroundPlate | None = None

    @property
    def sources(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """The captured and the generated frames, drawn as ``train.generated_every`` says."""
        captured = self.clip.split.train if self.drawn is None else self.drawn
        return captured, self.generated.frames if self.generated else ()

    @property
    def frames(self) -> tuple[int, ...]:
        """Every frame that is learnt from, captured and generated."""
        captured, made = self.sources
        return (*captured, *made)

    @property
    def poses(self) -> Poses:
        """The poses of captured and generated frames."""
        return joined(self.clip.poses, self.generated.poses) if self.generated else self.clip.poses

    def view(self, frame: int) -> View:
        """The crop of a captured frame, or a generated frame as it is."""
        made = self.generated
        return self.crops[frame] if made is None or frame not in made.frames else made.view(frame)


def read_training_data(
    ingest: Path, fit: Path, auxiliary: Path | None, body: BodyModel | Path, margin: int
) -> TrainingData:
    """The training data that ingest, fit and auxiliary published, checked.

    Args:
        ingest, fit, auxiliary: the folders of the stages; None where there are no generated frames.
        body: the body model that the clip was fitted with, or its file.
        margin: pixels around the person that the crops show.

    Raises:
        UserError: as of ``read_fitted_clip`` and ``read_generated``, or no mask shows anybody.
    """
    clip = read_fitted_clip(ingest, fit, body)
    return TrainingData(
        clip=clip,
        crops=clip.cached_views(clip.person_box(margin)),
        whole=clip.cached_views(),
        generated=read_generated(auxiliary, clip.poses),
    )
