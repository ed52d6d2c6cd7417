"""The metrics of one picture of one frame against the truth: a pure function for each group of them.

PSNR, SSIM, LPIPS and flicker themselves are in :mod:`pipeline.metrics`; here they get the names that stand
in the table of scores.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping
from functools import cached_property, partial
from pathlib import Path
from typing import Protocol
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor

from pipeline.clip.boxes import Box
from pipeline.clip.composite import BACKGROUNDS, BLACK, WHITE, cut_out, to_bytes
from pipeline.config.evaluation_protocol import OWN, TRUTH
from pipeline.finite import require_finite
from pipeline.metrics.arcface import ArcFace, five_points
from pipeline.metrics.face_identity import RecognizedFace, identity_cosine, identity_distance
from pipeline.metrics.lpips import Lpips
from pipeline.metrics.psnr import psnr
from pipeline.metrics.regions import interior, person
from pipeline.metrics.ssim import ssim
from stages.evaluate.methods import OnBackground

FACE_MARGIN = 0.5  # of the face crop's size, around it, for the face finder


class FaceEmbedder(Protocol):
    """Finds and embeds a face; :class:`pipeline.metrics.face_identity.FaceRecognizer` is one."""

    def read(self, image: np.ndarray, box: Box | None = None) -> RecognizedFace | None:
        """The face in [H, W, 3] uint8 RGB, or None."""


class AlignedFaceEmbedder(Protocol):
    """Embeds a face by where its points are; :class:`pipeline.metrics.arcface.ArcFace` is one."""

    def embed(self, image: np.ndarray, points: np.ndarray) -> np.ndarray:
        """The embedding of the face in [H, W, 3] uint8 RGB whose five points are [5, 2], pixels."""


def open_arcface(file: str, protocol: str, log: Callable[[str], None]) -> ArcFace | None:
    """ArcFace from its ONNX file; None where none is named; under the paper's protocols the log says so."""
    if file:
        return ArcFace(Path(file))
    if protocol != "ours":
        log("faces are not compared (FC): evaluate.arcface=FILE names ArcFace's ONNX file")
    return None


@dataclasses.dataclass(frozen=True)
class ScoredPicture:
    """An image with the features that LPIPS compares, so that they are computed once.

    Attributes:
        image: [H, W, 3] float in [0, 1], on the background of the scorer.
        black: [H, W, 3], the same on black, where interiors are measured.
        features: LPIPS backbone -> its features.
    """

    image: Tensor  # [H, W, 3]
    black: Tensor  # [H, W, 3]
    features: Mapping[str, list[Tensor]]


class Scorer:
    """Composites pictures as a protocol says and compares them, with the LPIPS backbones that are loaded.

    Attributes:
        networks: LPIPS backbone -> the network.
        background: what all pictures are composited on, one of ``BACKGROUNDS``.
        render_mask: whose mask cuts pictures out: ``OWN`` or ``TRUTH``.
    """

    def __init__(
        self, networks: Mapping[str, Lpips], background: str = BLACK, render_mask: str = OWN
    ) -> None:
        self.networks, self.background, self.render_mask = networks, background, render_mask
        # A picture is forgotten with the object that it was made of.
        self._known: WeakKeyDictionary[OnBackground, ScoredPicture] = WeakKeyDictionary()

    @property
    def metrics(self) -> tuple[str, ...]:
        """The names of the metrics, in the order of the tables."""
        return ("psnr", "psnr_interior", "ssim", *(f"lpips_{name}" for name in self.networks))

    @torch.no_grad()
    def picture(self, image: Tensor, black: Tensor | None = None) -> ScoredPicture:
        """An image made ready.

        Args:
            image: [H, W, 3] float in [0, 1], on the background.
            black: the same on black; the image itself if None.

        Raises:
            NotFiniteError: a pixel is not a number.
        """
        require_finite({"a picture": image}, "scoring", "before any metric", "run the train stage again")
        features = {name: network.features(image) for name, network in self.networks.items()}
        return ScoredPicture(image, image if black is None else black, features)

    def composited(self, picture: OnBackground) -> ScoredPicture:
        """A picture on the protocol's background, made ready; the same object is not made ready twice."""
        if picture not in self._known:
            black = None if self.background == BLACK else picture(BLACK)
            self._known[picture] = self.picture(picture(self.background), black)
        return self._known[picture]

    def cut(self, picture: OnBackground, mask: np.ndarray) -> ScoredPicture:
        """The same, cut out by the true mask [H, W] uint8 where the protocol says so."""
        if self.render_mask != TRUTH:
            return self.composited(picture)
        return self.composited(partial(cut_out, picture(BLACK), picture(WHITE), mask))

    def crops(self, picture: ScoredPicture, boxes: Iterable[Box]) -> list[ScoredPicture]:
        """Parts of a picture, each made ready by itself."""
        parts = [box.slices for box in boxes]
        return [self.picture(picture.image[part], picture.black[part]) for part in parts]

    @torch.no_grad()
    def values(
        self, picture: ScoredPicture, truth: ScoredPicture, interior: Tensor, person: Tensor | None = None
    ) -> dict[str, float]:
        """Every metric of a whole picture.

        Args:
            picture: what is scored.
            truth: the person.
            interior: [H, W] bool, see :func:`pipeline.metrics.regions.interior`.
            person: [H, W] bool, the person's pixels; without ``psnr_person`` if None.

        Returns:
            Metric -> value; ``psnr_interior`` and ``psnr_person`` are NaN where there is no such pixel.
        """
        values = {
            "psnr": psnr(picture.image, truth.image),
            "psnr_interior": psnr(picture.black, truth.black, interior),
            "ssim": ssim(picture.image, truth.image, BACKGROUNDS[self.background]),
        }
        if person is not None:
            values["psnr_person"] = psnr(picture.black, truth.black, person)
        return values | lpips_metrics(self.networks, picture, truth)

    @torch.no_grad()
    def crop_values(
        self, region: str, crops: list[ScoredPicture], truths: list[ScoredPicture]
    ) -> dict[str, float]:
        """PSNR, SSIM and LPIPS of a region, the mean over its crops: ``psnr_face`` and so on."""
        found = []
        for crop, truth in zip(crops, truths, strict=True):
            values = {
                "psnr": psnr(crop.image, truth.image),
                "ssim": ssim(crop.image, truth.image, BACKGROUNDS[self.background]),
            }
            found.append(values | lpips_metrics(self.networks, crop, truth))
        return {f"{name}_{region}": math.fsum(one[name] for one in found) / len(found) for name in found[0]}


