"""How long to wait after a failure: longer each time, and never all rigs at once."""

from __future__ import annotations

import random

FIRST_S, LONGEST_S = 1.0, 300.0


class Backoff:
    """Waits from 1 s to 5 min, by chance up to half shorter."""

    def __init__(self, chance: random.Random, first_s: float = FIRST_S) -> None:
        self.chance, self.first_s, self.failures = chance, first_s, 0

    def next_s(self) -> float:
        """The next wait, s."""
        wait_s = min(LONGEST_S, self.first_s * 2.0 ** min(self.failures, 20))
        self.failures += 1
        return max(FIRST_S, wait_s * self.chance.uniform(0.5, 1.0))

    def reset(self) -> None:
        """It went well."""
        self.failures = 0
