"""What a place is to the domains, and all kinds of them; a new kind is a class in a file of its own and a row here."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Protocol

from numpy.typing import ArrayLike

from umf_ros.core.geometry import Array
from umf_ros.lab.simulation.domains.indoors import Corridor, Rooms
from umf_ros.lab.simulation.domains.landscape import Landscape
from umf_ros.lab.simulation.domains.quarry import Quarry
from umf_ros.lab.simulation.domains.solids import Scene
from umf_ros.lab.simulation.domains.street import Street
from umf_ros.lab.simulation.domains.trees import Trees
from umf_ros.lab.simulation.world import World

ALIASING = 0.6  # of the landscapes: most of their rocks and lumps come again elsewhere


class Place(Protocol):
    """A world that a carrier can drive through more than once."""

    @property
    def trail(self) -> Array:
        """(N, 2) dense closed curve that stays clear, m."""

    @property
    def lateral_m(self) -> float:
        """How far beside the trail it can be driven."""

    def height(self, x: ArrayLike, y: ArrayLike) -> Array:
        """Height of the ground under points, m."""

    def scene(self, visit: int) -> Scene:
        """What there is to see during one visit: cars and chairs move between visits."""


@dataclass(frozen=True, slots=True)
class Kind:
    """One kind of place.

    Attributes:
        build: the place of a seed.
        scale: of distances, 1 in the open: indoors the same step shows another place sooner.
    """

    build: Callable[[int], Place]
    scale: float


def _landscape(seed: int, family: str) -> Landscape:
    return Landscape(World(seed, family, ALIASING))


PLACES: dict[str, Kind] = {
    "corridor": Kind(Corridor, 0.5),
    "rooms": Kind(Rooms, 0.4),
    "street": Kind(Street, 1.0),
    "orchard": Kind(partial(Trees, regular=True), 0.8),
    "woods": Kind(partial(Trees, regular=False), 0.8),
    "quarry": Kind(Quarry, 1.0),
    "etna": Kind(partial(_landscape, family="etna"), 1.0),
    "moon": Kind(partial(_landscape, family="moon"), 1.0),
    "canyon": Kind(partial(_landscape, family="canyon"), 1.0),
    "dunes": Kind(partial(_landscape, family="dunes"), 1.0),
}
