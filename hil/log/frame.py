"""Ticks as columns: a pandas DataFrame, and what a column is called and measured in."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from hil.errors import HilError
from hil.signals import FIELDS, DriveState, Field, Reason, Request

if TYPE_CHECKING:
    from hil.log.reader import Log

ENUMS: Final = {"drive_state": DriveState, "state": DriveState, "reason": Reason, "request": Request}
NAME_BYTES: Final = 32
REMEDY: Final = "pip install 'hil-drive[export]'"


class MissingPackage(HilError, ImportError):
    """A format needs a package that is not installed; the message says how to install it."""


def need(module: str, what: str) -> Any:
    """Import an optional package. Raises MissingPackage with the command that installs it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        raise MissingPackage(f"{what} needs the package {package}: {REMEDY}") from error


def title(field: Field) -> str:
    """Column title with the unit, for formats that have no other place for it."""
    return f"{field.name} [{field.unit}]" if field.unit else field.name


def data_frame(log: Log, *, names: bool) -> Any:
    """All ticks of ``log`` as a DataFrame; see :meth:`hil.log.reader.Log.to_pandas`."""
    pd = need("pandas", "to_pandas")
    columns: dict[str, Any] = {field.name: np.ascontiguousarray(log.ticks[field.name]) for field in FIELDS}
    if names:
        for name, kind in ENUMS.items():
            columns[name] = pd.Categorical([_name(kind, value) for value in columns[name].tolist()])
    t = columns["t_ns"]
    frame = pd.DataFrame(columns)
    frame.index = pd.Index((t - t[0]) * 1e-9 if len(t) else t * 1e-9, name="t [s]")
    frame.attrs["units"] = {field.name: field.unit for field in FIELDS}
    frame.attrs["meanings"] = {field.name: field.doc for field in FIELDS}
    return frame


def named(name: str, values: Any) -> Any:
    """The names of an enum field's values as text of a fixed size; a number that has none is its digits."""
    kinds, places = np.unique(values, return_inverse=True)
    return np.array([_name(ENUMS[name], int(value)) for value in kinds], f"S{NAME_BYTES}")[places]


def _name(kind: Any, value: int) -> str:
    """Name of an enum's value; a number that has none stays a number."""
    try:
        return str(kind(value).name)
    except ValueError:
        return str(value)
