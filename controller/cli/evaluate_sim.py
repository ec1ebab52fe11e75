"""`controller evaluate --sim`: many tables sorted in simulation, over all processors, judged by the world's truth."""

from __future__ import annotations

import gc
import json
import multiprocessing
import signal
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from time import process_time
from typing import Any

import cv2
from rich.table import Table

from controller import __version__
from controller.backends import Level, Mode, simulated_cell
from controller.cli.output import stderr, stdout
from controller.config.cell import CellConfig
from controller.errors import InputError, SorterError
from controller.insight import comparison, evaluation_report
from controller.insight.comparison import Evaluation
from controller.insight.evaluation import summary
from controller.insight.trial import Record, Trial
from controller.service.session import RunOptions, Session


@dataclass(frozen=True, slots=True)
class Job:
    """One table to sort; goes to a process of its own.

    Attributes:
        config: The cell.
        parts: On the table.
        seed, level: Of the simulated world.
        disturb: What disturbs it, as for `controller run --disturb`.
        pick_proof: Whether grasps are proved.
    """

    config: CellConfig
    parts: int
    seed: int
    level: Level
    disturb: str = ""
    pick_proof: bool = True


def sort_one(job: Job) -> Record:
    """Sort one table and write down all about it; what went wrong is part of the record, not an exception."""
    # The cell of the table before is a ring of 50 MB and more, which Python by itself looks for once in ten tables.
    gc.collect()
    trial = Trial(job.config)
    with tempfile.TemporaryDirectory(prefix="evaluate-") as folder:
        out = Path(folder) / "run"
        options = RunOptions(
            Mode.SIM,
            job.config,
            out=out,
            parts=job.parts,
            seed=job.seed,
            level=job.level,
            disturb=job.disturb,
            pick_proof=job.pick_proof,
            watch=trial.watch,
        )
        problem = {}
        began = process_time()
        try:
            figures = Session(options).run()
        except Exception as error:
            # A defect in one run must neither hide the others' figures nor its own seed.
            named = isinstance(error, SorterError)
            problem = {"error": str(error) if named else f"{type(error).__name__}: {error}"}
            report = out / "report.json"
            figures = json.loads(report.read_text(encoding="utf-8")) if report.is_file() else {}
    if not figures:
        return {"seed": job.seed, **problem}
    return {"seed": job.seed, "cpu_s": round(process_time() - began, 3), **problem, **trial.record(figures)}


def evaluate_sim(
    head: Mapping[str, Any],
    jobs: Sequence[Job],
    processes: int,
    report: Path | None,
    compare: Path | None,
    as_json: bool,
) -> int:
    """Run the jobs, print the figures, write the report; 1 when a run broke off.

    Args:
        head: What is run, for the figures.
        jobs: The tables.
        processes: How many at a time.
        report: Folder for `evaluation.html` and `evaluation.json`.
        compare: An `evaluation.json` of before.
        as_json: Print JSON.
    """
    before = _read_evaluation(compare) if compare is not None else None
    simulated_cell()  # once, before every table fails for the same reason
    diary = None if report is None else Diary(report, head)
    records = [] if diary is None else diary.done([job.seed for job in jobs])
    done = {record["seed"] for record in records}
    console = stderr()
    if done:
        console.print(f"{len(done)} tables are done already, in {report}", highlight=False)
    interrupted = False
    handler = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        for record in sorted_tables([job for job in jobs if job.seed not in done], processes):
            records.append(record)
            if diary is not None:
                diary.add(record)
            console.print(
                f"{len(records):4d} of {len(jobs)}  {_line(record)}", highlight=False, markup=False, soft_wrap=True
            )
    except (KeyboardInterrupt, BrokenProcessPool):
        interrupted = True
        console.print("interrupted: what is done is reported; the same command goes on from here", highlight=False)
    finally:
        signal.signal(signal.SIGTERM, handler)
    records.sort(key=lambda record: int(record["seed"]))
    figures = summary({**head, "seeds": span([record["seed"] for record in records])}, records)
    config = jobs[0].config
    evaluation = Evaluation(figures, config.model_dump(mode="json"), records)
    if report is not None:
        text = json.dumps({"summary": figures, "configuration": evaluation.configuration, "runs": records})
        (report / "evaluation.json").write_text(text + "\n", encoding="utf-8")
        page = evaluation_report.page(evaluation, config, before, str(compare))
        (report / "evaluation.html").write_text(page, encoding="utf-8")
    if as_json:
        print(json.dumps(figures))
    else:
        _print(evaluation, before, report)
    return 130 if interrupted else 1 if figures["broken_runs"] else 0


