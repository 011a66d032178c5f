"""`umf s3li`: evaluation on a download of S3LI."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from umf_ros.core.errors import ConfigError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import TaskID

    from umf_ros.lab.datasets.s3li_folder import S3liFolder
    from umf_ros.lab.evaluation.s3li_run import Record, S3liRun


def command(
    folder: Annotated[Path, typer.Argument(help="Download of S3LI: Etna, Vulcano, or both.")],
    out: Annotated[Path, typer.Option(help="Folder of runs, tables and report.")] = Path("results/s3li"),
    figures: Annotated[Path | None, typer.Option("--json", help="Also write the figures to this file.")] = None,
    sequences: Annotated[str, typer.Option(help="Comma-separated names; default: all that are found.")] = "",
    resume: Annotated[bool, typer.Option("--resume", help="Keep the finished sequences in --out.")] = False,
) -> None:
    """Replay all sequences of S3LI in a folder, evaluate them by GNSS, and print three protocols.

    UMF's recall@1, MPRF's precision@1 with the toolkit's pairs, and precision and recall of published closures with the
    trajectory errors before and after. If a sequence fails, the others continue, and the exit status is 1.
    """
    import json

    from rich.console import Console

    from umf_ros.core.io import check_writable, write_atomically
    from umf_ros.lab.datasets.s3li_folder import find_s3li
    from umf_ros.lab.evaluation.results import EvaluationReport, print_table
    from umf_ros.lab.evaluation.s3li_run import S3liRun, latex, pooled, protocol_table, sequence_table

    console = Console()
    download = _chosen(find_s3li(folder), sequences)
    check_writable(out)
    for line in [one for sequence in download.sequences for one in sequence.missing]:
        console.print(line, style="yellow", markup=False, highlight=False, soft_wrap=True)
    if download.absent and not sequences:
        console.print(f"not there: {', '.join(download.absent)}", markup=False, highlight=False, soft_wrap=True)
    run = S3liRun(download, out, resume)
    notes = _run(run, download, console)
    tables = {"S3LI by protocol": protocol_table(run.records), "S3LI by sequence": sequence_table(run.records)}
    for title, table in tables.items():
        print_table(console, title, table)
    notes += run.faults + _told(run.records)
    for note in notes:
        console.print(note, style="yellow", markup=False, highlight=False, soft_wrap=True)
    total = pooled(list(run.records.values()))
    found = {"sequences": run.records, "all": total, "notes": notes}
    EvaluationReport("S3LI", notes, total, tables).write(out)
    write_atomically(out / "s3li.tex", "\n".join(latex(table) for table in tables.values()))
    for path in filter(None, (out / "s3li.json", figures)):
        write_atomically(path, json.dumps(found, indent=2) + "\n")
    console.print(f"{out}: evaluation.md, s3li.tex, s3li.json", markup=False, highlight=False, soft_wrap=True)
    if run.faults or any(one["status"].startswith("failed") for one in run.records.values()):
        raise typer.Exit(1)


def _chosen(download: S3liFolder, sequences: str) -> S3liFolder:
    from dataclasses import replace

    names = [name for name in sequences.split(",") if name]
    known = {one.name: one for one in download.sequences}
    unknown = [name for name in names if name not in known]
    if unknown:
        raise ConfigError(f"{download.root} holds nothing of {unknown[0]!r}; there is {', '.join(known)}")
    return replace(download, sequences=[known[name] for name in names]) if names else download


def _told(records: dict[str, Record]) -> list[str]:
    """Faults and warnings, each with the sequences it is about."""
    about: dict[str, list[str]] = {}
    for name, one in records.items():
        failed = [one["status"]] if one["status"].startswith("failed") else []
        for text in dict.fromkeys(failed + one["warnings"]):
            about.setdefault(text, []).append(name)
    return [f"{', '.join(names)}: {text}" for text, names in about.items()]


def _run(run: S3liRun, download: S3liFolder, console: Console) -> list[str]:
    """Replay and retrieve with a bar over all sequences; returns lines about what was left out."""
    from umf_ros.lab.commands.simulate import counted_progress

    left_out: list[str] = []
    with counted_progress(console) as progress:
        bar = progress.add_task("replaying", total=len(download.sequences))
        for number, one in enumerate(download.sequences):
            progress.update(bar, description=one.name)
            run.replay(one, lambda done, number=number: progress.update(bar, completed=number + done))  # type: ignore[misc]
            progress.update(bar, completed=number + 1)
            if not console.is_terminal:
                status = run.records[one.name]["status"]
                console.print(f"{number + 1} of {len(download.sequences)}: {one.name}: {status}", markup=False)
        for dataset in dict.fromkeys(one.dataset for one in download.sequences):
            task = progress.add_task(f"retrieving {dataset}", total=1.0)

            def show(name: str, done: float, task: TaskID = task) -> None:
                progress.update(task, description=name, completed=done)

            left_out += run.retrieve(dataset, show)
    return left_out
