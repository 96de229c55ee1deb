"""What ip says about an interface, and the bits of the longest frames."""

from __future__ import annotations

import json
import shutil

import pytest

from drivers.busload import bus_load, classic_bits, fd_bits, frame_seconds
from drivers.errors import DriverError
from drivers.kernel import InterfaceFacts, interface_facts, parse_link

KVASER = """[{"ifname":"can0","flags":["NOARP","UP","LOWER_UP","ECHO"],"mtu":16,"operstate":"UP","txqlen":10,
"linkinfo":{"info_kind":"can","info_data":{"state":"ERROR-ACTIVE","berr_counter":{"tx":0,"rx":0},
"restart_ms":0,"bittiming":{"bitrate":1000000,"sample_point":"0.750"}}}}]"""
SICK_FD = """[{},{"ifname":"can1","flags":["NOARP","ECHO"],"mtu":72,"operstate":"DOWN","txqlen":1000,
"linkinfo":{"info_kind":"can","info_data":{"ctrlmode":["FD"],"state":"BUS-OFF",
"berr_counter":{"tx":248,"rx":3},"restart_ms":100,"bittiming":{"bitrate":500000,"sample_point":"0.875"},
"data_bittiming":{"bitrate":2000000,"sample_point":"0.750"}},"info_xstats":{"restarts":1,"bus_error":7,
"arbitration_lost":0,"error_warning":2,"error_passive":2,"bus_off":4}},
"stats64":{"rx":{"packets":80},"tx":{"packets":90,"dropped":5}}}]"""
FIXED_RATES = """[{"ifname":"can2","flags":["UP"],"mtu":16,"txqlen":10,"linkinfo":{"info_kind":"can",
"info_data":{"state":"STOPPED","bittiming_bitrate":125000,"data_bittiming_bitrate":1000000}}}]"""
VCAN = '[{"ifname":"vcan0","flags":["NOARP","UP"],"mtu":72,"txqlen":1000,"linkinfo":{"info_kind":"vcan"}}]'


def test_a_card_that_is_well() -> None:
    assert parse_link(KVASER, "can0") == InterfaceFacts(
        "can0", "can", True, 16, 10, "ERROR-ACTIVE", 1_000_000, None, 0, 0, 0, None
    )


def test_a_card_that_is_off_the_bus() -> None:
    assert parse_link(SICK_FD, "can1") == InterfaceFacts(
        "can1", "can", False, 72, 1000, "BUS-OFF", 500_000, 2_000_000, 100, 248, 3, 4, 2, 2, 1, 7, 5, 90, 80
    )


def test_the_facts_in_one_line() -> None:
    sick, vcan = parse_link(SICK_FD, "can1"), parse_link(VCAN, "vcan0")
    assert sick is not None and vcan is not None
    assert sick.text() == (
        "can1 can down: state BUS-OFF, error counter tx 248, rx 3, times error-warning 2, error-passive 2, "
        "bus-off 4, restarted 1, bus errors 7, bitrate 500000, data bitrate 2000000, restart-ms 100, "
        "queue length 1000, frames sent 90, dropped 5, received 80"
    )
    assert vcan.text() == "vcan0 vcan up: queue length 1000, frames sent 0, dropped 0, received 0"


def test_an_adapter_with_fixed_bitrates() -> None:
    facts = parse_link(FIXED_RATES, "can2")
    assert facts is not None
    assert (facts.bitrate, facts.data_bitrate, facts.restart_ms) == (125_000, 1_000_000, 0)


def test_vcan_tells_neither_bitrate_nor_state() -> None:
    assert parse_link(VCAN, "vcan0") == InterfaceFacts("vcan0", "vcan", True, 72, 1000)


def test_another_interface_is_not_taken_for_it() -> None:
    assert parse_link(KVASER, "can1") is None and parse_link("", "can1") is None


@pytest.mark.parametrize("text", ["no JSON", "7", "[7]", '[{"ifname":"can0"}]', json.dumps({"a": 1})])
def test_what_is_not_ips_json_is_said(text: str) -> None:
    with pytest.raises(DriverError, match="ip says about can0"):
        parse_link(text, "can0")


@pytest.mark.skipif(shutil.which("ip") is None, reason="iproute2 is not installed")
def test_the_kernel_of_this_machine_is_asked() -> None:
    facts = interface_facts("lo")
    assert facts is not None and facts.mtu > 1000 and facts.bitrate is None
    assert interface_facts("nonecan9") is None


def test_without_iproute2_it_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(DriverError, match="install iproute2"):
        interface_facts("lo")


def test_longest_frames_by_hand() -> None:
    # Davis et al., table of section 2: 55 + 10 s bits with 11-bit, 80 + 10 s with 29-bit identifiers
    for s in range(9):
        assert classic_bits(s) == 55 + 10 * s
        assert classic_bits(s, extended=True) == 80 + 10 * s
    assert fd_bits(64) == (32, 673)
    assert fd_bits(9) == fd_bits(12) == (32, 148)
    assert fd_bits(8, extended=True) == (49, 108)


def test_load_of_the_house_protocol_at_1_khz() -> None:
    one = frame_seconds(1, fd=False, extended=False, bitrate=1_000_000)
    eight = frame_seconds(8, fd=False, extended=False, bitrate=1_000_000)
    load = bus_load([(one, 1000.0), (eight, 1000.0), (eight, 1000.0), (eight, 100.0)])
    assert load == pytest.approx(0.065 + 0.27 + 0.0135)
    fd = frame_seconds(64, fd=True, extended=False, bitrate=500_000, data_bitrate=2_000_000)
    assert fd == pytest.approx(32 / 500e3 + 673 / 2e6)
