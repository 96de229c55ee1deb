"""Where compiled kernels are kept, and when they are out of date.

numba's own cache looks at the file of a function, not at those of the functions that it calls: an old
callee would live on inside a new caller. Here a kernel is as old as the sources that its module imports,
directly or not, within this project: a change compiles what depends on it, and nothing else. What a registry
finds stands in no import: it names those files itself (:func:`rests_on`). A kernel has one set of files
whatever line it stands on, so what is out of date is overwritten and nothing needs cleaning up.
"""

from __future__ import annotations

import contextlib
import fcntl
import functools
import hashlib
import os
import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, Final

from llvmlite import binding
from numba.core import caching, codegen, compiler, environment, runtime

numba_caching: Any = caching  # ships no types
numba_codegen: Any = codegen
numba_compiler: Any = compiler
numba_environment: Any = environment
numba_runtime: Any = runtime
ROOT: Final = Path(__file__).resolve().parents[1]
PACKAGES: Final = ("hil", "drivers", "firmware_model")
_IMPORT: Final = re.compile(
    rf"^[ \t]*(?:from|import)[ \t]+((?:{'|'.join(PACKAGES)})\b[\w.]*)"  # from a.b / import a.b
    r"(?:[ \t]+import[ \t]+(\([^)]*\)|[^\n]*))?",
    re.MULTILINE,
)


def cache_folder() -> Path:
    """``NUMBA_CACHE_DIR``; else ``.cache/numba`` of the source tree; installed, the user's cache folder."""
    if given := os.environ.get("NUMBA_CACHE_DIR"):
        return Path(given)
    if (ROOT / "pyproject.toml").is_file():
        return ROOT / ".cache" / "numba"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "hil-drive" / "numba"


_FOUND: Final[dict[Path, frozenset[Path]]] = {}
"""Files that a registry has found, by the registry's own."""


def rests_on(registry: str, files: Iterable[Path]) -> None:
    """Count ``files`` as imported by the file ``registry``, for the kernels made from now on.

    Of a package outside this project all that lies beside the file counts too, since a kernel may call it.
    """
    found = {path.resolve() for path in files}
    for path in [path for path in found if not path.is_relative_to(ROOT)]:
        if path.with_name("__init__.py").is_file():
            found |= set(path.parent.rglob("*.py"))
    _FOUND[Path(registry).resolve()] = frozenset(found)


@functools.cache
def sources(path: Path) -> frozenset[Path]:
    """The file and all files of this project that it imports, directly or not."""
    found, left = {path}, [path]
    while left:
        file = left.pop()
        new = (_imported(file) | _FOUND.get(file, frozenset())) - found
        found |= new
        left += new
    return frozenset(found)


@functools.cache
def _imported(path: Path) -> frozenset[Path]:
    """Files of this project that a file imports itself, those of the packages above them left out."""
    text = path.read_text(encoding="utf-8")
    names = {name for match in _IMPORT.finditer(text) for name in _modules(match[1], match[2] or "")}
    return frozenset(file for name in names if (file := _file(name)) is not None)


def _modules(module: str, names: str) -> list[str]:
    """Modules that a statement may import: the one named, and each name in it."""
    return [module, *(f"{module}.{name}" for name in re.findall(r"\w+", re.sub(r"#.*", "", names)))]


@functools.cache
def _file(module: str) -> Path | None:
    path = ROOT.joinpath(*module.split("."))
    candidates = (path.with_suffix(".py"), path / "__init__.py")
    return next((file for file in candidates if file.is_file()), None)


@functools.cache
def _digest(path: Path) -> bytes:
    return hashlib.sha256(path.read_bytes()).digest()


@functools.cache
def stamp(path: Path) -> str:
    """Digest of :func:`sources` of a file, with their names."""
    total = hashlib.sha256()
    for source in sorted(sources(path)):
        name = source.relative_to(ROOT) if source.is_relative_to(ROOT) else source
        total.update(str(name).encode() + b"\0" + _digest(source))
    return total.hexdigest()


class KernelLocator(numba_caching._CacheLocator):  # type: ignore[misc] # numba has no public way to set one
    """A folder for each source file; the stamp is :func:`stamp`, the name that of the function alone."""

    def __init__(self, py_file: str) -> None:
        self._py_file = py_file
        path = Path(py_file).resolve()
        place = path.relative_to(ROOT) if path.is_relative_to(ROOT) else path.relative_to("/")
        self._stamp, self._path = stamp(path), cache_folder() / ".".join(place.with_suffix("").parts)

    def get_cache_path(self) -> str:
        """Folder of the kernels of this file."""
        return str(self._path)

    def get_source_stamp(self) -> str:
        """What makes a kept kernel out of date when it changes."""
        return self._stamp

    def get_disambiguator(self) -> str:
        """Nothing: a module has each name once."""
        return "kernel"

    @classmethod
    def from_function(cls, _function: Callable[..., Any], py_file: str) -> KernelLocator | None:
        """The locator of a kernel; None where the folder can't be made, and numba looks for another."""
        return _locator(py_file)


