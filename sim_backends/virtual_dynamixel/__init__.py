"""Virtual Dynamixel servos on a virtual bus: the truth the unmodified driver talks to.

    bytes -> bus -> protocol -> servo -> control loop -> Plant (the world's joints)

Everything here is written from the manuals and apart from `drivers/arm`, so that one mistake cannot pass on
both sides. What no manual confirms is marked `Assumption:` where it is made; all of it:

| module | assumed |
|---|---|
| `bus` | an unfinished packet is forgotten after a silence; what is sent while servos still answer is lost |
| `protocol` | packets with a wrong checksum get no answer; a length beyond the longest is noise |
| `instructions` | time per ID of a broadcast ping; behind a missing servo the others stay silent; a fast read of what \
cannot be read gives zeros |
| `control_table` | gaps between registers read as 0; nothing of a write is stored when one register refuses; which \
values answer Data Limit and which Data Range |
| `servo` | what torque on makes of an old goal; time of a reboot; what Moving_Status counts as arrived; a registered \
write is checked again when it is carried out |
| `motor` | a large Homing_Offset in position mode; the other goals at torque on; where a tripped watchdog holds |
| `profile`, `control_loop` | a profile replaced on its way; every goal plans anew; a loop at 1 kHz |
| `health` | load and time of an overload; warming; a hardware error stays until a reboot |
| `models` | firmware new enough for all of it; the XC430-W150 like its sibling |
"""

from sim_backends.virtual_dynamixel.bus import VirtualBus
from sim_backends.virtual_dynamixel.faults import Fault
from sim_backends.virtual_dynamixel.servo import ServoSpec
from sim_backends.virtual_dynamixel.stream import BusStream

__all__ = ["BusStream", "Fault", "ServoSpec", "VirtualBus"]
