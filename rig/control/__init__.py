"""The rig as others see it: requests, tests one at a time, and a latch that only a person opens."""
