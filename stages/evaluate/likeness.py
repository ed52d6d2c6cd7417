"""Whose face the avatar has: embeddings of rendered and true faces (the paper's face consistency)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np

from pipeline.boxes import Box
from pipeline.composite import to_bytes
from pipeline.metrics.identity import Face, identity_cosine, identity_distance
from stages.evaluate.judging import Truth
from stages.evaluate.scoring import Picture, Score

ROOM = 0.5  # of the face crop's size, around it, for the face finder


class Reader(Protocol):
    """What finds and embeds a face; :class:`pipeline.metrics.identity.FaceReader` is one."""

    def read(self, image: np.ndarray, box: Box | None = None) -> Face | None:
        """The face in [H, W, 3] uint8 RGB, or None."""


def likeness(reader: Reader, truth: Truth, pictures: Mapping[str, Picture]) -> list[Score]:
    """How far each method's face is from the true one of the same frame.

    Args:
        reader: finds and embeds faces.
        truth: of the frame.
        pictures: method -> what it shows.

    Returns:
        ``identity_found``, 1 or 0, and where a face was found ``identity_distance`` and
        ``identity_cosine``, of each method; nothing at all where the true frame shows no face.
    """
    boxes = truth.boxes.get("face")
    if not boxes:
        return []
    face = boxes[0]
    box = face.widened(round(ROOM * max(face.width, face.height)))
    true = reader.read(to_bytes(truth.picture.image), box)
    if true is None:
        return []
    scores = []
    for method, picture in pictures.items():
        found = reader.read(to_bytes(picture.image), box)
        scores.append(truth.score(method, "identity_found", float(found is not None)))
        if found is not None:
            distance = identity_distance(found.embedding, true.embedding)
            cosine = identity_cosine(found.embedding, true.embedding)
            scores.append(truth.score(method, "identity_distance", distance))
            scores.append(truth.score(method, "identity_cosine", cosine))
    return scores
