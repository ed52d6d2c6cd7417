"""Size and time of each file for other programs.

Holds: docs/exports.md, "What it costs, and how it is checked". Processor seconds of this process, the
fastest of three: of splats those of writing alone, of ``avatar.glb`` of making the mesh, of posing once for
its colours and of baking them, too. ``--quick``, or no folder: the avatar that comes with the project.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from benchmarks import frame
from pipeline.config.workspace import REPOSITORY
from pipeline.posable import PosableAvatar, load_posable
from pipeline.splat.splat_files import write_splats

SPLATS = ("avatar.ply", "avatar.spz", "avatar_splats.glb")
RIG = "avatar.glb"
SHIPPED = REPOSITORY / "data" / "avatars" / "mannequin_full"


def measure(options: argparse.Namespace, report: frame.Report) -> str:
    """Writes every file of every avatar."""
    subjects = options.subjects if options.subjects and not options.quick else [SHIPPED]
    for subject in subjects:
        avatar = load_posable(subject)
        with tempfile.TemporaryDirectory() as folder:
            for name, size, seconds in rows(avatar, Path(folder)):
                about = {"avatar": subject.name, "Gaussians": len(avatar.gaussians()), "file": name}
                report.add({**about, "MB": size / 1e6, "processor s": seconds})
    slowest = max(report.tables["rows"], key=lambda row: row["processor s"])
    return f"the slowest is {slowest['file']} of {slowest['avatar']}: {slowest['processor s']:.1f} s"


def rows(avatar: PosableAvatar, folder: Path) -> Iterator[tuple[str, int, float]]:
    """Name, bytes and seconds of each file."""
    gaussians = avatar.gaussians()
    for name in SPLATS:
        yield name, *timed(lambda path: write_splats(path, gaussians, "-y"), folder / name)
    yield RIG, *timed(avatar.save_rig, folder / RIG)


def timed(write: Callable[[Path], None], path: Path) -> tuple[int, float]:
    """Bytes and processor seconds of writing a file; the fastest of three."""
    spent = []
    for _ in range(3):
        start = time.process_time()
        write(path)
        spent.append(time.process_time() - start)
    return path.stat().st_size, min(spent)


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options of this benchmark."""
    parser.add_argument("subjects", nargs="*", type=Path, help="folders of subjects in the store")


if __name__ == "__main__":
    sys.exit(frame.run("exports", __doc__, measure, options=add_options))
