from __future__ import annotations

import pytest
from submaps_drives import Drive, drive, rough_ground

from umf_ros.core.config import Database
from umf_ros.places.database import PlaceDatabase


@pytest.fixture(scope="session")
def outing() -> Drive:
    return drive(rough_ground(5))


@pytest.fixture
def database() -> PlaceDatabase:
    return PlaceDatabase(Database(), "none", 2)
