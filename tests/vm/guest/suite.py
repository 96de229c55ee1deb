"""Runs inside the bench machine (or on any host with vcan): real hil processes on real SocketCAN interfaces.

Each scenario leaves what it saw in $OUT/NAME/: the run's JSON, its log, what candump saw. Judging is left to
the tests on the host side, so that one boot serves them all.
"""

from __future__ import annotations

import ctypes
import json
import os
import shutil
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from hil import cli
from tests.vm.guest import IN_MACHINE
from tests.vm.guest import instructions as counted
from tests.vm.guest.process import CONFIG, FD, KERNEL, SCRATCH, Forked, warm_up

OUT = Path(os.environ["OUT"])


def sh(*command: str) -> str:
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


class Scenario:
    """Emulator on one interface, controller on another (or the same), candump watching."""

    def __init__(
        self,
        name: str,
        drive: str = "vcan0",
        controller: str = "vcan0",
        seconds: float = 2.0,
        config: str = CONFIG,
        plant: tuple[str, ...] = (),
        settings: tuple[str, ...] = (),
    ) -> None:
        self.name, self.drive, self.controller, self.seconds = name, drive, controller, seconds
        self.config, self.plant, self.settings = config, plant, settings
        self.run: Forked | None = None
        self.folder = SCRATCH / name
        self.folder.mkdir()
        self.dump = self.folder / "candump.log"

    def __enter__(self) -> Scenario:
        self._candump = subprocess.Popen(["candump", "-L", self.controller], stdout=self.dump.open("w"))
        plant = [word for one in self.plant for word in ("--plant-set", one)]
        words = ("emulate", self.config, *self._bus(self.drive), *plant)
        self.emulator = Forked.hil(self.folder / "emulator.txt", *words)
        self.emulator.until("ready")
        return self

    def _bus(self, channel: str) -> list[str]:
        own = [word for one in self.settings for word in ("--set", one)]
        return ["-i", "socketcan", "-c", channel, *own]

    def start(self, before: Callable[[], None] = lambda: None) -> None:
        folder = ["--set", f'log.folder="{self.folder}"', "--set", f"loop.duration_s={self.seconds}"]
        arm = [] if self.controller.startswith("vcan") else ["--arm", "--yes"]
        words = ("run", self.config, *self._bus(self.controller), "--json", *arm, *folder)

        def job() -> int:
            before()
            return cli.main(list(words))

        self.run = Forked(self.folder / "run.json", job)

    def running(self, command: str = " 201#") -> None:
        """Wait until commands are on the bus and the drive has been in operation for a while."""
        while self.dump.read_text().count(command) <= 300 and self.run.poll() is None:
            time.sleep(0.01)

    def __exit__(self, *_: object) -> None:
        code = self.run.wait() if self.run else 0
        self.emulator.send_signal(signal.SIGTERM)
        self.emulator.wait()
        self._candump.terminate()
        self._candump.wait()
        said = json.loads((self.run.said() if self.run else "") or "{}")
        result = {"returncode": code, "run": said, "emulator": self.emulator.said()}
        (self.folder / "result.json").write_text(json.dumps(result))
        shutil.copytree(self.folder, OUT / self.name)


def vcan_two_processes() -> None:
    with Scenario("vcan_two_processes") as s:
        s.start()


def vcan_8_khz() -> None:
    settings = ("loop.rate_hz=8000", "loop.feedback_timeout_us=100")
    with Scenario("vcan_8_khz", seconds=0.4, settings=settings) as s:
        s.start()


def vcan_without_fifo() -> None:
    """The controller is root, but may not ask for a real-time priority."""
    with Scenario("vcan_without_fifo") as s:
        s.start(before=drop_sys_nice)


def drop_sys_nice() -> None:
    """Give up CAP_SYS_NICE for good, so that SCHED_FIFO is denied as it is to an ordinary user."""
    libc, cap_sys_nice = ctypes.CDLL(None, use_errno=True), 23
    head, sets = (ctypes.c_uint32 * 2)(0x20080522, 0), (ctypes.c_uint32 * 6)()  # version 3, this process
    libc.capget(head, sets)
    for word in range(3):  # effective, permitted, inheritable of the first 32
        sets[word] &= ~(1 << cap_sys_nice)
    if libc.capset(head, sets) != 0:
        raise OSError(ctypes.get_errno(), "capabilities can't be changed")


def vcan_kernel_sync() -> None:
    """SYNC by the kernel's own timer."""
    with Scenario("vcan_kernel_sync", settings=KERNEL) as s:
        s.start()


