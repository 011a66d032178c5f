"""`umf compare` and `umf explain`: comparison of two views, and a picture of the decision."""

from __future__ import annotations

import csv
import json
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from umf_ros.commands import recordings as options
from umf_ros.core.errors import BagError, ConfigError, OutputError, UmfError, one_line, writing
from umf_ros.lab.commands.report import moment_of, recording_of

if TYPE_CHECKING:
    from rich.console import Console

    from umf_ros.lab.evaluation.comparison import Comparer, Pair, Row
    from umf_ros.lab.evaluation.place_views import PlaceView

Image = Annotated[Path | None, typer.Option(help="Image file; needs --calibration.", show_default=False)]
ViewName = Annotated[
    str | None, typer.Argument(help="Scan (.pcd, .ply, .npy, .bin), left image, or BAG@STAMP.", show_default=False)
]


def command(
    match: ViewName = None,
    query: ViewName = None,
    match_left: Image = None,
    match_right: Image = None,
    query_left: Image = None,
    query_right: Image = None,
    pairs: Annotated[Path | None, typer.Option("--list", help="CSV file of pairs; paths are relative to it.")] = None,
    out: Annotated[Path | None, typer.Option(help="CSV file for the verdicts on the list.")] = None,
    calibration: Annotated[Path | None, typer.Option(help="Calibration file, or name of a data set.")] = None,
    bin_columns: Annotated[
        int, typer.Option(min=0, max=64, help="Numbers per point of a .bin file; 0: 4, 5 or 3, by its data.")
    ] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print the verdict as JSON.")] = False,
    config: options.ConfigPath = None,
    changes: options.Changes = None,
    dataset: options.DatasetName = "auto",
    embedder: options.EmbedderName = None,
    weights: options.WeightsPath = None,
) -> None:
    """Decide whether two views show the same place, and estimate their relative pose.

    A view is a scan, an image (left, and right for its depth), or both; or a frame of a recording, BAG@STAMP.
    STAMP is in ns, or in seconds from the recording's start.
    Without --calibration a scan is in the body frame: x forward, y left, z up.
    """
    images = match_left, match_right, query_left, query_right
    if pairs is not None and (match is not None or any(images) or as_json or out is None):
        raise ConfigError("--list PAIRS.csv needs --out VERDICTS.csv, and neither MATCH, QUERY, images nor --json")
    if pairs is None:
        _check_named(match or match_left, query or query_left, out)
    if out is not None and out.exists():
        raise OutputError(f"{out} exists already: name another file with --out")

    from rich.console import Console

    from umf_ros.commands.console import WARNING
    from umf_ros.core.config import load_settings
    from umf_ros.detector import make_detector_embedder
    from umf_ros.lab.evaluation.comparison import Comparer, read_pairs
    from umf_ros.lab.evaluation.place_views import ViewReader

    if pairs is not None:
        asked = read_pairs(pairs)
    else:
        asked = [(_view(match, match_left, match_right), _view(query, query_left, query_right))]
    method = {"embedding__method": embedder, "embedding__weights": str(weights) if weights else None}
    source = options.parameters(config, changes)
    settings = load_settings(source, **method)
    errors = Console(stderr=True)
    views = ViewReader(
        make_detector_embedder(settings),
        calibration,
        bin_columns,
        source,
        dataset,
        warn=lambda text: errors.print(text, **WARNING),
        method=settings.embedding.method,
    )
    views.expect(view for pair in asked for view in pair)
    comparer = Comparer(views, settings.verification)
    if pairs is not None and out is not None:
        _compare_list(comparer, asked, pairs.parent, out, errors)
    else:
        _show(comparer.compare(*asked[0]), as_json)


def _check_named(match: str | Path | None, query: str | Path | None, out: Path | None) -> None:
    """Refuse invalid arguments before the slow imports."""
    if out is not None:
        raise ConfigError("--out VERDICTS.csv goes with --list PAIRS.csv; one pair is printed (--json)")
    for view, name in ((match, "MATCH"), (query, "QUERY")):
        if not view:
            raise ConfigError(f"say what to compare: {name} is missing (or --list PAIRS.csv --out VERDICTS.csv)")


def _view(name: str | None, left: Path | None, right: Path | None) -> PlaceView:
    from umf_ros.lab.evaluation.place_views import PlaceView
    from umf_ros.lab.scan_files import IMAGE_SUFFIXES

    scan, images = name or "", [str(path) if path else "" for path in (left, right)]
    if Path(scan).suffix.lower() in IMAGE_SUFFIXES:
        if images[0]:
            raise ConfigError(f"{scan} and {images[0]} are both the left image")
        scan, images[0] = "", scan
    return PlaceView(scan, *images)


