"""What is said of config keys: each has a line, a unit and a range, and schema and loader agree."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from firmware_model.config import PlantConfig
from hil.cli import main
from hil.config.table import Table
from hil.config.tables import RunConfig, load_toml, validate
from hil.config.toml import put
from hil.errors import ConfigError
from hil.manual import schema
from hil.manual.keys import Key, found, tables
from hil.manual.page import SCHEMAS, files
from hil.manual.schema import FILES, schema_of
from hil.manual.units import PURE
from tests.conftest import CONFIGS, ROOT

pytestmark = pytest.mark.slow

MADE = files()
KEYS = [key for table in tables() for key in table.keys]
VALIDATORS = {file: jsonschema.Draft202012Validator(schema_of(file)) for file in FILES}
SHIPPED = [path for path in CONFIGS.rglob("*.toml") if path.parent.name != "motors"]


def unsaid(keys: list[Key]) -> list[str]:
    """Keys without a line, and numbers without a unit that are no pure numbers."""
    lines = [key.key for key in keys if len(key.doc) < 5 or not key.doc.endswith(".")]
    bare = [key for key in keys if {"number", "integer"} & set(key.type.split()) and not key.unit]
    return lines + [key.key for key in bare if key.key.split(".")[-1].split(":")[-1] not in PURE]


def test_every_key_has_a_line_and_every_number_its_unit() -> None:
    assert len(KEYS) > 400 and unsaid(KEYS) == []


def test_a_key_without_a_line_or_a_unit_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    class Bare(Table):
        said_s: float = 1.0
        """A time."""
        unsaid_s: float = 1.0
        bare: float = 2.0
        """A number."""

    monkeypatch.setitem(schema.FILES, "plant", Bare)
    schema_of.cache_clear()
    try:
        keys = [key for table in tables() for key in table.keys if table.file == "plant"]
        assert unsaid(keys) == ["plant:unsaid_s", "plant:bare"]
    finally:
        schema_of.cache_clear()


@pytest.mark.parametrize("name", MADE)
def test_page_and_schemas_are_current(name: str) -> None:
    assert (ROOT / "docs" / name).read_text(encoding="utf-8") == MADE[name], "make reference"


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: str(path.relative_to(CONFIGS)))
def test_a_shipped_file_names_its_schema_and_keeps_it(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    named = path.parent / text.splitlines()[0].removeprefix("#:schema ")
    assert named.resolve().parent == ROOT / "docs" and named.name in SCHEMAS
    VALIDATORS[SCHEMAS[named.name]].validate(tomllib.loads(text))


@pytest.mark.parametrize("file", FILES)
def test_a_schema_is_one(file: str) -> None:
    jsonschema.Draft202012Validator.check_schema(schema_of(file))


def given(file: str) -> tuple[dict[str, Any], Path]:
    """A shipped file with something in every table, and its folder."""
    path = CONFIGS / ("demo.toml" if file == "run" else "plants/demo.toml")
    return tomllib.loads(path.read_text(encoding="utf-8")), path.parent


def whole(file: str, key: Key) -> dict[str, Any]:
    """A table of the key's kind, else the file's own, with every number in its range."""
    return {
        other.key.rpartition(".")[2]: other.kind if other.key.endswith(".kind") else middle(other)
        for other in KEYS
        if other.key.rpartition(".")[0] == key.key.rpartition(".")[0] and other.kind == key.kind
    }


def middle(key: Key) -> Any:
    """Some value of the key's range; 1 where that is in it."""
    one = min(max(1.0, key.least or 0.0), key.most or 1.0)
    one = 1 if key.type == "integer" else one
    return [one] if key.type.startswith("list") else key.type == "true or false" or one


def beyond(key: Key) -> Iterator[Any]:
    """Values that the key must refuse: beside its range, and of another type."""
    for bound, way in ((key.least, -1), (key.above, -1), (key.most, 1)):
        if bound is not None:
            far = bound + way * max(1, abs(bound))
            yield [far, far] if key.type.startswith("list") else far
    yield {"number": "1.0", "integer": 1.5, "text": 1, "true or false": "yes"}.get(key.type, {"a": 1})


