"""The rig as others see it: tests one at a time, a Unix socket, and a latch that only a person opens."""
