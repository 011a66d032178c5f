"""Parts of a run: settings, schedule, log, checkpoints, judgement and the command."""

from __future__ import annotations

import csv
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import typer
import yaml
from tiny_worlds import TINY, pose_at, some_input, write_world
from typer.testing import CliRunner

from umf_ros.core.errors import ConfigError, OutputError, UmfError, WeightsError
from umf_ros.lab.commands import train as train_command
from umf_ros.lab.datasets.simulated import SimulatedWorld, WorldFolder
from umf_ros.lab.training.metric_objective import MetricObjective, describe, figures, mean_of, validate
from umf_ros.lab.training.networks import PRESETS, make_network, read_card, save_weights
from umf_ros.lab.training.objective import Progress, append_row, learning_rate, resuming, save_checkpoint
from umf_ros.lab.training.trainer import Team, Trainer, choose_device, join_team, load_run, read_recipe
from umf_ros.networks.umf import UMF
from umf_ros.networks.weights import load_weights

CPU = Team(0, 1, torch.device("cpu"))


@pytest.fixture(autouse=True)
def tiny_preset(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PRESETS, "tiny", TINY)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("worlds")
    write_world(folder / "world_00001.npz", 1, count=12)
    return folder


def quick(folder: Path, **chosen: object):
    small = {"preset": "tiny", "steps": 2, "epoch_steps": 1, "batch": 4, "local_pairs": 0, "weight_super": 0}
    return load_run(None, train=str(folder), **(small | {"half": False} | chosen))


def trainer(folder: Path, out: Path, validation=list, **chosen: object) -> Trainer:
    out.mkdir(exist_ok=True)
    torch.manual_seed(0)
    settings = quick(folder, **chosen)
    return Trainer(MetricObjective(UMF(TINY), settings, validation), WorldFolder(folder).refresh, settings, out, CPU)


def ignore(*_: object) -> None:
    pass


# settings


def test_the_command_line_overrules_the_file(tmp_path):
    path = tmp_path / "run.yaml"
    path.write_text("train: a\nsteps: 10\nseed: 3\nimage_size: [64, 96]\n")
    found = load_run(path, steps=20, seed=None)
    assert (found.train, found.steps, found.seed, found.image_size) == ("a", 20, 3, (64, 96))


@pytest.mark.parametrize(
    ("content", "word"),
    [
        (b"- a\n- b\n", "expected names and values, found a list"),
        (b"steps", "expected names and values, found a str"),
        (b"steps: [1", "not valid YAML"),
        (b"train: \xff\xfe", "not valid YAML"),
        (b"steps: 0\nbatch: 2\n", "steps: .*; batch: "),
        (b"speed: 3\n", "unknown parameter speed"),
        (b"loss: hinge\n", "loss: "),
        (b"1: 2\n", "a name must be text, not 1"),
    ],
)
def test_wrong_settings_are_one_clear_line(tmp_path, content, word):
    path = tmp_path / "run.yaml"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=word) as raised:
        load_run(path, train="worlds")
    assert "\n" not in str(raised.value)


def test_settings_that_are_not_there(tmp_path):
    with pytest.raises(ConfigError, match="No such file"):
        load_run(tmp_path / "none.yaml", train="worlds")
    with pytest.raises(ConfigError, match="train is missing"):
        load_run(None)


# schedule and log


def test_the_rate_climbs_peaks_and_fades():
    rates = [learning_rate(0.1, 10, step, 200) for step in range(201)]
    assert rates[0] == pytest.approx(0.01, rel=1e-3) and rates[9] == pytest.approx(0.1, rel=0.01)
    assert rates[100] == pytest.approx(0.05) and rates[200] == pytest.approx(0, abs=1e-9)
    assert (np.diff(rates[:9]) > 0).all() and (np.diff(rates[10:]) < 0).all()
    assert learning_rate(0.1, 0, 0, 200) == pytest.approx(0.1)


