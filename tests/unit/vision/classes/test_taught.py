from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from controller.errors import InputError
from controller.vision.classes import store
from controller.vision.classes.classifier import Classifier
from controller.vision.classes.features import LENGTH
from controller.vision.classes.markings import SIDE
from controller.vision.classes.store import TaughtClass, load_class, load_classes, remove_class, save_class
from controller.vision.classes.taught import Taught, admit
from tests.benchmarks.surfaces import KINDS, UNKNOWN
from tests.benchmarks.teaching import Floats32, views


@pytest.fixture(scope="module")
def shown() -> dict[str, Floats32]:
    """Six views of each kind and print."""
    values, names, lost, _ = views([*KINDS, "print A", "print B"], 6, 21)
    assert lost == 0
    return {kind: values[[name == kind for name in names]] for kind in dict.fromkeys(names)}


def _class(name: str, values: Floats32, units: str = "px") -> TaughtClass:
    pictures = tuple(f"{name}{k}.png" for k in range(len(values)))
    return TaughtClass(name, units, values, pictures, np.zeros((len(values), SIDE, SIDE), np.uint8))


def test_new_views_are_known_and_new_kinds_are_not(shown: dict[str, Floats32]) -> None:
    classifier = Classifier(shown)
    values, names, _, _ = views(list(shown), 3, 22)
    said = [v.name if v else None for v in classifier.verdicts(values)]
    # The issue asks for 98 % of 1000 (the benchmark measures it); one of these 30 may be left unknown.
    assert sum(a == b for a, b in zip(names, said, strict=True)) >= len(names) - 1
    strange, _, _, _ = views(list(UNKNOWN), 3, 23)
    assert sum(v is not None and v.name is not None for v in classifier.verdicts(strange)) <= 1


def test_nothing_taught_names_nothing() -> None:
    assert Classifier({}).verdicts(np.zeros((2, LENGTH), np.float32)) == [None, None]


def test_a_class_keeps_through_its_files(shown: dict[str, Floats32], tmp_path: Path) -> None:
    path = save_class(tmp_path, _class("star no. 5", shown["star"]))
    again = load_class(path)
    assert again.name == "star no. 5"
    assert np.array_equal(again.views, shown["star"])
    save_class(tmp_path, _class("star no. 5", shown["star"][:4]))
    assert len(load_class(path).views) == 4
    assert len(list(tmp_path.glob("*.npz"))) == 1
    remove_class(tmp_path, "star no. 5")
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(InputError, match="no class"):
        remove_class(tmp_path, "star no. 5")


def test_damage_is_noticed(shown: dict[str, Floats32], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = save_class(tmp_path, _class("star", shown["star"]))
    record = json.loads(path.read_text(encoding="utf-8"))
    data = tmp_path / record["data"]
    whole = data.read_bytes()
    data.write_bytes(whole[:-1] + b"x")
    with pytest.raises(InputError, match="checksum"):
        load_classes(tmp_path)
    data.write_bytes(whole)
    path.write_text(json.dumps(record | {"features": 99}), encoding="utf-8")
    with pytest.raises(InputError, match="version 99"):
        load_classes(tmp_path)
    path.write_text(json.dumps(record | {"views": 3}), encoding="utf-8")
    with pytest.raises(InputError, match="figures"):
        load_classes(tmp_path)
    path.write_text("{", encoding="utf-8")
    with pytest.raises(InputError, match=r"star\.json"):
        load_classes(tmp_path)
    monkeypatch.setattr(store, "_MOST_BYTES", 0)
    with pytest.raises(InputError, match="larger than"):
        load_classes(tmp_path)


@pytest.mark.parametrize("name", ["", "../x", ".hidden", "a/b", "x" * 41])
def test_a_name_that_is_no_file_name_is_refused(name: str, shown: dict[str, Floats32], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no name for a class"):
        save_class(tmp_path, _class(name, shown["star"]))


def test_a_class_must_be_one_thing_and_a_new_one(shown: dict[str, Floats32]) -> None:
    with pytest.raises(InputError, match="2 different things"):
        admit(_class("both", np.concatenate([shown["ring"][:3], shown["cross"][:3]])), ())
    admit(_class("both", np.concatenate([shown["ring"][:3], shown["cross"][:3]])), (), faces=2)
    with pytest.raises(InputError, match="3 different things"):
        admit(_class("all sorts", np.concatenate([shown["ring"][:2], shown["star"][:1], shown["L"][:1]])), ())
    with pytest.raises(InputError, match="are the least"):
        admit(_class("few", shown["ring"][:2]), ())
    with pytest.raises(InputError, match="look like 'ring'"):
        admit(_class("again", shown["ring"][3:]), [_class("ring", shown["ring"][:4])])
    with pytest.raises(InputError, match="in mm, others in px"):
        admit(_class("star", shown["star"]), [_class("ring", shown["ring"], "mm")])


def test_what_lies_beside_the_part_is_left_out(shown: dict[str, Floats32]) -> None:
    values = np.concatenate([shown["gear"], shown["L"][:1]])
    new = TaughtClass("gear", "px", values, ("a", "b", "c", "d", "e", "f", "f"), np.zeros((7, SIDE, SIDE), np.uint8))
    admission = admit(new, ())
    assert len(admission.new.views) == 6
    assert admission.warnings == ("left out something unlike 'gear' in f",)


def test_the_digest_tells_sets_of_classes_apart(shown: dict[str, Floats32]) -> None:
    one, two = _class("star", shown["star"]), _class("star", shown["star"][:5])
    assert Taught((one,)).digest != Taught((two,)).digest
