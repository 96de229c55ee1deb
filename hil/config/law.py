"""Tables of the control law and its observers: made of the keys that each registered kind declares."""

from __future__ import annotations

import typing
from collections.abc import Mapping
from typing import Annotated, Any, Literal, Union

from pydantic import BeforeValidator, Discriminator, Field, Tag, TypeAdapter, create_model

from hil.config.motor import AnticoggingTable, IdTable, KnownLoadTable
from hil.config.table import LEAST, MOST, Table, included
from hil.control.registry import REQUIRED, Key, laws, observers


def _annotation(key: Key) -> tuple[Any, Any]:
    """Type and default of a member's key, as pydantic takes them."""
    if key.type == "flag":
        return bool, Field(key.default, description=key.doc)
    if key.type == "i_d_table":
        return Annotated[IdTable | None, BeforeValidator(included)], Field(key.default, description=key.doc)
    most = MOST if key.most is None else key.most
    least = LEAST if key.least is None and key.above == 0.0 else key.least
    bounds: Any = Field(gt=key.above, ge=least, le=most, allow_inf_nan=False)
    kind: Any = Annotated[float, bounds]
    if key.type == "numbers":
        kind = Annotated[list[kind], Field(min_length=1, max_length=key.count)]
    given = ... if key.default is REQUIRED else key.default
    more: Any = {"x-unit": key.unit} if key.unit else None
    about = Field(given, description=key.doc, json_schema_extra=more)
    return kind | None if given is None else kind, about


def _tables(members: Mapping[str, Any], suffix: str, common: dict[str, Any]) -> Any:
    """The union of the tables of all members; ``kind`` tells them apart, the most usual may leave it out."""
    made = []
    for kind, member in members.items():
        fields = {name: _annotation(key) for name, key in member.keys.items()} | common
        name = "".join(part.title() for part in kind.split("-")) + suffix
        tag: Any = (Literal[kind], kind)
        table = create_model(name, __base__=Table, __doc__=member.doc, kind=tag, **fields)
        made.append(Annotated[table, Tag(kind)])
    names = ", ".join(repr(kind) for kind in members)
    return Annotated[
        Union[tuple(made)],  # noqa: UP007 - made at run time
        Discriminator(
            _observer_kind if suffix == "Observer" else _law_kind,
            custom_error_type="unknown_kind",
            custom_error_message=f"kind must be one of {names}",
        ),
    ]


def _observer_kind(value: Any) -> Any:
    """The kind that an observer's table names; the paper's when it names none."""
    return value.get("kind", "ftdob") if isinstance(value, Mapping) else getattr(value, "kind", None)


def _law_kind(value: Any) -> Any:
    """The kind that a law's table names; the cascade when it names none."""
    return value.get("kind", "cascade") if isinstance(value, Mapping) else getattr(value, "kind", None)


ANTICOGGING = (
    "Load torque over the angle to compensate: a file of hil identify --steps cogging; left out: none."
)
KNOWN_LOAD = "Load torque by speed and angle that is known beforehand; left out: none."
COUPLING = "Reluctance torque and cross-coupling are known terms; false: the observers find them."
if typing.TYPE_CHECKING:
    ChannelTable = Any
    ControllerTable = Any
else:
    ChannelTable = _tables(observers(), "Observer", {})
    """One channel's observer: a table of each registered kind (:mod:`hil.control.observers`)."""
    ControllerTable = _tables(
        laws(),
        "Controller",
        {
            "compensate_coupling": (bool, Field(True, description=COUPLING)),
            "anticogging": (
                Annotated[AnticoggingTable | None, BeforeValidator(included)],
                Field(None, description=ANTICOGGING),
            ),
            "known_load": (KnownLoadTable | None, Field(None, description=KNOWN_LOAD)),
        },
    )
    """The control law: a table of each registered kind (:mod:`hil.control.laws`)."""


class ObserverTable(Table):
    """The disturbance observer of the speed channel and of both current channels.

    A drive with a current loop of its own has no observer of the currents.
    """

    speed: ChannelTable
    """Observer of the load torque, in the speed channel."""
    current: ChannelTable | None = None
    """Observer of the voltage errors, in both current channels; a drive that takes a current or a torque has
    none."""


def cascade() -> Any:
    """The controller of a config that names none."""
    adapter: Any = TypeAdapter(ControllerTable)
    return adapter.validate_python({"kind": "cascade"})