def sync_beside_a_load() -> None:
    """The loop's SYNC and the kernel's, each beside a load on the one core; softirqs do not wait."""
    if not IN_MACHINE:
        (OUT / "sync_beside_a_load.skipped").touch()
        return
    ksoftirqd = sh("pgrep", "-x", "ksoftirqd/0").strip()
    sh("chrt", "-f", "-p", "1", ksoftirqd)
    for name, settings in (("loaded_loop", ()), ("loaded_kernel", KERNEL)):
        with Scenario(name, settings=settings) as s:
            s.start()
            s.running()
            load = Forked(s.folder / "load.txt", packets_to_itself)
            (s.folder / "marks.json").write_text(json.dumps({"loaded": time.time()}))
            s.run.wait()
            load.send_signal(signal.SIGKILL)
            load.wait()
    sh("chrt", "-o", "-p", "0", ksoftirqd)


def packets_to_itself() -> int:
    """Keeps the kernel busy: system calls, and a softirq for each packet that comes in."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as own:
        own.bind(("127.0.0.1", 0))
        own.connect(own.getsockname())
        while True:
            own.send(bytes(1200))
            own.recv(1200)


def kernel_sync_ends_with_its_process() -> None:
    """The drive's watchdog is off, and there is no guardian: the job dies with the controller alone."""
    own = (*KERNEL, "guardian.enabled=false")
    with Scenario("kernel_sync_ends", seconds=30.0, plant=("firmware.watchdog_ms=0.0",), settings=own) as s:
        s.start()
        s.running()
        s.run.send_signal(signal.SIGKILL)
        s.run.wait()
        time.sleep(0.01)
        (s.folder / "before.txt").write_text(str(s.dump.read_text().count(" 080#")))
        time.sleep(0.2)
        (s.folder / "after.txt").write_text(str(s.dump.read_text().count(" 080#")))


def kernel_sync_of_a_stopped_process() -> None:
    """SYNC goes on, commands do not: the guardian stops the drive, and nothing is sent after SIGCONT."""
    plant = ("firmware.watchdog_ms=0.0",)
    with Scenario("kernel_sync_stopped", seconds=30.0, plant=plant, settings=KERNEL) as s:
        s.start()
        s.running()
        s.run.send_signal(signal.SIGSTOP)
        time.sleep(0.3)
        (s.folder / "marks.json").write_text(json.dumps({"continued": time.time()}))
        s.run.send_signal(signal.SIGCONT)
        s.run.wait()


def kernel_sync_of_a_stopped_process_ends_by_the_watchdog() -> None:
    """Without a guardian: the drive's watchdog is fed by commands alone, not by SYNC."""
    own = (*KERNEL, "guardian.enabled=false")
    with Scenario("kernel_sync_watchdog", seconds=30.0, settings=own) as s:
        s.start()
        s.running()
        s.run.send_signal(signal.SIGSTOP)
        time.sleep(0.15)
        s.run.send_signal(signal.SIGCONT)
        s.run.wait()


def rehearsal() -> None:
    """Not judged: every page of a run is touched once, so that none is fetched from the host later."""
    with Scenario("rehearsal", seconds=0.5) as s:
        s.start()


def kvaser_pair() -> None:
    if not Path("/sys/class/net/can1").exists():
        return
    (OUT / "kvaser-link.json").write_text(
        sh("ip", "-json", "-details", "-statistics", "link", "show", "can0")
    )
    with Scenario("kvaser_pair", drive="can1", controller="can0") as s:
        s.start()


def interface_goes_down_and_up() -> None:
    with Scenario("interface_goes_down_and_up", seconds=30.0) as s:
        s.start()
        s.running()
        sh("ip", "link", "set", "vcan0", "down")
        time.sleep(0.3)
        sh("ip", "link", "set", "vcan0", "up")
        after = subprocess.Popen(["candump", "-L", "vcan0"], stdout=(s.folder / "after.log").open("w"))
        s.run.wait()
        time.sleep(0.5)
        after.terminate()


def drive_dies() -> None:
    with Scenario("drive_dies", seconds=30.0) as s:
        s.start()
        s.running()
        s.emulator.send_signal(signal.SIGKILL)


def second_master() -> None:
    with Scenario("second_master", seconds=30.0) as s:
        s.start()
        s.running()
        sh("cansend", "vcan0", "201#0102030405060708")


def injected_and_ridden_through() -> None:
    with Scenario("injected_and_ridden_through", seconds=6.0) as s:
        s.start()
        s.running()
        for frame in ("181#0011223344556677", "181#00", "555#DEADBEEF", "1ABCDEF0#00", "181#R"):
            sh("cansend", "vcan0", frame)
            time.sleep(0.05)
        sh("cangen", "vcan0", "-I", "444", "-L", "8", "-g", "0", "-n", "300")


