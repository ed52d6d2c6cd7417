"""The places where a subject's avatar is found: published, left by a run that trains it, or shipped."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from pipeline.avatar import load_avatar
from pipeline.avatar.storage import PREVIEW
from pipeline.body import BodyModel, Poses, load_body, read_poses
from pipeline.clip.camera import Camera
from pipeline.clip.frames import frame_path
from pipeline.clip.records import read_cameras, read_footage
from pipeline.config.workspace import Workspace
from pipeline.errors import UserError
from pipeline.store.artifact import SCRATCH, Store, in_use
from pipeline.untrusted import parse_json
from pipeline.viewer.packed import ViewedMotion
from pipeline.viewer.shown import filmed_motion, novel_motion, packed_avatar, posed_motion

AVATAR = "avatar.safetensors"
SHIPPED = "avatars"  # the folder of data/ with avatars that come with the project


@dataclasses.dataclass(frozen=True)
class FoundAvatar:
    """An avatar's file as it is now.

    Attributes:
        path: the file.
        kind: ``published``, ``shipped``, or a checkpoint's: ``training`` of a run that goes on, ``stopped``
            of one that was broken off.
        changed: when, seconds since the epoch.
        size: in bytes.
    """

    path: Path
    kind: str
    changed: float
    size: int

    @property
    def stamp(self) -> str:
        """A text that is another one whenever the file is."""
        return f"{self.path.parent.name}-{self.changed}-{self.size}"


@dataclasses.dataclass(frozen=True)
class AvatarSource:
    """A subject's avatar and what goes with it.

    Attributes:
        workspace: where things lie.
        subject: whose.
        motion: what animate published of a motion that was asked for; None: nothing was.
    """

    workspace: Workspace
    subject: str
    motion: Path | None = None

    @property
    def store(self) -> Store:
        return Store(self.workspace.artifacts)

    def find(self) -> FoundAvatar:
        """The avatar to show: a run's that trains now, else the published one, else what ships.

        Raises:
            UserError: there is none.
        """
        published = self.published("train")
        known = None if published is None else _file(published / AVATAR, "published")
        runs = [*self.store.folder(self.subject, "train").glob(f"{SCRATCH}*")]
        going = {run for run in runs if in_use(run)}
        files = [_file(run / "work" / PREVIEW, "training" if run in going else "stopped") for run in runs]
        previews = [one for one in files if one is not None]
        newest = max(previews, key=lambda one: one.changed, default=None)
        if newest is not None and (known is None or newest.changed > known.changed):
            return newest
        known = known or _file(self.shipped / AVATAR, "shipped")
        if known is None:
            who = self.subject
            remedy = f"doit run subject={who} makes it"
            if going:
                remedy = "it is being trained, try again after its first checkpoint (train.checkpoint_every=)"
            raise UserError(f"there is no avatar of '{who}' yet: {remedy}")
        return known

    def published(self, stage: str) -> Path | None:
        """The folder of the stage's version in use, or None."""
        artifact = self.store.latest(self.subject, stage)
        return None if artifact is None else artifact.folder

    @property
    def shipped(self) -> Path:
        """The folder of an avatar that comes with the project, whether or not there is one."""
        return self.workspace.definitions(SHIPPED) / self.subject

    def packed(self, found: FoundAvatar) -> bytes:
        """The avatar with its motions, as the page reads them.

        Raises:
            UserError: a file is damaged, of another version or of another body model.
        """
        body = load_body(self.workspace.body_file)
        avatar = load_avatar(found.path, body)
        poses = self.poses(found)
        motions = [novel_motion(), *self._filmed(found, poses)]
        if self.motion is not None:
            motions.insert(0, animated_motion(self.motion))
        return packed_avatar(avatar, poses, self._fitting(motions, body), self.workspace.body_file)

    def poses(self, found: FoundAvatar) -> Poses | None:
        """The clip's poses, as refined as they are known; None where nothing is known."""
        fit = self.published("fit")
        places = [found.path.parent / "poses.parquet", *([] if fit is None else [fit / "poses.parquet"])]
        return next((read_poses(path) for path in places if path.is_file()), None)

    def _filmed(self, found: FoundAvatar, poses: Poses | None) -> Sequence[ViewedMotion]:
        if poses is None or not len(poses):
            return []
        if found.kind == "shipped":
            cameras, fps = _cameras(found.path.parent / "cameras.parquet"), 0.0
            return [filmed_motion(poses, cameras, fps)]
        ingest = self.published("ingest")
        if ingest is None:
            return [filmed_motion(poses, {}, 0.0)]
        pictures = all(frame_path(ingest / "frames", frame).is_file() for frame in poses.frames)
        return [filmed_motion(poses, _cameras(ingest / "cameras.parquet"), _rate(ingest), pictures)]

    @staticmethod
    def _fitting(motions: Sequence[ViewedMotion], body: BodyModel) -> list[ViewedMotion]:
        """The motions with no more expressions than the body has."""
        known = body.expression_directions.shape[2]
        return [dataclasses.replace(one, expression=one.expression[:, :known]) for one in motions]

    def frame(self, number: int) -> bytes:
        """A filmed frame, PNG.

        Raises:
            UserError: there is none of that number.
        """
        ingest = self.published("ingest")
        path = None if ingest is None else frame_path(ingest / "frames", number)
        if path is None or not path.is_file():
            raise UserError(f"there is no frame {number}")
        return path.read_bytes()


def animated_motion(folder: Path) -> ViewedMotion:
    """The motion that animate published.

    Raises:
        UserError: a file of it is missing or damaged.
    """
    told, path = parse_json(folder / "animate.json", "run the animate stage again"), folder / "motion.parquet"
    name, fps = (told.get("motion"), told.get("fps")) if isinstance(told, dict) else (None, None)
    if not isinstance(name, str) or not isinstance(fps, int | float) or not 0 < fps < 1e6:
        raise UserError(f"{folder / 'animate.json'} tells no name and no rate: run the animate stage again")
    return posed_motion(Path(name).name, float(fps), read_poses(path))


def said_of(found: FoundAvatar) -> str:
    """A sentence on where the avatar comes from; empty for a published one."""
    if found.kind == "training":
        return f"A checkpoint of the training that runs, {max(0, time.time() - found.changed):.0f} s old."
    if found.kind == "stopped":
        return "A checkpoint of a training that was broken off: the command that began it goes on with it."
    return "It comes with the project: nothing was trained here." if found.kind == "shipped" else ""


def _cameras(path: Path) -> Mapping[int, Camera]:
    return read_cameras(path) if path.is_file() else {}


def _rate(ingest: Path) -> float:
    """Kept frames a second; 0 where there is no clock or no record."""
    with contextlib.suppress(UserError):
        times = read_footage(ingest / "footage.json").seconds
        if len(times) > 1 and times[-1] > times[0]:
            return (len(times) - 1) / (times[-1] - times[0])
    return 0.0


def _file(path: Path, kind: str) -> FoundAvatar | None:
    try:
        state = path.stat()
    except OSError:  # it went while we looked
        return None
    return FoundAvatar(path, kind, state.st_mtime, state.st_size)
