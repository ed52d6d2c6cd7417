"""The one kind of error that a user is meant to read, and the one line that an error becomes.

A full disk, a folder that cannot be written and memory that ran out are the machine's fault; a user is told
so whatever library noticed.
"""

from __future__ import annotations

import errno
import re
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

FULL = (errno.ENOSPC, errno.EDQUOT)
READ_ONLY = (errno.EROFS, errno.EACCES, errno.EPERM)
# Libraries that write files themselves say it in words of their own.
FULL_WORDS = re.compile(r"No space left on device|os error 28|errno 28|Disk quota exceeded", re.IGNORECASE)
MEMORY_WORDS = re.compile(
    r"can't allocate memory|cannot allocate memory|out of memory|failed to map segment|std::bad_alloc"
    r"|can't start new thread|pthread_create|unable to allocate|insufficient memory",
    re.IGNORECASE,
)


class UserError(Exception):
    """Something that the user can mend: the message names the file and the remedy in one line.

    The command line prints the message alone, without a traceback, and exits with status 1.
    Anything else that is raised is a defect of ours and keeps its traceback.
    """


def error_message(error: BaseException, where: Path) -> str | None:
    """The one line that a user is shown for this error, or None if it is a defect of ours.

    Args:
        error: what stopped a stage.
        where: the folder that it was writing to, for errors that name no file.

    >>> error_message(UserError("clip.mp4 is missing: check source="), Path("."))
    'clip.mp4 is missing: check source='
    >>> error_message(ZeroDivisionError(), Path(".")) is None
    True
    """
    if isinstance(error, UserError):
        return str(error)
    if is_disk_full(error):
        place = named_file(error) or fullest(where, Path(tempfile.gettempdir()))
        return (
            f"{place}: the disk is full ({free_space(place)}); free some space or choose another store "
            "(artifacts=FOLDER), then run the same command again"
        )
    if any(isinstance(one, OSError) and one.errno in READ_ONLY for one in chain(error)):
        place = named_file(error) or where
        if where in (place, *place.parents):
            return f"{place}: cannot be written ({reason(error)}); choose another store: artifacts=FOLDER"
        return f"{place}: cannot be used ({reason(error)}); change its permissions or name another"
    if any(isinstance(one, MemoryError) or MEMORY_WORDS.search(str(one)) for one in chain(error)):
        return (
            f"memory ran out ({first_line(error)}); close other programs, run fewer subjects at once or "
            "choose a smaller preset, then run the same command again"
        )
    return None


def is_disk_full(error: BaseException) -> bool:
    """True where a full disk or quota caused an error, whatever library raised it."""
    numbers = (one.errno for one in chain(error) if isinstance(one, OSError))
    return any(number in FULL for number in numbers) or any(
        FULL_WORDS.search(str(one)) for one in chain(error)
    )


def chain(error: BaseException) -> Iterator[BaseException]:
    """An error and its causes, at most twenty."""
    one: BaseException | None = error
    for _ in range(20):
        if one is None:
            return
        yield one
        one = one.__cause__ or one.__context__


def named_file(error: BaseException) -> Path | None:
    """The file that the error is about, where it says so."""
    names = (one.filename for one in chain(error) if isinstance(one, OSError))
    return next((Path(name) for name in names if isinstance(name, str)), None)


def reason(error: BaseException) -> str:
    """The operating system's words for an error."""
    return next((one.strerror or str(one) for one in chain(error) if isinstance(one, OSError)), str(error))


def fullest(*folders: Path) -> Path:
    """The folder whose disk has the least room left."""
    return min(folders, key=lambda folder: shutil.disk_usage(existing(folder)).free)


def existing(path: Path) -> Path:
    """The path, or the nearest folder above it that exists."""
    return next(one for one in (path, *path.absolute().parents) if one.exists())


def free_space(path: Path) -> str:
    """The free and the whole space of the disk of a path, for people."""
    usage = shutil.disk_usage(existing(path))
    return f"{readable_size(usage.free)} of {readable_size(usage.total)} free"


def readable_size(count: float) -> str:
    """A number of bytes for people."""
    for unit in ("bytes", "KiB", "MiB", "GiB"):
        if count < 1024 or unit == "GiB":
            break
        count /= 1024
    return f"{count:.0f} {unit}" if unit == "bytes" else f"{count:.1f} {unit}"


def first_line(error: BaseException) -> str:
    """The first line of an error's text."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
