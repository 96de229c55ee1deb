"""The controller's side: what the message that `drive.signals.sync` names says in each tick."""

from drivers.client import DriveClient
from drivers.drive import DriveKind

READ = 0x52
SPEED, CURRENT, MODE, SUPPLY = 1, 2, 4, 8


class QueryClient(DriveClient):
    """The house's client, but that it asks where CANopen sends SYNC; the rest follows from DBC and map."""

    def request(self) -> bytes:
        """Read all registers that the map reads; commands nothing."""
        return self.binding.sync.encode({"Opcode": READ, "Registers": SPEED | CURRENT | MODE | SUPPLY})


MEMBER = DriveKind("registers are read by a request, torques are written", QueryClient, asked=True)
