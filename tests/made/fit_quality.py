"""The judgement of a fit that is right."""

from collections.abc import Sequence

import numpy as np

from pipeline.clip.fit_quality import FitQuality


def good_fit(frames: Sequence[int] | np.ndarray) -> FitQuality:
    """A fit that is right in every one of some frames: what made-up clips have."""
    ones = np.ones(len(frames))
    accepted = np.ones(len(frames), bool)
    return FitQuality(np.array(frames, np.int64), ones, 100 * ones, ones, ones, 0 * ones, accepted)
