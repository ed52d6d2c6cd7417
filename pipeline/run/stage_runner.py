"""The stages of a subject, one after the other, with a loader's help where there is one."""

from __future__ import annotations

import atexit
import functools
import threading
from collections.abc import Mapping, Sequence

from pipeline.config.request import Request
from pipeline.run.process import run_stage_process
from pipeline.run.stage_loader import StageLoader, can_load_ahead


class StageRunner:
    """Runs stages.

    Attributes:
        request: the command line's.
        borrowed: subject -> its own request, of those that are a clip which another's stage reads.
    """

    def __init__(self, request: Request, borrowed: Mapping[str, Request] | None = None):
        """Starts nothing yet."""
        self.request, self.borrowed = request, borrowed or {}
        self._loader: StageLoader | None = None
        self._loader_is_taken = threading.Lock()
        atexit.register(self.close)

    def run(self, stage: str, subject: str, following: Sequence[str] = ()) -> str | None:
        """Runs a stage; returns why it failed, in a line, and None where it did not.

        Args:
            stage: its name.
            subject: whose.
            following: ``Stage.run`` of the stages after it; their code is loaded meanwhile.
        """
        run = functools.partial(run_stage_process, stage, subject, self.borrowed.get(subject, self.request))
        loader = self._loader
        if loader is None:
            self._loader = StageLoader(following) if following and can_load_ahead() else None
        elif loader.alive and self._loader_is_taken.acquire(blocking=False):
            try:
                return run(start=loader.run)
            finally:
                self._loader_is_taken.release()
        return run()

    def close(self) -> None:
        """Ends the loader."""
        if self._loader is not None:
            self._loader.close()
        self._loader = None
