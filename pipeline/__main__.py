"""One stage of one subject: ``python -m pipeline fit --subject oliver train.seed=3``.

Each run is a process of its own: a crash or an out-of-memory kill ends one stage, memory goes back, and the
same line works under any scheduler. ``python -m pipeline settings train`` lists what can be set.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from pipeline.config.request import parse_request
from pipeline.config.settings import help_lines, near
from pipeline.errors import UserError, error_message
from pipeline.run.job import open_job, run_stage
from pipeline.run.process import INTERRUPTED, end_process, leave_reason
from pipeline.run.stage import load_stages


def parse_arguments(arguments: list[str]) -> argparse.Namespace:
    """The command line of one stage."""
    parser = argparse.ArgumentParser(
        prog="python -m pipeline",
        description="Run one stage for one subject, or list the settings of stages: settings STAGE ...",
    )
    parser.add_argument("stage")
    parser.add_argument("--subject")
    parser.add_argument(
        "words",
        nargs="*",
        metavar="NAME=VALUE",
        help="as after 'doit run': preset=, source=, train.seed= ...",
    )
    options = parser.parse_intermixed_args(arguments)
    if options.stage != "settings" and not options.subject:
        parser.error("a stage needs --subject NAME")
    return options


def print_settings(names: list[str]) -> int:
    """Prints what can be set about some stages, or about all; returns the exit status."""
    stages = load_stages()
    unknown = [name for name in names if name not in stages]
    if unknown:
        print(f"there is no stage '{unknown[0]}'{near(unknown[0], stages)}", file=sys.stderr)
        return 1
    try:
        for name in names or stages:
            print("\n".join(help_lines(stages[name].settings, name)))
        sys.stdout.flush()
    except BrokenPipeError:  # the reader, such as head, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0


def main(arguments: list[str] | None = None) -> int:
    """Runs one stage; returns the exit status."""
    options = parse_arguments(sys.argv[1:] if arguments is None else arguments)
    if options.stage == "settings":
        return print_settings(options.words)
    where = Path.cwd()
    try:
        job = open_job(options.subject, parse_request(options.words, options.subject))
        if options.stage not in job.stages:
            raise UserError(f"there is no stage '{options.stage}'{near(options.stage, job.stages)}")
        where = job.workspace.artifacts
        run_stage(job, options.stage)
    except KeyboardInterrupt:
        print(
            f"{options.stage}:{options.subject} stopped; the same command goes on from here", file=sys.stderr
        )
        return INTERRUPTED
    except Exception as error:
        message = error_message(error, where)
        leave_reason(message or f"{type(error).__name__}: {error} (a defect; its traceback is above)")
        if message is None:
            raise
        print(f"{options.stage}:{options.subject} failed: {message}", file=sys.stderr, flush=True)
        return 1
    return 0


if __name__ == "__main__":
    end_process(main())
