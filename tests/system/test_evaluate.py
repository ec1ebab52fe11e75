"""Evaluation and film, as their user starts them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tests.system.conftest import Controller


def one_line(stdout: str) -> dict[str, Any]:
    lines = stdout.splitlines()
    assert len(lines) == 1, stdout
    loaded: dict[str, Any] = json.loads(lines[0])
    return loaded


def test_tables_are_sorted_over_processes_judged_and_compared(controller: Controller, tmp_path: Path) -> None:
    old = {"level": "static", "arm": "reactorx_150", "parts_per_table": 2, "seeds": "3-4"}
    (tmp_path / "old.json").write_text(json.dumps({"summary": old, "runs": []}))
    asked = ("evaluate", "--sim", "--seeds", "3-4", "--parts", 2, "--level", "ideal", "--jobs", 2)
    done = controller(*asked, "--report", "first", "--compare", "old.json", "--json")
    assert done.returncode == 0, done.stderr
    figures = one_line(done.stdout)
    assert (figures["runs"], figures["parts"], figures["correct"], figures["silent"]) == (2, 4, 4, 0)
    assert figures["sorted"] == figures["correct"] + figures["missorted"] + figures["silent"]
    kept = json.loads((tmp_path / "first" / "evaluation.json").read_text())
    assert kept["summary"] == figures
    assert [run["seed"] for run in kept["runs"]] == [3, 4]
    lanes = {span["lane"] for span in kept["runs"][0]["spans"]}
    assert lanes == {"state", "camera", "computing", "arm", "gripper"}
    page = (tmp_path / "first" / "evaluation.html").read_text()
    assert page.count("<svg") >= 4
    assert "http" not in page
    assert "<tr><td>level</td><td>static</td><td>ideal</td></tr>" in page
    assert "simulated for one of processor time" in page


def test_a_film_does_not_change_the_run(controller: Controller, calibration: Path, tmp_path: Path) -> None:
    asked = ("run", "--sim", "--parts", 1, "--level", "static", "--seed", 7, "--json", "--calibration", calibration)
    filmed = controller(*asked, "--video", "film.mp4", "--out", "a")
    plain = controller(*asked, "--out", "b")
    assert filmed.returncode == 0, filmed.stderr
    first, second = one_line(filmed.stdout), one_line(plain.stdout)
    for figures in (first, second):
        del figures["wall_s"], figures["out"]
    assert first == second
    video = cv2.VideoCapture(str(tmp_path / "film.mp4"))
    try:
        frames = video.get(cv2.CAP_PROP_FRAME_COUNT)
        assert abs(frames / video.get(cv2.CAP_PROP_FPS) - first["sim_s"]) < 0.5
        ok, last = video.read()
        assert ok
        assert last.shape == (388, 1280, 3)
    finally:
        video.release()


def test_annotated_pictures_are_compared(controller: Controller, tmp_path: Path) -> None:
    image = np.full((240, 320, 3), 200, np.uint8)
    cv2.circle(image, (160, 120), 40, (40, 40, 160), -1)
    cv2.imwrite(str(tmp_path / "a.png"), image)
    circle = {"class": "circle", "centre_px": [160, 120], "bbox_px": [120, 80, 81, 81]}
    entry = {"file": "a.png", "size": [320, 240], "objects": [circle]}
    (tmp_path / "annotations.json").write_text(json.dumps({"images": [entry]}))
    done = controller("evaluate", "--images", tmp_path, "--report", "seen", "--json")
    assert done.returncode == 0, done.stderr
    assert one_line(done.stdout)["right"] == 1
    assert "data:image/jpeg" in (tmp_path / "seen" / "images.html").read_text()


def test_usage(controller: Controller, tmp_path: Path) -> None:
    assert controller("evaluate").returncode == 2
    assert controller("evaluate", "--sim", "--seeds", "9-3").returncode == 2
    assert controller("evaluate", "--sim", "--images", tmp_path).returncode == 2
    assert controller("evaluate", "--sim", "--compare", "none.json").returncode == 1
    assert controller("run", "--video", "a.mp4", "--replay", tmp_path).returncode == 2
    done = controller("evaluate", "--images", tmp_path)
    assert done.returncode == 1
    assert "annotations.json" in done.stderr
