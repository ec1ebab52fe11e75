"""Virtual Dynamixel servos on a virtual bus: the truth the unmodified driver talks to.

    bytes -> bus -> protocol -> servo -> control loop -> Plant (the world's joints)

Everything here is written from the manuals and apart from `drivers/arm`, so that one mistake cannot pass on
both sides. What no manual confirms is marked `Assumption:` where it is made.
"""

from sim_backends.virtual_dynamixel.bus import VirtualBus
from sim_backends.virtual_dynamixel.faults import Fault
from sim_backends.virtual_dynamixel.servo import ServoSpec
from sim_backends.virtual_dynamixel.stream import BusStream

__all__ = ["BusStream", "Fault", "ServoSpec", "VirtualBus"]
