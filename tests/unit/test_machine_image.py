"""The bench machine's image: named after what is in it, made again when it is not what was written."""

from __future__ import annotations

import importlib.metadata
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.vm import image, machine

NAME = "0123456789abcdef"


def package(version: str, plugins: str | None = None) -> SimpleNamespace:
    return SimpleNamespace(metadata={"Name": "numba"}, version=version, read_text=lambda _: plugins)


def test_the_name_tells_packages_and_machine_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    def named(one: SimpleNamespace, *parts: str) -> str:
        monkeypatch.setattr(importlib.metadata, "distributions", lambda: [one])
        return image.key(*parts)

    names = [
        named(package("0.61"), "qemu 7", "-m"),
        named(package("0.62"), "qemu 7", "-m"),
        named(package("0.61", "[can.interface]"), "qemu 7", "-m"),
        named(package("0.61"), "qemu 8", "-m"),
    ]
    assert len(set(names)) == 4
    assert named(package("0.61"), "qemu 7", "-m") == names[0]


def test_the_name_follows_our_own_sources(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "guest").mkdir()
    for source in image.SOURCES:
        (tmp_path / source).write_bytes((image.HERE / source).read_bytes())
    before = image.key()
    monkeypatch.setattr(image, "HERE", tmp_path)
    assert image.key() == before
    for source in image.SOURCES:
        with (tmp_path / source).open("a") as file:
            file.write("\n")
        assert image.key() != before
        before = image.key()


