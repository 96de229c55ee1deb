"""What a report says of a run: envelopes, close-ups, step responses, figures, criteria, refusals."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from hil.cli import main
from hil.config.tables import RunConfig, load_toml
from hil.errors import ConfigError
from hil.log.schema import FRAME
from hil.report.collect import collect
from hil.report.criteria import judge
from hil.report.curves import KEYS
from hil.report.embed import script_json
from hil.report.envelope import BEFORE, CloseUps, Envelope, merged
from hil.report.frames import ERROR, EXTENDED, REMOTE, Frames, id_text
from hil.report.page import traffic
from hil.report.segments import Responses, deviation, largest, last_outside
from hil.report.statistics import Histogram, Spectrum
from hil.runtime.bus import message_names
from hil.runtime.setup import Overrides, load_setup
from hil.signals import DriveState, new_ticks
from hil.sim.simulate import simulate

pytestmark = pytest.mark.slow

SEED = 20261124


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    settings = (f'log.folder="{folder}"', 'log.name="run"', "criteria.dip_max_rad_s=3.0")
    settings += ("criteria.recovery_max_s=0.2", "criteria.bus_load_max_percent=50.0")
    setup = load_setup(Path("configs/demo.toml").resolve(), Overrides(settings=settings))
    return Path(simulate(setup, [])["log"])


@pytest.mark.parametrize("ticks", [1, 7, 8, 9, 100, 1000])
def test_an_envelope_holds_every_extreme(ticks: int) -> None:
    random = np.random.default_rng(SEED + ticks)
    values = random.normal(size=(2, ticks)).astype(np.float32)
    values[0, random.integers(ticks)] = 1e6
    t, own, at = np.arange(ticks) * 1e-3, Envelope(2, most=8), 0
    while at < ticks:
        n = int(random.integers(1, 40))
        own.feed(t[at : at + n], values[:, at : at + n])
        at += n
    times, low, high = own.bins()
    assert len(times) <= 9, SEED + ticks
    for row, begin in enumerate(range(0, ticks, own.width)):
        part = values[:, begin : begin + own.width]
        assert times[row] == t[begin], SEED + ticks
        np.testing.assert_array_equal(low[:, row], part.min(axis=1), err_msg=str(SEED + ticks))
        np.testing.assert_array_equal(high[:, row], part.max(axis=1), err_msg=str(SEED + ticks))


def test_a_bin_without_numbers_is_none_and_one_number_is_enough() -> None:
    own = Envelope(1, most=2)
    own.feed(np.arange(4.0), np.array([[np.nan, np.nan, np.nan, 3.0]], np.float32))
    _, low, high = own.bins()
    assert own.width == 2
    assert np.isnan(low[0, 0]) and low[0, 1] == high[0, 1] == 3.0


def test_close_ups_replace_bins_by_single_ticks() -> None:
    ticks = 30_000
    t = np.arange(ticks) * 1e-3
    values = np.sin(t)[None, :].astype(np.float32)
    own, near = Envelope(1, most=100), CloseUps()
    for at in range(0, ticks, 1000):
        rows = slice(at, at + 1000)
        own.feed(t[rows], values[:, rows])
        near.feed(t[rows], values[:, rows], [(10, 1.0)] if at == 7000 else [])
    times, low, high = merged(own, near)
    assert own.width > 1 and (np.diff(times) > 0).all()
    inside = (times >= (7010 - BEFORE + own.width) * 1e-3) & (times < 8.5)
    np.testing.assert_allclose(np.diff(times[inside]), 1e-3)
    np.testing.assert_array_equal(low[0, inside], high[0, inside])
    np.testing.assert_allclose(low[0, inside], np.sin(times[inside]), rtol=1e-6)


def test_responses_of_known_shapes() -> None:
    ticks = new_ticks(3000)
    t = np.arange(3000) * 1e-3
    ticks["state"], ticks["T_L_true"], ticks["gap"] = int(DriveState.OPERATION_ENABLED), 0.0, 1
    ticks["w_ref"] = np.where(t >= 0.5, 10.0, 0.0)
    since = np.maximum(t - 0.5, 0.0)
    ticks["w"] = 10.0 * (1 - np.exp(-since * 20) * np.cos(50 * since))
    ticks["T_L_true"][2000:] = 2.0
    after = np.maximum(t - 2.0, 0.0)
    ticks["w"] -= np.where(t >= 2.0, 4.0 * np.exp(-after * 10), 0.0)
    ticks["T_L_hat"][2010:] = 1.9
    own = Responses()
    own.N = 10
    for at in range(0, 3000, 700):
        own.feed(t[at : at + 700], ticks[at : at + 700])
    own.finish()
    move, load = own.kept
    assert (move.kind, move.size, load.kind, load.size) == ("reference", 10.0, "load", 2.0)
    peak = np.max(1 - np.exp(-since * 20) * np.cos(50 * since)) - 1
    assert move.overshoot_percent == pytest.approx(100 * peak, rel=1e-3)
    assert load.t == 2.0 and load.dip == pytest.approx(4.0, rel=1e-3)
    assert load.recovery_s == pytest.approx(np.log(8.0) / 10, abs=1.5e-3)
    assert load.estimate_error == pytest.approx(0.1)


def test_last_outside() -> None:
    t = np.arange(5.0)
    assert last_outside(t, np.array([9.0, 0, 2, 0, 0]), 1.0) == 3.0
    assert last_outside(t, np.array([0.0, 0, 0, 0, 2]), 1.0) is None
    assert last_outside(t, np.array([0.0, np.nan, 0, 0, 0]), 1.0) == 2.0


def test_the_quick_ways_are_numpys() -> None:
    values = np.random.default_rng(SEED).normal(3.0, 1.0, 1237)
    assert deviation(values) == np.std(values)
    assert largest(np.abs(values)) == np.abs(values).max()
    values[5] = np.nan
    assert largest(np.abs(values)) == np.nanmax(np.abs(values))
    assert largest(np.full(3, np.nan)) == largest(np.empty(0)) == 0.0


def test_a_histogram_knows_percentiles_to_a_bin() -> None:
    values = np.random.default_rng(SEED).lognormal(3.0, 1.0, 100_000)
    own = Histogram()
    own.feed(values[:1000])
    own.feed(values[1000:])
    for name, share in (("p50", 50), ("p99", 99), ("p999", 99.9)):
        true = np.percentile(values, share)
        assert true <= own.as_dict()[name] * 1.001 <= true * 1.06, SEED
    assert own.as_dict()["max"] == values.max()


def test_the_spectrum_finds_a_line_and_its_power() -> None:
    ticks = new_ticks(20_000)
    ticks["state"], ticks["gap"] = int(DriveState.OPERATION_ENABLED), 1
    ticks["w"] = 3.0 * np.sin(2 * np.pi * 62.5 * np.arange(20_000) * 1e-3)
    own = Spectrum()
    for at in range(0, 20_000, 900):
        own.feed(ticks[at : at + 900])
    frequencies, density = own.density(1000.0)
    assert frequencies[np.argmax(density[0])] == 62.5
    power = np.sum(density[0] ** 2) * (frequencies[1] - frequencies[0])
    assert power == pytest.approx(3.0**2 / 2, rel=0.01)


def test_frames_are_counted_and_the_bus_load_is_a_share_of_time() -> None:
    from hil.log.schema import FRAME

    records = np.zeros(2000, FRAME)
    records["t_ns"] = np.arange(2000) * 1_000_000
    records["can_id"], records["size"] = 0x181, 8
    records["received"] = np.arange(2000) % 2
    own = Frames()
    own.feed(records[:700])
    own.feed(records[700:])
    assert {key: t.count for key, t in own.traffic.items()} == {(0x181, True): 1000, (0x181, False): 1000}
    assert own.traffic[0x181, True].shortest == own.traffic[0x181, True].longest == 2.0
    load = own.load(lambda length, extended: 1e-4 if length == 8 and not extended else 0.0)
    assert load == (pytest.approx(10.0, rel=1e-3), pytest.approx(10.0))


OF_NODE_1 = "BO_ 385 FEEDBACK: 8 X\n\nBO_ 128 SYNC: 1 X\n\nBO_ 2147483777 OWN: 1 X\n\nBO_ 1 OTHER: 1 X\n"
NAMED: dict[tuple[int, str], dict[int, str]] = {
    (3, ""): {0x183: "FEEDBACK", 0x80: "SYNC", 0x80000081: "OWN", 0x001: "OTHER"},
    (3, "id << 0 : 4"): {0x183: "FEEDBACK", 0x83: "SYNC", 0x80000083: "OWN", 0x003: "OTHER"},
    (200, ""): {},
}


@pytest.mark.parametrize("node", NAMED)
def test_messages_have_their_names_by_the_rule_by_which_a_run_moves_them(node: tuple[int, str]) -> None:
    config = load_toml(Path("configs/demo.toml"), RunConfig)
    drive = config.drive.model_copy(update={"node_id": node[0], "node_rule": node[1]})
    assert message_names(config.model_copy(update={"drive": drive}), OF_NODE_1) == NAMED[node]
    assert message_names(None, "") == {}


def test_what_is_no_data_frame_has_no_messages_name(log: Path) -> None:
    run = collect(log, verify=False)
    records = np.zeros(4, FRAME)
    records["can_id"] = [0x80, ERROR | 0x80, EXTENDED | 0x80, REMOTE | 0x80]
    run.frames.feed(records)
    rows = re.findall(r"<tr>.*?</tr>", traffic(run))[1:]
    assert [re.findall(r"<td[^>]*>(.*?)</td>", row)[:2] for row in rows] == [
        ["080", "SYNC"], ["error 80", ""], ["080 remote", "SYNC"], ["00000080", ""],
    ]  # fmt: skip
    assert id_text(EXTENDED | REMOTE | 0x12) == "00000012 remote"


def test_a_run_is_judged_by_its_config(log: Path) -> None:
    run = collect(log)
    outcomes = {check.name: check.outcome for check in judge(run)}
    assert outcomes["ended"] == outcomes["log"] == outcomes["replay"] == "pass"
    assert outcomes["worst dip after a load step"] == "fail"  # 3.9 rad/s, 3 allowed here
    assert outcomes["slowest recovery to 0.5 rad/s"] == "pass"
    assert outcomes["bus load, busiest second"] == "no data"
    t, low, high = run.curves()
    assert len(t) == run.totals.ticks
    np.testing.assert_array_equal(low[KEYS.index("w")], high[KEYS.index("w")])


def test_strict_fails_where_a_check_fails(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out.html"
    assert main(["report", str(log), "-o", str(out), "--no-replay"]) == 0
    assert main(["report", str(log), "-o", str(out), "--no-replay", "--strict"]) == 1
    assert "http" not in out.read_text().partition("<body>")[0].replace("http-equiv", "").replace(
        "https://github.com/leeoniya/uPlot", ""
    )
    capsys.readouterr()


def test_a_picture_is_a_png(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out.png"
    assert main(["report", str(log), str(log), "-o", str(out), "--no-replay"]) == 0
    assert out.read_bytes().startswith(b"\x89PNG\r\n") and out.stat().st_size > 20_000
    capsys.readouterr()


def test_what_cannot_be_reported_is_one_clear_refusal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    foreign = tmp_path / "foreign.mcap"
    foreign.write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    for args, said in (
        ([str(foreign)], "is no log of hil"),
        ([str(tmp_path / "none.mcap")], "no such file"),
        ([str(foreign), "-o", "out.pdf"], "out.pdf: must end in .html or .png; name another file"),
        ([str(foreign)] * 9, "at most 8"),
    ):
        assert main(["report", *args]) == 2
        assert said in capsys.readouterr().err


def test_truncated_logs_are_reported_with_their_damage(log: Path, tmp_path: Path) -> None:
    whole = log.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole[: len(whole) * 2 // 3])
    run = collect(cut)
    assert run.log.damage is not None and run.totals.ticks > 1000
    assert {check.name: check.outcome for check in judge(run)}["log"] == "fail"


def test_criteria_are_strict(configs: Path) -> None:
    with pytest.raises(ConfigError, match=r"did you mean 'dip_max_rad_s'"):
        load_toml(configs / "demo.toml", RunConfig, ["criteria.dip_max_rads=1"])


def test_no_text_ends_its_script_element() -> None:
    text = script_json({"a": "</script><!-- <script> & \u2028"})
    assert not set("<>&\u2028") & set(text)