@functools.cache
def _locator(py_file: str) -> KernelLocator | None:
    """The one locator of a file's kernels: a file has many, and to try its folder takes long."""
    locator = KernelLocator(py_file)
    try:
        locator.ensure_cache_path()
    except OSError:
        return None
    return locator


class KeptLibrary(numba_codegen.JITCodeLibrary):  # type: ignore[misc] # as above
    """The machine code of a kept kernel. Its bitcode is parsed when another kernel is compiled with it.

    numba's own parses it at once and reads every name in it, which takes longer than to load the code.
    """

    _bitcode: bytes | None = None
    _parsed: Any = None

    @classmethod
    def kept(cls, target: Any, state: tuple[str, str, tuple[bytes, bytes]]) -> KeptLibrary:
        """The library that ``serialize_using_object_code`` made ``state`` of."""
        name, _, (code, bitcode) = state
        library = cls(target, name)
        library.enable_object_caching()
        library._set_compiled_object(code)
        library._finalize_final_module()
        library._bitcode = bitcode
        return library

    @property
    def _shared_module(self) -> Any:
        if self._parsed is None and self._bitcode is not None:
            self._parsed = binding.parse_bitcode(self._bitcode)
            self._codegen._engine._load_defined_symbols(self._parsed)
        return self._parsed

    @_shared_module.setter
    def _shared_module(self, module: Any) -> None:
        self._parsed = module

    def get_pointer_to_function(self, name: str) -> int:
        """Address of a function, 0 where there is none of the name."""
        return int(self._codegen._engine.get_function_address(name))


class _Kernels(numba_caching.CompileResultCacheImpl):  # type: ignore[misc] # as above
    _locator_classes = (KernelLocator, *numba_caching.CacheImpl._locator_classes)

    def reduce(self, cres: Any) -> Any:
        """What is kept of a kernel. To load it imports no module of numba's: its globals are not used."""
        *kept, environments = super().reduce(cres)
        return (*kept, tuple(map(_without_globals, environments)))

    def rebuild(self, target_context: Any, payload: Any) -> Any:
        """The kernel of ``CompileResult._reduce``, its library a :class:`KeptLibrary`."""
        made = numba_compiler.CompileResult._rebuild(_Keeping(target_context), *payload)
        return made._replace(target_context=target_context)


def _without_globals(env: Any) -> Any:
    """The same environment of a function of numba's own, by which its module is not imported to load it."""
    if not env.globals["__name__"].startswith("numba."):
        return env
    bare = numba_environment.Environment({"__name__": "numba"})
    bare.consts[:], bare.env_name = env.consts, env.env_name
    return bare


class _Keeping:
    """numba's context of the processor; libraries that it reads are :class:`KeptLibrary`."""

    def __init__(self, context: Any) -> None:
        self._context = context

    def __getattr__(self, name: str) -> Any:
        return getattr(self._context, name)

    def codegen(self) -> Any:
        """What reads a library: itself, with the one method that is asked for."""
        return self

    def unserialize_library(self, state: Any) -> KeptLibrary:
        return KeptLibrary.kept(self._context.codegen(), state)


class KernelFiles(numba_caching.IndexDataCacheFile):  # type: ignore[misc] # as above
    """The files of one function's kernels, which processes may write at the same time.

    numba's own reads the index, takes a free name and writes both: of two processes with different signatures
    each could take the same name, and one would later run the other's kernel. Its index also stands before
    the data, so that a reader could find what an older source left under that name.
    """

    def save(self, key: Any, data: Any) -> None:
        """Write the kernel, then the index that names it, while no other process does. Raises OSError."""
        with _locked(self._cache_path):
            names = self._load_index()
            free = (
                name for i in range(1, len(names) + 2) if (name := self._data_name(i)) not in names.values()
            )
            names.setdefault(key, min(free))
            self._save_data(names[key], data)
            self._save_index(names)


@contextlib.contextmanager
def _locked(folder: str) -> Iterator[None]:
    """Hold a folder against the other processes and threads that ask for it."""
    fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX)
        yield
    finally:
        os.close(fd)


class KernelCache(numba_caching.FunctionCache):  # type: ignore[misc] # as above
    """numba's cache of one function, with :class:`KernelLocator` and :class:`KernelFiles`.

    Most functions are only ever parts of kernels: nothing is looked for before the first is asked for.
    """

    _impl_class = _Kernels

    def __init__(self, py_func: Any) -> None:
        self._kernel = py_func

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or "_kernel" not in vars(self) or "_impl" in vars(self):
            raise AttributeError(name)
        super().__init__(self._kernel)
        locator, base = self._impl.locator, self._impl.filename_base
        self._cache_file = KernelFiles(self._cache_path, base, locator.get_source_stamp())
        return getattr(self, name)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """A kept kernel, or None. numba's own reads in first what types and implements each builtin.

        Only to compile needs that, and the compiler does it itself; what is compiled needs the runtime.
        """
        numba_runtime.rtsys.initialize(target_context)
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)
