"""The networks of other methods: their parts, missing modalities, and their weights on disk."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_worlds import some_scan

from umf_ros.baselines.netvlad import NetVlad
from umf_ros.baselines.place_network import (
    EARLY,
    VOXELS,
    PlaceInput,
    PreparedView,
    count_parameters,
    some_points,
    stack,
)
from umf_ros.baselines.place_networks import NETWORKS, load_place_network, locate_place_weights, make_place_network
from umf_ros.baselines.pointnet2 import ball_query, farthest_points
from umf_ros.core.errors import ConfigError, WeightsError
from umf_ros.embedding.inputs import voxelise
from umf_ros.lab.training.networks import save_tensors


def some_batch(count: int = 3) -> PlaceInput:
    torch.manual_seed(0)
    views = []
    for seed in range(count):
        points = some_scan(seed)
        kept = some_points(points, np.random.default_rng(seed))
        views.append(PreparedView(np.ones((160, 224), np.float32), voxelise(points, None, 1, VOXELS), kept))
    return stack(views, torch.randn(count, EARLY, 10, 14))


@pytest.mark.parametrize("method", NETWORKS)
def test_descriptors_do_not_depend_on_the_rest_of_the_batch(method: str) -> None:
    torch.manual_seed(1)
    network, batch = make_place_network(method).eval(), some_batch()
    with torch.no_grad():
        whole = network(batch)["descriptor"]
        alone = network(PlaceInput(*(part[1:2] for part in batch)))["descriptor"]
    assert whole.shape == (3, network.length)
    torch.testing.assert_close(whole[1:2], alone, rtol=1e-3, atol=1e-4)
    assert (whole[0] - whole[1]).abs().max() > 1e-4


@pytest.mark.parametrize(
    ("method", "published", "share"), [("pointnet2", 671_392, 0.05), ("minkloc_lidar", 761_392, 0.06)]
)
def test_networks_of_scans_have_their_published_size(method: str, published: int, share: float) -> None:
    assert count_parameters(make_place_network(method)) == pytest.approx(published, rel=share)


@pytest.mark.parametrize("method", ["minkloc_fusion", "adafusion"])
def test_a_missing_modality_leaves_the_other(method: str) -> None:
    network, batch = make_place_network(method).eval(), some_batch(2)
    half = network.length // 2
    dark = batch._replace(image_present=torch.tensor([True, False]))
    mask = batch.mask.clone()
    mask[1] = False
    blind = batch._replace(mask=mask, cloud_present=torch.tensor([True, False]))
    with torch.no_grad():
        assert network(dark)["descriptor"][1, :half].abs().max() == 0
        assert network(dark)["descriptor"][1, half:].abs().max() > 0
        assert network(blind)["descriptor"][1, half:].abs().max() == 0
        assert torch.isfinite(network(blind)["descriptor"]).all()


def test_farthest_points_spread_and_balls_hold_what_is_near() -> None:
    line = torch.arange(10.0)[None, :, None] * torch.tensor([1.0, 0, 0])
    chosen = farthest_points(line, 3)
    assert chosen.tolist() == [[0, 9, 4]]
    near = ball_query(line, line[:, [5]], 1.1, 5)
    assert set(near[0, 0].tolist()) == {4, 5, 6}
    assert ball_query(line, line[:, [5]] + 0.4, 0.1, 2).tolist() == [[[5, 5]]]  # none within: the nearest


def test_netvlad_begins_at_its_clusters_and_whitens() -> None:
    torch.manual_seed(0)
    network = NetVlad(clusters=4, length=8)
    local = torch.nn.functional.normalize(torch.randn(200, 112), dim=1)
    network.begin(local[:4], local)
    share = network.assign(local[:4, :, None, None]).flatten(1).softmax(1)
    assert torch.equal(share.argmax(1), torch.arange(4)) and share.diagonal().min() > 0.9
    vlad = torch.randn(300, 4 * 112) @ torch.diag(torch.linspace(3, 0.1, 4 * 112))
    network.whiten(vlad)
    spread = ((vlad - network.mean) @ network.directions.T).std(0)
    assert (spread > 0.9).all() and (spread < 1.1).all()


def test_weights_go_to_disk_and_back(tmp_path: Path) -> None:
    network, path = make_place_network("pointnet2").eval(), tmp_path / "pointnet2.safetensors"
    save_tensors(network, path, {}, {"method": "pointnet2"}, "half")
    batch = some_batch(2)
    with torch.no_grad():
        again = load_place_network("pointnet2", path)(batch)["descriptor"]
        torch.testing.assert_close(again, network(batch)["descriptor"], rtol=0.02, atol=0.02)
    with pytest.raises(WeightsError, match="another method than netvlad"):
        load_place_network("netvlad", path)
    with pytest.raises(WeightsError, match="do not exist"):
        load_place_network("pointnet2", tmp_path / "none.safetensors")
    with pytest.raises(ConfigError, match="has no network"):
        make_place_network("magic")
    assert locate_place_weights("pointnet2", str(path)) == path
