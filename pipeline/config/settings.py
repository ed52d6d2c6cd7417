"""Typed settings: stage defaults < preset < dataset < subject < command line.

Every stage declares one frozen pydantic dataclass; the type of a field holds its range::

    @dataclass(frozen=True, config=SETTINGS)
    class TrainSettings:
        iterations: Iterations = setting(1000, "optimiser steps")
        skinning: Literal["own", "nearest"] = setting("own", "whose skinning weights a Gaussian has")

A layer is a mapping of stage name to a mapping of field name to value, as a TOML file gives it; the command
line gives text, which is read as the field's type. Everything is checked here, once, and passed down as
frozen objects. Nothing heavy is imported: the DAG reads settings, too.
"""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import functools
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError

from pipeline.errors import UserError
from pipeline.files.text_encoding import decode_text

SETTINGS = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)
"""Of every settings class: no other fields, no other types, finite numbers only."""

Fraction = Annotated[float, Field(ge=0, le=1)]
Positive = Annotated[float, Field(gt=0, le=1e6)]
Weight = Annotated[float, Field(ge=0, le=1e9)]
LearningRate = Annotated[float, Field(gt=0, le=10)]
Angle = Annotated[float, Field(ge=-3.2, le=3.2)]  # radians
FrameRate = Annotated[float, Field(gt=0, le=1000)]  # frames a second
Count = Annotated[int, Field(ge=1, le=1_000_000_000)]
CountOrNone = Annotated[int, Field(ge=0, le=1_000_000_000)]
Frames = Annotated[int, Field(ge=1, le=100_000)]  # that are made, not chosen
FramesOrNone = Annotated[int, Field(ge=0, le=100_000)]
Iterations = Annotated[int, Field(ge=1, le=10_000_000)]
Side = Annotated[int, Field(ge=32, le=8192)]  # pixels
EvenSide = Annotated[int, Field(ge=16, le=8192, multiple_of=2)]  # pixels; H.264 halves them for its colours
Seed = Annotated[int, Field(ge=0, le=2**32 - 1)]
NotEmpty = Annotated[str, Field(pattern=r"\S")]

Tables = Mapping[str, Mapping[str, Any]]
Schema = Mapping[str, Any]
TRUE = ("true", "yes", "on", "1")
FALSE = ("false", "no", "off", "0")


def setting(default: Any, meaning: str) -> Any:
    """A field of a settings class: its default, and its meaning in a line."""
    return Field(default, description=meaning)


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
        return tomllib.loads(decode_text(path.read_bytes()))
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror})") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: is not valid TOML: {error}") from error


def command_line_layer(overrides: Mapping[str, str]) -> Layer:
    """The layer of overrides such as ``train.iterations=2000``."""
    tables: dict[str, dict[str, str]] = {}
    for name, text in overrides.items():
        stage, _, field = name.partition(".")
        tables.setdefault(stage, {})[field] = text
    return Layer("the command line", tables)


def resolve(declared: Mapping[str, type], layers: Sequence[Layer]) -> dict[str, Any]:
    """The settings of every stage after all layers.

    Args:
        declared: stage name -> settings class.
        layers: the weakest first.

    Raises:
        UserError: an unknown stage or field (the near names are shown), or a value that does not fit.
    """
    merged: dict[str, dict[str, Any]] = {stage: {} for stage in declared}
    origin: dict[str, str] = dict.fromkeys(declared, "the defaults")
    for layer in layers:
        for stage, table in layer.tables.items():
            check_names(declared, layer.origin, stage, table)
            if table:
                merged[stage] |= read_fields(declared[stage], table, layer.origin, f"{stage}.")
                origin[stage] = layer.origin
    return {stage: build(kind, merged[stage], origin[stage]) for stage, kind in declared.items()}


def check_names(declared: Mapping[str, type], origin: str, stage: str, table: Mapping[str, Any]) -> None:
    """Refuses a table or a field that no stage declares, showing the near names."""
    if stage not in declared or not isinstance(table, Mapping):
        raise UserError(f"{origin}: there is no setting '{stage}'{near(stage, declared)}")
    for field in table:
        if field not in schemas(declared[stage]):
            others = [f"{other}.{one}" for other, kind in declared.items() for one in schemas(kind)]
            raise UserError(
                f"{origin}: there is no setting '{stage}.{field}'{near(f'{stage}.{field}', others)}"
            )


def read_fields(kind: type, table: Mapping[str, Any], origin: str, prefix: str = "") -> dict[str, Any]:
    """The values of some fields of a settings class as the fields' types, each within its range.

    Args:
        kind: the class.
        table: field -> value, or text.
        origin: where the values come from, for messages.
        prefix: what stands before the field's name in messages.

    Raises:
        UserError: a value does not fit; names the field, its range and the value.
    """
    values = {name: read(value, schemas(kind)[name]) for name, value in table.items()}
    try:
        kind(**values)
    except ValidationError as error:
        for one in error.errors():
            if one["loc"]:  # else it is about several fields, of which this table may hold only some
                name = str(one["loc"][0])
                raise UserError(
                    f"{origin}: {prefix}{name} {refusal(table[name], schemas(kind)[name])}"
                ) from None
    return values


