from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path

import pytest
import yaml

from umf_ros.core.config import Parameters, Settings, dump_settings, load_settings, nest, parse_changes
from umf_ros.core.errors import ConfigError


def write(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def test_no_file_gives_the_defaults() -> None:
    assert load_settings() == Settings()


def test_a_plain_file_and_a_ros_parameter_file_say_the_same(tmp_path: Path) -> None:
    plain = write(tmp_path / "a.yaml", "loop: {top_k: 7}\nkeyframe: {min_translation_m: 2}\n")
    ros = write(
        tmp_path / "b.yaml",
        "/**:\n  ros__parameters:\n    loop.top_k: 7\n    keyframe:\n      min_translation_m: 2.0\n",
    )
    assert load_settings(plain) == load_settings(ros)
    assert load_settings(plain).loop.top_k == 7


@pytest.mark.parametrize("text", ["loop.top_k: 7", "loop.top_k: 7\nloop: {min_travel_m: 3}"])
def test_names_of_a_plain_file_may_have_dots(tmp_path: Path, text: str) -> None:
    assert load_settings(write(tmp_path / "a.yaml", text)).loop.top_k == 7


def test_whole_numbers_pass_for_floats(tmp_path: Path) -> None:
    settings = load_settings(write(tmp_path / "a.yaml", "loop: {min_time_gap_s: 50}"))
    assert settings.loop.min_time_gap_s == 50.0 and isinstance(settings.loop.min_time_gap_s, float)


def test_overrides_win_and_none_is_no_override(tmp_path: Path) -> None:
    path = write(tmp_path / "a.yaml", "loop: {top_k: 7}")
    assert load_settings(path, loop__top_k=9, dataset=None).loop.top_k == 9


def test_effective_settings_survive_a_round_trip(tmp_path: Path) -> None:
    settings = load_settings(None, loop__top_k=3, embedding__method="thumbnail")
    text = dump_settings(settings)
    assert load_settings(write(tmp_path / "dump.yaml", text)) == settings
    assert "ros__parameters" in yaml.safe_load(text)["/**"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("loop: {topk: 7}", "unknown parameter loop.topk"),
        ("loop: {top_k: many}", "loop.top_k: .*got 'many'"),
        ("loop: {top_k: 0}", "loop.top_k: .*greater than or equal to 1"),
        ("loop: 5", "loop: "),
        ("[1, 2]", "expected names and values, found a list"),
        ("a: [", "is not valid YAML"),
        ("/**: {ros__parameters: {loop.top_k: 7}}\nloop: {top_k: 1}", "mixes node parameters"),
        ("/**: {ros__parameters: {loop: 3, loop.top_k: 7}}", "loop: holds settings, not a value"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        load_settings(write(tmp_path / "bad.yaml", text))
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"cannot read .*nowhere\.yaml"):
        load_settings(tmp_path / "nowhere.yaml")


def test_nesting_dotted_names() -> None:
    assert nest({"a.b": 1, "a.c.d": 2, "e": 3}) == {"a": {"b": 1, "c": {"d": 2}}, "e": 3}


def test_every_setting_is_described() -> None:
    for name, group in Settings.model_fields.items():
        fields = getattr(group.annotation, "model_fields", {name: group})
        for key, field in fields.items():
            assert field.description, f"{name}.{key} has no description"


BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{name}: &{name} [{', '.join([f'*{before}'] * 9)}]\n" for before, name in pairwise("abcdefghi")
)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (BOMB, "its aliases expand to too many nodes"),
        ("a: &a [*a]", "contains itself"),
        ("1: 2", "a name must be text, not 1"),
        ("loop: {3: 4}", "a name must be text, not 3"),
        ("[" * 100_000, "not valid YAML"),
        ("a: " + "b" * 2**23, "larger than 4 MB"),
        ("? {a: b}\n: c", "not valid YAML"),
        ("loop: !!python/object/apply:os.system [true]", "not valid YAML"),
        ("a: !!int ''", "not valid YAML"),
        ("a: !!bool maybe", "not valid YAML: 'maybe'"),
        ("a: !!timestamp x", "not valid YAML"),
        ("loop: {min_time_gap_s: .inf}", "loop.min_time_gap_s: .*finite"),
        ("loop: {min_travel_m: .nan}", "loop.min_travel_m"),
        ("loop: {min_time_gap_s: 1.0e+300}", "loop.min_time_gap_s"),
    ],
)
def test_a_hostile_file_is_one_short_line(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(ConfigError, match=message) as caught:
        load_settings(tmp_path / "a.yaml")
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 500


def test_localization_needs_a_map() -> None:
    with pytest.raises(ConfigError, match="mode localization needs a map"):
        load_settings(None, mode="localization")
    settings = load_settings(None, mode="localization", map="somewhere")
    assert settings.localizing and not Settings().localizing


def test_a_file_without_end_or_with_a_name_without_end_is_one_short_line(tmp_path: Path) -> None:
    for path in (Path("/dev/zero"), tmp_path / ("x" * 5000), tmp_path):
        with pytest.raises(ConfigError) as caught:
            load_settings(path)
        assert "\n" not in str(caught.value) and len(str(caught.value)) < 500


def test_paths_in_a_file_are_relative_to_it_and_those_of_overrides_to_the_folder_one_is_in(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "config").mkdir()
    path = write(tmp_path / "config" / "a.yaml", "calibration: own.yaml\nembedding.weights: ../net.safetensors\n")
    monkeypatch.chdir(tmp_path)
    found = load_settings("config/a.yaml", map="maps/one")
    assert Path(found.calibration) == path.parent / "own.yaml" and Path(found.map) == tmp_path / "maps" / "one"
    assert Path(found.embedding.weights).resolve() == tmp_path / "net.safetensors"
    assert load_settings(write(path, "calibration: tf\n")).calibration == "tf"
    assert load_settings(write(path, "calibration: s3li-etna\n")).calibration == "s3li-etna"


def test_changes_by_text_are_like_those_in_the_file(tmp_path: Path) -> None:
    path = write(tmp_path / "a.yaml", "loop: {top_k: 7}\ndataset: auto\n")
    changes = parse_changes(["loop.min_travel_m=2.5", "topics.left_image=", "qos.reliability=reliable"])
    found = load_settings(Parameters(path, changes), loop__top_k=None)
    assert (found.loop.top_k, found.loop.min_travel_m, found.topics.left_image) == (7, 2.5, "")
    assert found.qos.reliability == "reliable" and "dataset" not in found.model_fields_set
    for text in ("loop.top_k", "=3"):
        with pytest.raises(ConfigError, match=f"--set {text}: expected NAME=VALUE"):
            parse_changes([text])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("loop: {topk: 7}", "a.yaml: unknown parameter loop.topk; did you mean loop.top_k?"),
        ("top_k: 7", "did you mean loop.top_k?"),
        ("", "a.yaml is empty"),
        ("loop:\n  {top_k: 7", "not valid YAML: line 3, column "),
    ],
)
def test_what_was_meant_and_where_it_is_wrong_are_named(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=".*".join(map(re.escape, message.split("...")))):
        load_settings(write(tmp_path / "a.yaml", text))
    with pytest.raises(ConfigError, match=r"^unknown parameter loop\.topk; did"):  # not the file's fault
        load_settings(write(tmp_path / "a.yaml", "loop.top_k: 7"), loop__topk=3)
