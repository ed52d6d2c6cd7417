"""What the toy stages do. Each run leaves a line in ``ran.log`` beside the store, to be counted."""

import errno
import os
import signal
import time
from pathlib import Path

from pipeline.errors import UserError


def note(context):
    with (context.output.parents[4] / "ran.log").open("a") as file:
        file.write(f"{context.stage}:{context.subject}\n")


def gather(context):
    note(context)
    settings = context.settings
    text = settings.made_up or context.source.read_text()
    text += "" if settings.extra == "none" else Path(settings.extra).read_text()
    (context.output / "text.txt").write_text(text.upper() if settings.upper else text)
    (context.output / "extra.txt").write_text(str(settings.unused))


def bend(context):
    note(context)
    (context.output / "half.txt").write_text("half")
    fail = context.settings.fail
    if fail == "user":
        raise UserError("clip.mp4: is not a clip; name another")
    if fail == "bug":
        raise ZeroDivisionError("ours")
    if fail == "disk":
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(context.output / "half.txt"))
    if fail == "memory":
        raise MemoryError
    if fail == "killed":  # as the system does when memory is short
        os.kill(os.getpid(), signal.SIGKILL)
    text = (context.inputs["gather"] / "text.txt").read_text()
    (context.output / "bent.txt").write_text(f"{text}{context.settings.angle}")


def paint(context):
    """Counts up to ``iterations``, one checkpoint each, and says where it began."""
    note(context)
    checkpoint = context.work / "count.txt"
    done = int(checkpoint.read_text()) if checkpoint.exists() else 0
    with (context.output.parents[4] / "began.log").open("a") as file:
        file.write(f"{done}\n")
    with context.progress(context.settings.iterations, "painting") as progress:
        while done < context.settings.iterations:
            done += 1
            partial = checkpoint.with_suffix(".partial")
            partial.write_text(str(done))
            partial.replace(checkpoint)
            progress.advance()
            if context.settings.rate:
                time.sleep(context.settings.rate)
    context.timing("steps", done)
    (context.output / "painted.txt").write_text((context.inputs["bend"] / "bent.txt").read_text() * done)


def sing(context):
    """Sings what was bent to a tune: a word, a file's text, or what another subject's bend stage made."""
    note(context)
    tune = context.settings.tune
    if context.loans:
        tune = (context.loans["bend"] / "bent.txt").read_text()
    elif Path(tune).is_file():
        tune = Path(tune).read_text()
    (context.output / "song.txt").write_text((context.inputs["bend"] / "bent.txt").read_text() + tune)


def compile_slowly():
    """Stands for kernels that take a minute; says who compiles, at which priority."""
    folder = Path(os.environ["NUMBA_CACHE_DIR"])
    (folder / f"compiles-{os.getpid()}").write_text(str(os.nice(0)))
    time.sleep(60)


def compile_badly():
    raise ZeroDivisionError("ours")


def compile_quickly():
    with (Path(os.environ["NUMBA_CACHE_DIR"]) / "compiled").open("a") as file:
        file.write("once\n")
