"""A mistake in a configuration in one line: key path, what is wrong, what to do."""

from __future__ import annotations

import difflib
import types
import typing
from typing import Any

from pydantic import BaseModel

from hil.config.drive import FILTERS
from hil.control.registry import laws, observers


def describe(problem: Any, model: type[BaseModel]) -> str:
    """One line for one pydantic problem: key path, what is wrong, what to do."""
    path = ".".join(_written(problem["loc"]))
    if problem["type"] == "extra_forbidden":
        near = difflib.get_close_matches(str(problem["loc"][-1]), _keys_at(model, problem["loc"][:-1]), n=1)
        return f"{path}: unknown key" + (f"; did you mean {near[0]!r}?" if near else "; remove it")
    if problem["type"] == "missing":
        return f"{path}: missing; add it"
    text = problem["msg"].removeprefix("Value error, ")
    text = text[:1].lower() + text[1:]
    return f"{path}: {text}{_given(problem.get('input'))}"


def _given(value: Any) -> str:
    """What stood there, when it is no table; a number of hundreds of digits in short."""
    if not isinstance(value, (int, float, str)):
        return ""
    text = (
        repr(value) if not isinstance(value, int) or value.bit_length() < 256 else "a number beyond any range"
    )
    return f", not {text if len(text) <= 80 else text[:77] + '...'}"


def _written(loc: tuple[Any, ...]) -> list[str]:
    """The key path as the file has it: pydantic names the kind of a law or an observer after its table."""
    kinds: dict[Any, Any] = {"controller": laws(), "speed": observers(), "current": observers()}
    kinds["speed_filter"] = FILTERS
    before = ("", *loc)[: len(loc)]
    return [str(part) for table, part in zip(before, loc, strict=True) if part not in kinds.get(table, ())]


def _keys_at(model: type[BaseModel], loc: tuple[Any, ...]) -> list[str]:
    """Keys of the table at ``loc``; for a union of tables, of all its members that the tag names."""
    models: list[type[BaseModel]] = [model]
    for part in loc:
        found = [
            m
            for owner in models
            if part in owner.model_fields
            for m in models_in(owner.model_fields[part].annotation)
        ]
        models = found or [m for m in models if part in _tags(m)] or models
    return [key for m in models for key in m.model_fields]


def models_in(annotation: Any) -> list[type[BaseModel]]:
    """The tables that a field's type may be."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    if isinstance(annotation, types.UnionType) or typing.get_origin(annotation) is not None:
        return [m for a in typing.get_args(annotation) for m in models_in(a)]
    return []


def _tags(model: type[BaseModel]) -> tuple[Any, ...]:
    kind = model.model_fields.get("kind")
    return typing.get_args(kind.annotation) if kind else ()
