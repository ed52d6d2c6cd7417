"""U2-Net's small model (Qin et al. 2020): a soft mask of what stands out of a picture, by OpenCV's dnn.

It shares neither weights nor training pictures with MediaPipe's two segmentations, so where all three agree
that is worth more. It does not know what a person is: it is shown the person's box.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from pipeline.errors import UserError, first_line

MODEL = "u2netp.onnx"
SIDE = 320  # pixels of the picture that the network sees
_MEAN = np.array([0.485, 0.456, 0.406], np.float32)
_DEVIATION = np.array([0.229, 0.224, 0.225], np.float32)
_FAINT = 0.3  # a network's answer whose brightest pixel is darker is not stretched: nothing stands out


class SaliencyModel:
    """The network, ready to be asked."""

    def __init__(self, asset: Path) -> None:
        """Load the model from the asset's folder; UserError if it is missing or damaged."""
        path = asset / MODEL
        try:
            self._network = cv2.dnn.readNetFromONNX(str(path))
        except cv2.error as error:
            remedy = "fetch it again with doit run assets:u2netp"
            raise UserError(f"{path} cannot be read as a network ({first_line(error)}): {remedy}") from error
        self._output = self._network.getUnconnectedOutLayersNames()[0]  # the others are coarser

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """The mask of a picture [H, W, 3] uint8 RGB, [H, W] float32 in [0, 1]."""
        small = cv2.resize(image, (SIDE, SIDE), interpolation=cv2.INTER_AREA).astype(np.float32)
        small = (small / max(float(small.max()), 1.0) - _MEAN) / _DEVIATION
        self._network.setInput(np.ascontiguousarray(small.transpose(2, 0, 1)[None]))
        found = self._network.forward(self._output)[0, 0]
        low, high = float(found.min()), max(float(found.max()), _FAINT)
        found = (found - low) / max(high - low, 1e-6)
        return cv2.resize(found, image.shape[1::-1], interpolation=cv2.INTER_LINEAR)
