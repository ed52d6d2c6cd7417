"""The open body and its landmarks, read once a process; nobody changes them."""

import functools

from pipeline.body import BodyModel, Landmarks, load_body, load_landmarks
from pipeline.config.workspace import REPOSITORY

BODY_FOLDER = REPOSITORY / "data" / "body"
BODY_FILE = BODY_FOLDER / "open_body.npz"


@functools.cache
def open_body() -> BodyModel:
    """The open body."""
    return load_body(BODY_FILE)


@functools.cache
def open_landmarks() -> Landmarks:
    """Where keypoints lie on it."""
    return load_landmarks(open_body(), BODY_FOLDER)
