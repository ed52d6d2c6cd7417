"""The visibility gate: vertices that are seen too seldom take no part in training (paper, Section 3.4).

Each drawn frame shows the body vertices that lie in the crop around the person and in front of the camera.
That is measured for gated vertices as for all others, by posing the bare body, which costs a millisecond.

The score v_i is the share of the drawn frames that show vertex i (Eq. 6). Captured and generated frames are
counted separately, from the first iteration to the last. After the warm-up, and regularly again, a
threshold is found in the captured frames' scores (:mod:`pipeline.avatar.otsu_threshold`) and what lies
below it is gated: it leaves ``Avatar.surface``, and with it decoding, rendering and regularisation. Scores
go on being measured, so that a region that comes into view later returns.

The counters and the avatar's own mark of what is active are buffers; a checkpoint holds them, and a
resumed run goes on exactly as one that was never stopped.

A clip of a head says nothing about the feet. Where no training frame has a vertex in its picture, its score
is zero whatever training does, and the gate would take it out after the warm-up; so it gets no Gaussian to
begin with (``ever_in_frame``). That saves the warm-up's time, and the triplane is fitted to what is left.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pyarrow as pa
import torch
from torch import Tensor, nn

from pipeline.avatar import Avatar
from pipeline.avatar.canonical import dilate
from pipeline.avatar.evidence import Evidence
from pipeline.avatar.otsu_threshold import Threshold, evidence_threshold, fixed_threshold, plain_threshold
from pipeline.avatar.visibility import body_in_frame
from pipeline.body import Pose
from pipeline.clip.views import View, ViewCache
from pipeline.device import moved
from pipeline.files.json_files import write_json
from pipeline.files.tables import write_table
from stages.train.loop import Hook, Trainer
from stages.train.poses import PoseRefinement
from stages.train.settings import TrainSettings

SCHEMA = pa.schema(
    [
        ("vertex", pa.int32()),
        ("captured", pa.float32()),
        ("generated", pa.float32()),
        ("early", pa.bool_()),
        ("kept", pa.bool_()),
    ]
)
DEFINITION = "in_frame"  # what counts as seen, for gate.json
CAPTURED, GENERATED = 0, 1


class VisibilityGate(nn.Module, Hook):
    """The visibility scores of one run, and the threshold found in them.

    Attributes:
        hits: [2, K] int64, how many drawn frames showed each of the avatar's body vertices; captured and
            generated frames.
        drawn: [2] int64, how many frames were drawn.
        hits_at_threshold, drawn_at_threshold: the same when the last threshold was found, for a run that
            goes on from a checkpoint after it.
    """

    hits: Tensor  # [2, K]
    drawn: Tensor  # [2]
    hits_at_threshold: Tensor  # [2, K]
    drawn_at_threshold: Tensor  # [2]

    def __init__(self, avatar: Avatar, vertices: int, settings: TrainSettings):
        """A gate that has counted no frame yet.

        Args:
            avatar: whose body vertices are counted.
            vertices: of the whole body; those that the avatar has not are never seen.
            settings: of the stage.
        """
        super().__init__()
        self._avatar, self._vertices, self._settings = (avatar,), vertices, settings
        for name, shape in (("hits", (2, len(avatar.vertex_ids))), ("drawn", (2,))):
            for suffix in ("", "_at_threshold"):
                counts = torch.zeros(shape, dtype=torch.long, device=avatar.device)
                self.register_buffer(name + suffix, counts)
        self._active_at_start = avatar.active.clone()  # what is trained while the gate stays open

    @property
    def avatar(self) -> Avatar:
        """The gated avatar; kept in a tuple, so that its weights are not taken for this module's."""
        return self._avatar[0]

    @torch.no_grad()
    def on_frame(self, pose: Pose, view: View) -> None:
        """Counts one drawn frame and the vertices in its picture.

        Args:
            pose: in which it was rendered.
            view: the frame.
        """
        source = GENERATED if view.generated else CAPTURED
        self.hits[source] += body_in_frame(self.avatar.surfaces[0], pose, view.camera)
        self.drawn[source] += 1

    def on_step(self, trainer: Trainer, terms: dict[str, float]) -> None:
        """Finds the threshold anew where it is time."""
        if self.due(trainer.iteration):
            self.update()

    def scores(self) -> Tensor:
        """v_i of the avatar's body vertices, captured and generated: [2, K] in [0, 1]."""
        return self.hits / self.drawn.clamp_min(1)[:, None]

    def whole_body(self, values: Tensor) -> np.ndarray:
        """Values of the avatar's vertices, [K], spread over the whole body, [V] float64; elsewhere 0."""
        whole = torch.zeros(self._vertices, dtype=torch.float64)
        whole[self.avatar.vertex_ids] = values.double().cpu()
        return whole.numpy()

    def due(self, iteration: int) -> bool:
        """True where a threshold is to be found after that many iterations."""
        settings = self._settings
        first = round(settings.gate_from * settings.iterations)
        return iteration >= max(1, first) and (iteration - first) % settings.gate_every == 0

    @property
    def threshold(self) -> Threshold | None:
        """The last threshold that was found; None before the warm-up has ended."""
        return self._last_threshold()[0] if bool(self.drawn_at_threshold.any()) else None

    def described(self) -> str:
        """The last threshold in words, or why there is none."""
        found = self.threshold
        return found.why if found else "no look fell within the run, see train.gate_from and train.gate_every"

    def update(self) -> Threshold:
        """Finds the threshold and gates what lies below it."""
        self.hits_at_threshold.copy_(self.hits)
        self.drawn_at_threshold.copy_(self.drawn)
        threshold, active = self._last_threshold()
        faces, rings = self.avatar.surfaces[0].canonical.faces, self._settings.gate_rings
        self.avatar.gate(dilate(active, faces, rings) if threshold.closed else self._active_at_start)
        return threshold

    def _last_threshold(self) -> tuple[Threshold, Tensor]:
        """The threshold in the scores as they were when it was found, and what lies above it, [K] bool."""
        captured, generated = self.hits_at_threshold / self.drawn_at_threshold.clamp_min(1)[:, None]
        threshold = self._find_threshold(self.whole_body(captured))
        active = captured >= threshold.tau
        if self._settings.unseen in ("completed", "generated"):
            active |= (generated >= threshold.tau) & (self.drawn_at_threshold[GENERATED] > 0)
        if threshold.closed and not bool(active.any()):
            why = f"a line at {threshold.tau:.2f} would gate all of the body, so none is drawn"
            threshold = dataclasses.replace(threshold, tau=0.0, why=why)
        return threshold, active

    def _find_threshold(self, scores: np.ndarray) -> Threshold:
        fixed = self._settings.gate_threshold
        if fixed is not None:
            return fixed_threshold(scores, fixed)
        return plain_threshold(scores) if self._settings.gate_rule == "otsu" else evidence_threshold(scores)

    def write(self, folder: Path, evidence: Evidence) -> tuple[np.ndarray, np.ndarray]:
        """Writes ``visibility.parquet``, a row a body vertex, and ``gate.json``, the threshold.

        Args:
            folder: for the two files.
            evidence: of the finished avatar; the gate does not go by it, its record tells it.

        Returns:
            The scores of the whole body, the higher of captured and generated, and what is kept; [V] each.
        """
        captured, generated = self.scores()
        write_visibility(
            folder / "visibility.parquet",
            captured=self.whole_body(captured),
            generated=self.whole_body(generated),
            early=self.whole_body(self._active_at_start) == 0,
            kept=self.whole_body(self.avatar.active) == 1,
        )
        threshold = self.threshold or self._find_threshold(self.whole_body(captured))
        content = dataclasses.asdict(threshold) | {
            "definition": DEFINITION,
            "drawn": {"captured": int(self.drawn[CAPTURED]), "generated": int(self.drawn[GENERATED])},
            "evidence": trusted_shares(evidence),
        }
        write_json(folder / "gate.json", content)
        return self.whole_body(torch.maximum(captured, generated)), self.whole_body(self.avatar.active) == 1


