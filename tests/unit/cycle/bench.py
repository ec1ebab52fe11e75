"""A rig without a world: a recording arm, a camera that scripts its failures, and a table that is a list."""

from __future__ import annotations

import dataclasses
import itertools
from collections import Counter
from collections.abc import Callable, Container
from dataclasses import dataclass, field

import numpy as np
import pytest

from controller.config.arm import load_arm
from controller.config.cell import CellConfig, load_cell
from controller.config.files import shipped
from controller.cycle import looking
from controller.cycle.guard import Guard
from controller.cycle.machine import State
from controller.cycle.rig import Look, Observer, Rig
from controller.cycle.sorter import Sorter
from controller.domain import (
    CellCalibration,
    Descriptors,
    Detection,
    Frame,
    LocatedObject,
    Outcome,
    PickPlan,
    Result,
    Shape,
)
from controller.errors import Intruder, SorterError
from controller.geometry import CameraModel
from controller.localization.locate import Located
from controller.motion.planner import Planner
from controller.vision.detect import Detected
from controller.vision.recipe import load_recipe
from sim_backends.recording_arm import RecordingArm
from sim_backends.virtual_clock import VirtualClock

IMAGE = np.zeros((720, 1280, 3), np.uint8)
FOCAL = 1000.0


def part(x: float, y: float, shape: Shape = Shape.SQUARE, size: float = 40.0, score: float = 1.0) -> LocatedObject:
    """A square prism of 20 mm with its sides along the axes."""
    half = size / 2
    corners = np.array([[-half, -half], [half, -half], [half, half], [-half, half]])
    footprint = corners + np.array([x, y])
    detection = Detection(
        Frame(1, 0.0, IMAGE),
        shape,
        score,
        footprint,
        (640.0, 360.0),
        (size, size),
        0.0,
        size**2,
        (0.0, 0.0, size, size),
        Descriptors(1.0, 1.27, 0.0),
        str(shape),
    )
    return LocatedObject(detection, (x, y), 0.0, (size, size), 20.0, footprint, 0.2, "bench")


class BenchCamera:
    """Gives black pictures; `failures` are raised one by one first."""

    def __init__(self, clock: VirtualClock) -> None:
        self.failures: list[SorterError] = []
        self.opened = 0
        self.listener: Callable[[Frame], None] | None = None
        self._clock = clock

    def open(self) -> None:
        self.opened += 1

    def close(self) -> None:
        pass

    def glance(self, listener: Callable[[Frame], None] | None) -> None:
        self.listener = listener

    def capture(self, after: float, timeout: float = 2.0) -> Frame:
        if self.failures:
            raise self.failures.pop(0)
        return Frame(1, self._clock.now(), IMAGE)


@dataclass
class BenchLedger:
    """Keeps everything in one list, in order; `full` makes every write fail."""

    lines: list[tuple[str, str]] = field(default_factory=list)
    full: SorterError | None = None

    def intend(self, target_id: str, plan: PickPlan, attempt: int, at: float) -> None:
        self._write("intend", f"{target_id}/{attempt}")

    def conclude(self, outcome: Outcome) -> None:
        self._write("conclude", f"{outcome.target.target_id}:{outcome.result}")

    def note(self, kind: str, at: float, **details: object) -> None:
        self._write("note", kind)

    def _write(self, kind: str, what: str) -> None:
        if self.full is not None:
            raise self.full
        self.lines.append((kind, what))


class ListeningClock(VirtualClock):
    """Tells the bench whenever somebody sleeps."""

    def __init__(self, bench: Bench) -> None:
        super().__init__()
        self._bench = bench

    def sleep(self, seconds: float) -> None:
        super().sleep(seconds)
        self._bench.on_sleep(self.now())


