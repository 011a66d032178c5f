"""Which seeds belong to whom, so that nothing is ever tested on a world it was trained or tuned on."""

from __future__ import annotations

from umf_ros.core.errors import ConfigError

TRAINING = range(0, 10_000)
VALIDATION = range(10_000, 20_000)
TEST = range(20_000, 30_000)
"""Seeds from 30,000 on are free for a user's own worlds and are never drawn by this package."""


def check_seed(seed: int) -> int:
    """The seed itself.

    Raises:
        ConfigError: the seed is negative or does not fit 32 bits.
    """
    if not 0 <= seed < 2**32:
        raise ConfigError(f"seed {seed} is not between 0 and 4294967295")
    return seed
