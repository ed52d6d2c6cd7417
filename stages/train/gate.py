"""The visibility gate: what is seen too seldom takes no part in training (paper, Section 3.4).

Each drawn frame shows the body vertices that lie in the crop around the person and in front of the camera.
That is measured for gated vertices as for all others, by posing the bare body, which costs a millisecond.

The score v_i is the share of the drawn frames (Eq. 7), over captured and generated frames apart, from
the first iteration on and never forgotten. After the warm-up, and regularly again, a line is drawn through
the captured frames' scores (:mod:`pipeline.visibility`) and what lies below it is gated: it leaves
``Avatar.surface``, and with it decoding, rendering and regularisation. Scores go on being measured, so
that a region that comes into view later returns.

The counters and the avatar's own mark of what is active are buffers; a checkpoint holds them, and a
resumed run goes on exactly as one that was never stopped.
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
from pipeline.records import write_json
from pipeline.tables import write_table
from pipeline.visibility import Line, body_in_frame, evidence_threshold, fixed_threshold
from stages.train.data import View
from stages.train.poses import FramePose
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


class Gate(nn.Module):
    """The scores of one run, and the line through them.

    Attributes:
        hits: [2, K] int64, how many drawn frames showed each of the avatar's body vertices; captured and
            generated frames.
        drawn: [2] int64, how many frames were drawn.
        lined_hits, lined_drawn: the same when the last line was drawn, for a run that goes on from a
            checkpoint after it.
    """

    hits: Tensor  # [2, K]
    drawn: Tensor  # [2]
    lined_hits: Tensor  # [2, K]
    lined_drawn: Tensor  # [2]

    def __init__(self, avatar: Avatar, vertices: int, settings: TrainSettings):
        """Counts nothing yet.

        Args:
            avatar: whose body vertices are counted.
            vertices: of the whole body; those that the avatar has not are never seen.
            settings: of the stage.
        """
        super().__init__()
        self._avatar, self._vertices, self._settings = (avatar,), vertices, settings
        for name, shape in (("hits", (2, len(avatar.kept))), ("drawn", (2,))):
            for prefix in ("", "lined_"):
                counts = torch.zeros(shape, dtype=torch.long, device=avatar.device)
                self.register_buffer(prefix + name, counts)
        self._first = avatar.active.clone()  # what is trained while the gate stays open

    @property
    def avatar(self) -> Avatar:
        """Kept in a tuple, so that its weights are not taken for this module's."""
        return self._avatar[0]

    @torch.no_grad()
    def watch(self, pose: FramePose, view: View) -> None:
        """Counts what one drawn frame shows.

        Args:
            pose: in which it was rendered.
            view: the frame.
        """
        source = GENERATED if view.generated else CAPTURED
        self.hits[source] += body_in_frame(self.avatar.surfaces[0], pose.rotation, pose.transl, view.camera)
        self.drawn[source] += 1

    def scores(self) -> Tensor:
        """v_i of the avatar's body vertices, captured and generated: [2, K] in [0, 1]."""
        return self.hits / self.drawn.clamp_min(1)[:, None]

    def whole_body(self, values: Tensor) -> np.ndarray:
        """What is known of the avatar's vertices, [K], over the whole body, [V] float64; else 0."""
        whole = torch.zeros(self._vertices, dtype=torch.float64)
        whole[self.avatar.kept] = values.double().cpu()
        return whole.numpy()

    def due(self, iteration: int) -> bool:
        """Whether a line is drawn after that many iterations."""
        settings = self._settings
        first = round(settings.gate_from * settings.iterations)
        return iteration >= max(1, first) and (iteration - first) % settings.gate_every == 0

    @property
    def line(self) -> Line | None:
        """The last line that was drawn; None before the warm-up has ended."""
        return self._drawn()[0] if bool(self.lined_drawn.any()) else None

    def update(self) -> Line:
        """Draws the line and gates what lies below it."""
        self.lined_hits.copy_(self.hits)
        self.lined_drawn.copy_(self.drawn)
        line, active = self._drawn()
        faces, rings = self.avatar.surfaces[0].canonical.faces, self._settings.gate_rings
        self.avatar.gate(dilate(active, faces, rings) if line.closed else self._first)
        return line

    def _drawn(self) -> tuple[Line, Tensor]:
        """The line through the scores as they were, and what lies above it."""
        captured, generated = self.lined_hits / self.lined_drawn.clamp_min(1)[:, None]
        line = self._line(self.whole_body(captured))
        active = captured >= line.tau
        if self._settings.unseen == "generated":
            active |= (generated >= line.tau) & (self.lined_drawn[GENERATED] > 0)
        if line.closed and not bool(active.any()):
            why = f"a line at {line.tau:.2f} would gate all of the body, so none is drawn"
            line = dataclasses.replace(line, tau=0.0, why=why)
        return line, active

    def _line(self, scores: np.ndarray) -> Line:
        settings = self._settings
        if settings.gate_threshold is not None:
            return fixed_threshold(scores, settings.gate_threshold)
        return evidence_threshold(scores)

    def write(self, folder: Path) -> tuple[np.ndarray, np.ndarray]:
        """Writes ``visibility.parquet``, a row a body vertex, and ``gate.json``, the line.

        Returns:
            The scores of the whole body, the higher of captured and generated, and what is kept; [V] each.
        """
        captured, generated = self.scores()
        write_visibility(
            folder / "visibility.parquet",
            captured=self.whole_body(captured),
            generated=self.whole_body(generated),
            early=self.whole_body(self._first) == 0,
            kept=self.whole_body(self.avatar.active) == 1,
        )
        line = self.line or self._line(self.whole_body(captured))
        content = dataclasses.asdict(line) | {
            "definition": DEFINITION,
            "drawn": {"captured": int(self.drawn[CAPTURED]), "generated": int(self.drawn[GENERATED])},
        }
        write_json(folder / "gate.json", content)
        return self.whole_body(torch.maximum(captured, generated)), self.whole_body(self.avatar.active) == 1


def write_ungated(folder: Path, vertices: int) -> None:
    """What ``Gate.write`` writes, for a run in which nothing was counted and nothing gated."""
    nothing, everything = np.zeros(vertices), np.ones(vertices, bool)
    columns = {"captured": nothing, "generated": nothing, "early": ~everything, "kept": everything}
    write_visibility(folder / "visibility.parquet", **columns)
    content = dataclasses.asdict(Line(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, "the gate was off"))
    write_json(folder / "gate.json", content | {"definition": None, "drawn": {"captured": 0, "generated": 0}})


def write_visibility(path: Path, **columns: np.ndarray) -> None:
    """Writes ``visibility.parquet``: the columns of ``SCHEMA`` but the first, [V] each.

    ``captured`` and ``generated`` are the scores, ``early`` marks what got no Gaussian to begin with, and
    ``kept`` what the finished avatar has.
    """
    vertex = np.arange(len(columns["captured"]))
    write_table(path, SCHEMA, {"vertex": vertex, **columns})
