"""A finder of people: MediaPipe's person detector, frame by frame."""

from __future__ import annotations

import importlib
from pathlib import Path

import numpy as np

from pipeline.detection.mediapipe import BLANK, aside, load
from stages.ingest.people import Person

_FINDER_GRAPH = """
input_stream: "image"
output_stream: "detections"
node { calculator: "PoseDetectionCpu" input_stream: "IMAGE:image" output_stream: "DETECTIONS:detections" }
"""


class Finder:
    """Finds every person in a picture, without following anyone."""

    def __init__(self, asset: Path, native_log: Path) -> None:
        """Load the person detector; arguments and errors as those of ``pipeline.detection.Estimator``."""
        load(asset)
        self._native_log = native_log
        from google.protobuf import text_format

        base = importlib.import_module("mediapipe.python.solution_base")
        messages = importlib.import_module("mediapipe.framework.calculator_pb2")
        graph = text_format.Parse(_FINDER_GRAPH, messages.CalculatorGraphConfig())
        with aside(native_log):
            self._graph = base.SolutionBase(graph_config=graph, outputs=["detections"])
            self._graph.process(BLANK)

    def find(self, image: np.ndarray) -> list[Person]:
        """The people in ``image`` [H, W, 3] uint8 RGB; coordinates in its pixels."""
        height, width = image.shape[:2]
        with aside(self._native_log):
            found = self._graph.process(image).detections or []
        people = []
        for detection in found:
            points = [(p.x * width, p.y * height) for p in detection.location_data.relative_keypoints]
            hips, rim, shoulders = (np.array(point) for point in points[:3])
            radius = float(np.linalg.norm(rim - hips))
            people.append(Person(hips, shoulders, radius, float(detection.score[0])))
        return people
