"""Objectives of other methods' networks: UMF's own loss, or batch-hard triplets [Komorowski 2021].

Inputs are prepared once (`prepared_views`), and the frozen stages of an image trunk with them: a step computes the
layers that learn alone, within minutes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
import torch.nn.functional as F
from sklearn.cluster import KMeans
from torch import Tensor

from umf_ros.baselines.netvlad import NetVlad
from umf_ros.baselines.place_network import PlaceNetwork
from umf_ros.baselines.place_networks import load_place_network, make_place_network
from umf_ros.lab.datasets.listed import open_source
from umf_ros.lab.datasets.sample import Rule, SampleSequence
from umf_ros.lab.evaluation.results import mean, score
from umf_ros.lab.evaluation.retrieval import place_recognition, rank
from umf_ros.lab.training.batches import PairSampler
from umf_ros.lab.training.losses import Bank, Relations, batch_hard_triplet, neighbourhood_components, relate
from umf_ros.lab.training.networks import DescriptorSettings, Precision, RunSettings, save_tensors
from umf_ros.lab.training.objective import Judgement, Objective, generator
from umf_ros.lab.training.prepared_views import PlaceBatch, PreparedViews
from umf_ros.networks.config import locate_weights
from umf_ros.networks.weights import load_weights

RULE = Rule(negative_m=20.0, negative_deg=40.0, between_passes=True)
"""A later pass looks for itself in an earlier one."""
TRUNK_FROM = "umf_scene"
"""Shipped weights that hold the published trunk."""
IMAGES = 120
"""For the clusters; each has 140 local features."""
WHITENED = 700
"""Images that the whitening is fitted to."""


class DescriptorObjective(Objective):
    """Trains one of `umf_ros.baselines.place_networks`.

    Args:
        network: trained in place.
        settings: of the run.
    """

    settings_type: ClassVar[type[RunSettings]] = DescriptorSettings
    network: PlaceNetwork
    state: ClassVar[tuple[str, ...]] = (*Objective.state, "untrained")

    def __init__(self, network: PlaceNetwork, settings: DescriptorSettings) -> None:
        super().__init__(network, settings)
        self._validation = open_source(Path(settings.validation)).refresh if settings.validation else list
        self._sequences: Sequence[SampleSequence] = []
        self._sampler: PairSampler | None = None
        kept = Path(settings.views) if settings.views else None
        self._views = PreparedViews(network.reads, network.trunk, settings.variants, settings.seed, kept)
        self.untrained: dict[str, float] = {}

    @classmethod
    def make_network(cls, settings: DescriptorSettings) -> PlaceNetwork:
        """A fresh network on the published trunk, or one that starts from weights."""
        if settings.start:
            return load_place_network(settings.method, Path(settings.start))
        network = make_place_network(settings.method)
        if network.trunk is not None:
            scene = load_weights(locate_weights(Path(TRUNK_FROM))).scene
            assert scene is not None
            network.trunk.network.load_state_dict(scene.trunk.state_dict())
        return network

    def save(self, path: Path, card: dict[str, Any], precision: Precision) -> None:
        """Write the weights and their card."""
        save_tensors(self.network, path, card, {"method": self._settings.method}, precision)

    def batch_maker(self, sequences: Sequence[SampleSequence], rank: int) -> Callable[[int], PlaceBatch]:
        """Return the function that makes the batch of a step: pairs of views.

        Raises:
            ConfigError: no place of these sequences is visited twice.
        """
        if self._sampler is None or len(self._sequences) != len(sequences):  # to find all revisits takes its time
            self._sampler = PairSampler(sequences, RULE, whole=self._settings.loss == "neighbourhood")
        sampler, self._sequences = self._sampler, sequences
        if not self.untrained:
            self.begin()
            self.settle()
            self.untrained = self.recalls()
        pairs, seed = self.batch_size // 2, self._settings.seed

        def make(step: int) -> PlaceBatch:
            rng = generator(seed, step, rank)
            drawn = sampler.draw(pairs, rng)
            draws = [anchor for anchor, _ in drawn] + [positive for _, positive in drawn]
            return self._views.batch(sequences, draws, rng)

        return make

    def begin(self) -> None:
        """Prepare a fresh network, before its first step."""

    def settle(self) -> None:
        """Fit what is not learned, before the network is judged."""

    def forward(self, batch: PlaceBatch) -> dict[str, Tensor]:
        """The losses of the descriptor and of the modalities that have one of their own."""
        found = self.network(batch.input)
        relations = relate(batch.places, Bank(0, 1).places, RULE, found["descriptor"].device)
        image, cloud = self.network.weight_image, self.network.weight_cloud
        weights = {"descriptor": 1 - image - cloud, "image": image, "cloud": cloud}
        losses, active = {}, found["descriptor"].new_zeros(())
        for name, weight in weights.items():
            if not weight:
                continue
            unit = F.normalize(found[name].float(), dim=1)
            loss, share = self._loss(unit @ unit.T, relations)
            losses[name], active = loss, share if name == "descriptor" else active
        total = sum((weights[name] * loss for name, loss in losses.items()), start=active.new_zeros(()))
        return losses | {"total": total, "active": active}

    def _loss(self, similarity: Tensor, relations: Relations) -> tuple[Tensor, Tensor]:
        """The loss, and the share of rows that have something to learn."""
        positive, negative = relations.positive, relations.negative
        if self._settings.loss == "triplet":
            return batch_hard_triplet(similarity, positive, negative, self._settings.margin)
        best = similarity.masked_fill(~positive, -1.0).amax(1)
        worst = similarity.masked_fill(~negative, -1.0).amax(1)
        return neighbourhood_components(similarity, positive, negative), (best < worst).float().mean()

    def judge(self, step: int) -> Judgement:
        """Recall on the validation worlds."""
        self.settle()
        found = self.recalls()
        better = not found or self.improves(found["recall1"])
        return Judgement(
            better, self.exhausted, found | {f"{name}_untrained": value for name, value in self.untrained.items()}
        )

    def card(self) -> dict[str, Any]:
        """How good it was before and is now."""
        return {"untrained": self.untrained, "validation_recall1": round(self.best, 4)}

    def recalls(self) -> dict[str, float]:
        """Mean recall at one and five of later passes of the validation worlds, asked for the first."""
        worlds = self._validation()
        results = []
        for world in worlds:
            task = place_recognition(np.asarray(world.world_T_body), np.asarray(world.pass_index))
            found = self.describe(world)
            results.append(score(task, rank(found[task.queries] @ found[task.references].T)))
        if not results:
            return {}
        return {name: mean([getattr(one, name) for one in results]) for name in ("recall1", "recall5")}

    def describe(self, world: SampleSequence) -> np.ndarray:
        """Unit descriptors (N, D) of all samples of a world, as they are in use."""
        self.network.eval()
        device = next(self.network.parameters()).device
        parts = []
        for start in range(0, len(world), 32):
            seen = self._views.plain(world, range(start, min(start + 32, len(world)))).to(device)
            with torch.inference_mode():
                parts.append(F.normalize(self.network(seen)["descriptor"].float(), dim=1).cpu())
        return torch.cat(parts).numpy()


class NetVladObjective(DescriptorObjective):
    """Its centres begin as clusters of the trunk's own features."""

    network: NetVlad
    _whitened: Tensor | None = None

    def begin(self) -> None:
        """Find the clusters, unless the network starts from weights."""
        if self._settings.start:
            return
        with torch.no_grad():
            local = self.network.local(self._some(IMAGES)).flatten(2).transpose(1, 2).flatten(0, 1)
        count = len(self.network.centres)
        found = KMeans(count, n_init=1, max_iter=50, random_state=self._settings.seed).fit(local.numpy())
        self.network.begin(torch.from_numpy(found.cluster_centers_).float(), local)

    def settle(self) -> None:
        """Fit the whitening to training images as they are described now."""
        if self._whitened is None:
            self._whitened = self._some(WHITENED).half()
        self.network.eval()
        device = self.network.mean.device
        with torch.no_grad():
            parts = [self.network.vlad(part.float().to(device)) for part in self._whitened.split(64)]
        self.network.whiten(torch.cat(parts))

    def _some(self, count: int) -> Tensor:
        """Early maps (count, 80, 10, 14) of training images as they are."""
        every = [(world, row) for world in self._sequences for row in range(len(world))]
        chosen = np.random.default_rng(self._settings.seed).permutation(len(every))[:count]
        return torch.cat([self._views.plain(every[k][0], [every[k][1]]).maps for k in chosen])
