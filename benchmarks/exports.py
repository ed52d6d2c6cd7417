"""Size and time of each file for other programs: ``python -m benchmarks.exports data/artifacts/smile ...``.

Processor seconds of this process: of splats those of writing alone, of ``avatar.glb`` of making the mesh, of
posing once for its colours and of baking them, too.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from pipeline.posable import PosableAvatar, load_posable
from pipeline.splat.splat_files import write_splats

SPLATS = ("avatar.ply", "avatar.spz", "avatar_splats.glb")
RIG = "avatar.glb"


def measured(write: Callable[[Path], None], path: Path) -> tuple[int, float]:
    """Bytes and processor seconds of writing a file; the fastest of three."""
    spent = []
    for _ in range(3):
        start = time.process_time()
        write(path)
        spent.append(time.process_time() - start)
    return path.stat().st_size, min(spent)


def rows(avatar: PosableAvatar, folder: Path) -> Iterator[tuple[str, int, float]]:
    """Name, bytes and seconds of each file."""
    gaussians = avatar.gaussians()
    for name in SPLATS:
        yield name, *measured(lambda path: write_splats(path, gaussians, "-y"), folder / name)
    yield RIG, *measured(avatar.save_rig, folder / RIG)


def main() -> None:
    """Prints a table a subject."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("subjects", nargs="+", type=Path, help="folders of subjects")
    for subject in parser.parse_args().subjects:
        avatar = load_posable(subject)
        print(f"{subject.name}, {len(avatar.gaussians())} Gaussians")
        with tempfile.TemporaryDirectory() as folder:
            for name, size, seconds in rows(avatar, Path(folder)):
                print(f"  {name:18} {size / 1e6:6.2f} MB {seconds:6.2f} s")


if __name__ == "__main__":
    main()
