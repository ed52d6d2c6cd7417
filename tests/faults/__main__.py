"""Kill -9 at random moments: ``python -m tests.faults --kills 100 [--seed 0] [--quick] [--json FILE]``.

A real subject, tiny but with every stage, is made once undisturbed. Then the command that makes it is killed
at a random moment, looked at, and started again, over and over. Whenever a run comes through, every byte
that it published is compared with the undisturbed run's, and all begins anew.
"""

from __future__ import annotations

import argparse
import json
import signal
import sys
import tempfile
from pathlib import Path

from pipeline.config.workspace import REPOSITORY
from tests.faults.campaign import (
    A_STAGE,
    CORRUPT,
    DIFFERENT,
    MANUAL,
    ORPHAN,
    UNNOTICED,
    Campaign,
    Tally,
    undisturbed,
)  # fmt: skip
from tests.faults.observe import PHASES, SHOWS_TIMES
from tests.faults.project import real_project, toy_project


def main(arguments: list[str] | None = None) -> int:
    """Runs the campaign; returns 1 where anything was lost."""
    options = parse(sys.argv[1:] if arguments is None else arguments)
    if sys.platform != "linux":
        print("faults: only Linux shows processes in the way that this watches them", file=sys.stderr)
        return 1
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that its run is stopped too
    kills = 14 if options.quick else options.kills
    keep = Path(tempfile.mkdtemp(prefix="flexiavatar-faults-"))
    root = keep / "project"
    project = toy_project(root) if options.toy else real_project(root, options.assets.resolve())
    print(f"faults: {kills} kills, seed {options.seed}; first two undisturbed runs, minutes")
    sys.stdout.flush()
    reference = undisturbed(project, keep / "reference")
    shown = ", ".join(f"{name or 'doit'} {seconds:.1f}" for name, seconds in reference.seconds.items())
    print(f"faults: {len(reference.files)} files to compare; seconds of {shown}")
    print(f"faults: all kills will take about {reference.expected(kills) / 60:.0f} minutes", flush=True)
    seconds = 60 * options.minutes
    campaign = Campaign(project, reference, kills, options.seed, keep / "differences", seconds)
    try:
        tally = campaign.run()
    except (KeyboardInterrupt, SystemExit):
        tally = campaign.stopped()
        print("faults: stopped before its end; so far:")
    print("\n".join(report(tally, options.seed, project.stages)))
    if options.json:
        content = {"seed": options.seed, "undisturbed_seconds": reference.seconds, **tally.as_json()}
        options.json.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    print(f"faults: everything is kept in {keep}" if tally.failures else headline(tally))
    if tally.failures:
        print(headline(tally))
    return 1 if tally.failures else 0


def parse(arguments: list[str]) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults", description=__doc__)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0, help="of the moments, and of who is killed")
    parser.add_argument("--minutes", type=float, default=1e7, help="no more kills after so many minutes")
    parser.add_argument("--quick", action="store_true", help="14 kills")
    parser.add_argument("--toy", action="store_true", help="stages that only count: in minutes")
    parser.add_argument("--json", type=Path, help="write the numbers here")
    parser.add_argument("--assets", type=Path, default=REPOSITORY / "data" / "assets")
    return parser.parse_args(arguments)


def report(tally: Tally, seed: int, stages: tuple[str, ...]) -> list[str]:
    """The summary: where the kills fell, and what came of them."""
    names = ["doit", *stages]
    lines = ["", f"Kills by stage and phase (seed {seed})", ""]
    lines.append("| " + " | ".join(["", *PHASES, "all"]) + " |")
    lines.append("|" + "---|" * (len(PHASES) + 2))
    for name in names:
        row = [tally.kills[name, where] for where in PHASES]
        lines.append("| " + " | ".join([name, *(str(count or "") for count in row), str(sum(row))]) + " |")
    columns = [sum(tally.kills[name, where] for name in names) for where in PHASES]
    lines.append("| " + " | ".join(["all", *map(str, columns), str(sum(columns))]) + " |")
    targets = ", ".join(f"{name} {count}" for name, count in sorted(tally.targets.items()))
    lines += [
        "",
        f"killed: {targets} (group: all; stage: its process alone, as for want of memory; doit: it alone)",
        f"runs that came through and were compared: {tally.runs}; {tally.missed} of them were over before "
        "their kill's moment",
        f"runs that went on from a training checkpoint: {tally.resumed}",
        f"corrupt or half-published: {tally.count(CORRUPT)}",
        f"runs that needed a hand: {tally.count(MANUAL)}",
        f"processes that outlived their parent: {tally.count(ORPHAN)}",
        f"files with other bytes: {tally.count(DIFFERENT)} (not compared: run.json, and "
        f"{', '.join(SHOWS_TIMES)}, which show how long things took)",
        f"bits flipped in files of every kind: {tally.flipped}, not found: {tally.count(UNNOTICED)}; "
        f"then one in every stage, all made again by one command: {'yes' if tally.mended else 'not seen'}",
        f"left behind, hidden: {dict(tally.left) or 'nothing'}",
        f"seconds: {tally.seconds:.0f} ({A_STAGE} kills a stage between two whole runs)",
        *(f"FAILED: {failure}" for failure in tally.failures),
    ]
    return lines


def headline(tally: Tally) -> str:
    """The last line."""
    kills = sum(tally.kills.values())
    return (
        f"faults: {kills} kills, {tally.runs} whole runs compared byte for byte: "
        f"{tally.count(CORRUPT)} corrupt, {tally.count(MANUAL)} manual steps, "
        f"{tally.count(DIFFERENT)} files different, {tally.count(ORPHAN)} orphans; "
        f"{tally.flipped} flipped bits, {tally.count(UNNOTICED)} unnoticed"
    )


if __name__ == "__main__":
    sys.exit(main())
