"""`umf export`: a network as an OpenVINO model, for the embedder or for other programs and languages."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer


def command(
    out: Annotated[
        Path,
        typer.Argument(
            help="File to write: WEIGHTS.openvino beside the weights for the embedder; or .xml, OpenVINO's own format, "
            "with its .bin beside it."
        ),
    ],
    weights: Annotated[
        Path | None, typer.Option(help="Weights of UMF, or models/xfeat.safetensors; default: umf_scene.")
    ] = None,
    super_features: Annotated[
        bool, typer.Option("--super-features", help="Include the super-features in an .xml; .openvino has them.")
    ] = False,
    precision: Annotated[
        Literal["float32", "int8"],
        typer.Option(help="Precision of the convolutions; int8 takes less than half of the time."),
    ] = "float32",
    calibration: Annotated[
        Path, typer.Option(help="For int8: folder of rendered training worlds; missing ones are rendered.")
    ] = Path("runs/calibration"),
) -> None:
    """Export a network to OpenVINO.

    The embedder uses the model beside its weights, and torch without one.
    """
    from rich.console import Console

    from umf_ros.core.errors import ConfigError, WeightsError
    from umf_ros.core.io import check_writable
    from umf_ros.embedding import FeatureRequest
    from umf_ros.embedding.runtimes import MODEL_SUFFIX, outputs_of
    from umf_ros.networks.config import locate_weights

    if out.suffix not in (".xml", MODEL_SUFFIX):
        raise ConfigError(f"{out}: OpenVINO's files end in .xml, those of the embedder in {MODEL_SUFFIX}")
    check_writable(out.parent)
    located = locate_weights(weights)
    if not located.is_file():
        raise WeightsError(f"weights {located} do not exist")
    progress = Console(stderr=True)

    from umf_ros.lab.fit.quantisation import export_model, save_model

    def report(text: str) -> None:
        progress.print(text, markup=False, soft_wrap=True)

    outputs = outputs_of(FeatureRequest(supers=super_features or out.suffix == MODEL_SUFFIX))
    model = export_model(located, precision, calibration, report, outputs)
    save_model(model, out)
    weighed = out.with_suffix(".bin") if out.suffix == ".xml" else out
    sizes = (
        f"{len(model.inputs)} inputs, {len(model.outputs)} outputs, {weighed.stat().st_size / 1e6:.1f} MB of weights"
    )
    Console().print(f"{out}: {sizes}", markup=False, soft_wrap=True)
