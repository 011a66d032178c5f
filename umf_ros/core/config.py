"""Every setting of the package: one source for node parameters, command line and documentation.

Settings are nested; a node parameter's name is the path with dots, as in `keyframe.min_translation_m`.
Numbers carry their unit in the name.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from umf_ros.core.errors import ConfigError, either
from umf_ros.core.io import read_values
from umf_ros.core.resources import DEFAULT_DATASET, dataset_names, find


class Group(BaseModel):
    """A group of settings: unknown names are refused, whole numbers pass for floats."""

    model_config = ConfigDict(extra="forbid", frozen=True, validate_default=True, allow_inf_nan=False)


def _known(name: str) -> str:
    names = dataset_names()
    if name not in names:
        find("config/datasets")  # a broken installation lacks them all
        raise ValueError(f"Input should be {either([repr(one) for one in names])} (got {name!r})")
    return name


def without_password(address: str) -> str:
    """Return the address of a server; refuse one with a password, which would be written beside the results."""
    if "password" in address.lower() or (":" in address.partition("://")[2].partition("@")[0] and "@" in address):
        raise ValueError("the password belongs into ~/.pgpass or PGPASSWORD, not into the address")
    return address


AUTO = "auto"
"""Data set that the topics of a recording decide."""
TRANSFORMS = "tf"
"""Calibration in place of a file: `/tf_static` and camera_info say how the rig is built, or its messages wait."""
Dataset = Annotated[str, AfterValidator(_known)]
"""Name of a data set that has a file in `config/datasets`."""


class Topics(Group):
    """Names of the input topics; the defaults are S3LI Etna's."""

    left_image: str = Field("/stereo/left/image_rect", description="left image, sensor_msgs/Image")
    right_image: str = Field("/stereo/right/image_rect", description="right image; empty: no stereo")
    left_info: str = Field("/stereo/left/camera_info", description="left camera_info; empty: use the calibration file")
    right_info: str = Field("/stereo/right/camera_info", description="right camera_info, for the baseline")
    cloud: str = Field("/bf_lidar/points_raw", description="LiDAR scan, sensor_msgs/PointCloud2")
    odometry: str = Field("/odom", description="odometry, nav_msgs/Odometry; empty: none")


class AbsoluteTopics(Group):
    """Topics of measurements of absolute position and attitude."""

    gnss: str = Field("", description="GNSS, sensor_msgs/NavSatFix; empty: none")
    imu: str = Field("", description="IMU for the direction of gravity, sensor_msgs/Imu; empty: none")


class DatasetPreset(Group):
    """Calibration and topics of a data set, by its name: a file in `config/datasets`."""

    calibration: Path = Field(description="calibration file, relative to this one")
    topics: Topics = Topics()
    mark: str = Field("", description="topic that its recordings have and those of other data sets lack; empty: none")


class Qos(Group):
    """Quality of service of the sensor subscriptions."""

    reliability: Literal["best_effort", "reliable"] = Field("best_effort", description="best_effort fits any publisher")
    depth: int = Field(50, ge=1, le=1000, description="messages queued per subscription; covers a busy second")


class Sync(Group):
    """Synchronisation of messages into frames."""

    slop_s: float = Field(0.05, gt=0, le=1, description="largest time difference between image and scan, s")
    max_wait_s: float = Field(1.0, gt=0, le=10, description="stream time that a scan waits for a late input, s")
    queue_size: int = Field(60, ge=2, le=1000, description="messages buffered per input at most")
    odometry_buffer_s: float = Field(10.0, gt=0, le=600, description="odometry kept for interpolation, s")
    max_odometry_gap_s: float = Field(1.0, gt=0, le=60, description="longest odometry gap that is interpolated, s")
    require_image: bool = Field(False, description="drop scans without an image, rather than use the scan alone")


class OdometrySettings(Group):
    """Odometry of a rover that has none."""

    engine: Literal["", "vgicp"] = Field(
        "", description="engine with which the front-end makes ~/odometry from the scans, for both nodes; empty: none"
    )


class KeyframePolicy(Group):
    """Selection of keyframes."""

    min_translation_m: float = Field(0.5, ge=0, description="translation after which a frame becomes a keyframe, m")
    min_rotation_deg: float = Field(15.0, ge=0, le=180, description="or rotation after which it becomes one, deg")
    min_period_s: float = Field(0.4, ge=0, description="shortest time between keyframes, s")
    max_period_s: float = Field(5.0, gt=0, description="longest time between keyframes of a moving rover, s")
    untracked_period_s: float = Field(1.0, gt=0, description="time between keyframes without odometry, s")