def injected_beyond_the_budget() -> None:
    with Scenario("injected_beyond_the_budget", seconds=30.0) as s:
        s.start()
        s.running()
        sh("cangen", "vcan0", "-I", "181", "-L", "8", "-D", "0011223344556677", "-g", "1", "-n", "60")


def stale_counter_ridden_through() -> None:
    """Feedback of eight ticks before, whole, its CRC valid: its counter, of 16, tells that it is old."""
    with Scenario("stale_counter_ridden_through", seconds=4.0) as s:
        s.start()
        s.running()
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as own:
            own.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, struct.pack("=II", 0x181, 0x7FF))
            own.bind(("vcan0",))
            for _ in range(3):
                feedback = [own.recv(16) for _ in range(9)]
                own.send(feedback[0])


def stale_counters_beyond_the_budget() -> None:
    with Scenario("stale_counters_beyond_the_budget", seconds=30.0) as s:
        s.start()
        s.running()
        old = next(line for line in s.dump.read_text().splitlines() if " 181#" in line).split()[2][4:]
        sh("cangen", "vcan0", "-I", "181", "-L", "8", "-D", old, "-g", "1", "-n", "200")


# SocketCAN's error frames: class, then what the controller tells (passive), then its counters tx and rx
PASSIVE = "20000004#0030000000008888"
PASSIVE_RAW = struct.pack("=IB3x8s", 0x20000004, 8, bytes.fromhex("0030000000008888"))
BUS_OFF = "20000040#0000000000000000"


def error_frame_ridden_through() -> None:
    with Scenario("error_frame_ridden_through", seconds=3.0) as s:
        s.start()
        s.running()
        sh("cansend", "vcan0", PASSIVE)


def error_frames_beyond_the_budget() -> None:
    with Scenario("error_frames_beyond_the_budget", seconds=30.0) as s:
        s.start()
        s.running()
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as own:
            own.bind(("vcan0",))
            for _ in range(100):  # one a tick; a cansend for each comes too seldom
                own.send(PASSIVE_RAW)
                time.sleep(0.001)


def bus_off_is_reported() -> None:
    with Scenario("bus_off_is_reported", seconds=30.0) as s:
        s.start()
        s.running()
        sh("cansend", "vcan0", BUS_OFF)


QDISC = ("root", "tbf", "burst", "32b", "limit", "160b", "rate")
"""A bus that takes two frames and then one in 16 s; ten more wait, as with txqueuelen 10, then ENOBUFS."""


def queue_is_full() -> None:
    """The controller's card takes no more frames; when it does again, what was queued goes out."""
    if not Path("/sys/class/net/can1").exists():
        return
    with Scenario("queue_is_full", drive="can1", controller="can0", seconds=30.0) as s:
        wire = subprocess.Popen(["candump", "-L", "can1"], stdout=(s.folder / "wire.log").open("w"))
        s.start()
        s.running()
        sh("tc", "qdisc", "replace", "dev", "can0", *QDISC, "8bit")
        s.run.wait()
        (s.folder / "queued.txt").write_text(sh("tc", "-s", "qdisc", "show", "dev", "can0"))
        (s.folder / "marks.json").write_text(json.dumps({"drained": time.time()}))
        sh("tc", "qdisc", "change", "dev", "can0", *QDISC, "100mbit")
        # the queue is looked at again with the next frame, even with one that it refuses
        while subprocess.run(["cansend", "can0", "7E0#00"], capture_output=True, check=False).returncode:
            time.sleep(0.05)
        time.sleep(0.2)
        sh("cansend", "can0", "080#01")  # what does the drive say of itself now
        time.sleep(0.05)
        wire.terminate()
        wire.wait()
        sh("tc", "qdisc", "del", "dev", "can0", "root")


def no_partner() -> None:
    if not Path("/sys/class/net/can1").exists():
        return
    with Scenario("no_partner", drive="can1", controller="can0", seconds=30.0) as s:
        s.start()
        s.running()
        sh("ip", "link", "set", "can1", "down")
        s.run.wait()
        (s.folder / "link.json").write_text(
            sh("ip", "-json", "-details", "-statistics", "link", "show", "can0")
        )
        sh("ip", "link", "set", "can1", "up")


def vcan_fd() -> None:
    """One 64-byte frame each way."""
    with Scenario("vcan_fd", settings=FD, plant=('dbc="../drives/hil_pmsm_fd.dbc"',)) as s:
        s.start()


