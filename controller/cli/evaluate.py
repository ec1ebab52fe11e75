"""`controller evaluate`: accuracy against truth, in simulation, on annotated pictures, and the paper's table."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from controller.backends import Level
from controller.cli.classes import ClassesFolder, with_classes
from controller.cli.config import default_config
from controller.cli.evaluate_images import evaluate_pictures
from controller.cli.evaluate_paper import evaluate_paper
from controller.cli.evaluate_sim import Job, evaluate_sim
from controller.config.cell import load_cell

group = typer.Typer(invoke_without_command=True)


@group.callback()
def evaluate(
    context: typer.Context,
    sim: Annotated[
        bool, typer.Option("--sim", help="Sort simulated tables and compare with the world's truth.")
    ] = False,
    images: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Look at the pictures of DIR and compare with its annotations.json."),
    ] = None,
    recipe: Annotated[str, typer.Option(metavar="precise|paper|FILE", help="How to look at pictures.")] = "precise",
    frames: Annotated[int, typer.Option(min=1, metavar="N", help="How many tables to sort, a seed each.")] = 10,
    parts: Annotated[int, typer.Option(min=1, max=200, help="Parts on each table.")] = 10,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the first table.")] = 0,
    seeds: Annotated[
        str | None, typer.Option(metavar="A-B", help="Seeds of the tables, both ends included; instead of the above.")
    ] = None,
    level: Annotated[Level, typer.Option(help="How imperfect the simulated world is.")] = Level.DYNAMIC,
    disturb: Annotated[
        str, typer.Option(metavar="KINDS", help="slip, knock, remove, add, move, swap, hand, or all.")
    ] = "",
    pick_proof: Annotated[
        bool, typer.Option("--pick-proof/--no-pick-proof", help="Off: believe every grasp; shows its worth.")
    ] = True,
    config: Annotated[Path | None, typer.Option(metavar="FILE", help="The cell's TOML file.")] = None,
    classes: ClassesFolder = None,
    arm: Annotated[str | None, typer.Option(metavar="NAME", help="Another arm than the configuration's.")] = None,
    jobs: Annotated[int | None, typer.Option(min=1, help="Processes; as many as processors unless given.")] = None,
    report: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Write JSON and an HTML page into DIR; tables done there are not done again."),
    ] = None,
    compare: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Compare with the evaluation.json of another evaluation.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="The figures as one JSON line on stdout.")] = False,
) -> int:
    """Measure accuracy against truth: a simulated world's, or that of annotated pictures.

    Examples: controller evaluate --sim --seeds 0-99 --report evaluation |
    controller evaluate --sim --no-pick-proof --compare evaluation/evaluation.json | controller evaluate --sim
    --disturb all | controller evaluate --images photos --report seen

    An evaluation that was cut off goes on where it was when the same command is given again.
    """
    if context.invoked_subcommand is not None:
        return 0
    if sim == (images is not None):
        raise typer.BadParameter("say what to evaluate: either --sim or --images DIR")
    if images is not None:
        return evaluate_pictures(images, recipe, report, as_json)
    cell = with_classes(load_cell(config or default_config(arm)), classes)
    if arm is not None:
        cell = cell.model_copy(update={"arm": cell.arm.model_copy(update={"description": arm})})
    head = {
        "mode": "sim",
        "arm": cell.arm.description,
        "arm_given": arm is not None,
        "config": None if config is None else str(config),
        "classes": None if classes is None else str(classes),
        "level": str(level),
        "parts_per_table": parts,
        "disturb": disturb,
        "pick_proof": pick_proof,
        "config_digest": cell.digest,
    }
    numbers = range(seed, seed + frames) if seeds is None else _seeds(seeds)
    tables = [Job(cell, parts, number, level, disturb, pick_proof) for number in numbers]
    processes = min(jobs or len(os.sched_getaffinity(0)), len(tables))
    return evaluate_sim(head, tables, processes, report, compare, as_json)


def _seeds(text: str) -> range:
    first, dash, last = text.partition("-")
    last = last if dash else first
    if not (first.isdecimal() and last.isdecimal() and int(first) <= int(last)):
        raise typer.BadParameter("give --seeds as A-B, for instance 0-99")
    return range(int(first), int(last) + 1)


def add_to(app: typer.Typer) -> None:
    """Add the commands to the program."""
    group.command("paper")(evaluate_paper)
    app.add_typer(group, name="evaluate")