@dataclasses.dataclass(frozen=True)
class FrameTruth:
    """The person in a frame, with which each method's picture of it is compared.

    Attributes:
        frame: number in the source clip.
        split: one of ``SPLITS``.
        view: empty, or ``OTHER_CAMERA``.
        scorer: the metrics.
        picture: the person.
        on: the person before it is composited.
        mask: [H, W] uint8, soft alpha.
        boxes: region -> its crops.
        points: [133, 3], what was detected in the frame, pixels and scores; None where nothing was.
    """

    frame: int
    split: str
    view: str
    scorer: Scorer
    picture: ScoredPicture
    on: OnBackground
    mask: np.ndarray  # [H, W]
    boxes: Mapping[str, list[Box]]
    points: np.ndarray | None = None

    @cached_property
    def interior(self) -> Tensor:
        """[H, W] bool, the eroded mask."""
        return interior(self.mask)

    @cached_property
    def person(self) -> Tensor:
        """[H, W] bool, the mask."""
        return person(self.mask)

    @cached_property
    def crops(self) -> dict[str, list[ScoredPicture]]:
        """Region -> its crops of the truth."""
        return {region: self.scorer.crops(self.picture, boxes) for region, boxes in self.boxes.items()}


def picture_metrics(picture: ScoredPicture, truth: FrameTruth) -> dict[str, float]:
    """The metrics of the whole picture and of its crops of face and hands."""
    values = truth.scorer.values(picture, truth.picture, truth.interior, truth.person)
    for region, crops in truth.crops.items():
        own = truth.scorer.crops(picture, truth.boxes[region])
        values |= truth.scorer.crop_values(region, own, crops)
    return values


def lpips_metrics(
    networks: Mapping[str, Lpips], picture: ScoredPicture, truth: ScoredPicture
) -> dict[str, float]:
    """``lpips_alex`` and so on, of the backbones that are loaded."""
    return {
        f"lpips_{name}": float(network.distance(picture.features[name], truth.features[name]))
        for name, network in networks.items()
    }


def composite_metrics(picture: OnBackground, truth: FrameTruth) -> dict[str, float]:
    """PSNR under every composite, on either background by the picture's own alpha or the truth's mask.

    Returns:
        ``psnr_black_own``, ``psnr_black_truth``, ``psnr_white_own`` and ``psnr_white_truth``.
    """
    black, white = picture(BLACK), picture(WHITE)
    values = {}
    for background, own in ((BLACK, black), (WHITE, white)):
        true = truth.on(background)
        values[f"psnr_{background}_{OWN}"] = psnr(own, true)
        values[f"psnr_{background}_{TRUTH}"] = psnr(cut_out(black, white, truth.mask, background), true)
    return values


def face_metrics(
    embedder: FaceEmbedder, pictures: Mapping[str, Tensor], truth: FrameTruth
) -> dict[str, dict[str, float]]:
    """The distance of each method's face from the true one of the frame (the paper's face consistency).

    Args:
        embedder: finds and embeds faces.
        pictures: method -> [H, W, 3] float in [0, 1].
        truth: of the frame.

    Returns:
        Method -> ``identity_found``, 1 or 0, and where a face was found ``identity_distance`` and
        ``identity_cosine``; empty where the true frame shows no face.
    """
    boxes = truth.boxes.get("face")
    if not boxes:
        return {}
    face = boxes[0]
    box = face.widened(round(FACE_MARGIN * max(face.width, face.height)))
    true = embedder.read(to_bytes(truth.picture.image), box)
    if true is None:
        return {}
    found = {}
    for method, picture in pictures.items():
        shown = embedder.read(to_bytes(picture), box)
        found[method] = {"identity_found": float(shown is not None)}
        if shown is not None:
            found[method]["identity_distance"] = identity_distance(shown.embedding, true.embedding)
            found[method]["identity_cosine"] = identity_cosine(shown.embedding, true.embedding)
    return found


def arcface_metrics(
    arcface: AlignedFaceEmbedder, pictures: Mapping[str, Tensor], truth: FrameTruth
) -> dict[str, dict[str, float]]:
    """The paper's FC (supplement E.2): the cosine of ArcFace's embeddings of a method's face and the true.

    Args:
        arcface: embeds faces.
        pictures: method -> [H, W, 3] float in [0, 1].
        truth: of the frame, by whose points all are aligned.

    Returns:
        Method -> ``arcface_cosine``; empty where the frame's five face points are not all trusted.
    """
    points = None if truth.points is None else five_points(truth.points)
    if points is None:
        return {}
    true = arcface.embed(to_bytes(truth.picture.image), points)
    return {
        method: {"arcface_cosine": identity_cosine(arcface.embed(to_bytes(picture), points), true)}
        for method, picture in pictures.items()
    }
