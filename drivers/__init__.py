"""CAN: bus, codec and drive client. The only package that knows CAN; knows neither side of the bus."""

import sys


def _import_can() -> None:
    """Import python-can without asammdf, which its reader of MF4 files would load together with pandas.

    That is half of the start-up of a run, for a format that no bus needs; `hil export` loads asammdf itself.
    """
    if "can" in sys.modules or "asammdf" in sys.modules:
        return
    sys.modules["asammdf"] = None  # type: ignore[assignment]  # an import of it fails, and python-can goes on
    try:
        import can  # noqa: F401
    finally:
        del sys.modules["asammdf"]


_import_can()
