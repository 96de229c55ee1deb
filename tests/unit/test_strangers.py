"""Files of a stranger can't run code or exhaust memory, and nothing binds to the world."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers.codec import Database
from drivers.dbc import MAX_DBC_BYTES
from drivers.errors import DatabaseError
from firmware_model.config import PlantConfig
from hil.config.tables import RunConfig, load_toml
from hil.config.toml import MAX_CONFIG_BYTES, read_toml
from hil.errors import ConfigError
from hil.faults.matrix import Matrix
from hil.runtime.header import plant_of
from tests.conftest import CONFIGS, ROOT

pytestmark = pytest.mark.slow

PACKAGES = ("hil", "drivers", "firmware_model")
RUNS_CODE = {"eval", "exec", "compile", "__import__"}
LOADS_CODE = {"pickle", "cPickle", "marshal", "shelve", "dill", "joblib", "yaml"}
# (file, call): what loads objects of its own fork
ALLOWED = {("hil/log/ahead.py", "pickle")}
MODELS = (RunConfig, PlantConfig, Matrix)


def sources() -> Iterator[tuple[str, ast.AST]]:
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            yield str(path.relative_to(ROOT)), ast.parse(path.read_text(encoding="utf-8"))


def code_runners(tree: ast.AST) -> set[str]:
    """What a module calls or imports that runs code it is given."""
    found: set[str] = set()
    for node in ast.walk(tree):
        match node:
            case ast.Call(func=ast.Name(id=name)) if name in RUNS_CODE:
                found.add(name)
            case ast.Import(names=names):
                found |= {n.name.split(".")[0] for n in names} & LOADS_CODE
            case ast.ImportFrom(module=str(module)):
                found |= {module.split(".")[0]} & LOADS_CODE
            case ast.keyword(arg="shell", value=ast.Constant(value=True)):
                found.add("shell")
            case ast.keyword(arg="allow_pickle", value=ast.Constant(value=True)):
                found.add("allow_pickle")
            case ast.Attribute(value=ast.Name(id="os"), attr="system" | "popen"):
                found.add("os.system")
    return found


def test_nothing_runs_code_that_a_file_could_hold() -> None:
    assert {(name, call) for name, tree in sources() for call in code_runners(tree)} <= ALLOWED


@pytest.mark.parametrize(
    "source",
    (
        "eval(text)",
        "exec(text)",
        "import pickle",
        "import marshal",
        "from yaml import load",
        "np.load(p, allow_pickle=True)",
        "os.system(x)",
        "subprocess.run(x, shell=True)",
    ),
)
def test_the_scan_would_see_it(source: str) -> None:
    assert code_runners(ast.parse(source))


def addresses(tree: ast.AST) -> set[str]:
    """Constants that mean every interface of the machine, and calls that bind without an address."""
    found = {
        str(node.value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and node.value in ("0.0.0.0", "::", "INADDR_ANY")  # noqa: S104
    }
    for node in ast.walk(tree):
        match node:
            case ast.Call(
                func=ast.Attribute(attr="bind"), args=[ast.Tuple(elts=[ast.Constant(value=""), *_])]
            ):
                found.add("bind")
            case ast.Attribute(attr="INADDR_ANY"):
                found.add("INADDR_ANY")
    return found


def test_nothing_binds_to_every_interface() -> None:
    assert [(name, found) for name, tree in sources() if (found := addresses(tree))] == []
    assert addresses(ast.parse('s.bind(("", 80))')) and addresses(ast.parse('serve("0.0.0.0")'))


def within(megabytes: int, code: str, *words: str) -> subprocess.CompletedProcess[str]:
    """Run code in a process that may take so much memory beyond what it has once the packages are loaded."""
    head = (
        "import resource, sys\nfrom pathlib import Path\n"
        "from drivers.codec import Database\nfrom hil.config.tables import RunConfig, load_toml\n"
        "from hil.log.reader import open_log\n"
        "size = int(Path('/proc/self/statm').read_text().split()[0]) * resource.getpagesize()\n"
        f"limit = size + {megabytes << 20}\nresource.setrlimit(resource.RLIMIT_AS, (limit, limit))\n"
    )
    return subprocess.run(
        [sys.executable, "-c", head + code, *words],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=120,
    )


READS = {
    "config": "load_toml(Path(sys.argv[1]), RunConfig)",
    "dbc": "Database(Path(sys.argv[1]))",
    "log": "open_log(Path(sys.argv[1]))",
}


@pytest.mark.corners
@pytest.mark.parametrize("kind", READS)
def test_a_huge_file_is_refused_without_being_read(kind: str, tmp_path: Path) -> None:
    """A sparse file of 8 GB, in a process that may take 64 MB more than it has."""
    path = tmp_path / "huge"
    with path.open("wb") as file:
        file.truncate(8 << 30)
    done = within(64, READS[kind], str(path))
    last = done.stderr.strip().splitlines()[-1]
    assert done.returncode == 1 and last.startswith(("hil.", "drivers.")), done.stderr
    assert "MemoryError" not in done.stderr


def test_the_limit_of_memory_would_be_felt(tmp_path: Path) -> None:
    assert "MemoryError" in within(64, "bytes(200 << 20)").stderr


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.__name__)
@pytest.mark.parametrize(
    "text",
    [
        "x = " + "[" * 100_000,
        "x = " + "[" * 50_000 + "]" * 50_000,
        "x = " + "{a=" * 30_000 + "1" + "}" * 30_000,
        "x = " + "9" * 500_000,
        'x = "' + "y" * 900_000 + '"',
        "x = 1e999999999",
    ],
    ids=["open", "lists", "tables", "digits", "text", "exponent"],
)
def test_nested_and_endless_configs_are_refused(text: str, model: type, tmp_path: Path) -> None:
    assert len(text) < MAX_CONFIG_BYTES, "else its size is what is refused"
    path = tmp_path / "stranger.toml"
    path.write_text(text)
    with pytest.raises(ConfigError) as refused:
        load_toml(path, model)
    assert len(str(refused.value)) < 5_000, "a message is no copy of the file"


@pytest.mark.parametrize(
    "text", ["a." * 16 + "b = 1", "[" + '"a\\"" . ' * 16 + "b]", "x = {" + "'a'." * 16 + "b = 1}"]
)
def test_keys_of_many_parts_are_refused_before_they_are_parsed(text: str, tmp_path: Path) -> None:
    """tomllib keeps all prefixes of a key: a file of 200 kB would take 40 GB."""
    path = tmp_path / "stranger.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match="more than 16 parts"):
        read_toml(path)


def test_what_only_looks_like_a_deep_key_is_read(tmp_path: Path) -> None:
    path = tmp_path / "own.toml"
    path.write_text("a." * 15 + "b = 1\nx = [" + "1.5, " * 1000 + ']\ny = "up ... and on"\n')
    assert len(read_toml(path)["x"]) == 1000


def test_a_dbc_above_the_bound_is_refused_and_one_below_is_looked_at(tmp_path: Path) -> None:
    path = tmp_path / "big.dbc"
    path.write_bytes(b" " * (MAX_DBC_BYTES + 1))
    with pytest.raises(DatabaseError, match="larger than"):
        Database(path)


@pytest.mark.parametrize("kind", ["secret", "run", "long", "binary", "fifo", "none"])
def test_only_a_plant_is_kept_in_a_log(kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "plant.toml"
    match kind:
        case "secret":
            path.write_text("-----BEGIN OPENSSH PRIVATE KEY-----\nb3BlbnNzaC1rZXk\n")
        case "run":
            path.write_bytes((CONFIGS / "demo.toml").read_bytes())
        case "long":
            path.write_text("#" * (MAX_CONFIG_BYTES + 1))
        case "binary":
            path.write_bytes(b"\xff\xfe\x00" * 100)
        case "fifo":
            os.mkfifo(path)
    assert plant_of(path) == {}
    said = capsys.readouterr().err
    assert said.startswith(f"hil: no plant is kept in the log: {path}: ") and said.count("\n") == 1
    assert "b3Blb" not in said
    own = CONFIGS / "plants" / "demo.toml"
    assert plant_of(own) == {"plant.toml": own.read_text(encoding="utf-8")}
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("path", [Path("/dev/zero"), Path("/dev/urandom")], ids=str)
def test_a_file_without_an_end_is_no_config(path: Path) -> None:
    with pytest.raises(ConfigError, match="larger than"):
        read_toml(path)
