"""Tuning for scripts: designs for a wish, laws side by side, sweeps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from hil.api.setups import File, Settings, overrides, texts
from hil.campaign.plan import PLANT
from hil.campaign.sweep import job_of_sweep
from hil.campaign.sweep import sweep as swept
from hil.errors import HilError
from hil.faults.matrix import inline
from hil.tuning import compare as comparing
from hil.tuning import design as designing
from hil.tuning.bench import speed_drive, takes_voltage
from hil.tuning.families import settings_of

SPREAD = ("J", "psi_f", "R_s", "L")


def design(
    config: File,
    settings: Settings = (),
    *,
    spread: float | Mapping[str, float] = 0.3,
    load: float | None = None,
    w_noise: float | None = None,
    i_noise: float | None = None,
    **wish: Any,
) -> dict[str, Any]:
    """Windows and poles for a motor and a wish, as ``hil design``; takes seconds to minutes on all cores.

    ``wish``: ``u_noise_mv`` (of a drive with its own current loop ``command_noise`` [A or N m]), ``ms``,
    ``ms_worst``, ``dip`` [rad/s], ``recovery_ms``, ``laws``, ``effort`` and those of a shaft.
    ``load`` [N m], ``w_noise`` [rad/s], ``i_noise`` [A] default to those of the plant.
    Of the result: ``settings`` for ``hil.load``, the same as ``toml``, ``front``, what it will do.
    Raises ``hil.HilError`` when no design keeps the limits.
    """
    asked = designing.Wish(**_known(wish, designing.Wish))
    shares = dict(spread) if isinstance(spread, Mapping) else dict.fromkeys(SPREAD, float(spread))
    given = {"load": load, "w_noise": w_noise, "i_noise": i_noise}
    found = designing.design(Path(config), overrides(settings), asked, given, shares)[0]
    return found | {"settings": list(settings_of(found["tables"]))}


def compare(
    config: File, laws: Sequence[str] | None = None, settings: Settings = (), **wish: Any
) -> dict[str, Any]:
    """Laws, each tuned by one optimiser to the same limits and run on the same plants, as ``hil compare``.

    ``wish``: ``u_noise_mv`` or ``command_noise``, ``ms``, ``ms_worst``, ``spread``, ``seeds``, ``effort``;
    without ``laws`` all but the special ones. Raises ``hil.HilError``.
    """
    own = not takes_voltage(speed_drive(Path(config), overrides(settings)))
    families = comparing.parse_laws(",".join(comparing.default_laws(own) if laws is None else laws), own)
    asked = comparing.Wish(**_known(wish, comparing.Wish))
    return comparing.compare(Path(config), overrides(settings), families, asked)


def sweep(
    config: File,
    axes: Mapping[str, Sequence[Any]],
    settings: Settings = (),
    *,
    plant: Settings = (),
) -> list[dict[str, Any]]:
    """Simulate every combination of ``axes``, ``{"controller.speed_pole_rad_s": [40.0, 80.0]}``.

    A key of the emulated drive begins with ``plant:``; a value may be a whole table. A dict for each case:
    ``case``, ``ended``, dip, recovery and so on. Raises ``hil.HilError``.
    """
    own = [f"{key}={inline(list(v))}" for key, v in axes.items() if not key.startswith(PLANT)]
    plants = [f"{k.removeprefix(PLANT)}={inline(list(v))}" for k, v in axes.items() if k.startswith(PLANT)]
    return swept(*job_of_sweep(Path(config), overrides(settings), list(texts(plant)), own, plants))


def _known(wish: Mapping[str, Any], table: Any) -> dict[str, Any]:
    names = [field.name for field in fields(table)]
    if unknown := [name for name in wish if name not in names]:
        raise HilError(f"{', '.join(unknown)}: no wish; there are {', '.join(names)}")
    return dict(wish)
