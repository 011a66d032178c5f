"""`umf explain`: one picture of why two places of a recording are, or are not, the same."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from umf_ros.commands.recordings import BagPath, ConfigPath, DatasetName, EmbedderName, WeightsPath, open_recording

if TYPE_CHECKING:
    from collections.abc import Iterable

    from umf_ros.frames import Frame

Optional = typer.Option


def command(
    bag: BagPath,
    query: Annotated[str, typer.Argument(help="The later moment: stamp in ns, or seconds from the start.")],
    match: Annotated[str, typer.Argument(help="The earlier moment, likewise.")],
    out: Annotated[Path, Optional(help="Picture to write.")] = Path("explanation.png"),
    config: ConfigPath = None,
    dataset: DatasetName = "auto",
    embedder: EmbedderName = None,
    weights: WeightsPath = None,
) -> None:
    """Show both images with their matching features, both scans aligned, and the decision's numbers."""
    from rich.console import Console

    from umf_ros.bags.frames import FrameReader
    from umf_ros.lab.evaluation.explanation import draw, explain
    from umf_ros.loop_detector import make_detector_embedder, make_keyframe

    console = Console()
    moments = [_moment(text) for text in (query, match)]
    recording, settings = open_recording(bag, config, dataset, embedder, weights)
    network = make_detector_embedder(settings)
    with console.status("looking for the two moments"):
        frames = _nearest(FrameReader(recording, settings), moments)
    query_keyframe, match_keyframe = (make_keyframe(frame, network) for frame in frames)
    explanation = explain(query_keyframe, match_keyframe, settings.verification)
    draw(explanation, frames[0].left, frames[1].left, out)
    console.print(explanation.verdict, highlight=False)
    if explanation.best is not None:
        for name, value in explanation.best.measurement.numbers.items():
            console.print(f"  {name:22} {value:.4g}", highlight=False)
    console.print(f"wrote {out}", markup=False, highlight=False, soft_wrap=True)


def _moment(text: str) -> int | float:
    """Nanoseconds since the epoch (16 digits or more), or seconds from the start of the recording."""
    if text.isdigit() and len(text) >= 16:
        return int(text)
    try:
        value = float(text)
    except ValueError:
        raise typer.BadParameter(f"{text!r} is neither a stamp in ns nor seconds from the start") from None
    if not value >= 0:
        raise typer.BadParameter(f"{text!r} is before the start")
    return value


def _nearest(frames: Iterable[Frame], moments: list[int | float]) -> list[Frame]:
    """The frame nearest to each moment.

    Raises:
        BagError: the recording has no frame, or none within a second of a moment.
    """
    from umf_ros.errors import BagError

    best: list[Frame | None] = [None] * len(moments)
    wanted: list[int] = []
    for frame in frames:
        if not wanted:
            wanted = [one if isinstance(one, int) else frame.stamp_ns + round(1e9 * one) for one in moments]
        for position, stamp in enumerate(wanted):
            held = best[position]
            if held is None or abs(frame.stamp_ns - stamp) < abs(held.stamp_ns - stamp):
                best[position] = frame
        if frame.stamp_ns > max(wanted) + 10**9:
            break
    found = [frame for frame in best if frame is not None]
    if len(found) < len(moments):
        raise BagError("the recording has no frame with an image or a scan")
    for frame, stamp, moment in zip(found, wanted, moments, strict=True):
        if abs(frame.stamp_ns - stamp) > 10**9:
            raise BagError(f"no frame within a second of {moment}; the nearest is at {frame.stamp_ns} ns")
    return found