class EmbeddingSettings(Group):
    """Network for descriptors and local features of frames."""

    method: str = Field("umf", description="embedder by name: umf, or another of docs/benchmarks.md")
    weights: str = Field("", description="safetensors file; empty: umf_scene, or another method's own")
    runtime: Literal["auto", "torch", "openvino"] = Field("auto", description="inference runtime")
    device: str = Field("cpu", description="torch device; half precision on a GPU")
    threads: int = Field(0, ge=0, le=64, description="threads of each of the two networks; 0: half of the cores")


class Loop(Group):
    """Candidates for loop closures."""

    min_time_gap_s: float = Field(20.0, ge=0, le=1e9, description="least age of a match, s")
    min_travel_m: float = Field(15.0, ge=0, description="least path length from match to query, m")
    top_k: int = Field(20, ge=1, le=200, description="candidates per keyframe passed to verification")
    min_similarity: float = Field(0.0, ge=-1, le=1, description="least cosine similarity of a candidate")


class Verification(Group):
    """Reranking, metric pose and acceptance of candidates."""

    min_probability: float = Field(0.9, ge=0, le=1, description="least probability of a published closure")
    seed: int = Field(0, ge=0, description="seed of every RANSAC")
    features: Literal["umf", "xfeat"] = Field("xfeat", description="local features of images: XFeat's or the network's")
    modalities: Literal["both", "image", "cloud"] = Field("both", description="local features that reranking uses")
    rerank_features: int = Field(200, ge=20, le=2000, description="strongest features per modality for reranking")
    ransac_iterations: int = Field(100, ge=10, le=5000, description="iterations of every RANSAC")
    refine_best: int = Field(4, ge=1, le=50, description="reranked candidates whose metric pose is estimated")
    max_closures: int = Field(1, ge=1, le=50, description="closures published per keyframe at most")
    max_turn_deg: float = Field(0.0, ge=0, le=180, description="largest rotation of a closure, deg; 0: no limit")
    max_shift_m: float = Field(11.5, ge=0, description="largest translation of a closure, m; 0: no limit")
    odometry_drift: float = Field(
        0.05, gt=0, le=1, description="odometry error per distance driven, for the agreement of a fleet's closures"
    )
    calibration: str = Field("", description="fitted acceptance model (JSON); empty: the shipped one")


class PoseGraphSettings(Group):
    """The GTSAM back-end."""

    keyframe_period_s: float = Field(0.5, gt=0, le=60, description="sampling period of the odometry, s")
    keyframe_spacing_m: float = Field(0.25, gt=0, description="path length between poses of the graph, m")
    max_gap_s: float = Field(2.0, gt=0, description="longest gap of the odometry that is interpolated, s")
    odometry_sigma_m: float = Field(0.05, gt=0, description="odometry noise after one metre (random walk), m")
    odometry_sigma_deg: float = Field(0.5, gt=0, description="odometry noise after one metre (random walk), deg")
    max_closure_m: float = Field(100.0, gt=0, description="translation beyond which a closure is refused, m")
    max_correction_m: float = Field(0.0, ge=0, description="largest correction of a pose by a closure, m; 0: no limit")
    gate_chi2: float = Field(27.9, gt=0, description="largest squared Mahalanobis distance to the map (6 d.o.f.)")
    pair_chi2: float = Field(33.6, gt=0, description="largest squared Mahalanobis distance between consistent closures")
    alias_radius_m: float = Field(15.0, gt=0, description="radius of wrong closures to similar places, m")
    max_chance: float = Field(0.02, gt=0, le=1, description="largest false-alarm probability to accept at once")
    min_support: float = Field(8.0, ge=0, description="evidence (nats) that several places must give, each up to 4")
    place_m: float = Field(10.0, ge=0, description="path length within which closures count as one place, m")
    support_range_m: float = Field(80.0, gt=0, description="path length within which closures are compared, m")
    patience_m: float = Field(60.0, ge=0, description="path after which an uncontradicted closure is accepted, m")
    max_pending_s: float = Field(30.0, gt=0, description="longest wait of a closure for its odometry, stream time, s")
    origin: str = Field(
        "", description="latitude, longitude (deg), height (m) of the world frame; empty: by GNSS fixes"
    )
    elevation_model: str = Field("", description="heights of the ground: a GeoTIFF or an .asc; empty: none")
    elevation_sigma_m: float = Field(0.5, gt=0, description="standard deviation of its heights, m")
    elevation_start: str = Field("", description="x, y (m), heading (deg) of the first pose in the model; empty: GNSS")
    reject_outliers: bool = Field(True, description="reject outliers and scale the noise; false: accept all closures")


