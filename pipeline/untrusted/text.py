"""JSON and lists of names, bounded."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from pipeline.errors import UserError
from pipeline.files.text_encoding import decode_text
from pipeline.untrusted.bounds import bounded_bytes

MOST_BYTES = 256 << 20  # the largest that is known, an INSTA transforms.json, has some MB
MOST_KEYS = 500_000  # of all objects together; a dataset's index has a few a frame
_DIGITS = 400  # of one number


def parse_json(path: Path, remedy: str, most_bytes: int = MOST_BYTES, most_keys: int = MOST_KEYS) -> Any:
    """Read JSON.

    Args:
        path: the file.
        remedy: what the user can do; it ends the error's line.
        most_bytes: a larger file is refused before it is read.
        most_keys: of all its objects together.

    Raises:
        UserError: the file is missing, too large, no JSON, or holds NaN, an infinity or too many keys.
    """
    content = bounded_bytes(path, most_bytes, remedy)
    count = 0

    def counted(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        nonlocal count
        count += len(pairs)
        if count > most_keys:
            raise ValueError(f"it has more than {most_keys} keys")
        return dict(pairs)

    try:
        return json.loads(
            decode_text(content), parse_constant=_refuse, parse_float=_finite, parse_int=_whole,
            object_pairs_hook=counted,
        )  # fmt: skip
    except RecursionError:
        raise UserError(f"{path} is not readable JSON (it is nested too deep): {remedy}") from None
    except ValueError as error:
        raise UserError(f"{path} is not readable JSON ({error}): {remedy}") from None


def read_lines(path: Path, remedy: str, most: int = 1_000_000) -> list[str]:
    """The lines of a list without empty ones and spaces around; UserError where it is none, or too long."""
    try:
        text = decode_text(bounded_bytes(path, 64 << 20, remedy))
    except UnicodeDecodeError as error:
        raise UserError(f"{path} is no text ({error.reason}): {remedy}") from None
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    if len(lines) > most:
        raise UserError(f"{path} has {len(lines)} lines, more than {most}: {remedy}")
    return lines


def read_numbers(path: Path, remedy: str, suffix: str = "") -> list[int]:
    """A list of frame numbers, one a line, increasing.

    Args:
        path: the list.
        remedy: what the user can do; it ends the error's line.
        suffix: what each line ends with besides, such as ``.png``.

    Raises:
        UserError: a line is no such number, or there is none.
    """
    numbers = set()
    for line in read_lines(path, remedy):
        digits = line.removesuffix(suffix)
        if not (digits.isascii() and digits.isdigit() and len(digits) < 10):
            raise UserError(f"{path}: '{line[:40]}' is no frame number: {remedy}")
        numbers.add(int(digits))
    if not numbers:
        raise UserError(f"{path} names no frame: {remedy}")
    return sorted(numbers)


def _refuse(name: str) -> float:
    raise ValueError(f"it holds {name}, which is no finite number")


def _finite(text: str) -> float:
    value = float(text)
    return value if math.isfinite(value) else _refuse(text[:20])


def _whole(text: str) -> int:
    if len(text) > _DIGITS:  # reading digits takes time by the square of their number
        raise ValueError(f"it holds a number of {len(text)} digits")
    return int(text)
