"""Bounds on files of others: names stay in their folder; bytes, archives and pictures fit into memory."""

from __future__ import annotations

import io
import stat
import warnings
import zipfile
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from pipeline.errors import UserError

GIGABYTE = 1 << 30
_SHOWN = 60  # characters of a name in a message
MOST_PIXELS = 100_000_000  # 300 MB of RGB; 8K footage has 33 million


def inside(folder: Path, name: str, origin: Path) -> Path:
    """The file that ``name`` means, which must lie inside ``folder``.

    Links are followed before it is checked; backslashes count as slashes.

    Args:
        folder: where the file's names are relative to.
        name: as a frame list, an archive or an index has it.
        origin: the file that names it, for the message.

    Raises:
        UserError: the name is absolute, or leads out of the folder.
    """
    relative = PurePosixPath(str(name).replace("\\", "/"))
    shown = str(name)[:_SHOWN]
    remedy = "it may be made to harm: take it from its authors again"
    drive = bool(relative.parts) and ":" in relative.parts[0]
    if "\0" in str(name) or drive or relative.is_absolute() or ".." in relative.parts:
        raise UserError(f"{origin} names '{shown}', which is outside of {folder}: {remedy}")
    path = folder / relative
    if not path.resolve().is_relative_to(folder.resolve()):
        raise UserError(f"{origin} names '{shown}', a link out of {folder}: {remedy}")
    return path


def bounded_bytes(path: Path, most: int, remedy: str) -> bytes:
    """A file's content.

    Args:
        path: the file.
        most: bytes; a larger file is refused before it is read.
        remedy: what the user can do; it ends the error's line.

    Raises:
        UserError: the file is missing, cannot be read, or is too large.
    """
    try:
        status = path.stat()
        size = status.st_size
        if not stat.S_ISREG(status.st_mode):  # reading a FIFO would wait for somebody who writes
            raise UserError(f"{path} is no file that can be read as a whole: {remedy}")
        if size > most:
            raise UserError(f"{path} has {size >> 20} MB, more than the {most >> 20} MB allowed: {remedy}")
        with path.open("rb") as file:
            return file.read(size)
    except FileNotFoundError:
        raise UserError(f"{path} is missing: {remedy}") from None
    except OSError as error:
        raise UserError(f"{path} cannot be read ({error.strerror}): {remedy}") from None


def check_unpacked(members: Sequence[zipfile.ZipInfo], most_members: int, most_bytes: int) -> None:
    """Refuse an archive's members by what they say they unpack to; ValueError where that is too much."""
    if len(members) > most_members or sum(one.file_size for one in members) > most_bytes:
        raise ValueError(f"it unpacks to more than {most_members} files or {most_bytes >> 20} MB")


def check_picture(path: Path, remedy: str, content: bytes | None = None, most: int = MOST_PIXELS) -> None:
    """Refuse a picture that would not fit into memory.

    Args:
        path: the file.
        remedy: what the user can do; it ends the error's line.
        content: the file's bytes, where they are known already.
        most: pixels.

    Raises:
        UserError: no picture of a known kind, or more pixels than allowed.
    """
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(content) if content is not None else path) as picture:
                width, height = picture.size
    except Image.DecompressionBombError:
        raise UserError(f"{path} claims more pixels than {most:,}: {remedy}") from None
    except Exception:  # a damaged header raises nearly anything
        raise UserError(f"{path} is not a readable picture: {remedy}") from None
    if width * height > most or min(width, height) < 1:
        raise UserError(f"{path} claims {width}x{height} pixels, more than {most:,}: {remedy}")