class LocalizationSettings(Group):
    """Use of a drive that localised in a map."""

    update: bool = Field(False, description="it joins the map at ~/save and at the end; needs a folder of results")
    initial_pose: str = Field(
        "",
        description="x and y (m) and heading (deg) in the map where the rover may start, verified like a closure; "
        "empty: the last pose in results_dir, if there is one",
    )


class TerrainSettings(Group):
    """The map of the ground: limits of the rover, and bounds of what is published."""

    cell_m: float = Field(0.2, ge=0.05, le=2, description="side of voxels and of cells of the grid, m")
    footprint_m: float = Field(1.0, gt=0, le=10, description="width of the ground under the rover, m")
    max_slope_deg: float = Field(20.0, gt=0, lt=90, description="steepest ground that is free, deg")
    max_step_m: float = Field(0.25, gt=0, description="highest step between neighbouring cells that is free, m")
    max_roughness_m: float = Field(0.1, gt=0, description="largest deviation of the ground from a plane, m")
    clearance_m: float = Field(2.0, gt=0, description="height above the ground from which on nothing is in the way, m")
    max_cells: int = Field(
        25_000_000,
        ge=10_000,
        description="max cells of the published grid, beyond which it is cropped around the rover, and of map.pgm, "
        "beyond which its cells get wider",
    )
    period_s: float = Field(2.0, gt=0, description="shortest time between two publications, s")
    max_bytes_per_s: float = Field(1e6, gt=0, description="largest mean rate of cloud and grid together, bytes/s")


class FrameIds(Group):
    """Names of the coordinate frames (REP-105)."""

    map: str = Field("map", description="map frame")
    odom: str = Field("odom", description="odometry frame, where the odometry's messages name none")
    base: str = Field("base_link", description="body frame of calibration, transforms and closures")
    extrinsics: Literal["tf", "calibration"] = Field(
        "tf",
        description="extrinsics of camera and LiDAR: /tf_static where it has them, or the calibration file alone; "
        "a named data set keeps its own",
    )
    publish_tf: bool = Field(False, description="publish map -> odom on /tf when tf2_ros is installed")


class Database(Group):
    """Storage of places."""

    path: str = Field("", description="file of the place database, loaded when it exists; empty: a temporary file")
    cached_keyframes: int = Field(400, ge=20, description="keyframes whose local features stay in memory")
    backend: Literal["sqlite", "postgres"] = Field(
        "sqlite", description="postgres: also push places to a fleet's server and query those of other rovers"
    )
    server: Annotated[str, AfterValidator(without_password)] = Field(
        "", description="fleet server, postgresql://ROVER@HOST/DATABASE; the password is in ~/.pgpass or PGPASSWORD"
    )
    fleet_candidates: int = Field(5, ge=1, le=50, description="places of other rovers per keyframe to verify")


class WorkerSettings(Group):
    """Worker thread of the live node."""

    queue_size: int = Field(10, ge=1, le=1000, description="frames queued at most; the oldest is dropped and counted")
    finish_s: float = Field(2.0, ge=0, le=60, description="time at shutdown to process frames that wait [s]")