def test_a_log_names_its_columns_once(tmp_path):
    path = tmp_path / "log.csv"
    for step in (1, 2):
        append_row(path, {"step": step, "loss": 0.5 / step})
    assert list(csv.DictReader(path.open())) == [{"step": "1", "loss": "0.5"}, {"step": "2", "loss": "0.25"}]


def test_a_log_that_cannot_be_written(tmp_path):
    (tmp_path / "log.csv").mkdir()
    with pytest.raises(OutputError, match=r"cannot write .*log\.csv"):
        append_row(tmp_path / "log.csv", {"step": 1})


# checkpoints


def test_an_interrupted_write_leaves_the_previous_checkpoint(tmp_path):
    path = tmp_path / "checkpoint.pt"
    save_checkpoint(path, {"step": 1})

    class Unwritable:
        def __reduce__(self) -> tuple:
            raise RuntimeError("the disk is full")

    with pytest.raises(OutputError, match="the disk is full"):
        save_checkpoint(path, {"step": Unwritable()})
    with resuming(path) as state:
        assert state == {"step": 1}


@pytest.mark.parametrize("content", [b"", b"nothing of use", None])
def test_checkpoints_that_cannot_be_read(tmp_path, content):
    if content is not None:
        (tmp_path / "checkpoint.pt").write_bytes(content)
    with pytest.raises(WeightsError, match="cannot resume") as raised, resuming(tmp_path / "checkpoint.pt"):
        pytest.fail("it was read")
    assert "\n" not in str(raised.value)


def test_a_checkpoint_of_another_run_is_refused(folder, tmp_path):
    run = trainer(folder, tmp_path, steps=1)
    run.run(ignore, ignore)
    state = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    for other in ({"objective": {"weight": torch.zeros(2)}}, {"optimiser": {"model": 1}}, {"progress": {"moves": 3}}):
        save_checkpoint(tmp_path / "checkpoint.pt", state | other)
        with pytest.raises(WeightsError, match="of another run") as raised:
            run.resume()
        assert "\n" not in str(raised.value)


# teams


def test_devices_by_name():
    assert choose_device("cpu") == "cpu"
    assert choose_device("auto") == ("cuda" if torch.cuda.is_available() else "cpu")


def test_one_process_is_a_team_that_leads_itself(monkeypatch):
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    with join_team("cpu") as team:
        assert (team.rank, team.size, team.device.type, team.leads) == (0, 1, "cpu", True)
    assert not torch.distributed.is_initialized()


TWO = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
import torch
from tiny_worlds import TINY
from umf_ros.lab.datasets.simulated import WorldFolder
from umf_ros.networks.umf import UMF
from umf_ros.lab.training.trainer import join_team
from umf_ros.lab.training.metric_objective import MetricObjective
from umf_ros.lab.training.trainer import load_run
from umf_ros.lab.training.trainer import Trainer
torch.manual_seed(0)
folder = Path(sys.argv[1])
small = dict(preset="tiny", steps=2, epoch_steps=1, batch=4, half=False, bank=0, weight_super=0)
with join_team("cpu") as team:
    network = UMF(TINY)
    out = folder / f"rank{team.rank}"
    out.mkdir()
    settings = load_run(None, train=str(folder), **small)
    trainer = Trainer(MetricObjective(network, settings), WorldFolder(folder).refresh, settings, out, team)
    trainer.run(lambda progress: None, lambda: None)
    seen = sum(float(value.double().abs().sum()) for name, value in network.named_parameters())
    print(f"rank {team.rank}: {seen:.9f} {trainer.progress.losses['fused']:.9f}", flush=True)