class Bench(Observer):
    """The rig, the table as a list, and what was seen of the run."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *parts: LocatedObject) -> None:
        self._patch = monkeypatch
        self.table = list(parts)
        self.clock = ListeningClock(self)
        self.arm = RecordingArm(load_arm("reactorx_150"), self.clock, on_command=self._commanded, grip_model=self._grip)
        self.camera = BenchCamera(self.clock)
        self.ledger = BenchLedger()
        self.config = load_cell(shipped("sim.toml"))
        self.states: list[State] = []
        self.outcomes: list[Outcome] = []
        self.on_command: Callable[[dict[str, object]], None] = lambda command: None
        self.confirm: Callable[[PickPlan], bool] = lambda plan: True
        self.most_parts: int | None = None
        self.until_empty = True
        self.held_for: list[SorterError] = []
        self.overcome = 0
        self.concerns: dict[str, str] = {}
        self.warnings: list[str] = []
        self.on_sleep: Callable[[float], None] = lambda now: None
        self.filled: Counter[str] = Counter()
        self._width = 0.0
        monkeypatch.setattr(looking, "detect", lambda *args, **kwargs: Detected((), {"total": 0.0}))
        monkeypatch.setattr(looking, "locate", self.locate)

    def intrude(self, looks: Container[int]) -> None:
        """Something reaches over the table in these frames; 1 is the first."""
        count = itertools.count(1)

        def check(guard: Guard, frame: Frame, hidden: object) -> None:
            if next(count) in looks:
                raise Intruder("a hand", "take it away")

        self._patch.setattr(Guard, "check_frame", check)

    def reach_over_on_the_way(self, moves: Container[int]) -> None:
        """Something reaches over the table in the middle of these moves that are watched; 1 is the first."""
        count = itertools.count(1)

        def check(guard: Guard, glance: Frame, hidden: object) -> None:
            raise Intruder("a hand", "take it away")

        def commanded(command: dict[str, object]) -> None:
            if self.camera.listener is not None and next(count) in moves:
                self.camera.listener(Frame(1, self.clock.now(), IMAGE))

        self._patch.setattr(Guard, "check_glance", check)
        self.on_command = commanded

    def locate(self, *_: object) -> Located:
        """What lies on the table."""
        return Located(tuple(self.table), ())

    def change(self, section: str, **values: object) -> None:
        """Change keys of one section of the configuration."""
        table = getattr(self.config, section).model_copy(update=values)
        self.config = self.config.model_copy(update={section: table})

    def sorter(self) -> Sorter:
        """A sorter on this bench."""
        matrix = np.array([[FOCAL, 0.0, 639.5], [0.0, FOCAL, 359.5], [0.0, 0.0, 1.0]])
        down = np.array([[0.0, -1, 0, 0], [-1, 0, 0, 0], [0, 0, -1, 600.0], [0, 0, 0, 1]])
        calibration = CellCalibration(
            "bench", CameraModel(matrix, np.zeros(5), (1280, 720)), down, self.config.table.T_base_table()
        )
        config: CellConfig = self.config
        rig = Rig(
            config,
            self.camera,
            self.arm,
            self.clock,
            self.ledger,
            calibration,
            load_recipe("precise"),
            Planner(self.arm.description, calibration, config.bin_values()),
            (self,),
            self.confirm,
            concerns=lambda: self.concerns,
        )
        return Sorter(rig, until_empty=self.until_empty, most_parts=self.most_parts, filled=self.filled)

    def run(self) -> Sorter:
        """Sort until the table is empty."""
        self.arm.open()
        sorter = self.sorter()
        sorter.run()
        return sorter

    @property
    def results(self) -> list[Result]:
        """Of every outcome, in order."""
        return [outcome.result for outcome in self.outcomes]

    @property
    def commands(self) -> list[str]:
        """Every command by its name, moves by what they are for."""
        return [str(c.get("name", c["command"])) for c in self.arm.commands]

    # --- what the run tells ---------------------------------------------------------------------------

    def entered(self, state: State, at: float) -> None:
        self.states.append(state)

    def held(self, cause: SorterError, at: float) -> None:
        self.held_for.append(cause)

    def resumed(self, at: float) -> None:
        self.overcome += 1

    def warned(self, code: str, cause: str, at: float) -> None:
        self.warnings.append(f"{code}: {cause}")

    def eased(self, code: str, at: float) -> None:
        self.warnings.append(f"{code} is over")

    def looked(self, look: Look) -> None:
        assert all(thing.detection.frame.image is IMAGE for thing in look.located)

    def planned(self, plan: PickPlan) -> None:
        self._width = plan.grasp.width

    def concluded(self, outcome: Outcome) -> None:
        self.outcomes.append(outcome)
        if outcome.result in (Result.PLACED, Result.REJECTED):
            self.table = [t for t in self.table if t.detection is not outcome.target.detection]

    def _grip(self, before: float, wanted: float) -> tuple[bool, float]:
        return (True, self._width) if wanted < self._width <= before else (False, wanted)

    def _commanded(self, command: dict[str, object]) -> None:
        self.on_command(command)


def moved(thing: LocatedObject, x: float, y: float) -> LocatedObject:
    """The same part elsewhere."""
    shift = np.array([x - thing.center[0], y - thing.center[1]])
    return dataclasses.replace(thing, center=(x, y), footprint=thing.footprint + shift)