class Settings(Group):
    """All settings."""

    dataset: Dataset = Field(DEFAULT_DATASET, description="calibration and topics: a file in `config/datasets` by name")
    calibration: str = Field("", description="YAML file; tf: /tf_static and camera_info alone; empty: the data set's")
    mode: Literal["mapping", "localization"] = Field(
        "mapping", description="mapping, or localization in the map that `map` names"
    )
    map: str = Field("", description="folder of a map that `umf map` made, for mode localization")
    localization: LocalizationSettings = LocalizationSettings()
    topics: Topics = Topics()
    absolute: AbsoluteTopics = AbsoluteTopics()
    qos: Qos = Qos()
    sync: Sync = Sync()
    odometry: OdometrySettings = OdometrySettings()
    keyframe: KeyframePolicy = KeyframePolicy()
    embedding: EmbeddingSettings = EmbeddingSettings()
    loop: Loop = Loop()
    verification: Verification = Verification()
    pose_graph: PoseGraphSettings = PoseGraphSettings()
    terrain: TerrainSettings = TerrainSettings()
    frames: FrameIds = FrameIds()
    database: Database = Database()
    worker: WorkerSettings = WorkerSettings()

    @model_validator(mode="after")
    def _check_map(self) -> Settings:
        if self.localizing and not self.map:
            raise ValueError("mode localization needs a map: the parameter map names its folder")
        return self

    @property
    def localizing(self) -> bool:
        """Whether the rover is localised in a fixed map."""
        return self.mode == "localization"

    @property
    def grows_map(self) -> bool:
        """Whether what is seen while localising becomes a part of the map."""
        return self.localizing and self.localization.update

    @property
    def uses_transforms(self) -> bool:
        """Whether `/tf_static` says where the sensors are: a data set that was chosen has a calibration of its own."""
        if self.calibration == TRANSFORMS:
            return True
        return self.frames.extrinsics == "tf" and self.dataset == DEFAULT_DATASET


@dataclass(frozen=True)
class Parameters:
    """A parameter file, if there is one, with changes to it: overrides of `load_settings`."""

    path: Path | None = None
    changes: Mapping[str, Any] = field(default_factory=dict)


ParameterSource = str | Path | Parameters | None


def load_settings(source: ParameterSource = None, **overrides: Any) -> Settings:
    """Return the settings in a YAML file, plain or with ROS parameters (`/**: ros__parameters:`); None: the defaults.

    Overrides are by dotted name with `__` for the dot, as in `loop__top_k=10`; None is skipped. Relative paths in the
    file are relative to it, those of overrides to the working folder; both are returned as absolute ones.

    Raises:
        ConfigError: the file cannot be read or is empty, or a name, type or value is wrong.
    """
    chosen = source if isinstance(source, Parameters) else Parameters(Path(source) if source else None)
    path, overrides = chosen.path, {**chosen.changes, **{k: v for k, v in overrides.items() if v is not None}}
    values = _read_parameters(path) if path else {}
    given = {name.replace("__", "."): value for name, value in overrides.items()}
    for name, value in given.items():
        _set(values, name.split("."), _anchored(name, value, Path()))
    if values.get("dataset") == AUTO:
        del values["dataset"]
    try:
        return Settings.model_validate(values)
    except ValidationError as error:
        named = {".".join(map(str, problem["loc"])) for problem in error.errors()}
        raise ConfigError(f"{path}: {_problems(error)}" if path and named - set(given) else _problems(error)) from None


def parse_changes(changes: Iterable[str]) -> dict[str, Any]:
    """Return overrides of `load_settings` from texts such as "loop.top_k=20", whose values are YAML.

    Raises:
        ConfigError: a text has no name or no value.
    """
    found = {}
    for change in changes:
        name, equals, text = change.partition("=")
        try:
            value = yaml.safe_load(text)
        except yaml.YAMLError:
            value = text
        if not name or not equals:
            raise ConfigError(f"--set {change}: expected NAME=VALUE, as in loop.top_k=20")
        found[name.strip().replace(".", "__")] = "" if value is None else value
    return found


_PATHS = ("calibration", "map", "embedding.weights", "database.path")


def _anchored(name: str, value: Any, folder: Path) -> Any:
    """Return the value of a parameter, a relative path of a file as the absolute one below a folder."""
    if name not in _PATHS or not isinstance(value, str) or value in ("", TRANSFORMS, *dataset_names()):
        return value
    return str((folder / value).absolute())


def _read_parameters(path: Path) -> dict[str, Any]:
    content = read_values(path)
    if not content:
        raise ConfigError(f"{path} is empty: it sets no parameter")
    values = _node_parameters(content, path)
    for name in _PATHS:
        group, _, last = name.rpartition(".")
        holder = values.get(group) if group else values
        if isinstance(holder, dict) and last in holder:
            holder[last] = _anchored(name, holder[last], path.parent)
    return values


