"""A check for training that makes the avatar worse, though every number in it is finite.

With learning rates a hundred times too high nothing overflows: GroupNorm and sigmoids bound what the heads
say, and Adam bounds the steps. What comes out is a ruin all the same, and must not be published as an avatar.
"""

from __future__ import annotations

from pipeline.errors import UserError
from stages.train.settings import TrainSettings

# dB under the untrained avatar. Rates ten times too high lose 2 of a perfect start, a hundred times 7 to 19.
WORSE = 3.0
SEEN = 25.0  # dB from which on a difference is not a ruin: a made-up clip that starts at 37 dB may fall to 30
WATCHED = 3  # training frames that are looked at where none is held out


def require_progress(untrained: float, now: float, iteration: int, settings: TrainSettings) -> None:
    """Refuses to go on with an avatar much worse than the fitted body in its initial colours.

    Args:
        untrained, now: PSNR of the same frames, dB.
        iteration: steps done.
        settings: of the stage.

    Raises:
        UserError: it does.
    """
    if now >= min(untrained - WORSE, SEEN):
        return
    rates = ", ".join(
        f"train.{name} (now {getattr(settings, name):g})"
        for name in ("learning_rate", "plane_learning_rate", "pose_learning_rate")
    )
    raise UserError(
        f"training stopped: after {iteration} iterations its pictures are worse than before the first, "
        f"{now:.1f} dB of {untrained:.1f}; try smaller {rates}; the last checkpoint is kept, nothing is "
        "published"
    )
