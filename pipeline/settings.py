"""Typed settings: stage defaults < preset < dataset < subject < command line.

Every stage declares one frozen dataclass. A layer is a mapping of stage name to a mapping of field
name to value, as a TOML file gives it; the command line gives text, which is read as the field's
type. Everything is checked here, once, and passed down as frozen objects.
"""

from __future__ import annotations

import dataclasses
import difflib
import tomllib
import types
import typing
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.errors import UserError

Tables = Mapping[str, Mapping[str, Any]]
TRUE = ("true", "yes", "on", "1")
FALSE = ("false", "no", "off", "0")


@dataclasses.dataclass(frozen=True)
class Layer:
    """Settings from one place.

    Attributes:
        origin: where they come from, for messages: a file, or "the command line".
        tables: stage -> field -> value.
    """

    origin: str
    tables: Tables


def near(name: str, known: Iterable[str]) -> str:
    """``"; did you mean a, b?"`` for the known names that resemble ``name``, or nothing."""
    close = difflib.get_close_matches(name, list(known), n=3, cutoff=0.5)
    return f"; did you mean {' or '.join(close)}?" if close else ""


def read_toml(path: Path) -> dict[str, Any]:
    """Reads a TOML file.

    Raises:
        UserError: the file is not there or is not TOML.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror})") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: is not valid TOML: {error}") from error


def command_line_layer(words: Mapping[str, str]) -> Layer:
    """The layer of words such as ``train.iterations=2000``."""
    tables: dict[str, dict[str, str]] = {}
    for name, text in words.items():
        stage, _, field = name.partition(".")
        tables.setdefault(stage, {})[field] = text
    return Layer("the command line", tables)


def resolve(declared: Mapping[str, type], layers: Sequence[Layer]) -> dict[str, Any]:
    """The settings of every stage after all layers.

    Args:
        declared: stage name -> settings dataclass.
        layers: the weakest first.

    Raises:
        UserError: an unknown stage or field (the near names are shown), or a value that does not fit.
    """
    merged: dict[str, dict[str, Any]] = {stage: {} for stage in declared}
    origin: dict[str, str] = dict.fromkeys(declared, "the defaults")
    for layer in layers:
        for stage, table in layer.tables.items():
            check_names(declared, layer.origin, stage, table)
            for field, value in table.items():
                merged[stage][field] = read_value(declared[stage], stage, field, value, layer.origin)
                origin[stage] = layer.origin
    settings = {}
    for stage, kind in declared.items():
        try:
            settings[stage] = kind(**merged[stage])
        except ValueError as error:
            raise UserError(f"{origin[stage]}: {error}") from error
    return settings


def check_names(declared: Mapping[str, type], origin: str, stage: str, table: Mapping[str, Any]) -> None:
    """Refuses a table or a field that no stage declares, showing the near names."""
    if stage not in declared or not isinstance(table, Mapping):
        raise UserError(f"{origin}: there is no setting '{stage}'{near(stage, declared)}")
    known = [f"{stage}.{field.name}" for field in dataclasses.fields(declared[stage])]
    for field in table:
        if f"{stage}.{field}" not in known:
            others = [
                f"{other}.{one.name}" for other, kind in declared.items() for one in dataclasses.fields(kind)
            ]
            raise UserError(
                f"{origin}: there is no setting '{stage}.{field}'{near(f'{stage}.{field}', others)}"
            )


def read_value(kind: type, stage: str, field: str, value: Any, origin: str) -> Any:
    """One value as its field's type; text is read, numbers are checked.

    Raises:
        UserError: the value does not fit.
    """
    expected = typing.get_type_hints(kind)[field]
    try:
        return convert(value, expected)
    except (TypeError, ValueError) as error:
        raise UserError(f"{origin}: {stage}.{field} must be {describe(expected)}, not {value!r}") from error


def convert(value: Any, expected: Any) -> Any:
    """``value`` as ``expected``: bool, int, float, str, tuple[T, ...] or T | None.

    Raises:
        ValueError, TypeError: it cannot be read so without losing something.
    """
    if typing.get_origin(expected) in (typing.Union, types.UnionType):
        options = [option for option in typing.get_args(expected) if option is not type(None)]
        if value is None or (isinstance(value, str) and value.lower() in ("none", "")):
            return None
        return convert(value, options[0])
    if typing.get_origin(expected) is tuple:
        items = value.split(",") if isinstance(value, str) else list(value)
        return tuple(convert(item, typing.get_args(expected)[0]) for item in items if item != "")
    return convert_scalar(value, expected)


def convert_scalar(value: Any, expected: type) -> Any:
    """``value`` as a bool, int, float or str."""
    if expected is bool:
        text = str(value).lower()
        if text not in TRUE + FALSE:
            raise ValueError(text)
        return text in TRUE
    if isinstance(value, bool):
        raise TypeError("a truth value is not a number")
    if expected is int:
        number = float(value)
        if number != int(number):
            raise ValueError(value)
        return int(number)
    if expected is float:
        return float(value)
    if not isinstance(value, str):
        raise TypeError(value)
    return value


def describe(expected: Any) -> str:
    """A type in a user's words."""
    names = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}
    if typing.get_origin(expected) is tuple:
        return f"a list such as a,b of {describe(typing.get_args(expected)[0])}"
    if typing.get_origin(expected) in (typing.Union, types.UnionType):
        return " or ".join(
            "none" if part is type(None) else describe(part) for part in typing.get_args(expected)
        )
    return names.get(expected, str(expected))


def as_dict(settings: Any) -> dict[str, Any]:
    """A settings object as plain JSON values, for keys and manifests."""
    return {
        name: list(value) if isinstance(value, tuple) else value
        for name, value in dataclasses.asdict(settings).items()
    }
