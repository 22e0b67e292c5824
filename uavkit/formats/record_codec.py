"""Records of ``core`` to plain data and back, without loss, driven by the types of their fields.

Floats keep every bit (JSON writes the shortest text that reads back the same; NaN and infinities, which JSON lacks,
become texts). Enumerations go by name. Arrays go through a store: into the JSON itself, or beside it.
"""

import json
import math
import types
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any, Protocol, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from uavkit.core.errors import InputError, did_you_mean

T = TypeVar("T")
_NOT_FINITE = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}


class ArrayStore(Protocol):
    """Where the arrays of a record go, and come from."""

    def put(self, array: NDArray[Any]) -> Any:
        """Keep an array and return plain data that stands for it."""

    def get(self, plain: Any, where: str) -> NDArray[Any]:
        """Return the array that plain data stand for; raises InputError where there is none."""


class InlineArrays:
    """Arrays as lists in the JSON itself, for small ones."""

    def put(self, array: NDArray[Any]) -> Any:
        """Return dtype, shape and values."""
        values = [encode(value, self) for value in array.ravel().tolist()]
        return {"dtype": array.dtype.str, "shape": list(array.shape), "values": values}

    def get(self, plain: Any, where: str) -> NDArray[Any]:
        """Return the array of dtype, shape and values."""
        try:
            values = [_NOT_FINITE.get(value, value) if isinstance(value, str) else value for value in plain["values"]]
            return np.array(values, dtype=np.dtype(plain["dtype"])).reshape(plain["shape"])
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{where} is no array ({error}): run the step before again") from error


class NamedArrays:
    """Arrays beside the JSON, numbered, as in an npz file."""

    def __init__(self, arrays: dict[str, NDArray[Any]]) -> None:
        """Take the arrays to read from, or an empty dictionary to fill."""
        self.arrays = arrays

    def put(self, array: NDArray[Any]) -> Any:
        """Keep the array under the next name."""
        name = f"a{len(self.arrays)}"
        self.arrays[name] = array
        return {"array": name}

    def get(self, plain: Any, where: str) -> NDArray[Any]:
        """Return the array of that name."""
        name = plain.get("array") if isinstance(plain, dict) else None
        if name not in self.arrays:
            raise InputError(f"{where} is no stored array: run the step before again")
        return self.arrays[name]


def encode(value: Any, store: ArrayStore) -> Any:
    """Return plain data (for JSON) of a record, enumeration, tuple, dictionary by texts, array or number."""
    if isinstance(value, Enum):
        return value.name
    if isinstance(value, np.ndarray):
        return store.put(value)
    if is_dataclass(value):
        return {field.name: encode(getattr(value, field.name), store) for field in fields(value)}
    if isinstance(value, dict):
        return {key: encode(item, store) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [encode(item, store) for item in value]
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, float | np.floating):
        number = float(value)
        return number if math.isfinite(number) else str(number)
    return int(value) if isinstance(value, np.integer) else value


def decode(kind: type[T], plain: Any, store: ArrayStore, where: str) -> T:
    """Return a record of plain data; raises InputError naming the place where the two do not fit."""
    result: T = _decode(kind, plain, store, where)
    return result


def parse_json(path: Path, content: bytes) -> Any:
    """Return the plain data of JSON; raises InputError where it is damaged."""
    try:
        return json.loads(content.decode("utf-8"))
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise InputError(f"{path}: the file is damaged ({error}): run the step before again") from error


def _decode(kind: Any, plain: Any, store: ArrayStore, where: str) -> Any:
    origin, arguments = get_origin(kind), get_args(kind)
    if origin in (Union, types.UnionType):
        if plain is None and type(None) in arguments:
            return None
        (inner,) = (argument for argument in arguments if argument is not type(None))
        return _decode(inner, plain, store, where)
    if origin is np.ndarray or kind is np.ndarray:
        return _array(kind, store.get(plain, where), where)
    if origin is tuple:
        return _tuple(arguments, plain, store, where)
    if origin is dict:
        _require(isinstance(plain, dict), where, "a table", plain)
        return {key: _decode(arguments[1], item, store, f"{where}.{key}") for key, item in plain.items()}
    if is_dataclass(kind):
        return _record(kind, plain, store, where)
    if isinstance(kind, type) and issubclass(kind, Enum):
        _require(plain in kind.__members__, where, f"one of {', '.join(kind.__members__)}", plain)
        return kind[plain]
    return _scalar(kind, plain, where)


def _record(kind: Any, plain: Any, store: ArrayStore, where: str) -> Any:
    _require(isinstance(plain, dict), where, f"a {kind.__name__}", plain)
    hints, names = get_type_hints(kind), [field.name for field in fields(kind)]
    for key in plain:
        if key not in names:
            raise InputError(f"{where} has no {key!r}{did_you_mean(key, names)}")
    for name in names:
        if name not in plain:
            raise InputError(f"{where} lacks {name!r}: it was written by another version; run the step before again")
    values = {name: _decode(hints[name], plain[name], store, f"{where}.{name}") for name in names}
    try:
        return kind(**values)
    except ValueError as error:
        raise InputError(f"{where}: {error}") from error


def _tuple(arguments: tuple[Any, ...], plain: Any, store: ArrayStore, where: str) -> tuple[Any, ...]:
    _require(isinstance(plain, list), where, "a list", plain)
    if len(arguments) == 2 and arguments[1] is Ellipsis:
        arguments = (arguments[0],) * len(plain)
    _require(len(plain) == len(arguments), where, f"{len(arguments)} values", plain)
    return tuple(
        _decode(argument, item, store, f"{where}[{number}]")
        for number, (argument, item) in enumerate(zip(arguments, plain, strict=True))
    )


def _array(kind: Any, array: NDArray[Any], where: str) -> NDArray[Any]:
    scalar = get_args(get_args(kind)[1])[0]
    wanted = np.dtype(scalar) if isinstance(scalar, type) else array.dtype
    _require(array.dtype == wanted, where, f"an array of {wanted}", array.dtype)
    return array


def _scalar(kind: Any, plain: Any, where: str) -> Any:
    if kind is float:
        if isinstance(plain, str) and plain in _NOT_FINITE:
            return _NOT_FINITE[plain]
        _require(isinstance(plain, int | float) and not isinstance(plain, bool), where, "a number", plain)
        return float(plain)
    fits = isinstance(plain, kind) and not (kind is int and isinstance(plain, bool))
    _require(fits, where, f"of type {kind.__name__}", plain)
    return plain


def _require(fits: bool, where: str, wanted: str, plain: Any) -> None:
    if not fits:
        raise InputError(f"{where} should be {wanted}, is {str(plain)[:60]!r}")
