"""`umf export`: the network in OpenVINO's own format, for other programs and languages."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def command(
    out: Annotated[Path, typer.Argument(help="File to write, such as umf_scene.xml; its .bin goes beside it.")],
    weights: Annotated[Path | None, typer.Option(help="Weights file, or umf_light; default: umf_scene.")] = None,
    super_features: Annotated[bool, typer.Option("--super-features", help="Include the super-features.")] = False,
) -> None:
    """Export a network to OpenVINO."""
    from rich.console import Console

    from umf_ros.core.errors import ConfigError
    from umf_ros.core.io import check_writable
    from umf_ros.embedding.embedder import FeatureRequest
    from umf_ros.embedding.runtimes import convert_umf, outputs_of, save_model
    from umf_ros.networks.config import locate_weights

    if out.suffix != ".xml":
        raise ConfigError(f"{out}: OpenVINO's files end in .xml")
    check_writable(out.parent)
    model = convert_umf(locate_weights(weights), outputs_of(FeatureRequest(supers=super_features)))
    save_model(model, out)
    megabytes = out.with_suffix(".bin").stat().st_size / 1e6
    sizes = f"{len(model.inputs)} inputs, {len(model.outputs)} outputs, {megabytes:.1f} MB of weights"
    Console().print(f"{out}: {sizes}", markup=False, soft_wrap=True)