def load_preset(dataset: str) -> DatasetPreset:
    """Return the preset of a data set, its calibration as a path that can be opened.

    Raises:
        UmfError: there is no such data set.
        ConfigError: its file cannot be read, or a name, type or value is wrong.
    """
    path = find(f"config/datasets/{dataset}.yaml")
    try:
        preset = DatasetPreset.model_validate(read_values(path))
    except ValidationError as error:
        raise ConfigError(f"{path}: {problems(error)}") from None
    return preset.model_copy(update={"calibration": path.parent / preset.calibration})


def topics_of(settings: Settings) -> Topics:
    """Return the input topics: those of the data set, except where the settings differ from the defaults."""
    defaults = Topics().model_dump()
    own = {name: topic for name, topic in settings.topics.model_dump().items() if topic != defaults[name]}
    return load_preset(settings.dataset).topics.model_copy(update=own)


def parse_settings(values: dict[str, Any]) -> Settings:
    """Return settings from a nested dictionary.

    Raises:
        ConfigError: names every wrong entry on one line.
    """
    try:
        return Settings.model_validate(values)
    except ValidationError as error:
        raise ConfigError(_problems(error)) from None


def dump_settings(settings: Settings) -> str:
    """Return the effective settings as YAML that `load_settings` and a ROS node both read."""
    body = {"/**": {"ros__parameters": settings.model_dump()}}
    return yaml.safe_dump(body, sort_keys=False, allow_unicode=True)


def nest(flat: dict[str, Any]) -> dict[str, Any]:
    """Return `{"a.b": 1}` as `{"a": {"b": 1}}`."""
    nested: dict[str, Any] = {}
    for name, value in sorted(flat.items(), key=lambda one: one[0].count(".")):  # a group never replaces its values
        _set(nested, name.split("."), value)
    return nested


def _set(values: dict[str, Any], path: list[str], value: Any) -> None:
    for part in path[:-1]:
        values = values.setdefault(part, {})
        if not isinstance(values, dict):
            raise ConfigError(f"{part}: holds settings, not a value")
    values[path[-1]] = value


def _node_parameters(content: dict[str, Any], path: str | Path) -> dict[str, Any]:
    """Return the settings in a ROS parameter file, or in a plain one; both may have dotted names."""
    blocks = [block for block in content.values() if isinstance(block, dict) and "ros__parameters" in block]
    if not blocks:
        return nest(content)
    if len(blocks) != len(content):
        raise ConfigError(f"{path}: mixes node parameters with plain settings")
    flat: dict[str, Any] = {}
    for block in blocks:
        flat |= {name: value for name, value in (block["ros__parameters"] or {}).items() if name not in NODE_ONLY}
    return nest(flat)


NODE_ONLY = frozenset({"use_sim_time", "results_dir", "autostart"})


def problems(error: ValidationError, known: Collection[str] = ()) -> str:
    """Return every wrong value with its error, on one line; for an unknown name the nearest of the `known` ones."""
    return "; ".join(_explain(problem, known) for problem in error.errors())


def _problems(error: ValidationError) -> str:
    return problems(error, _names())


@cache
def _names() -> tuple[str, ...]:
    """Return the names of all parameters and groups."""
    names = dict.fromkeys(Settings.model_fields)
    for group, info in Settings.model_fields.items():
        names |= dict.fromkeys(f"{group}.{name}" for name in getattr(info.annotation, "model_fields", ()))
    return tuple(names)


def _nearest(name: str, known: Collection[str]) -> str:
    """Return the known name with the same last part, or else the most similar one; empty without one."""
    last = name.rpartition(".")[2]
    same = [one for one in known if one.rpartition(".")[2] == last]
    return next(iter(same or get_close_matches(name, known, 1)), "")


def _explain(problem: Any, known: Collection[str]) -> str:
    name = ".".join(str(part) for part in problem["loc"])
    text = str(problem["msg"]).removeprefix("Value error, ")
    if not name:  # of several values together
        return text
    if problem["type"] == "extra_forbidden":
        nearest = _nearest(name, known)
        return f"unknown parameter {name}" + (f"; did you mean {nearest}?" if nearest else "")
    if problem["type"] == "missing":
        return f"{name} is missing"
    got = "" if problem["type"] == "value_error" else f" (got {problem['input']!r})"  # may hold a password
    return f"{name}: {text[0].lower()}{text[1:]}{got}"
