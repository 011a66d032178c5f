"""The eight families of worlds [UMF 5.1.4]: what is typical for each, as ranges to draw from."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from umf_ros.core.errors import ConfigError

Range = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Traits:
    """The numbers behind one world.

    Attributes:
        relief: standard deviation of the fractal relief, m.
        lumps: amplitude of the metre-scale unevenness, m.
        craters: number of small craters.
        great_crater: radius of the one large crater, m; 0 for none.
        dune_height: half the height of the dunes, m.
        dune_length: distance from crest to crest, m.
        cliff: height of the mesas (positive) or depth of the canyons (negative), m.
        mounds: number of mounds.
        rocks: number of rocks.
        rock_slope: exponent of the cumulative size distribution of the rocks.
        largest_rock: diameter, m.
        hills: height of the mountains on the horizon, m.
        albedo: mean reflectance of the ground.
        rock_albedo: how much brighter (positive) the rocks are, in units of exp(1).
        contrast: how strongly the ground's brightness varies.
        strata: contrast of the layers in cliffs and rocks.
        sky: brightness of the sky; 0 is black.
        ambient: light that reaches the shadows, as a share of the sun's.
        haze_m: distance over which haze swallows contrast.
        backscatter: 0 for a matt ground, 1 for one that shines back like the Moon's.
    """

    relief: float
    lumps: float
    craters: float
    great_crater: float
    dune_height: float
    dune_length: float
    cliff: float
    mounds: float
    rocks: float
    rock_slope: float
    largest_rock: float
    hills: float
    albedo: float
    rock_albedo: float
    contrast: float
    strata: float
    sky: float
    ambient: float
    haze_m: float
    backscatter: float


_EARTHLIKE: dict[str, Range] = {
    "relief": (1.0, 2.4),
    "lumps": (0.04, 0.09),
    "craters": (0, 8),
    "great_crater": (0, 0),
    "dune_height": (0, 0.15),
    "dune_length": (9, 18),
    "cliff": (0, 0),
    "mounds": (0, 25),
    "rocks": (9000, 22000),
    "rock_slope": (1.5, 1.9),
    "largest_rock": (2.5, 4.5),
    "hills": (20, 70),
    "albedo": (0.15, 0.22),
    "rock_albedo": (-0.15, 0.25),
    "contrast": (0.8, 1.2),
    "strata": (0, 0.1),
    "sky": (0.16, 0.36),
    "ambient": (0.16, 0.28),
    "haze_m": (1200, 3000),
    "backscatter": (0.1, 0.3),
}

_DIFFERENT: dict[str, dict[str, Range]] = {
    "etna": {
        "great_crater": (18, 36),
        "craters": (5, 40),
        "mounds": (10, 40),
        "rocks": (14000, 26000),
        "rock_slope": (1.45, 1.7),
        "albedo": (0.1, 0.17),
        "dune_height": (0, 0.4),
    },
    "moon": {
        "craters": (50, 120),
        "great_crater": (14, 34),
        "rocks": (7000, 18000),
        "mounds": (0, 5),
        "dune_height": (0, 0),
        "albedo": (0.2, 0.28),
        "rock_albedo": (0.1, 0.35),
        "contrast": (0.7, 1.0),
        "strata": (0, 0),
        "sky": (0, 0),
        "ambient": (0.03, 0.05),
        "haze_m": (1e7, 1e7),
        "backscatter": (0.8, 1.0),
    },
    "canyon": {
        "cliff": (-14, -7),
        "rocks": (10000, 20000),
        "strata": (0.25, 0.45),
        "albedo": (0.2, 0.3),
        "relief": (0.8, 1.6),
    },
    "terrain": {"relief": (1.8, 3.0), "rocks": (11000, 22000), "mounds": (10, 40)},
    "dunes": {
        "dune_height": (0.4, 0.75),
        "rocks": (5000, 10000),
        "rock_slope": (1.3, 1.6),
        "albedo": (0.22, 0.3),
        "relief": (0.8, 1.6),
    },
    "mesa": {
        "cliff": (5, 11),
        "rocks": (10000, 20000),
        "strata": (0.25, 0.45),
        "albedo": (0.2, 0.3),
        "relief": (0.7, 1.4),
    },
    "mounds": {"mounds": (120, 260), "rocks": (7000, 16000), "relief": (0.7, 1.4)},
}

FAMILIES = (*_DIFFERENT, "random")
"""Names of the families; `random` takes every trait from a family of its own choice."""


def draw_traits(family: str, rng: np.random.Generator) -> Traits:
    """The traits of one world of a family.

    Raises:
        ConfigError: there is no such family.
    """
    if family not in FAMILIES:
        raise ConfigError(f"unknown family {family!r}; expected one of {', '.join(FAMILIES)}")
    names = [field.name for field in fields(Traits)]
    donors = rng.choice(list(_DIFFERENT), len(names)) if family == "random" else [family] * len(names)
    sky_donor = donors[names.index("sky")]
    values = {}
    for name, donor in zip(names, donors, strict=True):
        # what makes the light of a planet belongs together, or a black sky would cast soft shadows
        owner = sky_donor if name in ("ambient", "haze_m", "backscatter") else donor
        low, high = {**_EARTHLIKE, **_DIFFERENT[str(owner)]}[name]
        values[name] = float(rng.uniform(low, high))
    return Traits(**values)