class Diary:
    """The records of an evaluation as they are made, so that one that was cut off can go on.

    Args:
        folder: Where it is kept.
        head: What is run: records of anything else are not taken over.
    """

    def __init__(self, folder: Path, head: Mapping[str, Any]) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._path = folder / "runs.jsonl"
        self._head = json.loads(json.dumps({**head, "version": __version__}))

    def done(self, seeds: Sequence[int]) -> list[Record]:
        """Records of these seeds that are there already; what belongs to another evaluation is thrown away."""
        lines = self._path.read_text(encoding="utf-8").splitlines() if self._path.is_file() else []
        if not lines or _read(lines[0]) != self._head:
            self._path.write_text(json.dumps(self._head) + "\n", encoding="utf-8")
            return []
        # The last line may have been cut off with the process that wrote it.
        found = {record["seed"]: record for record in map(_read, lines[1:]) if record is not None}
        kept = {seed: record for seed, record in found.items() if "error" not in record}
        text = [json.dumps(line) for line in (self._head, *kept.values())]
        self._path.write_text("\n".join(text) + "\n", encoding="utf-8")
        return [kept[seed] for seed in seeds if seed in kept]

    def add(self, record: Record) -> None:
        """Keep a record."""
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(record) + "\n")


def _read(line: str) -> Record | None:
    try:
        found: Record = json.loads(line)
    except ValueError:
        return None
    return found


def span(seeds: Sequence[int]) -> str:
    """Sorted seeds in words: `0-99`, or one by one where some are missing."""
    if seeds and len(seeds) == seeds[-1] - seeds[0] + 1:
        return f"{seeds[0]}-{seeds[-1]}"
    return " ".join(map(str, seeds))


def sorted_tables(jobs: Sequence[Job], processes: int) -> Iterator[Record]:
    """Records as they are done."""
    if processes == 1:
        yield from map(sort_one, jobs)
        return
    # Fresh processes: a forked one would inherit the threads' locks of this one.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, context, initializer=cv2.setNumThreads, initargs=(1,)) as pool:
        waiting = [pool.submit(sort_one, job) for job in jobs]
        try:
            for done in as_completed(waiting):
                yield done.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _read_evaluation(path: Path) -> Evaluation:
    remedy = "name an evaluation.json of --report DIR"
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        evaluation = Evaluation(found["summary"], found.get("configuration", {}), found["runs"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path} is no evaluation ({error})", remedy) from error
    kinds = (evaluation.figures, dict), (evaluation.configuration, dict), (evaluation.records, list)
    if not all(isinstance(part, kind) for part, kind in kinds):
        raise InputError(f"{path} is no evaluation", remedy)
    return evaluation


def _line(record: Record) -> str:
    figures = record.get("figures", {})
    told = ", ".join(
        f"{figures[key]} {key}"
        for key in ("correct", "missorted", "silent", "rejected", "left", "dropped", "indeterminate", "collisions")
        if figures.get(key)
    )
    problem = f"  broke off: {record['error']}" if "error" in record else ""
    return f"seed {record['seed']}: {told}{problem}"


def _print(evaluation: Evaluation, before: Evaluation | None, report: Path | None) -> None:
    console = stdout()
    console.print(_table(evaluation_report.rows(evaluation.figures)))
    if before is not None:
        changed = comparison.settings(evaluation, before)
        console.print(_table(changed, comparison.SETTINGS_HEADING) if changed else "\nBoth were set alike.")
        differences = [difference.row() for difference in comparison.differences(evaluation, before)]
        console.print(_table(differences, comparison.DIFFERENCES_HEADING))
        console.print(comparison.HOW_JUDGED, highlight=False)
    for run in evaluation.figures["broken_runs"]:
        print(f"seed {run['seed']} broke off: {run['error']}", file=sys.stderr)
    if report is not None:
        console.print(f"Report: {report / 'evaluation.html'}")


def _table(rows: Sequence[Sequence[str]], heading: Sequence[str] = ()) -> Table:
    grid = Table(*heading, box=None, pad_edge=False, show_header=bool(heading))
    for row in rows:
        grid.add_row(*row)
    return grid
