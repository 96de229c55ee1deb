"""docs/safety.md names real tests: a row whose test was renamed or removed fails here."""

from __future__ import annotations

import ast
import re
from pathlib import Path

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


def test_every_hazard_names_a_test() -> None:
    rows = hazards(PAGE)
    assert len(rows) > 20
    assert [row for row in rows if not NAMED.search(row)] == []
