"""Fixtures: the served app, and all that holds in the tests of the service."""

from tests.api.conftest import *  # noqa: F403