def _compare_list(comparer: Comparer, asked: list[Pair], base: Path, out: Path, errors: Console) -> None:
    """Write one row per pair; a pair that cannot be compared is reported and does not stop the others."""
    from rich.progress import track

    from umf_ros.lab.evaluation.comparison import RESULT_COLUMNS, VIEW_COLUMNS, view_row

    accepted, failures = 0, []
    with writing(out), out.open("x", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, [*VIEW_COLUMNS, *RESULT_COLUMNS])
        table.writeheader()
        pairs = track(asked, "Comparing", console=errors, transient=True, disable=not errors.is_terminal)
        for number, pair in enumerate(pairs, 1):
            row, failure = _result(comparer, pair)
            accepted += row["accepted"]
            failures += [f"pair {number}: {failure}"] if failure else []
            table.writerow(row | view_row(*pair, base))
            file.flush()
    for line in failures:
        typer.echo(line, err=True)
    typer.echo(f"{out}: {len(asked)} pairs, {accepted} the same place, {len(failures)} could not be compared")
    if failures:
        raise typer.Exit(1)


def _result(comparer: Comparer, pair: Pair) -> tuple[Row, str]:
    """Return the row of a pair, and the reason if it could not be compared."""
    from umf_ros.lab.evaluation.comparison import result_row

    try:
        return comparer.compare(*pair), ""
    except UmfError as error:
        failure = str(error)
    except Exception as error:  # foreign data: one pair must not cost the others their results
        failure = f"{type(error).__name__}: {one_line(error)}"
    return result_row(failure), failure


def _show(row: Row, as_json: bool) -> None:
    from umf_ros.lab.evaluation.comparison import POSE, SIGMA

    if as_json:
        typer.echo(json.dumps(row, indent=2))
        return
    sure = "" if row["probability"] is None else f", probability {row['probability']:.3f}"
    if not row["accepted"]:
        typer.echo(f"not accepted as the same place: {row['reason']}{sure}")
    else:
        typer.echo(f"the same place{sure}")
        for title, names in (("match_T_query", POSE), ("sigma (m, rad)", SIGMA)):
            numbers = "  ".join(f"{name.removeprefix('sigma_')} {row[name]:.4f}" for name in names)
            typer.echo(f"  {title:15} {numbers}")
    typer.echo(f"  similarity {row['similarity']:.3f}, {row['milliseconds']:.0f} ms")


def explain(
    source: Annotated[Path, typer.Argument(metavar="RUN|BAG", help="A run folder, or a recording.")],
    query: Annotated[str, typer.Argument(help="The later moment: stamp in ns, or seconds from the start.")],
    match: Annotated[str, typer.Argument(help="The earlier moment, in the same units.")],
    out: Annotated[Path | None, typer.Option(help="Picture to write; default: a new explanation.png.")] = None,
    config: options.ConfigPath = None,
    changes: options.Changes = None,
    dataset: options.DatasetName = "auto",
    embedder: options.EmbedderName = None,
    weights: options.WeightsPath = None,
) -> None:
    """Draw both images with their matches, the aligned scans, and the numbers of the decision.

    A run folder stands for its recording, read with the parameters of the run.
    """
    moments = [moment_of(text) for text in (query, match)]
    options.check_files(source, config)

    from rich.console import Console

    from umf_ros.commands.console import waiting

    console = Console()
    with waiting(console, "Looking for the two moments"):
        import umf_ros.lab.evaluation.comparison as comparison
        from umf_ros.bags.frames import FrameReader
        from umf_ros.detector import make_detector_embedder, make_keyframe
        from umf_ros.lab.evaluation.place_views import nearest_frames
        from umf_ros.verification.measurement import MEASUREMENTS

        bag, config = _of_run(source, config) if (source / "summary.json").is_file() else (source, config)
        chosen = options.parameters(config, changes)
        recording, settings = options.open_recording(bag, chosen, dataset, embedder, weights)
        network, frames = make_detector_embedder(settings), []
        for one in nearest_frames(FrameReader(recording, settings), moments):
            if isinstance(one, BagError):
                raise one
            frames.append(one)
        query_keyframe, match_keyframe = (make_keyframe(frame, network) for frame in frames)
        explanation = comparison.explain(query_keyframe, match_keyframe, settings.verification)
        names = chain([Path("explanation.png")], (Path(f"explanation_{number}.png") for number in count(2)))
        picture = out or next(path for path in names if not path.exists())
        comparison.draw(explanation, frames[0].left, frames[1].left, picture)
    console.print(explanation.verdict, highlight=False)
    if explanation.best is not None:
        for name, value in explanation.best.measurements.items():
            console.print(f"  {name:22} {value:<10.4g} {MEASUREMENTS[name]}", highlight=False, soft_wrap=True)
    console.print(f"wrote {picture}", markup=False, highlight=False, soft_wrap=True)


def _of_run(folder: Path, config: Path | None) -> tuple[Path, Path]:
    """Return the recording and the parameter file of a run."""
    bag = recording_of(folder)
    if bag is None:
        raise UmfError(f"{folder}: its recording is unknown or was moved; name it in place of the folder")
    return bag, config or folder / "config.yaml"
