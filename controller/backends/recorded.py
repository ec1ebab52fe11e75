"""Sets in which no arm sorts: pictures from a folder, and rehearsals on any set's devices."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from controller.backends.devices import BackendOptions, Devices
from controller.config.cell import CellConfig
from controller.cycle.rehearsal import EmptyHanded, ImaginedPart, OneLook, Rehearsal
from controller.domain import ArmDescription
from controller.ports import Arm


def replay_devices(config: CellConfig, arm: ArmDescription, options: BackendOptions) -> Devices:
    """Pictures from a folder, an arm that only writes down what it is told, and a clock that moves by itself."""
    from sim_backends.recording_arm import CommandFile, RecordingArm
    from sim_backends.replay_camera import ReplayCamera
    from sim_backends.virtual_clock import VirtualClock

    assert options.replay is not None
    clock = VirtualClock()
    imagined = ImaginedPart()
    moves = CommandFile(options.out / "moves.jsonl")
    recorder = RecordingArm(arm, clock, on_command=moves, grip_model=imagined.grip)
    camera = ReplayCamera(options.replay, clock)
    return Devices(camera, recorder, clock, observers=(imagined,), closers=[moves.close])


def rehearsed(devices: Devices, arm: ArmDescription, options: BackendOptions, rehearsal: Rehearsal) -> Devices:
    """The same devices for a rehearsal: one look, and an arm that only writes down its moves, or grips nothing.

    They are to be opened and closed by themselves. The world's truth is left out: nothing that the cell believes
    to have done was done.
    """
    from sim_backends.recording_arm import CommandFile, RecordingArm

    imagined = ImaginedPart()
    closers: list[Callable[[], None]] = []
    stand_in: Arm = EmptyHanded(devices.arm, imagined)
    if rehearsal is Rehearsal.DRY:
        moves = CommandFile(options.out / "moves.jsonl")
        closers.append(moves.close)
        stand_in = RecordingArm(arm, devices.clock, on_command=moves, grip_model=imagined.grip)
    camera = OneLook(devices.camera)
    observers = (*devices.observers, imagined)
    return replace(devices, camera=camera, arm=stand_in, truth=None, observers=observers, closers=closers)
