"""A misspelt field in a kernel is found here, not when the kernel first runs: kernels take ``Any``."""

from __future__ import annotations

import ast
import functools
import importlib
from pathlib import Path

import numpy as np
import pytest

from tests.conftest import ROOT

PACKAGES = ("hil", "drivers", "firmware_model")


def module(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def kernels(text: str) -> list[ast.FunctionDef]:
    """The functions of a source that are compiled."""
    found = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.FunctionDef)]
    return [node for node in found if any("jit" in ast.unparse(line) for line in node.decorator_list)]


def asked(kernel: ast.FunctionDef) -> set[str]:
    """The fields that a kernel reads and writes."""
    indices = [node.slice for node in ast.walk(kernel) if isinstance(node, ast.Subscript)]
    return {
        str(index.value)
        for index in indices
        if isinstance(index, ast.Constant) and isinstance(index.value, str)
    }


SOURCES = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
WITH_KERNELS = [
    path for path in SOURCES if any(asked(one) for one in kernels(path.read_text(encoding="utf-8")))
]


@functools.cache
def fields() -> frozenset[str]:
    """The fields of every record type that stands at the top of a module."""
    found: set[str] = set()
    for path in SOURCES:
        if "np.dtype(" in path.read_text(encoding="utf-8"):
            values = vars(importlib.import_module(module(path))).values()
            found.update(*(value.names or () for value in values if isinstance(value, np.dtype)))
    return frozenset(found)


def test_there_are_kernels_and_fields() -> None:
    assert len(WITH_KERNELS) > 15 and len(fields()) > 300


def test_a_misspelt_field_is_seen() -> None:
    (kernel,) = kernels("@jit\ndef step(p, t):\n    t['u_q'] = p['u_maxx'] + t['w']\n")
    assert asked(kernel) - fields() == {"u_maxx"}


@pytest.mark.parametrize("path", WITH_KERNELS, ids=lambda path: str(path.relative_to(ROOT)))
def test_a_kernel_asks_for_fields_that_there_are(path: Path) -> None:
    for kernel in kernels(path.read_text(encoding="utf-8")):
        assert asked(kernel) <= fields(), kernel.name