def ever_in_frame(avatar: Avatar, poses: PoseRefinement, views: ViewCache, frames: tuple[int, ...]) -> Tensor:
    """The body vertices that lie in the picture of at least one of the frames, [K] bool.

    Args:
        avatar: untrained.
        poses: of every frame.
        views: the cameras.
        frames: frame numbers.
    """
    seen = torch.zeros(len(avatar.vertex_ids), dtype=torch.bool, device=avatar.device)
    for frame in frames:
        camera = moved(views.camera(frame), avatar.device)
        seen |= body_in_frame(avatar.surfaces[0], poses.fitted(frame), camera)
    return seen


def trusted_shares(evidence: Evidence) -> dict[str, float]:
    """The mean trust in colour and shape of the avatar's Gaussians, for gate.json."""
    return {"color": float(evidence.trust.mean()), "shape": float(evidence.shape_trust.mean())}


def write_ungated(folder: Path, vertices: int, evidence: Evidence) -> None:
    """Writes what ``VisibilityGate.write`` would, for a run without a gate."""
    nothing, everything = np.zeros(vertices), np.ones(vertices, bool)
    columns = {"captured": nothing, "generated": nothing, "early": ~everything, "kept": everything}
    write_visibility(folder / "visibility.parquet", **columns)
    content = dataclasses.asdict(Threshold(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, "the gate was off"))
    drawn = {"captured": 0, "generated": 0}
    record = {"definition": None, "drawn": drawn, "evidence": trusted_shares(evidence)}
    write_json(folder / "gate.json", content | record)


def write_visibility(path: Path, **columns: np.ndarray) -> None:
    """Writes ``visibility.parquet``: the columns of ``SCHEMA`` but the first, [V] each.

    ``captured`` and ``generated`` are the scores, ``early`` marks what got no Gaussian to begin with, and
    ``kept`` what the finished avatar has.
    """
    vertex = np.arange(len(columns["captured"]))
    write_table(path, SCHEMA, {"vertex": vertex, **columns})
