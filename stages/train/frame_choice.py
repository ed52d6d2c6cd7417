"""The frames that training draws: all of a short clip, the most different ones of a long clip.

A frame teaches little when it is drawn once or twice: its pose is not refined by then, and what disagrees
with it is blurred. So a clip with more frames than the steps can visit often enough is learnt from fewer of
them, chosen to lie as far from each other as they can in pose, expression and view.
"""

from __future__ import annotations

import roma
import torch
from torch import Tensor

from stages.train.data import TrainingData

DIRECTIONS = 12  # principal directions in which frames are told apart


def frames_to_draw(data: TrainingData, steps: int, visits: float) -> tuple[int, ...]:
    """The captured training frames that are drawn, increasing.

    Args:
        data: of the clip.
        steps: frames that the run draws.
        visits: how often each is to be drawn; 0 draws all frames, however seldom.
    """
    frames = data.clip.split.train
    count = round(steps / visits) if visits else len(frames)
    if count >= len(frames):
        return frames
    order = farthest_first(frame_features(data, frames), max(1, count))
    return tuple(sorted(frames[place] for place in order))


def frame_features(data: TrainingData, frames: tuple[int, ...]) -> Tensor:
    """Pose, expression and view of each frame as numbers that can be compared, [F, D].

    Along the clip's principal directions, each scaled to the root of its deviation: large movements count
    more than small ones, but do not drown them.
    """
    clip, rows = data.clip, []
    for frame in frames:
        pose = clip.pose(frame)
        turn = roma.rotvec_to_rotmat(pose.rotation)
        view = turn[0].mT @ torch.nn.functional.normalize(clip.cameras[frame].centre - pose.transl, dim=0)
        rows.append(torch.cat([turn[1:].flatten(), pose.expression, view]))
    values = torch.stack(rows).double()
    values = values - values.mean(0)
    left, lengths, _ = torch.linalg.svd(values, full_matrices=False)
    return left[:, :DIRECTIONS] * lengths[:DIRECTIONS].sqrt()


def farthest_first(features: Tensor, count: int) -> list[int]:
    """Rows that lie far apart: the one nearest the mean, then always the one farthest from all before it.

    Args:
        features: [F, D].
        count: rows asked for, at most F.
    """
    chosen = [int((features - features.mean(0)).square().sum(1).argmin())]
    nearest = torch.full((len(features),), torch.inf, dtype=features.dtype)
    while len(chosen) < count:
        nearest = torch.minimum(nearest, (features - features[chosen[-1]]).square().sum(1))
        nearest[chosen[-1]] = -1.0
        chosen.append(int(nearest.argmax()))
    return chosen
