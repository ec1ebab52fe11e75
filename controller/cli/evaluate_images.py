"""`controller evaluate --images DIR`: a recipe beside what people have marked in photographs."""

from __future__ import annotations

import json
from pathlib import Path

from rich.table import Table

from controller.cli.output import stdout
from controller.insight import images_evaluation
from controller.vision.recipe import load_recipe


def evaluate_pictures(folder: Path, recipe: str, report: Path | None, as_json: bool) -> int:
    """Look at all annotated pictures of a folder, print the figures, write the report.

    Args:
        folder: With `annotations.json`, or with folders that have one.
        recipe: Name or file.
        report: Folder for `images.html` and `images.json`.
        as_json: Print JSON.
    """
    if report is not None:
        report.mkdir(parents=True, exist_ok=True)
    pictures = list(images_evaluation.evaluate_images(folder, load_recipe(recipe)))
    figures = images_evaluation.summary(folder, recipe, pictures)
    if report is not None:
        (report / "images.json").write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
        (report / "images.html").write_text(images_evaluation.page(figures, pictures), encoding="utf-8")
    if as_json:
        print(json.dumps(figures))
        return 0
    console = stdout()
    grid = Table(box=None, show_header=False, pad_edge=False)
    for row in images_evaluation.rows(figures):
        grid.add_row(*row)
    console.print(grid)
    seen = sorted({name for row in figures["confusion"].values() for name in row})
    matrix = Table("true \\ seen", *seen, box=None)
    for true, row in figures["confusion"].items():
        matrix.add_row(true, *(str(row.get(name, "")) for name in seen))
    console.print(matrix)
    for picture in images_evaluation.worst(pictures):
        if picture.errors:
            console.print(f"{picture.name}: {images_evaluation.mistakes(picture)}", soft_wrap=True)
    if report is not None:
        console.print(f"Report: {report / 'images.html'}")
    return 0