def refuses(file: str, data: dict[str, Any], base: Path) -> tuple[bool, bool]:
    """Whether the schema and whether the loader refuses."""
    try:
        validate(data, FILES[file], "", base)
        loader = False
    except ConfigError:
        loader = True
    return not VALIDATORS[file].is_valid(data), loader


SETTABLE = [
    (file, key)
    for file, before in (("run", ""), ("plant", "plant:"))
    for key in KEYS
    if (":" not in key.key if file == "run" else key.key.startswith(before))
    and not key.key.endswith(".kind")
    and not key.key.startswith(("drive.signals", "faults.expect"))
    and "table" not in key.type
]


@pytest.mark.parametrize(("file", "key"), SETTABLE, ids=[f"{key.key}-{key.kind}" for _, key in SETTABLE])
def test_schema_and_loader_refuse_the_same(file: str, key: Key) -> None:
    name = key.key.rpartition(":")[2]
    for value in beyond(key):
        data, base = given(file)
        if key.kind:
            table, _, last = name.rpartition(".")
            row = whole(file, key) | {last: value}
            put(data, table, [row] if table in ("load", "fault") else row, base)
        else:
            put(data, name, value, base)
        assert refuses(file, data, base) == (True, True), value


@pytest.mark.parametrize("file", ["run", "plant"])
def test_unknown_keys_are_refused_by_both(file: str) -> None:
    data, base = given(file)
    assert refuses(file, data, base) == (False, False)
    put(data, "motor.x", 1, base)
    assert refuses(file, data, base) == (True, True)


def test_a_key_is_found_by_its_whole_name_its_table_or_its_end() -> None:
    assert [key.key for key in found("loop.rate_hz")] == ["loop.rate_hz"]
    assert [key.key for key in found("rate_hz")] == ["loop.rate_hz"]
    assert {key.key for key in found("[stop]")} == {"stop.ramp_rad_s2", "stop.ramp_max_s"}
    assert {key.kind for key in found("plant:load.0.at_s")} == {"step", "brake"}
    assert {key.key.split(":")[0] for key in found("campaign")} == {"campaign"}


@pytest.mark.parametrize("wanted", ["loop.raet_hz", "", "nothing like it"])
def test_what_is_no_key_is_refused(wanted: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["config", "explain", wanted]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"hil: {wanted}: no such key") and said.count("\n") == 1
    assert ("did you mean 'loop.rate_hz'" in said) == (wanted == "loop.raet_hz")


def test_explain_says_type_range_unit_and_default(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["config", "explain", "rate_hz"]) == 0
    assert capsys.readouterr().out.startswith(
        "loop.rate_hz: integer, 10 to 20000 Hz, default 1000\n    Ticks"
    )
    assert main(["config", "explain", "loop.rate_hz", "--json"]) == 0
    (key,) = json.loads(capsys.readouterr().out)["keys"]
    assert (key["least"], key["most"], key["unit"], key["default"]) == (10, 20000, "Hz", 1000)
    assert main(["config", "explain", "--json"]) == 0
    assert {"loop", "plant:load", "faults:row"} <= {
        t["table"] for t in json.loads(capsys.readouterr().out)["tables"]
    }


@pytest.mark.parametrize("file", FILES)
def test_the_schema_is_printed(file: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["config", "schema", file]) == 0
    assert json.loads(capsys.readouterr().out) == schema_of(file)


def test_a_schema_of_nothing_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["config", "schema", "motor"]) == 2
    assert "there are run, plant, faults, campaign" in capsys.readouterr().err


def test_a_new_folder_has_its_schemas(tmp_path: Path) -> None:
    assert main(["init", str(tmp_path / "mine")]) == 0
    for path in (tmp_path / "mine").rglob("*.toml"):
        text = path.read_text(encoding="utf-8")
        if text.startswith("#:schema "):
            named = path.parent / text.splitlines()[0].removeprefix("#:schema ")
            assert json.loads(named.read_text(encoding="utf-8")) == schema_of(SCHEMAS[named.name])
    assert load_toml(tmp_path / "mine" / "demo.toml", RunConfig)
    assert load_toml(tmp_path / "mine" / "plants" / "demo.toml", PlantConfig)
