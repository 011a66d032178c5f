"""`umf explain`: one picture of why two places of a recording are, or are not, the same."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from umf_ros.commands.recordings import BagPath, ConfigPath, DatasetName, EmbedderName, WeightsPath, open_recording
from umf_ros.core.errors import BagError

if TYPE_CHECKING:
    from umf_ros.lab.evaluation.comparison import Moment

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
    from umf_ros.detector import make_detector_embedder, make_keyframe
    from umf_ros.lab.evaluation.comparison import draw, explain, nearest_frames

    console = Console()
    moments = [_moment(text) for text in (query, match)]
    recording, settings = open_recording(bag, config, dataset, embedder, weights)
    network = make_detector_embedder(settings)
    with console.status("looking for the two moments"):
        found = nearest_frames(FrameReader(recording, settings), moments)
    frames = []
    for one in found:
        if isinstance(one, BagError):
            raise one
        frames.append(one)
    query_keyframe, match_keyframe = (make_keyframe(frame, network) for frame in frames)
    explanation = explain(query_keyframe, match_keyframe, settings.verification)
    draw(explanation, frames[0].left, frames[1].left, out)
    console.print(explanation.verdict, highlight=False)
    if explanation.best is not None:
        for name, value in explanation.best.measurements.items():
            console.print(f"  {name:22} {value:.4g}", highlight=False)
    console.print(f"wrote {out}", markup=False, highlight=False, soft_wrap=True)


def _moment(text: str) -> Moment:
    from umf_ros.lab.evaluation.comparison import parse_moment

    try:
        return parse_moment(text)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from None
