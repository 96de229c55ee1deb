"""python-can and what imports it, without asammdf, and pandas with it, which it takes where it is installed.

That is for MF4 files and takes longer than all else of python-can. Exports and imports load it themselves.
"""

from __future__ import annotations

from drivers.lean import without

with without("asammdf"):
    import can
    import cantools

__all__ = ["can", "cantools"]