@pytest.fixture
def making(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Saving writes a file instead of booting; what was saved is listed."""
    saved: list[str] = []

    def save(command: list[str], serial: Path, part: Path) -> None:
        part.write_bytes(b"state of the machine")
        saved.append(command[0])

    monkeypatch.setattr(image, "save", save)
    monkeypatch.setattr(image, "packages", lambda: {"absent": [], "modules": [], "files": []})
    monkeypatch.setattr(image, "archive", lambda *_: None)
    return saved


def make(cache: Path, name: str = NAME) -> Path:
    return image.made(cache, name, lambda _: None, lambda _: ["qemu"])


def cut(whole: Path) -> None:
    whole.write_bytes(whole.read_bytes()[:-1])


def another(whole: Path) -> None:
    whole.write_bytes(b"state of some other one ")


def no_digest(whole: Path) -> None:
    whole.with_suffix(".sha256").unlink()


def test_an_image_is_made_once(making: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first = make(tmp_path)
    assert capsys.readouterr().err.splitlines() == [
        f"machine: image-{NAME}.zst is not there: making it takes half a minute"
    ]
    assert make(tmp_path) == first and making == ["qemu"]
    assert capsys.readouterr().err == ""
    assert make(tmp_path, "another") != first and making == ["qemu", "qemu"]


@pytest.mark.parametrize("damage", [cut, another, no_digest])
def test_a_damaged_image_is_made_again(
    damage: Callable[[Path], None], making: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = make(tmp_path)
    damage(whole)
    assert not image.is_whole(whole)
    capsys.readouterr()
    assert make(tmp_path) == whole and len(making) == 2
    assert image.is_whole(whole) and whole.read_bytes() == b"state of the machine"
    said = capsys.readouterr().err.splitlines()
    assert said == [f"machine: image-{NAME}.zst is damaged: making it takes half a minute"]


def test_the_newest_images_are_kept(making: list[str], tmp_path: Path) -> None:
    names = [str(number) for number in range(image.KEPT + 2)]
    for age, name in enumerate(reversed(names)):
        os.utime(make(tmp_path, name), (1e9 - age, 1e9 - age))
    make(tmp_path, names[0])
    kept = {path.name for path in tmp_path.glob("image-*.zst")}
    assert len(kept) == image.KEPT and {"image-0.zst", f"image-{names[-1]}.zst"} <= kept
    assert {path.stem for path in tmp_path.glob("*.sha256")} == {name.removesuffix(".zst") for name in kept}


def test_a_machine_that_does_not_come_up_is_said_with_its_log(tmp_path: Path) -> None:
    with pytest.raises(image.ImageError, match=f"does not come to stand by; see {tmp_path}/serial"):
        image.save(["false"], tmp_path / "serial", tmp_path / "part")
    assert not (tmp_path / "part").exists()


def test_the_way_to_a_file_goes_through_links(tmp_path: Path) -> None:
    real = tmp_path / "versions" / "3"
    real.mkdir(parents=True)
    (real / "python3").touch()
    (real / "python").symlink_to("python3")
    (tmp_path / "venv").symlink_to("versions/3")
    way = set(image.with_way(tmp_path / "venv" / "python"))
    inside = {str(path.relative_to(tmp_path)) for path in way if path.is_relative_to(tmp_path)}
    assert inside == {".", "venv", "versions", "versions/3", "versions/3/python", "versions/3/python3"}
    assert set(tmp_path.parents) <= way


SHOW = "import sys; print(__name__, sys.argv, sys.path[0]); sys.exit(3)"
JOBS = {
    "file": ["show.py", "one", "--two"],
    "module": ["-m", "show", "one"],
    "text": ["-c", SHOW, "one"],
}


def run_job(folder: Path, program: list[str], words: list[str]) -> tuple[int, str, str]:
    environment = os.environ | {
        "PYTHONPATH": str(image.ROOT),
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
    }
    done = subprocess.run(
        [*program, *words], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    return done.returncode, done.stdout, done.stderr


@pytest.fixture
def standby(tmp_path: Path) -> list[str]:
    """The Python that stands by, woken at once, and not in a machine."""
    (tmp_path / "show.py").write_text(SHOW)
    script = tmp_path / "standby" / "standby.py"
    script.parent.mkdir()
    source = (image.HERE / "standby.py").read_text().rpartition("if __name__")[0]
    script.write_text(f"{source}\nbecome(['python', *sys.argv[1:]])\n")
    return [sys.executable, str(script)]


@pytest.mark.parametrize("kind", JOBS)
def test_a_job_in_the_imported_python_is_as_in_a_new_one(
    kind: str, standby: list[str], tmp_path: Path
) -> None:
    own = run_job(tmp_path, ["python"], JOBS[kind])
    assert own[0] == 3 and own[1].startswith("__main__ ")
    assert run_job(tmp_path, standby, JOBS[kind]) == own


@pytest.mark.parametrize("words", [["missing.py"], ["-m", "missing"]])
def test_a_job_that_is_not_there_fails(words: list[str], standby: list[str], tmp_path: Path) -> None:
    code, _, said = run_job(tmp_path, standby, words)
    assert code == 1 and "missing" in said.splitlines()[-1]


def test_kernels_that_others_replace_meanwhile_are_taken_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Indices first: what an index names was there before it; a file that goes as it is found is left out."""
    folder, taken, order = tmp_path / "kernels", tmp_path / "taken", []
    (folder / "room").mkdir(parents=True)
    for name in ("a.1.nbc", "a.nbi", "b.1.nbc", "b.nbi"):
        (folder / "room" / name).write_text(name)
    (folder / "warm-1").touch()
    (folder / "room" / "gone.1.nbc").symlink_to(tmp_path / "nowhere")
    copy = shutil.copy2

    def watched(source: Path, target: Path) -> object:
        order.append(Path(source).suffix)
        return copy(source, target)

    monkeypatch.setattr(machine, "kernels", lambda: folder)
    monkeypatch.setattr(shutil, "copy2", watched)
    machine.take_kernels(taken)
    assert order == [".nbi", ".nbi", ".nbc", ".nbc", ".nbc"]
    assert {path.name: path.read_text() for path in (taken / "room").iterdir()} == {
        name: name for name in ("a.1.nbc", "a.nbi", "b.1.nbc", "b.nbi")
    }
