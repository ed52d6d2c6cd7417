"""NeuMan: a walk around a person, as published and as ExAvatar and FlexiAvatar prepared it.

::

    images/00012.png
    segmentations/00012.png              255 is BACKGROUND, 0 the person
    masks/00012.png or masks/12.png      where prepared: 255 is the person; these are preferred
    sparse/{cameras,images,points3D}.txt a COLMAP model, picture names as above
    {train,val,test}_split.txt           lines such as 00012.png
    keypoints_whole_body/12.json, smplx_init/, smplx_optimized/    where prepared, see ``prepared``

Source: apple/ml-neuman (data_io/neuman_helper.py) and the releases of ExAvatar and FlexiAvatar.
Conversions: segmentations are inverted. COLMAP's unit is arbitrary, so metres come from
``ingest.camera_scale``, or from the person (``cameras.scale``). Of fitted poses the unsmoothed ones are
read, as the authors do for NeuMan. Without the split files the official rule is applied: v = n // 5
validation frames at most, every int(n / v)-th from half of that on; the first half of them is the test set,
the second the validation set, the rest is learnt from. Validation frames are in neither part here. ROMP's
poses (``smpl_output_romp.pkl``), depth and DensePose are not read.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pipeline.clip.frame_files import number_files
from pipeline.untrusted import read_numbers
from stages.ingest.cameras.calibration_files import find_model, read_model
from stages.ingest.datasets.exavatar_poses import read_exavatar_poses
from stages.ingest.datasets.recording import Recording, Shot, files_of, lacking
from stages.ingest.settings import IngestSettings
from stages.ingest.video import PICTURES, clip_frames, folder_clip

_REMEDY = "unpack the NeuMan dataset again"
_LISTS = ("train_split.txt", "test_split.txt")


def recognises(folder: Path) -> bool:
    """A folder of images with a COLMAP model and masks of either polarity."""
    masked = any((folder / name).is_dir() for name in ("segmentations", "masks"))
    return (folder / "images").is_dir() and masked and find_model(folder) is not None


def read(source: Path, settings: IngestSettings) -> Recording:
    """Read a sequence's folder; UserError where a file of it is malformed."""
    clip = folder_clip(source / "images", number_files(source / "images", PICTURES))
    masks, kind = files_of(source / "masks", clip), "white"
    if masks is None:
        masks, kind = files_of(source / "segmentations", clip), "inverted"
    model = find_model(source)
    shot = Shot(
        clip=clip,
        calibration=None if model is None else read_model(model),
        keypoints=files_of(source / "keypoints_whole_body", clip, (".json",)),
        masks=masks,
        mask_kind=kind,
        poses=read_exavatar_poses(source, clip_frames(clip), smoothed=False),
    )
    train, test = _split(source, list(clip.pictures))
    notes = [lacking("masks", len(masks or ()), len(clip.pictures), "masks/ and segmentations/")]
    if not _listed(source):
        notes.append(f"no {' and '.join(_LISTS)}, so the split is NeuMan's rule")
    return Recording("neuman", (shot,), train, test, tuple(note for note in notes if note))


def _listed(source: Path) -> bool:
    return all((source / name).is_file() for name in _LISTS)


def _split(source: Path, frames: list[int]) -> tuple[frozenset[int], frozenset[int]]:
    if _listed(source):
        listed = [read_numbers(source / name, _REMEDY, ".png") for name in _LISTS]
        return frozenset(listed[0]), frozenset(listed[1])
    return official_split(frames)


def official_split(frames: Sequence[int]) -> tuple[frozenset[int], frozenset[int]]:
    """Training and test frames by NeuMan's own rule; the validation frames are in neither."""
    held = len(frames) // 5
    if held == 0:
        return frozenset(frames), frozenset()
    length = int(len(frames) / held)
    chosen = list(frames)[length // 2 :: length]
    return frozenset(set(frames) - set(chosen)), frozenset(chosen[: len(chosen) // 2])
