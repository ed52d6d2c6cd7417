"""Stages one after the other, each with its code loaded while the one before it works.

Loading a stage's code takes three to five seconds, most of it torch's, and one stage keeps one of two cores
idle for most of its time.
"""

from __future__ import annotations

import atexit
import os
from collections.abc import Mapping

from pipeline.config.request import Request
from pipeline.run.process import StageProcess


class StageRunner:
    """Runs the stages of one subject.

    Attributes:
        request: the command line's.
        borrowed: subject -> its own request, of those that are a clip which another's stage reads.
    """

    def __init__(self, request: Request, borrowed: Mapping[str, Request] | None = None):
        """Starts nothing yet. What waits in the end is ended with this process."""
        self.request, self.borrowed = request, borrowed or {}
        self._waiting: dict[tuple[str, str], StageProcess] = {}
        atexit.register(self.close)

    def run(self, stage: str, subject: str, following: str | None = None) -> str | None:
        """Runs a stage; returns why it failed, in a line, and None where it did not.

        Args:
            stage: its name.
            subject: whose.
            following: the stage that will be run after it, if one will.
        """
        process = self._waiting.pop((stage, subject), None)
        if process is None:
            process = StageProcess(stage, subject, self.borrowed.get(subject, self.request))
        if following is not None and (os.cpu_count() or 1) > 1:
            key = (following, subject)
            self._waiting[key] = self._waiting.get(key) or StageProcess(*key, self.request, waits=True)
        return process.finish()

    def close(self) -> None:
        """Ends what waits."""
        while self._waiting:
            self._waiting.popitem()[1].close()
