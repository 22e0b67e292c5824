"""Strict reading of TOML: an unknown key is an error that names the nearest known one."""

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, ValidationError

from uavkit.core.errors import InputError, did_you_mean

M = TypeVar("M", bound=BaseModel)


class StrictModel(BaseModel):
    """Base of everything that is read from TOML or JSON: no unknown keys, no silent conversions."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


def read_toml(path: Path, model: type[M]) -> M:
    """Return a TOML file's contents, validated; raises InputError naming file, key and the nearest known key."""
    try:
        text = path.read_bytes().decode("utf-8-sig")
        content = tomllib.loads(text)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InputError(f"{path}: no valid TOML: {error}") from error
    return validated(model, content, str(path))


def validated(model: type[M], content: Mapping[str, Any], where: str) -> M:
    """Return a model of plain data; raises InputError with a thing that is wrong and its place."""
    try:
        return model.model_validate(content)
    except ValidationError as error:
        faults = error.errors()  # a misspelt key is also a missing one: the spelling helps more
        first = next((fault for fault in faults if fault["type"] == "extra_forbidden"), faults[0])
        raise InputError(f"{where}: {_message(model, first)}") from error


def _message(model: type[BaseModel], error: Any) -> str:
    place = [str(part) for part in error["loc"]]
    table, key = place[:-1], place[-1] if place else ""
    if error["type"] == "extra_forbidden":
        known = _keys_of(model, table)
        return f"{_table(table)}has no option {key!r}{did_you_mean(key, known)}"
    if error["type"] == "missing":
        return f"{_table(table)}lacks {key!r}"
    return f"{_table(table)}{key} = {error['input']!r}: {error['msg']}"


def _table(place: list[str]) -> str:
    return f"[{'.'.join(place)}] " if place else ""


def _keys_of(model: type[BaseModel], place: list[str]) -> list[str]:
    """Return the keys of the model that a path of keys (and list positions) leads to."""
    for part in place:
        if part in model.model_fields:
            inner = _model_in(model.model_fields[part].annotation)
            if inner is None:
                return []
            model = inner
    return list(model.model_fields)


def _model_in(annotation: Any) -> type[BaseModel] | None:
    """Return the model inside an annotation like ``X``, ``X | None``, ``list[X]`` or ``dict[str, X]``."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((found for argument in get_args(annotation) if (found := _model_in(argument)) is not None), None)
