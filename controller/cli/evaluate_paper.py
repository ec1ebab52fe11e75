"""`controller evaluate paper`: the paper's Table 1, by its method and by ours."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated, Any

import cv2
import typer
from rich.table import Table

from controller.backends import Level
from controller.cli.config import default_config
from controller.cli.output import stdout
from controller.config.cell import load_cell
from controller.errors import InputError
from controller.insight.paper_table import looks, table
from controller.vision.annotate import annotate


def evaluate_paper(
    frames: Annotated[int, typer.Option(min=1, max=1000, help="Pictures; 50 for a figure to publish.")] = 20,
    seed: Annotated[int, typer.Option(min=0, help="Seed of cameras, lenses, lamps and parts.")] = 0,
    level: Annotated[Level, typer.Option(help="How imperfect the painted pictures are.")] = Level.STATIC,
    report: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Write the table and one marked picture a mounting into DIR.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")] = False,
) -> None:
    """The paper's Table 1, by its method and by ours, on painted pictures of a lens that distorts.

    Example: controller evaluate paper --frames 50 --report paper-table

    Coordinates are the paper's: left-handed, from the platform's upper right corner.
    """
    config = load_cell(default_config())
    found = []
    for look in looks(config, frames, seed, level, lambda line: print(line, file=sys.stderr)):
        found.append(look)
        if len(found) % 10 == 0 or len(found) == frames:
            print(f"{len(found)} of {frames} pictures", file=sys.stderr)
    result = {"seed": seed, "level": str(level), **table(found)}
    if report is not None:
        try:
            report.mkdir(parents=True, exist_ok=True)
            (report / "paper.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
        except OSError as error:
            raise InputError(f"{report}: cannot be written ({error.strerror})", "choose another folder") from error
        for index, look in enumerate(found[::5]):
            cv2.imwrite(str(report / f"mounting-{index + 1}.png"), annotate(look.frame.image, look.detections))
    if as_json:
        print(json.dumps(result))
    else:
        _show(result)


def _show(result: dict[str, Any]) -> None:
    grid = Table(box=None, pad_edge=False)
    for heading in _HEADINGS:
        grid.add_column(heading, justify="left" if heading in ("shape", "method") else "right", no_wrap=True)
    for shape, row in result["rows"].items():
        printed = row["printed"]
        percent = (f"{value:.2f}" for value in printed["error_percent"])
        off = sum((d - a) ** 2 for d, a in zip(printed["detected_mm"], row["actual_mm"], strict=True)) ** 0.5
        seen = _pair(printed["detected_mm"])
        grid.add_row(shape, _pair(row["actual_mm"], 0), "paper, printed", "", seen, *percent, f"{off:.2f}")
        for method, title in _METHODS.items():
            mine = row[method]
            grid.add_row("", "", title, str(mine["found"]), _pair(mine["detected_mm"]), *_numbers(mine))
    mean = result["mean"]
    printed = mean["printed"]
    grid.add_section()
    percent = (f"{value:.3f}" for value in printed["error_percent"])
    turn = f"{printed['orientation_percent']} %"
    grid.add_row("mean", "", "paper, printed", "", "", *percent, f"{printed['error_mm']:.2f}", "", turn)
    for method, title in _METHODS.items():
        grid.add_row("", "", title, f"{mean[method]['found']}/{result['parts']}", "", *_numbers(mean[method]))
    stdout().print(grid)
    print(f"{result['frames']} pictures, level {result['level']}, seed {result['seed']}; detected: mean over them.")
    ours = mean["ours"]
    if ours["error_percent"] is not None and ours["orientation_deg"] is not None:
        good = max(ours["error_percent"]) <= MOST_PERCENT and ours["orientation_deg"] <= MOST_DEG
        limits = f"at most {MOST_PERCENT:g} % in X and in Y, {MOST_DEG:g} deg"
        print(f"Asked of ours: {limits}: {'met' if good else 'NOT MET'}.")


#: What is asked of our method: mean errors of place and direction.
MOST_PERCENT, MOST_DEG = 0.15, 0.3
_HEADINGS = ("shape", "actual, mm", "method", "found", "detected, mm", "X, %", "Y, %", "mm", "p95 mm", "turn, deg")
_METHODS = {"paper": "its method", "model": "its equations, our outlines", "ours": "ours"}


def _pair(point: list[float] | None, digits: int = 2) -> str:
    return "-" if point is None else f"({point[0]:.{digits}f}, {point[1]:.{digits}f})"


def _numbers(figures: dict[str, Any]) -> list[str]:
    values = [*(figures["error_percent"] or (None, None)), figures["error_mm"], figures["p95_mm"]]
    values.append(figures["orientation_deg"])
    return ["-" if value is None else f"{value:.2f}" for value in values]
