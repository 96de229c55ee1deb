"""What every table of a configuration is made of: base, ranges of physical quantities, inclusion by path."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationInfo

LEAST, MOST = 1e-12, 1e9
Positive = Annotated[float, Field(ge=LEAST, le=MOST, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, le=MOST, allow_inf_nan=False)]
Finite = Annotated[float, Field(ge=-MOST, le=MOST, allow_inf_nan=False)]
"""Ranges of physical quantities: no product or square of a few of them overflows or vanishes."""
Seconds = Annotated[float, Field(ge=1e-6, le=1e7, allow_inf_nan=False)]
"""Times whose nanoseconds and ticks are whole numbers with room to spare; 1e7 s are four months."""
Since = Annotated[float, Field(ge=0, le=1e7, allow_inf_nan=False)]
Speed = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]


class Table(BaseModel):
    """Base of all tables: frozen, unknown keys refused, no silent conversion of strings."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


def included(value: Any, info: ValidationInfo) -> Any:
    """A table may be given inline or as the path of a TOML file that holds it."""
    return info.context["include"](value) if isinstance(value, str) and info.context else value
