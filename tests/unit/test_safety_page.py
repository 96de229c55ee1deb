"""docs/safety.md names real tests: a row whose test was renamed or removed fails here."""

from __future__ import annotations

import ast
import re
from pathlib import Path
from typing import Any, get_args

import pytest

from firmware_model.faults import LinkFault, PlantFault
from hil.config.tables import load_toml
from hil.faults.matrix import Host, Matrix, Row

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "safety.md").read_text(encoding="utf-8")
NAMED = re.compile(r"`(tests/[\w/]+\.py)::(\w+)`")


def missing(page: str) -> list[str]:
    """Return the ``path::name`` of the page that are no test functions in the tree."""
    named = sorted(set(NAMED.findall(page)))
    return [f"{path}::{name}" for path, name in named if name not in functions_in(ROOT / path)]


def functions_in(path: Path) -> set[str]:
    if not path.is_file():
        return set()
    body = ast.parse(path.read_text(encoding="utf-8")).body
    return {node.name for node in body if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")}


def hazards(page: str) -> list[str]:
    """Return the rows of the hazard table without its head."""
    return [row for row in page.split("## Hazards")[1].split("## ")[0].splitlines() if row.startswith("|")][
        2:
    ]


def test_every_named_test_exists() -> None:
    assert missing(PAGE) == []


def test_a_name_that_is_not_there_is_found() -> None:
    page = "`tests/unit/test_guard.py::test_gone` `tests/unit/test_gone.py::test_at_all`"
    assert missing(page) == ["tests/unit/test_gone.py::test_at_all", "tests/unit/test_guard.py::test_gone"]


def tried(page: str) -> list[tuple[str, str]]:
    """(kind, beginning of the rows' names) of the table of faults."""
    part = page.split("## Faults that are tried")[1].split("## ")[0]
    rows = [row.split("|") for row in part.splitlines() if row.startswith("|")][2:]
    return [(cells[2].strip(" `"), cells[4].strip(" `")) for cells in rows]


def kinds_of(row: Row) -> set[str]:
    return {fault["kind"] for fault in row.fault} | ({row.host.kind} if row.host else set())


def test_the_table_of_faults_and_the_matrix_name_the_same() -> None:
    rows = load_toml(ROOT / "configs" / "faults.toml", Matrix).row
    there = {kind for table in (*get_args(LinkFault), *get_args(PlantFault)) for kind in kind_of(table)}
    there |= {kind for table in get_args(get_args(Host)[0]) for kind in kind_of(table)}
    assert {kind for kind, _ in tried(PAGE)} == there, "kinds of faults that can be scripted"
    for kind, name in tried(PAGE):
        named = [row for row in rows if row.name.startswith(name)]
        assert named and all(kind in kinds_of(row) for row in named), (kind, name)


def kind_of(table: Any) -> tuple[str, ...]:
    kinds: tuple[str, ...] = get_args(table.model_fields["kind"].annotation)
    return kinds


def test_every_hazard_names_a_test() -> None:
    rows = hazards(PAGE)
    assert len(rows) > 20
    assert [row for row in rows if not NAMED.search(row)] == []
