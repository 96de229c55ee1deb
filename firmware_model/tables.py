"""What every table of the emulated drive is made of: its base and the ranges of its numbers."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Positive = Annotated[float, Field(ge=1e-12, le=1e9, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, le=1e9, allow_inf_nan=False)]
Finite = Annotated[float, Field(ge=-1e9, le=1e9, allow_inf_nan=False)]
"""Ranges of physical quantities: no product or square of a few of them overflows or vanishes."""
Since = Annotated[float, Field(ge=0, le=1e7, allow_inf_nan=False)]
Span = Annotated[float, Field(ge=1e-9, le=1e7, allow_inf_nan=False)]
"""Times [s] whose nanoseconds are whole numbers with room to spare."""


class Table(BaseModel):
    """Base of all tables: frozen, unknown keys refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)
