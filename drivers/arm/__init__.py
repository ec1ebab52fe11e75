"""The arm: Dynamixel X servos on a half-duplex bus, from bytes on the wire to the `Arm` port."""
