"""Training of other methods' networks and of the vocabulary: they learn, resume, and leave weights that load."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import typer
from sources import rows_of
from tiny_worlds import write_world
from typer.testing import CliRunner

from umf_ros.baselines.dbow2 import Vocabulary
from umf_ros.baselines.place_networks import NETWORKS, load_place_network
from umf_ros.core.config import EmbeddingSettings
from umf_ros.core.errors import ConfigError, UmfError
from umf_ros.embedding import make_embedder
from umf_ros.lab.commands import train as train_command
from umf_ros.lab.datasets.simulated import WorldFolder
from umf_ros.lab.fit.vocabulary import fit_vocabulary, vocabulary_settings
from umf_ros.lab.training.networks import read_card
from umf_ros.lab.training.objective import find_objective
from umf_ros.lab.training.trainer import load_run, train

QUICK = {"batch": 8, "epoch_steps": 2, "warmup_steps": 1, "threads": 1, "batch_limit": 12}
app = typer.Typer()
app.command("train")(train_command.command)


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """A world of 8 frames."""
    (tmp_path / "small").mkdir()
    write_world(tmp_path / "small" / "world_10001.npz", 7, count=8)
    return tmp_path / "small"


def ignore(*_: object) -> None:
    pass


@pytest.mark.parametrize("method", NETWORKS)
def test_a_run_learns_from_its_triplets_and_leaves_weights(
    method: str, folder: Path, small: Path, tmp_path: Path
) -> None:
    chosen = {"train": str(folder), "validation": str(small), "method": method, "steps": 4}
    path = train(load_run(None, **(QUICK | chosen)), tmp_path / "run", False, ignore)
    assert path.name == f"{method}.safetensors"
    network = load_place_network(method, path)
    fresh = find_objective(method).make_network(load_run(None, **chosen))
    frozen = [name for name, value in fresh.named_parameters() if not value.requires_grad]
    assert all(name.split(".network.")[0].endswith("trunk") for name in frozen)
    for name, value in network.named_parameters():
        if name in frozen:  # kept as published, but for half precision
            torch.testing.assert_close(value, fresh.get_parameter(name), rtol=1e-2, atol=1e-3)
    log = rows_of(tmp_path / "run" / "log.csv")
    assert [row["step"] for row in log] == ["2", "4"] and 0 <= float(log[-1]["recall1"]) <= 1
    card = read_card(path)
    assert card["architecture"] == {"method": method} and "recall1" in card["untrained"]
    embedder = make_embedder(EmbeddingSettings(method=method, weights=str(path)))
    assert embedder.dimension == network.length


@pytest.mark.parametrize("chosen", [{"method": "minkloc_lidar"}, {"method": "netvlad", "loss": "triplet"}])
def test_the_loss_of_a_batch_falls(folder: Path, chosen: dict[str, str]) -> None:
    torch.manual_seed(0)
    settings = load_run(None, train=str(folder), **(QUICK | chosen))
    kind = find_objective(settings.method)
    objective = kind(kind.make_network(settings), settings)
    batch = objective.batch_maker(WorldFolder(folder).refresh(), 0)(0)
    trained = [value for value in objective.parameters() if value.requires_grad]
    optimiser = torch.optim.Adam(trained, 1e-3)
    losses = []
    objective.train()
    for _ in range(8):
        found = objective(batch)
        optimiser.zero_grad()
        found["total"].backward()
        optimiser.step()
        losses.append(float(found["total"].detach()))
    assert losses[-1] < 0.95 * losses[0]


def test_a_resumed_run_repeats_an_uninterrupted_one(folder: Path, tmp_path: Path) -> None:
    chosen = QUICK | {"train": str(folder), "method": "pointnet2", "steps": 4}
    whole = train(load_run(None, **chosen), tmp_path / "whole", False, ignore)

    def stop(progress: object) -> None:
        if progress.step == 3:  # type: ignore[attr-defined]
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(load_run(None, **chosen), tmp_path / "parts", False, stop)
    parts = train(load_run(None, **chosen), tmp_path / "parts", True, ignore)
    one, two = (load_place_network("pointnet2", path).state_dict() for path in (whole, parts))
    assert all(torch.equal(one[name], two[name]) for name in one)


def test_a_vocabulary_grows_from_the_same_worlds(folder: Path, tmp_path: Path) -> None:
    config = tmp_path / "small.yaml"
    config.write_text("branching: 4\ndepth: 2\nevery: 4\n")
    arguments = [str(folder), "--method", "dbow2", "--config", str(config), "--out", str(tmp_path / "words")]
    found = CliRunner().invoke(app, arguments)
    assert found.exit_code == 0, found.output
    words = Vocabulary.load(tmp_path / "words" / "dbow2.safetensors").words
    card = read_card(tmp_path / "words" / "dbow2.safetensors")
    assert 4 <= words <= 16 and card["words"] == words and card["training_worlds"] == ["world_00001", "world_00002"]
    again = fit_vocabulary(vocabulary_settings(config, train=str(folder)), tmp_path / "again", ignore)
    np.testing.assert_array_equal(
        Vocabulary.load(again).nodes, Vocabulary.load(tmp_path / "words" / "dbow2.safetensors").nodes
    )


@pytest.mark.parametrize(
    ("method", "content", "message"),
    [("dbow2", "depth: 9\n", "depth"), ("netvlad", "margin: -1\n", "margin"), ("magic", "", "unknown method 'magic'")],
)
def test_wrong_settings_are_one_clear_line(method: str, content: str, message: str, tmp_path: Path) -> None:
    config = tmp_path / "wrong.yaml"
    config.write_text(content)
    found = CliRunner().invoke(app, [str(tmp_path), "--method", method, "--config", str(config)])
    assert isinstance(found.exception, UmfError | ConfigError) and message in str(found.exception)