def vcan_other_drive() -> None:
    """Big endian, extended identifiers, CAN FD, no SYNC: by configuration alone."""
    with Scenario("vcan_other_drive", config="configs/inverter.toml") as s:
        s.start()


def shadow(name: str = "shadow", config: str = CONFIG, command: str = " 201#") -> None:
    """A shadow joins a running controller, sees what it sees, and leaves before it."""
    with Scenario(name, config=config, seconds=3.0) as s:
        s.start()
        s.running(command)
        own = ["--set", f'log.folder="{s.folder / "shadow"}"', "--set", "loop.duration_s=1.0"]
        words = ("run", config, "-i", "socketcan", "-c", "vcan0", "--json", "--shadow", *own)
        beside = Forked.hil(s.folder / "shadow.json", *words)
        (s.folder / "shadow.txt").write_text(str(beside.wait()))


def shadow_of_other_drive() -> None:
    """Without an echo it takes the newest command that it saw for what is applied."""
    shadow("shadow_of_other_drive", "configs/inverter.toml", " 18FF1100#")


def other_drive_watchdog() -> None:
    """Its own watchdog ends what nothing else does: the controller stands still, no guardian."""
    alone = ("guardian.enabled=false",)
    with Scenario("other_drive_watchdog", config="configs/inverter.toml", seconds=30.0, settings=alone) as s:
        s.start()
        s.running(" 18FF1100#")
        s.run.send_signal(signal.SIGSTOP)
        time.sleep(0.15)
        s.run.send_signal(signal.SIGCONT)


def other_drive_is_late() -> None:
    """Its feedback stays away for 15 ms and then comes in a heap."""
    with Scenario("other_drive_is_late", config="configs/inverter.toml", seconds=2.0) as s:
        s.start()
        s.running(" 18FF1100#")
        s.emulator.send_signal(signal.SIGSTOP)
        time.sleep(0.015)
        s.emulator.send_signal(signal.SIGCONT)


def controller_is_killed() -> None:
    """With the drive's watchdog off: what stops it is the guardian."""
    with Scenario("controller_is_killed", seconds=30.0, plant=("firmware.watchdog_ms=0.0",)) as s:
        s.start()
        s.running()
        s.run.send_signal(signal.SIGKILL)
        s.run.wait()
        time.sleep(0.3)


BY_HAND = (
    "080#01", "201#8001060000000000",  # shutdown
    "080#02", "201#6102070000000000",  # switch on
    "080#03", "201#94030F0000000000",  # enable operation
    "080#04", "201#44040F00A00F0000",  # u_q = 40 V
    "080#05", "080#06",
)  # fmt: skip


CLOCK_STEPS_S = (3600.0, -7200.0, 3600.0)


def clock_steps() -> None:
    """The wall clock jumps an hour on, two back, one on, as a time server may set it. Never a real host's."""
    if not IN_MACHINE:
        (OUT / "clock_steps.skipped").touch()
        return
    with Scenario("clock_steps", seconds=3.0) as s:
        s.start()
        s.running()
        marks = []
        for step_s in CLOCK_STEPS_S:
            marks.append(time.monotonic_ns())
            time.clock_settime(time.CLOCK_REALTIME, time.time() + step_s)
            time.sleep(0.4)
        (s.folder / "marks.json").write_text(json.dumps(marks))


def by_hand() -> None:
    """The emulated drive driven with cansend alone, then left to its watchdog."""
    with Scenario("by_hand", plant=("firmware.watchdog_ms=1000.0",)):
        for frame in BY_HAND:
            sh("cansend", "vcan0", frame)
            time.sleep(0.01)
        time.sleep(1.5)
        sh("cansend", "vcan0", "080#07")
        time.sleep(0.05)


def canplayer() -> None:
    """can-utils' canplayer plays on vcan0 what `hil export` wrote of an earlier run."""
    folder = SCRATCH / "canplayer"
    folder.mkdir()
    log, exported = next((SCRATCH / "rehearsal").glob("*.mcap")), folder / "exported.log"
    Forked.hil(folder / "export.txt", "export", str(log), "-o", str(exported)).wait()
    with (folder / "played.log").open("w") as heard:
        dump = subprocess.Popen(["candump", "-L", "vcan0"], stdout=heard)
        time.sleep(0.1)
        sh("canplayer", "-I", str(exported), "vcan0=can0")  # an export calls its bus can0
        time.sleep(0.1)
        dump.terminate()
        dump.wait()
    shutil.copytree(folder, OUT / folder.name)


