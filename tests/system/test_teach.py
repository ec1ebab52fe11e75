"""Teaching on the command line: taught, named, tested and forgotten; what makes no sense changes nothing."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np

from tests.benchmarks import surfaces
from tests.benchmarks.surfaces import KINDS, Thing
from tests.system.conftest import Controller

_COLOUR = ((60, 60, 190), (60, 60, 190))


def _photos(folder: Path, kind: str, count: int, seed: int) -> Path:
    """Pictures of two parts of a kind each, in any place and turn."""
    folder.mkdir(exist_ok=True)
    random = np.random.default_rng(seed)
    for k in range(count):
        things = [
            Thing([ring * 32.0 for ring in KINDS[kind]], _COLOUR, x, 110.0, float(random.uniform(-3, 3)))
            for x in (90.0, 250.0)
        ]
        picture = surfaces.paint(things, (340, 220), random, light=surfaces.field((340, 220), 5500.0, 0.8, 0.2, 1.0))
        cv2.imwrite(str(folder / f"{kind}_{k}.png"), picture)
    return folder


def test_a_part_is_taught_named_and_forgotten(controller: Controller, tmp_path: Path) -> None:
    taught = controller("teach", "big star", _photos(tmp_path / "star", "star", 4, 1), "--json")
    assert taught.returncode == 0, taught.stderr
    assert json.loads(taught.stdout)["confusion"]["big star"] == {"big star": 8}
    _photos(_photos(tmp_path / "new", "star", 1, 4), "ring", 1, 5)
    tested = controller("classes", "test", tmp_path / "new", "--json")
    lines = [json.loads(line) for line in tested.stdout.splitlines()]
    said = {Path(line["image"]).stem: {thing["class"] for thing in line["objects"]} for line in lines}
    assert said == {"star_0": {"big star"}, "ring_0": {"unknown"}}
    assert controller("classes", "remove", "big star").returncode == 0
    assert controller("classes", "list", "--json").stdout == ""


def test_an_empty_picture_teaches_nothing(controller: Controller, tmp_path: Path) -> None:
    picture = surfaces.paint([], (340, 220), np.random.default_rng(0))
    cv2.imwrite(str(tmp_path / "empty.png"), picture)
    refused = controller("teach", "nothing", tmp_path / "empty.png")
    assert refused.returncode == 1
    assert "shows nothing" in refused.stderr
    assert not (tmp_path / "state" / "sorting-controller" / "classes").exists()


def test_a_drawn_part_without_a_height_is_refused(controller: Controller, tmp_path: Path) -> None:
    (tmp_path / "a.svg").write_text(
        '<svg width="40mm" height="30mm" viewBox="0 0 40 30"><path d="M0 0H40V30H0Z"/></svg>'
    )
    refused = controller("teach", "plate", "--drawing", tmp_path / "a.svg", "--height-mm", "0")
    assert refused.returncode == 2
    assert "needs its height" in refused.stderr


def test_a_rule_for_a_label_that_was_never_taught_stops_the_run_before_it_begins(
    controller: Controller, tmp_path: Path
) -> None:
    text = (Path(__file__).parents[2] / "configs" / "sim.toml").read_text(encoding="utf-8")
    rule = '\n[[sorting.rules]]\nlabel = "big star"\nbin = "squares"\n'
    (tmp_path / "cell.toml").write_text(text + rule, encoding="utf-8")
    refused = controller("run", "--sim", "--config", tmp_path / "cell.toml", "--out", tmp_path / "out")
    assert refused.returncode == 78
    assert "never taught" in refused.stderr


def test_annotations_are_proposed_corrected_and_learnt(controller: Controller, tmp_path: Path) -> None:
    folder = _photos(_photos(tmp_path / "photos", "star", 3, 7), "cross", 3, 8)
    assert controller("annotate", folder).returncode == 0
    path = folder / "annotations.json"
    content = json.loads(path.read_text(encoding="utf-8"))
    assert [entry["n"] for entry in content["images"]] == [2] * 6
    said = [word for name in ("star", "cross") for k in (1, 2) for word in ("--set", f"{name}_*.png:{k}={name}")]
    assert controller("annotate", folder, *said, "--save", tmp_path / "look").returncode == 0
    assert len(list((tmp_path / "look").glob("*.png"))) == 6
    # Classes of annotations stay shapes: the pictures can be evaluated as they are.
    assert controller("evaluate", "--images", folder, "--json").returncode == 0
    before = path.read_text(encoding="utf-8")
    wrong = controller("annotate", folder, "--set", "star_0.png:1=ring", "--set", "star_0.png:9=ring")
    assert wrong.returncode == 1
    assert "has no object 9" in wrong.stderr
    assert path.read_text(encoding="utf-8") == before
    result = json.loads(controller("train", folder, "--json").stdout)
    assert result["examples"] == 12
    assert result["right"]["nearest_views"] == 1.0
    assert json.loads(controller("annotate", folder, "--json").stdout)["proposed"] == 0