"""


def test_two_processes_learn_the_same_from_different_batches(folder, tmp_path):
    write_world(tmp_path / "world_00002.npz", 2, count=12)
    (tmp_path / "two.py").write_text(TWO)
    port = str(20_000 + os.getpid() % 20_000)
    environment = os.environ | {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
    command = [sys.executable, str(tmp_path / "two.py"), str(tmp_path), str(Path(__file__).parents[2])]
    processes = [
        subprocess.Popen(command, env=environment | {"RANK": rank, "LOCAL_RANK": rank}, stdout=subprocess.PIPE)
        for rank in "01"
    ]
    said = [process.communicate(timeout=300)[0].decode() for process in processes]
    assert [process.returncode for process in processes] == [0, 0]
    weights, losses = zip(*(re.search(r"rank \d: (\S+) (\S+)", text).groups() for text in said), strict=True)
    assert weights[0] == weights[1] and losses[0] != losses[1]
    assert (tmp_path / "rank0" / "checkpoint.pt").is_file() and not list((tmp_path / "rank1").iterdir())


# judgement


def test_descriptors_come_by_mode_and_follow_the_rows(folder):
    torch.manual_seed(0)
    network, world = UMF(TINY), SimulatedWorld(folder / "world_00001.npz")
    whole = describe(network, world, np.arange(12), batch=5)
    some = describe(network, world, np.array([7, 2]))
    assert set(whole) == {"fused", "image", "cloud"}
    half = TINY.descriptor // 2
    for mode, found in whole.items():
        assert found.shape == (12, TINY.descriptor)
        np.testing.assert_allclose(found[[7, 2]], some[mode], atol=1e-5)
        np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-5)
    assert np.abs(whole["image"][:, half:]).max() < 1e-5 and np.abs(whole["cloud"][:, :half]).max() < 1e-5


def test_only_revisits_are_queries(folder, tmp_path):
    turned = np.stack([pose_at(8.0 * (i % 6), 2.0, 180.0 * (i >= 6)) for i in range(12)])
    write_world(tmp_path / "back.npz", 1, 12, world_T_body=turned)
    worlds = [SimulatedWorld(folder / "world_00001.npz"), SimulatedWorld(tmp_path / "back.npz")]
    found = validate(UMF(TINY), worlds, stride=2)
    assert found["world_00001"]["fused"].queries == 3 and found["back"]["fused"].queries == 0
    assert mean_of(found, "fused", "recall1") == found["world_00001"]["fused"].recall1 == 1
    assert figures(found["back"]["fused"]) == {
        "queries": 0, "recall1": None, "recall5": None, "recall1_within_5m": None, "recall_at_precision1": None,
    }  # fmt: skip
    assert np.isnan(mean_of({"back": found["back"]}, "fused", "recall1"))


def test_a_match_beyond_five_metres_is_a_match_but_no_near_one(tmp_path):
    away = np.stack([pose_at(30.0 * (i % 6), 8.0 * (i >= 6)) for i in range(12)])
    write_world(tmp_path / "away.npz", 1, 12, world_T_body=away)
    found = validate(UMF(TINY), [SimulatedWorld(tmp_path / "away.npz")])["away"]["fused"]
    assert (found.recall1, found.recall1_within_5m) == (1, 0)


def test_the_best_weights_are_kept_and_not_the_last(folder, tmp_path):
    kept: list[int] = []
    run = trainer(folder, tmp_path, WorldFolder(folder).refresh, steps=3, validate_epochs=1, learning_rate=1e-9)
    run.run(ignore, lambda: kept.append(run.progress.step))
    assert kept == [1]  # this world is perfect from the start: nothing later is better
    assert run.progress.figures["recall1_fused"] == 1 and run.progress.figures["recall1_5m"] == 1


def test_without_anything_to_compare_the_last_weights_are_kept(folder, tmp_path):
    lone = tmp_path / "lone"
    lone.mkdir()
    write_world(lone / "a.npz", 1, 12, pass_index=np.zeros(12, np.int32))
    kept: list[int] = []
    run = trainer(folder, tmp_path / "run", WorldFolder(lone).refresh, steps=3, validate_epochs=1)
    run.run(ignore, lambda: kept.append(run.progress.step))
    assert kept == [1, 2, 3] and "recall1_fused" not in run.progress.figures


def test_every_modality_is_lost_now_and_then_and_never_both(folder, tmp_path, monkeypatch):
    """With the largest chance every row loses one; the losses stay numbers all the same."""
    seen: list[dict[str, float]] = []
    run = trainer(folder, tmp_path, steps=4, modality_dropout=0.5)
    run.run(lambda progress: seen.append(dict(progress.losses)), ignore)
    assert len(seen) == 4 and all(np.isfinite(list(losses.values())).all() for losses in seen)


# the commands


app = typer.Typer()
app.callback()(lambda: None)  # so that the name of its command is read
app.command("train")(train_command.command)


def umf(*arguments: object) -> str:
    found = CliRunner().invoke(app, [str(word) for word in arguments], catch_exceptions=True)
    if isinstance(found.exception, UmfError):
        raise found.exception
    assert found.exit_code == 0, found.output
    return found.output


def test_training_from_the_command_line(folder, tmp_path, monkeypatch):
    start, out, config = tmp_path / "start.safetensors", tmp_path / "run", tmp_path / "run.yaml"
    torch.manual_seed(5)
    save_weights(UMF(TINY), start, {"command": "umf train before", "steps": 7, "earlier_runs": [{"steps": 3}]})
    config.write_text(yaml.safe_dump({"preset": "tiny", "epoch_steps": 1, "batch": 4, "local_pairs": 1}))
    monkeypatch.setattr(sys, "argv", ["umf", "train", str(folder), f"--config={config}", "--steps", "1"])
    said = umf("train", folder, "--config", config, "--start", start, "--out", out, "--steps", 1)
    assert f"weights: {out / 'tiny.safetensors'}" in said.replace("\n", "")
    card = read_card(out / "tiny.safetensors")
    assert card["steps"] == 1 and card["settings"]["start"] == "start.safetensors"
    assert [run["steps"] for run in card["earlier_runs"]] == [3, 7]
    assert card["command"] == f"umf train {folder.name} --config=run.yaml --steps 1"
    begun, ended = (load_weights(path).state_dict() for path in (start, out / "tiny.safetensors"))
    largest = max(float((begun[name] - ended[name]).abs().max()) for name in begun if name.endswith("head.weight"))
    assert 0 < largest < 0.01  # one step away from where it started
    with pytest.raises(OutputError, match="holds a run: --resume continues it"):
        umf("train", folder, "--config", config, "--out", out, "--steps", 2)
    umf("train", folder, "--config", config, "--out", out, "--steps", 2, "--resume")
    assert [row["step"] for row in csv.DictReader((out / "log.csv").open())] == ["1", "2"]


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["train", "nowhere", "--preset", "tiny"], "cannot read nowhere"),
        (["train", "{worlds}", "--loss", "hinge"], "loss: "),
        (["train", "{worlds}", "--preset", "tiny", "--device", "foo"], "device: "),
        (["train", "{worlds}", "--steps", "0"], "steps: "),
    ],
)
def test_what_cannot_be_trained_is_said_in_one_line(arguments, word, folder, tmp_path):
    with pytest.raises(UmfError, match=word) as raised:
        umf(*(str(part).format(worlds=folder) for part in arguments), "--out", tmp_path / "out")
    assert "\n" not in str(raised.value)


def test_a_run_of_one_kind_does_not_resume_from_the_other(folder, tmp_path):
    options = "--out", tmp_path, "--preset", "tiny", "--steps", 1
    umf("train", folder, *options)
    with pytest.raises(WeightsError, match="of another run"):
        umf("train", folder, *options, "--method", "minkloc_fusion", "--resume")


def test_a_recipe_trains_stage_by_stage_and_goes_on_where_it_was_interrupted(tmp_path):
    out, recipe = tmp_path / "run", tmp_path / "recipe.yaml"
    for part, seed in (("train", 1), ("validation", 10000)):  # there already: nothing is left to simulate
        (out / "worlds" / part).mkdir(parents=True)
        write_world(out / "worlds" / part / f"world_{seed:05d}.npz", seed, count=24)
    settings = {"preset": "tiny", "batch": 4, "epoch_steps": 1, "validate_epochs": 1, "local_pairs": 0, "bank": 0}
    stages = [{"steps": 2}, {"steps": 3, "freeze_encoders": True}]
    content = {"training": "1:2", "validation": "10000:10001", "common": settings, "stages": stages}
    recipe.write_text(yaml.safe_dump(content))
    umf("train", "--recipe", recipe, "--out", out)
    last = out / "stage_2" / "tiny.safetensors"
    assert read_card(last)["earlier_runs"][0]["settings"]["steps"] == 2
    assert Path(yaml.safe_load((out / "stage_2" / "training.yaml").read_text())["start"]).parent.name == "stage_1"
    (out / "stage_2" / "checkpoint.pt").unlink()  # as if interrupted between the stages
    before = (out / "stage_1" / "log.csv").read_bytes()
    umf("train", "--recipe", recipe, "--out", out)
    assert (out / "stage_1" / "log.csv").read_bytes() == before
    assert read_card(last)["settings"]["steps"] == 3


def test_a_run_keeps_no_weights_that_are_worse_than_those_at_its_start(folder, tmp_path):
    torch.manual_seed(0)
    save_weights(UMF(TINY), tmp_path / "start.safetensors", {})
    chosen = {"start": str(tmp_path / "start.safetensors"), "validation": str(folder), "validate_epochs": 1}
    settings = quick(folder, learning_rate=1e-12, fixed_statistics=True, **chosen)
    objective = MetricObjective(make_network("tiny", settings.start), settings)
    run, kept = Trainer(objective, WorldFolder(folder).refresh, settings, tmp_path, CPU), []
    run.run(ignore, lambda: kept.append(run.progress.step))
    assert run.progress.step == 2
    assert kept == [0]


def test_a_deeper_network_starts_as_the_one_it_grew_from(tmp_path, monkeypatch):
    torch.manual_seed(6)
    shallow = UMF(TINY).eval()
    save_weights(shallow, tmp_path / "shallow.safetensors", {})
    monkeypatch.setitem(PRESETS, "deep", replace(TINY, backbone="resnet34", voxel_blocks=2))
    monkeypatch.setitem(PRESETS, "bottleneck", replace(TINY, backbone="resnet50"))
    deep = make_network("deep", str(tmp_path / "shallow.safetensors")).eval()
    batch = some_input(TINY)
    found, wanted = deep(batch), load_weights(tmp_path / "shallow.safetensors")(batch)
    torch.testing.assert_close(found.descriptor, wanted.descriptor, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(found.cloud.descriptors, wanted.cloud.descriptors, atol=1e-5, rtol=1e-4)
    new = sum(value.numel() for value in deep.parameters()) - sum(value.numel() for value in shallow.parameters())
    assert new > 0
    with pytest.raises(ConfigError, match="is not a bottleneck"):
        make_network("bottleneck", str(tmp_path / "shallow.safetensors"))
    save_weights(deep, tmp_path / "deep.safetensors", {})
    with pytest.raises(ConfigError, match="is not a tiny"):
        make_network("tiny", str(tmp_path / "deep.safetensors"))


def test_weights_of_another_network_do_not_start_a_run(tmp_path):
    save_weights(UMF(TINY), tmp_path / "tiny.safetensors", {})
    with pytest.raises(ConfigError, match="is not a umf_light"):
        make_network("umf_light", str(tmp_path / "tiny.safetensors"))
    assert make_network("tiny", str(tmp_path / "tiny.safetensors"), (32, 64)).config.image_size == (32, 64)


def test_progress_is_plain_data():
    """It goes into the checkpoint, which holds nothing that could run."""
    assert Progress(**vars(Progress(step=3, losses={"total": 1.0}))).losses == {"total": 1.0}


@pytest.mark.parametrize("seeds", ["first:last", "5:5", "-2:3"])
def test_a_recipe_whose_seeds_name_no_world_is_refused(tmp_path, seeds):
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text(yaml.safe_dump({"training": seeds, "validation": "10000:10001", "stages": [{"steps": 1}]}))
    with pytest.raises(ConfigError, match="seeds"):
        read_recipe(str(recipe))
