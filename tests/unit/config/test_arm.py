from __future__ import annotations

import math
from pathlib import Path

import pytest

from controller.config.arm import load_arm
from controller.config.files import shipped
from controller.errors import ConfigError

ARMS = sorted(path.stem for path in shipped("arms").glob("*.toml"))
RX150 = shipped("arms/reactorx_150.toml").read_text(encoding="utf-8")


def changed(tmp_path: Path, old: str, new: str, count: int = 1) -> str:
    assert old in RX150
    path = tmp_path / "mine.toml"
    path.write_text(RX150.replace(old, new, count), encoding="utf-8")
    return str(path)


def test_five_arms_ship() -> None:
    assert set(ARMS) >= {"reactorx_150", "pincherx_100", "widowx_200", "widowx_250", "open_manipulator_x"}


@pytest.mark.parametrize("name", ARMS)
def test_shipped_arms_make_sense(name: str) -> None:
    arm = load_arm(name)
    assert arm.name == name
    assert len(arm.joints) == len(arm.links) == len(arm.rest) == len(arm.ready)
    for joint, ready in zip(arm.joints, arm.ready, strict=True):
        # Goals lead by up to 5 deg: the ready pose leaves that to the limit.
        assert joint.limits[0] + math.radians(5.0) < ready < joint.limits[1] - math.radians(5.0)
        assert 1.0 < joint.speed_limit < 4.82
        assert all(abs(v) < 300.0 for v in joint.offset)


def test_units_are_converted() -> None:
    arm = load_arm("reactorx_150")
    assert arm.joints[1].limits == pytest.approx((-1.85005, 1.74533), abs=1e-5)
    # In ticks: the limits that the maker writes into the servo.
    assert [round(2048 + v * 4096 / (2 * math.pi)) for v in arm.joints[1].limits] == pytest.approx([841, 3185], abs=2)
    assert sum(link.mass for link in arm.links) == pytest.approx(1.006, abs=0.01)
    assert arm.payload == pytest.approx(0.1)


def test_a_file_of_ones_own_is_named_after_itself(tmp_path: Path) -> None:
    assert load_arm(changed(tmp_path, "ReactorX-150", "Mine", 2)).name == "mine"


def test_an_unknown_arm_lists_the_known_ones() -> None:
    with pytest.raises(ConfigError, match="pincherx_100"):
        load_arm("reactorx_1500")


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ('axis = "z"', 'axis = "y"', "joint axes yyyyx are not supported"),
        ("servo_id = 2", "servo_id = 1", "not all different"),
        ("limits_deg = [-106.0, 100.0]", "limits_deg = [100.0, -106.0]", "limits_deg"),
        ("rest_deg = [0.0, ", "rest_deg = [", "rest_deg has 4 angles"),
        ("ready_deg = [0.0, -42.0", "ready_deg = [0.0, -142.0", "shoulder -142 is outside"),
        ("opening_mm = [30.0, 74.0]", "opening_mm = [30.0, 80.0]", "what this crank can do"),
        ("parameters = [14.0, 24.0, 0.0]", "parameters = [14.0, 24.0]", "3 parameters"),
        ("tool_mm = [93.575, 0.0", "tool_mm = [93.575, 2.0", "planar chain"),
        ("speed_limit_deg_s = 143.0", "speed_limit_deg_s = -1.0", "speed_limit_deg_s"),
        ("speed_limit_deg_s = 143.0", "speed_limit = 143.0", "did you mean speed_limit_deg_s"),
        ('name = "shoulder"', 'name = "waist"', "names are not all different"),
    ],
)
def test_mistakes_are_named(tmp_path: Path, old: str, new: str, complaint: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_arm(changed(tmp_path, old, new))
    assert complaint in str(caught.value)
    assert "mine.toml" in str(caught.value)