def build(kind: type, values: Mapping[str, Any], origin: str) -> Any:
    """A settings object; UserError, which begins with ``origin``, where its fields do not fit each other."""
    try:
        return kind(**values)
    except ValidationError as error:
        first = error.errors()[0]
        raise UserError(f"{origin}: {first.get('ctx', {}).get('error', first['msg'])}") from None


def refusal(value: Any, schema: Schema) -> str:
    """``must be ..., not VALUE``, with the near words where the field takes words."""
    shown = value if isinstance(value, str) and value.strip() else repr(value)
    return f"must be {describe(schema)}, not {shown}{near(str(value), words_of(schema))}"


@functools.cache
def schemas(kind: type) -> dict[str, Schema]:
    """Field -> the JSON schema of its type, default and meaning, in the class's order."""
    properties: dict[str, Schema] = TypeAdapter(kind).json_schema()["properties"]
    return properties


def read(value: Any, schema: Schema) -> Any:
    """``value``, which may be text, as the type of a field; what cannot be read comes back as it is."""
    if "anyOf" in schema:
        options = [option for option in schema["anyOf"] if option.get("type") != "null"]
        if len(options) < len(schema["anyOf"]) and str(value).lower() in ("none", ""):
            return None
        return read(value, options[0])
    with contextlib.suppress(TypeError, ValueError, OverflowError):
        if schema["type"] == "array":
            items = value.split(",") if isinstance(value, str) else list(value)
            return tuple(read(item, schema["items"]) for item in items if item != "")
        if schema["type"] == "boolean":
            return {**dict.fromkeys(TRUE, True), **dict.fromkeys(FALSE, False)}.get(str(value).lower(), value)
        if schema["type"] in ("integer", "number") and not isinstance(value, bool):
            number = float(value)
            return int(number) if schema["type"] == "integer" and number == int(number) else number
    return value


def describe(schema: Schema) -> str:
    """A field's type and range in a user's words."""
    if "anyOf" in schema:
        return " or ".join(describe(option) for option in schema["anyOf"])
    if "enum" in schema:
        return f"one of {', '.join(str(word) or repr(word) for word in schema['enum'])}"
    kind = schema["type"]
    if kind == "array":
        least = "not empty, " if schema.get("minItems") else ""
        return f"a list such as a,b, {least}each {describe(schema['items'])}"
    if kind == "string" and "pattern" in schema:
        return f"text like {schema['examples'][0]}" if "examples" in schema else "text that is not empty"
    names = {"null": "none", "boolean": "true or false", "string": "text"}
    return names[kind] if kind in names else describe_number(schema)


def describe_number(schema: Schema) -> str:
    """``a whole number from 1 to 10``, ``a number more than 0 and at most 1``."""
    step = {None: "", 2: "even "}[schema.get("multipleOf")]
    noun = f"{'an' if step else 'a'} {step}{'whole ' if schema['type'] == 'integer' else ''}number"
    if "minimum" in schema and "maximum" in schema:
        return f"{noun} from {schema['minimum']:.10g} to {schema['maximum']:.10g}"
    sides = {
        "exclusiveMinimum": "more than", "minimum": "at least",
        "exclusiveMaximum": "less than", "maximum": "at most",
    }  # fmt: skip
    limits = [f"{word} {schema[side]:.10g}" for side, word in sides.items() if side in schema]
    return f"{noun} {' and '.join(limits)}" if limits else noun


def words_of(schema: Schema) -> list[str]:
    """The words that a field takes; none where it takes numbers or any text."""
    parts = [*schema.get("anyOf", ()), schema.get("items", {})]
    return [str(word) for part in (schema, *parts) for word in part.get("enum", ())]


def help_lines(kind: type, stage: str) -> list[str]:
    """A line for each setting of a stage: its name, default, type, range and meaning."""
    lines = []
    for name, schema in schemas(kind).items():
        default = schema["default"]
        text = ",".join(map(str, default)) if isinstance(default, list) else str(default)
        text = text.lower() if default is None or isinstance(default, bool) else text
        lines.append(f"{stage}.{name}={text}: {describe(schema)}; {schema['description']}")
    return lines


def as_dict(settings: Any) -> dict[str, Any]:
    """A settings object as plain JSON values, for keys and manifests."""
    return {
        name: list(value) if isinstance(value, tuple) else value
        for name, value in dataclasses.asdict(settings).items()
    }