def stranger(
    name: str, config: str, drive: Callable[[], int], settings: Sequence[str], *sets_up: str
) -> None:
    """A drive on a stack of strangers on vcan0, in lockstep: it takes longer than a period at times."""
    folder = SCRATCH / name
    shutil.copytree("configs", folder / "configs")
    path = folder / "configs" / "own.toml"
    path.write_text(config)
    own = ('bus.interface="socketcan"', 'bus.channel="vcan0"', f'log.folder="{folder}"', *settings)
    words = [str(path), *(word for one in own for word in ("--set", one))]
    dump = subprocess.Popen(["candump", "-L", "vcan0"], stdout=(folder / "candump.log").open("w"))
    there = Forked(folder / "drive.txt", drive)
    there.until("ready")
    code = Forked.hil(folder / "configure.txt", "configure", *words, *sets_up).wait() if sets_up else 0
    run = Forked.hil(folder / "run.json", "run", *words, "--json")
    code = run.wait() or code
    there.send_signal(signal.SIGTERM)
    there.wait()
    dump.terminate()
    dump.wait()
    (folder / "result.json").write_text(
        json.dumps({"returncode": code, "run": json.loads(run.said() or "{}")})
    )
    shutil.copytree(folder, OUT / name)


def stranger_cia402() -> None:
    """durand: set up by SDO from the EDS that it makes itself, NMT, states, speed, stop."""
    from tests import durand402

    eds = SCRATCH / "durand.eds"
    short = ("loop.duration_s=0.8", "reference.at_s=0.05", "reference.down_at_s=0.6")
    short += ("reference.w_rad_s=40.0", "reference.rate_rad_s2=400.0", "reference.jerk_rad_s3=2e4")
    settings = (*short, 'loop.clock="lockstep"', "canopen.answer_timeout_s=5.0", f'canopen.eds="{eds}"')
    made = str(SCRATCH / "stranger_cia402" / "configs" / "drives" / "cia402.dbc")
    config = durand402.config_of(Path("configs/cia402.toml").read_text())
    stranger(
        "stranger_cia402", config, lambda: durand402.main("vcan0", eds, "socketcan"), settings, "--dbc", made
    )


def stranger_joint() -> None:
    """am-sdk: plant and firmware its makers', 64-byte frames."""
    from tests import amdrive

    (SCRATCH / "am.dbc").write_text(amdrive.DBC)
    settings = (f'drive.dbc="{SCRATCH / "am.dbc"}"', "loop.duration_s=0.8", "reference.down_at_s=0.6")
    stranger("stranger_joint", amdrive.CONFIG, lambda: amdrive.main("vcan0", "socketcan"), settings)


def instructions() -> None:
    """What a tick costs, phase by phase."""
    counted.measure(OUT)


def two_nodes() -> None:
    """What a tick of two nodes costs beside that of one."""
    counted.count_nodes(OUT)


def main() -> int:
    scenarios: list[Callable[[], None]] = [
        rehearsal,
        vcan_two_processes,
        vcan_8_khz,
        vcan_without_fifo,
        vcan_kernel_sync,
        sync_beside_a_load,
        kernel_sync_ends_with_its_process,
        kernel_sync_of_a_stopped_process,
        kernel_sync_of_a_stopped_process_ends_by_the_watchdog,
        kvaser_pair,
        vcan_fd,
        vcan_other_drive,
        shadow,
        shadow_of_other_drive,
        other_drive_watchdog,
        other_drive_is_late,
        by_hand,
        clock_steps,
        controller_is_killed,
        interface_goes_down_and_up,
        drive_dies,
        second_master,
        injected_and_ridden_through,
        injected_beyond_the_budget,
        stale_counter_ridden_through,
        stale_counters_beyond_the_budget,
        error_frame_ridden_through,
        error_frames_beyond_the_budget,
        bus_off_is_reported,
        queue_is_full,
        no_partner,
        canplayer,
        stranger_cia402,
        stranger_joint,
        instructions,
        two_nodes,
    ]
    wanted = sys.argv[1:]
    begin = time.monotonic()
    warm_up()
    print(f"warm-up: {time.monotonic() - begin:.1f} s", flush=True)
    for scenario in scenarios:
        if wanted and scenario.__name__ not in wanted:
            continue
        begin = time.monotonic()
        try:
            scenario()
        except Exception as error:  # noqa: BLE001 - the next scenario runs anyway; the host judges
            print(f"{scenario.__name__}: {type(error).__name__}: {error}", flush=True)
        print(f"{scenario.__name__}: {time.monotonic() - begin:.1f} s", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
